//! `surfaced import csv`: turns CSV tables into a library.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::show::{self, counted, quoted};
use super::{Done, Failure, bad_files, parsed};
use crate::dataset::csv::{Clock, CsvForm, CsvTable, NamePattern};
use crate::library::{LibraryError, files};
use crate::record::{TrialOptions, check_writable, write_library_toml, write_trial};
use crate::scene::{LibraryToml, Scene, SourceId};
use crate::trial::{Signal, Trial, TrialKey};

/// Names by which a column of times is recognised, each with the length of its unit in seconds.
const TIMES: [(&str, f64); 8] = [
    ("time", 1.0),
    ("t", 1.0),
    ("timestamp", 1.0),
    ("time_s", 1.0),
    ("time_ms", 1e-3),
    ("t_ms", 1e-3),
    ("time_us", 1e-6),
    ("time_ns", 1e-9),
];

/// Make a library from CSV tables, one for each trial, or a long one with columns that name trials
///
/// Columns may be separated by commas, semicolons, tabs or spaces. --dry-run shows what was understood,
/// and writes nothing.
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
    /// Column of times, to which rows are resampled (default: `time`, `t`, `timestamp`, `time_ms`, …)
    #[arg(long, value_name = "COLUMN", conflicts_with = "rate")]
    time: Option<String>,
    /// Length of the unit of time in seconds, such as 0.001 (default: by the column's name, else 1)
    #[arg(long, value_name = "SECONDS", value_parser = super::seconds)]
    time_unit: Option<f64>,
    /// Column with the surface, in a long table
    #[arg(long, value_name = "COLUMN")]
    surface: Option<String>,
    /// Column with the person
    #[arg(long, value_name = "COLUMN")]
    user: Option<String>,
    /// Column with the number of the trial
    #[arg(long, value_name = "COLUMN")]
    trial: Option<String>,
    /// Pattern of the file names without extension; * matches any text
    #[arg(long, value_name = "PATTERN", default_value = "{surface}/{trial}", value_parser = pattern)]
    names: NamePattern,
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
    let expected = "a whole number of rows a second; for another, give --time";
    parsed(text, |hz| *hz > 0, expected).map(|hz: u32| f64::from(hz))
}

fn pattern(text: &str) -> Result<NamePattern, String> {
    match text.contains("{surface}") {
        true => Ok(NamePattern(text.into())),
        false => Err("expected a pattern with {surface}, such as {surface}_{user}_{trial}".into()),
    }
}

pub(super) fn run(args: &CsvArgs) -> Done {
    let mut tables = Vec::new();
    args.tables.iter().try_for_each(|path| find(path, &mut tables))?;
    let Some(first) = tables.first() else {
        let problem = "no table is there; expected files whose names end with .csv, .tsv or .txt";
        return Err(Failure::at(&args.tables[0], problem));
    };
    if args.out.exists() && !files::list(&args.out)?.is_empty() {
        return Err(Failure::usage_at(&args.out, "the library is there already; name another"));
    }
    let form = understood(args, &CsvTable::read(first)?)?;
    let (mut trials, mut bad, mut uneven_hz) = (Vec::<Trial>::new(), Vec::new(), None);
    let mut keys = BTreeSet::new();
    for path in &tables {
        let name = path.with_extension("").to_string_lossy().replace('\\', "/");
        let problem = |problem| LibraryError::file(path, problem);
        match CsvTable::read(path).and_then(|t| t.trials(&name, &form).map_err(problem)) {
            Err(error) => bad.push(error),
            Ok((found, rate_hz)) => {
                uneven_hz = uneven_hz.or(rate_hz);
                for trial in found {
                    match keys.insert(trial.key.clone()) {
                        true => trials.push(trial),
                        false => bad.push(problem(format!(
                            "another file holds {}, too; give --names a pattern with {{trial}}",
                            trial.key
                        ))),
                    }
                }
            }
        }
    }
    if trials.is_empty() {
        return Err(LibraryError::of_all(bad)
            .map_or_else(|| Failure::Failed("no trial was found".into()), Failure::from));
    }
    print(&form, &trials, uneven_hz);
    bad_files::skip(&args.out, bad)?;
    if args.dry_run {
        say!("nothing is written; leave --dry-run out to write {}", args.out.display());
        return Ok(());
    }
    write(&args.out, &trials)?;
    say!("wrote {} to {}", counted(trials.len(), "trial"), args.out.display());
    show::next(&format!("surfaced check {}", quoted(&args.out)));
    Ok(())
}

/// Adds the tables at a path, which is a single file or a folder with tables and subfolders.
fn find(path: &Path, tables: &mut Vec<PathBuf>) -> Done {
    if !path.is_dir() {
        tables.push(path.to_path_buf());
        return Ok(());
    }
    for item in files::list(path)?.iter().filter(|item| !item.is_hidden()) {
        let extension = item.stem_and_extension().1;
        if item.is_dir {
            find(&item.path, tables)?;
        } else if ["csv", "tsv", "txt"].contains(&&*extension) {
            tables.push(item.path.clone());
        }
    }
    Ok(())
}

/// Determines the meaning of the columns from the arguments and the first table.
fn understood(args: &CsvArgs, first: &CsvTable) -> Result<CsvForm, Failure> {
    let guessed = || {
        let column = |(name, _): &(&str, f64)| {
            first.header.iter().find(|column| column.eq_ignore_ascii_case(name)).cloned()
        };
        TIMES.iter().find_map(column)
    };
    let clock = match (args.rate, args.time.clone().or_else(guessed)) {
        (Some(rate_hz), _) => Clock::Rate(rate_hz),
        (None, Some(column)) => {
            let known = TIMES.iter().find(|(name, _)| column.eq_ignore_ascii_case(name));
            let unit_s = args.time_unit.or(known.map(|(_, unit_s)| *unit_s)).unwrap_or(1.0);
            Clock::Times { column, unit_s }
        }
        (None, None) => {
            return Err(Failure::Usage(
                "the rate is not known: give --rate HZ, or --time COLUMN for a column of times"
                    .into(),
            ));
        }
    };
    let labels = [&args.surface, &args.user, &args.trial].map(Clone::clone);
    let sources =
        if args.source.is_empty() { grouped(first, &clock, &labels)? } else { args.source.clone() };
    Ok(CsvForm { sources, clock, labels, names: args.names.clone() })
}

/// Groups columns into sources by name. Columns whose names differ only after the last `_`, `.`,
/// `-` or space, or in a last digit, are channels of one source.
fn grouped(
    first: &CsvTable,
    clock: &Clock,
    labels: &[Option<String>; 3],
) -> Result<Vec<(SourceId, Vec<String>)>, Failure> {
    let is_time = |name: &str| {
        matches!(clock, Clock::Times { column, .. } if column == name)
            || TIMES.iter().any(|(time, _)| name.eq_ignore_ascii_case(time))
    };
    let mut sources: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for name in first.numeric() {
        if is_time(&name) || labels.iter().flatten().any(|label| *label == name) {
            continue;
        }
        let stem = name.trim_end_matches(|c: char| c.is_ascii_digit());
        let stem = stem.rsplit_once(['_', '.', '-', ' ']).map_or(stem, |(stem, _)| stem);
        let plain: String = stem.chars().filter(char::is_ascii_alphanumeric).collect();
        let id = if plain.is_empty() { "sensor".to_string() } else { plain.to_ascii_lowercase() };
        sources.entry(id).or_default().push(name);
    }
    if sources.is_empty() {
        return Err(Failure::Failed(format!(
            "no column of samples is left; the columns: {}",
            first.header.join(", ")
        )));
    }
    let named = |(id, columns): (String, Vec<String>)| Ok((SourceId::new(&id)?, columns));
    sources.into_iter().map(named).collect()
}

fn print(form: &CsvForm, trials: &[Trial], uneven_hz: Option<f64>) {
    let rows = form.sources.iter().map(|(id, columns)| {
        let series = trials.iter().find_map(|trial| match trial.signals.get(id) {
            Some(Signal::Series(series)) => Some(series),
            _ => None,
        });
        let rate = series.map_or_else(String::new, |series| format!("{} Hz", series.rate_hz()));
        vec![id.to_string(), columns.join(", "), rate]
    });
    show::table(&["source", "columns", ">rate"], rows);
    result!();
    let mut surfaces: BTreeMap<&str, (usize, BTreeSet<&str>, f64)> = BTreeMap::new();
    for trial in trials {
        let TrialKey { surface, user, .. } = &trial.key;
        let of = surfaces.entry(surface).or_default();
        of.0 += 1;
        of.1.insert(user);
        of.2 += trial.longest_s(|_| true).unwrap_or(0.0);
    }
    let rows = surfaces.iter().map(|(surface, (count, users, seconds))| {
        let mean = format!("{:.1} s", seconds / *count as f64);
        vec![(*surface).to_string(), count.to_string(), mean, show::listed(users)]
    });
    show::table(&["surface", ">trials", ">mean length", "by"], rows);
    if let (Clock::Times { column, .. }, Some(hz)) = (&form.clock, uneven_hz) {
        say!(
            "rows come {hz:.1} times a second by `{column}`; they are resampled by straight lines"
        );
    }
}

/// Writes the trials as a library, whose description lists the sources of the trials.
fn write(out: &Path, trials: &[Trial]) -> Done {
    let mut text = String::from("format = 1\n");
    let mut written = BTreeSet::new();
    for (id, signal) in trials.iter().flat_map(|trial| &trial.signals) {
        if let (Signal::Series(series), true) = (signal, written.insert(id)) {
            let channels = series.channels();
            text += &format!("[sources.{id}]\ndomain = \"time\"\nchannels = {channels}\n");
        }
    }
    let scene = LibraryToml::parse(&text, &Scene::lmt108())?.sources;
    check_writable(out)?;
    let name = out.file_name().map(|name| name.to_string_lossy()).unwrap_or_default();
    write_library_toml(out, &scene, &name, false)?;
    let options = TrialOptions { durable: false, ..TrialOptions::default() };
    for trial in trials {
        write_trial(out, trial, &scene, &options)?;
    }
    Ok(())
}
