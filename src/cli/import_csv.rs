//! `surfaced import csv`: turns tables into a library.

mod summary;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use summary::Summary;

use super::show::{self, counted, quoted};
use super::{Done, Failure, Named, bad_files, one_of, parsed};
use crate::dataset::tables::{
    self, Clock, Form, Gaps, Head, NamePattern, Read, SessionOf, array_file, columns,
};
use crate::library::{LibraryError, files};
use crate::record::importing::Importing;
use crate::record::{TrialOptions, check_writable, write_library_toml, write_trial};
use crate::scene::{LibraryToml, Scene, SourceId};
use crate::trial::TrialKey;

const TABLES: [&str; 12] =
    ["csv", "tsv", "txt", "lvm", "dat", "asc", "log", "gz", "npy", "npz", "mat", "parquet"];
/// Extensions of tables that are refused, with the reason.
const REFUSED: [&str; 7] = ["xlsx", "xls", "ods", "feather", "h5", "tdms", "zip"];

const GAPS: [Named<Gaps>; 2] = [
    (Gaps::Cut, "cut", "Cut the trial there, and make a trial of each part"),
    (Gaps::Error, "error", "Do not use the trial"),
];

/// Make a library from CSV tables, one for each trial, or a long one with columns that name trials
///
/// Understands what separates the columns, names and units above them, decimal commas, packed files
/// (.gz), and times in any unit, as dates or in Excel's days. --dry-run shows what was understood, and
/// writes nothing.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced import csv recordings --out my-library --rate 1000 \
                        --dry-run\n  surfaced import csv recordings --out my-library --names \
                        '{surface}/{user}_{trial}' --time time_ms --source acc=ax,ay,az --source \
                        force=f\n  surfaced import csv all.csv --out my-library --rate 100 \
                        --surface material --user person --trial run\n\nTime: some seconds for a \
                        hundred megabytes")]
pub(super) struct CsvArgs {
    /// Tables, or folders that hold them
    #[arg(required = true)]
    tables: Vec<PathBuf>,
    /// The library to make; it must not exist yet
    #[arg(long, value_name = "LIBRARY")]
    out: PathBuf,
    /// A source and the columns that are its channels (default: columns whose names differ only at
    /// the end, such as acc_x and acc_y, are one source)
    #[arg(long, value_name = "ID=COLUMN,…", value_parser = source)]
    source: Vec<(SourceId, Vec<String>)>,
    /// Number of rows per second
    #[arg(long, value_name = "HZ", value_parser = rate)]
    rate: Option<f64>,
    /// Column of times, to which rows are resampled (default: by names such as `time` or `timestamp`, or a
    /// column of dates)
    #[arg(long, value_name = "COLUMN", conflicts_with = "rate")]
    time: Option<String>,
    /// Length of the unit of time in seconds, such as 0.001 (default: by the column's header, or its values)
    #[arg(long, value_name = "SECONDS", value_parser = unit)]
    time_unit: Option<f64>,
    /// Column with the surface, in a long table (for arrays, as --labels)
    #[arg(long, value_name = "COLUMN")]
    surface: Option<String>,
    /// Column with the person, or array or file with that of each trial
    #[arg(long, value_name = "COLUMN")]
    user: Option<String>,
    /// Column with the number of the trial
    #[arg(long, value_name = "COLUMN")]
    trial: Option<String>,
    /// The session, one sitting of one person: a column, an array, a pattern of the file names with
    /// {session}, `file` (each file is a session), or `none` (default: {session} in --names, else none)
    #[arg(long, value_name = "COLUMN|PATTERN|file|none")]
    session: Option<String>,
    /// Pattern of the file names without extension; * matches any text (default: {surface}/{trial})
    #[arg(long, value_name = "PATTERN", value_parser = pattern)]
    names: Option<NamePattern>,
    /// Labels of the trials of an array: an array of the .npz or .mat, or a file (.npy, or a label a line)
    #[arg(long, value_name = "ARRAY|FILE", conflicts_with = "surface")]
    labels: Option<String>,
    /// Array of an .npz or .mat that holds the trials, or cell array whose cells are trials (default: the
    /// only one of two or three dimensions)
    #[arg(long, value_name = "ARRAY")]
    variable: Option<String>,
    /// How to treat gaps of more than 5 samples in a row; shorter ones are filled in, up to 5 % of a channel
    #[arg(long, default_value = "cut", value_parser = one_of(GAPS))]
    gaps: Gaps,
    /// Count Excel's days from 1904, as old Macs do
    #[arg(long)]
    from_1904: bool,
    /// Size to which a packed file may unpack, in gigabytes
    #[arg(long, value_name = "GB", default_value_t = 8, value_parser = clap::value_parser!(u64).range(1..1000))]
    max_gb: u64,
    /// Show what was understood, and write nothing
    #[arg(long)]
    dry_run: bool,
}

fn source(text: &str) -> Result<(SourceId, Vec<String>), String> {
    let (id, columns) = text.split_once('=').ok_or("expected ID=COLUMN,COLUMN")?;
    let columns = columns.split(',').map(|name| name.trim().to_string()).collect();
    Ok((SourceId::new(id).map_err(|error| error.to_string())?, columns))
}

fn rate(text: &str) -> Result<f64, String> {
    parsed(
        text,
        |hz: &f64| (0.01..1e9).contains(hz),
        "a number of rows a second, such as 100 or 12.5",
    )
}

fn unit(text: &str) -> Result<f64, String> {
    let expected = "a number of seconds up to that of a day, such as 0.001 or 86400";
    parsed(text, |s: &f64| (1e-9..=86_400.0).contains(s), expected)
}

fn pattern(text: &str) -> Result<NamePattern, String> {
    match ["{surface}", "{user}", "{trial}", "{session}"].iter().any(|field| text.contains(field)) {
        true => Ok(NamePattern(text.into())),
        false => Err("expected a pattern such as {surface}_{user}_{trial}".into()),
    }
}

impl CsvArgs {
    /// How the session of a file's trials is named; `None` if a column names it.
    fn session_of(&self) -> Option<SessionOf> {
        match self.session.as_deref() {
            None => Some(SessionOf::Names),
            Some("none") => Some(SessionOf::Nothing),
            Some("file") => Some(SessionOf::File(self.tables.clone())),
            Some(pattern) if pattern.contains("{session}") => {
                Some(SessionOf::Pattern(NamePattern(pattern.into())))
            }
            Some(_) => None,
        }
    }
}

pub(super) fn run(args: &CsvArgs) -> Done {
    let mut ids = BTreeSet::new();
    if let Some((twice, _)) = args.source.iter().find(|(id, _)| !ids.insert(id)) {
        let problem = format!("--source names `{twice}` twice; list all its columns at once");
        return Err(Failure::usage(problem));
    }
    let (mut tables, mut bad) = (Vec::new(), Vec::new());
    args.tables.iter().try_for_each(|path| find(path, &mut tables, &mut bad))?;
    if tables.is_empty() {
        let problem = format!(
            "no table is there; expected files whose names end with .{}. Sounds (.wav, .flac) need no import: a \
             folder for each surface that holds them is a library",
            TABLES.join(", .")
        );
        return Err(LibraryError::of_all(bad)
            .map_or_else(|| Failure::at(&args.tables[0], problem), Failure::from));
    }
    if args.out.exists() && !files::list(&args.out)?.is_empty() {
        return Err(Failure::usage_at(&args.out, "the library is there already; name another"));
    }
    match &args.names {
        _ if args.surface.is_some() || args.labels.is_some() => {}
        Some(names) if names.0.contains("{surface}") => {}
        Some(_) => {
            let problem =
                "nothing names the surface: give --names a pattern with {surface}, or --surface";
            return Err(Failure::usage(problem));
        }
        None => one_folder_a_surface(&args.tables, &tables)?,
    }
    let form = understood(args, &tables, &mut bad)?;
    let staging = if args.dry_run { None } else { Some(Staging::new(&args.out, &form)?) };
    let mut import = Import {
        form: &form,
        keys: BTreeSet::new(),
        folders: BTreeSet::new(),
        taken: BTreeMap::new(),
        summary: Summary::default(),
    };
    if let (None, Some(names)) = (&form.labels[0], &form.names) {
        tables::named(&tables, names).iter().for_each(|key| import.count(key));
    }
    for (at, path) in tables.iter().enumerate() {
        super::say::progress("tables", at, tables.len());
        if let Err(error) = import.table(path, staging.as_ref(), &mut bad) {
            // A full disk is no fault of the table.
            if error.path() == Some(path) { bad.push(error) } else { return Err(error.into()) }
        }
    }
    super::say::end_progress();
    if import.keys.is_empty() {
        return Err(LibraryError::of_all(bad)
            .map_or_else(|| Failure::Failed("no trial was found".into()), Failure::from));
    }
    import.summary.print(&form);
    let (several, all) = (import.summary.of_several, tables.len());
    let has_sessions =
        args.session.is_some() || import.keys.iter().any(|key| key.session.is_some());
    if several > 0 && all > 1 && !has_sessions {
        say!(
            "{several} of {all} tables hold several trials; trials of one sitting resemble each other: \
             --session file makes each table a session, which `eval` leaves out as a whole"
        );
    }
    let are_named = args.names.is_some() || form.labels[0].is_some();
    if let (false, true, Some(key)) = (are_named, tables.len() > 1, import.keys.first())
        && import.keys.iter().all(|other| other.surface == key.surface)
    {
        say!(
            "all trials are of the surface `{}`, the name of their folder; if the names of files name surfaces, say \
             how, such as --names '{{surface}}_{{trial}}'",
            key.surface
        );
    }
    // The tables are not in the library, so that a check of it does not name them.
    bad_files::warn(&args.out, bad, "--strict")?;
    let Some(staging) = staging else {
        say!("nothing is written; leave --dry-run out to write {}", args.out.display());
        return Ok(());
    };
    staging.importing.finish(&args.out)?;
    say!("wrote {} to {}", counted(import.keys.len(), "trial"), args.out.display());
    show::next(&format!("surfaced check {}", quoted(&args.out)));
    Ok(())
}

/// Refuses tables in folders of one name within several others, such as `anna/oak` and `ben/oak`: either folder
/// may be the surface.
fn one_folder_a_surface(given: &[PathBuf], tables: &[PathBuf]) -> Done {
    let mut upper = BTreeMap::new();
    for table in tables {
        let within = given.iter().find_map(|folder| table.strip_prefix(folder).ok());
        let mut above = within.into_iter().flat_map(|path| path.ancestors().skip(1));
        let (Some(folder), Some(parent)) = (above.next(), above.next()) else { continue };
        let (Some(name), Some(other)) = (folder.file_name(), parent.file_name()) else { continue };
        let first = *upper.entry(name).or_insert(other);
        if first != other {
            let [name, first, other] = [name, first, other].map(|name| name.to_string_lossy());
            // A program may write tables of the same names into a folder for each recording.
            let size = |path: &&PathBuf| std::fs::metadata(path).map_or(0, |about| about.len());
            let stem = tables.iter().max_by_key(size).and_then(|path| path.file_stem());
            let alike = tables.iter().filter(|other| other.file_stem() == stem).count();
            let own = stem
                .filter(|_| alike > 2)
                .map(|stem| format!("'{{surface}}/{{trial}}/{}' or ", stem.to_string_lossy()));
            return Err(Failure::usage(format!(
                "both `{first}` and `{other}` hold a folder `{name}`: say what names the surface, by --names \
                 {}'{{user}}/{{surface}}/{{trial}}' or '{{surface}}/{{user}}/{{trial}}', or by \
                 '{{surface}}/{{trial}}' if the upper folder names nothing",
                own.unwrap_or_default()
            )));
        }
    }
    Ok(())
}

/// Adds the tables at a path, which is a single file or a folder with tables and subfolders.
fn find(path: &Path, tables: &mut Vec<PathBuf>, bad: &mut Vec<LibraryError>) -> Done {
    if !path.is_dir() {
        tables.push(path.to_path_buf());
        return Ok(());
    }
    for item in files::list(path)?.iter().filter(|item| !item.is_hidden()) {
        let extension = item.stem_and_extension().1;
        if let Some(why) = item.unusable {
            bad.push(LibraryError::file(&item.path, why));
        } else if item.is_dir {
            find(&item.path, tables, bad)?;
        } else if TABLES.contains(&&*extension) {
            tables.push(item.path.clone());
        } else if REFUSED.contains(&&*extension) {
            let why = format!("a .{extension} file is not read; save its table as CSV");
            bad.push(LibraryError::file(&item.path, why));
        }
    }
    Ok(())
}

/// Determines the meaning of the columns from the arguments and the first table that can be read.
fn understood(args: &CsvArgs, tables: &[PathBuf], bad: &mut Vec<LibraryError>) -> Done<Form> {
    let most_unpacked = args.max_gb << 30;
    if let Some(path) = tables.first().filter(|path| array_file::is_array(path)) {
        return array_form(args, path, most_unpacked);
    }
    let mut unread = Vec::new();
    let mut read = |path| Head::read(path, most_unpacked).map_err(|error| unread.push(error)).ok();
    let first = tables.iter().find_map(|path| Some((path, read(path)?)));
    let Some((path, head)) = first else {
        unread.append(bad);
        let none = || Failure::Failed("no table can be read".into());
        return Err(LibraryError::of_all(unread).map_or_else(none, Failure::from));
    };
    let fail = |problem: String| Failure::from(LibraryError::file(path, problem));
    let form = form(args, most_unpacked);
    let clock = match (args.rate, &args.time) {
        (Some(rate_hz), _) => Clock::Rate(rate_hz),
        (None, Some(column)) => Clock::Times { column: column.clone(), unit_s: args.time_unit },
        (None, None) => {
            columns::oldest_first(&head).map_err(fail)?;
            let found = columns::clock(&head, args.time_unit, args.from_1904).map_err(fail)?;
            let unknown = "the rate is not known: give --rate HZ, or --time COLUMN for a column of \
                           times";
            match (found, head.layout.rate_hz) {
                (Some(column), _) => Clock::Times { column, unit_s: args.time_unit },
                (None, Some(rate_hz)) => Clock::Rate(rate_hz),
                (None, None) => return Err(Failure::usage(unknown)),
            }
        }
    };
    head.layout.notes.iter().for_each(|note| say!("{}: {note}", path.display()));
    let mut sources = args.source.clone();
    if sources.is_empty() {
        let (found, notes) = columns::sources(&head, &clock, &form.labels).map_err(fail)?;
        notes.iter().for_each(|note| say!("{note}"));
        sources = found;
    }
    let units = head.units(&sources).map_err(fail)?;
    let known = head.layout.columns.into_iter().map(|column| column.name).collect();
    Ok(Form { sources, known, units, clock, ..form })
}

/// How to read an array, whose channels are called 1, 2, …
fn array_form(args: &CsvArgs, path: &Path, most_unpacked: u64) -> Done<Form> {
    let rate_hz =
        args.rate.ok_or_else(|| Failure::usage("the rate is not known: give --rate HZ"))?;
    if args.trial.is_some() {
        let problem = "the trials of an array are numbered in their order; leave --trial out";
        return Err(Failure::usage(problem));
    }
    let form = form(args, most_unpacked);
    let (trials, _) = array_file::open(path, &form)?;
    trials.note.iter().for_each(|note| say!("{note}"));
    let mut sources = args.source.clone();
    if sources.is_empty() {
        let names = (1..=trials.channels).map(|channel| channel.to_string()).collect();
        sources = vec![(SourceId::new("sensor")?, names)];
    }
    Ok(Form { sources, clock: Clock::Rate(rate_hz), ..form })
}

/// The part of the form that the arguments alone tell.
fn form(args: &CsvArgs, most_unpacked: u64) -> Form {
    let session = args.session.clone().filter(|_| args.session_of().is_none());
    let surface = args.labels.clone().or_else(|| args.surface.clone());
    Form {
        sources: Vec::new(),
        known: BTreeSet::new(),
        units: Vec::new(),
        clock: Clock::Rate(1.0),
        labels: [surface, args.user.clone(), args.trial.clone(), session],
        // A column then stands among the labels.
        session: args.session_of().unwrap_or(SessionOf::Nothing),
        names: args.names.clone().or_else(|| {
            let usual = NamePattern("{surface}/{trial}".into());
            args.surface.is_none().then_some(usual)
        }),
        variable: args.variable.clone(),
        gaps: args.gaps,
        from_1904: args.from_1904,
        most_unpacked,
    }
}

/// An import that runs: what was read so far.
struct Import<'a> {
    form: &'a Form,
    keys: BTreeSet<TrialKey>,
    /// Surface, user and number of each trial, which name its folder.
    folders: BTreeSet<TrialKey>,
    /// The highest number of the trials of each surface and user.
    taken: BTreeMap<(String, String), u32>,
    summary: Summary,
}

impl Import<'_> {
    fn count(&mut self, key: &TrialKey) {
        let taken = self.taken.entry((key.surface.clone(), key.user.clone())).or_default();
        *taken = key.number.max(*taken);
    }

    /// The number after those of all trials of the surface and user.
    fn next_number(&mut self, key: &TrialKey) -> u32 {
        let most = self.taken.entry((key.surface.clone(), key.user.clone())).or_default();
        *most = most.saturating_add(1);
        *most
    }

    fn table(
        &mut self,
        path: &Path,
        staging: Option<&Staging>,
        bad: &mut Vec<LibraryError>,
    ) -> Result<(), LibraryError> {
        let folder = |staging: &Staging| staging.importing.folder.clone();
        let scratch = staging.map_or_else(std::env::temp_dir, folder);
        let (mut twice, mut trials) = (Vec::new(), 0);
        let said = tables::read(path, self.form, &scratch, &mut |keys, read| match read {
            None => {
                keys.iter().for_each(|key| self.count(key));
                Ok(())
            }
            Some(Read { mut trial, about, is_further }) => {
                if is_further {
                    trial.key.number = self.next_number(&trial.key);
                }
                if !self.keys.insert(trial.key.clone()) {
                    twice.push(format!(
                        "another file holds {}, too; give --names a pattern that tells them apart, by \
                         {{trial}}, {{user}} or {{session}}",
                        trial.key
                    ));
                    return Ok(());
                }
                // Each session may count its trials from 1.
                if !self.folders.insert(trial.key.clone().with_session(None)) {
                    trial.key.number = self.next_number(&trial.key);
                    self.folders.insert(trial.key.clone().with_session(None));
                }
                trials += 1;
                self.summary.add(&trial);
                let Some(staging) = staging else { return Ok(()) };
                let options = TrialOptions { durable: false, about };
                write_trial(&staging.importing.folder, &trial, &staging.scene, &options).map(drop)
            }
        })?;
        let problems = said.bad.iter().chain(&twice);
        bad.extend(problems.map(|problem| LibraryError::file(path, problem)));
        self.summary.said(said);
        self.summary.of_several += usize::from(trials > 1);
        Ok(())
    }
}

struct Staging {
    importing: Importing,
    scene: Scene,
}

impl Staging {
    fn new(out: &Path, form: &Form) -> Done<Self> {
        let mut text = String::from("format = 1\n");
        for (id, columns) in &form.sources {
            let channels = columns.len();
            text += &format!("[sources.{id}]\ndomain = \"time\"\nchannels = {channels}\n");
        }
        let scene = LibraryToml::parse(&text, &Scene::lmt108())?.sources;
        let importing = Importing::begin(out)?;
        check_writable(&importing.folder)?;
        let name = out.file_name().unwrap_or_default().to_string_lossy();
        write_library_toml(&importing.folder, &scene, &name, false)?;
        Ok(Self { importing, scene })
    }
}
