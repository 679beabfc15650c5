//! `surfaced library`: lists the trials of a library, and edits them, which can be undone. Sets its
//! reference surfaces, and shows their drift.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::path::{Path, PathBuf};

use clap::Subcommand;
use jiff::Timestamp;
use serde::Serialize;

use super::condition::WhereArgs;
use super::live::session;
use super::method::ComparingArgs;
use super::{Done, Failure, bad_files, check, say, show};
use crate::dataset;
use crate::evaluate::control_chart::BASELINE;
use crate::evaluate::{TrialCheck, TrialVerdict};
use crate::history::{self, ChartView, Drift, History, ReferenceView};
use crate::record::edit::{self, Editor, LibraryLock, ListedTrial, Step};
use crate::record::reference::{references, set_reference};
use crate::scene::Scene;
use crate::trial::{TrialKey, normal};

/// List the trials of a library, rename, move, remove and restore them, set their session, and find drift
///
/// A trial is given by its folder, SURFACE/TRIAL, or its file, SURFACE/FILE.wav, as `list` shows
/// it; a SURFACE alone means all its trials. Removed trials are kept in LIBRARY/.removed, and every
/// edit of trials can be undone.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced library list my-library\n  \
                        surfaced library rename my-library oak oak-sanded\n  \
                        surfaced library remove my-library oak/anna-03\n  \
                        surfaced library session my-library oak --to monday\n  \
                        surfaced library undo my-library\n  \
                        surfaced library reference my-library oak\n\nTime: edits take a moment; list \
                        without --quick takes as long as surfaced check")]
pub(super) struct Args {
    #[command(subcommand)]
    edit: Edit,
}

#[derive(Subcommand)]
enum Edit {
    /// List the trials: date, user, session, flaws, and the name that each gets when it is left out
    List(ListArgs),
    /// Give all trials of a surface another label
    Rename {
        /// The library's folder
        library: PathBuf,
        /// The present label
        surface: String,
        /// The new label
        label: String,
        /// Add the trials to those that have the new label already
        #[arg(long)]
        merge: bool,
    },
    /// Give some trials another label
    Move {
        #[command(flatten)]
        of: TrialsArgs,
        /// The new label
        #[arg(long, value_name = "LABEL")]
        to: String,
    },
    /// Give some trials another session, or none: one sitting of one person at one place
    #[command(group = clap::ArgGroup::new("session").required(true))]
    Session {
        #[command(flatten)]
        of: TrialsArgs,
        /// The new session
        #[arg(long, value_name = "NAME", group = "session", value_parser = session)]
        to: Option<String>,
        /// Take the session away
        #[arg(long, group = "session")]
        none: bool,
    },
    /// Remove trials; `restore` brings them back
    Remove(TrialsArgs),
    /// Bring removed trials back; `list --removed` shows them
    Restore(TrialsArgs),
    /// Make a surface a reference, whose scans show drift; without a surface, show references and drift
    ///
    /// A reference is a part that stays the same and is scanned again and again. The first scans after
    /// this moment tell how the station is; later ones are compared with them. Give the command again
    /// after a repair. A station that runs must read its library again (Reload on its page).
    Reference(ReferenceArgs),
    /// Undo the last edit
    Undo {
        /// The library's folder
        library: PathBuf,
    },
}

#[derive(clap::Args)]
struct TrialsArgs {
    /// The library's folder
    library: PathBuf,
    /// Trials, SURFACE/TRIAL or SURFACE/FILE.wav each, or surfaces
    #[arg(required = true, value_parser = |name: &str| Ok::<_, Infallible>(normal(name)))]
    trials: Vec<String>,
}

#[derive(clap::Args)]
struct ReferenceArgs {
    /// The library's folder
    library: PathBuf,
    /// The surface
    surface: Option<String>,
    /// Make it no reference any more
    #[arg(long, requires = "surface")]
    none: bool,
    /// Print the drift as one JSON document on stdout
    #[arg(long, conflicts_with = "surface")]
    json: bool,
}

#[derive(clap::Args)]
struct ListArgs {
    /// The library's folder
    library: PathBuf,
    /// List the removed trials
    #[arg(long)]
    removed: bool,
    /// Skip leaving each trial out to name it, which takes a while
    #[arg(long)]
    quick: bool,
    /// Print one JSON document on stdout
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    comparing: ComparingArgs,
}

pub(super) fn run(args: &Args) -> Done {
    let (library, step) = match &args.edit {
        Edit::List(args) => return list(args),
        Edit::Reference(args) => return reference(args),
        Edit::Rename { library, surface, label, merge } => {
            let label = named(label)?;
            if !merge {
                is_free(library, surface, &label)?;
            }
            (library, editor(library)?.rename(&normal(surface), &label)?)
        }
        Edit::Move { of: TrialsArgs { library, trials }, to } => {
            (library, editor(library)?.move_to(trials, &named(to)?)?)
        }
        Edit::Session { of: TrialsArgs { library, trials }, to, none: _ } => {
            (library, editor(library)?.set_session(trials, to.as_deref())?)
        }
        Edit::Remove(of) => (&of.library, editor(&of.library)?.remove(&of.trials)?),
        Edit::Restore(of) => (&of.library, editor(&of.library)?.restore(&of.trials)?),
        Edit::Undo { library } => {
            let step = editor(library)?.undo()?;
            moved(&step);
            say!("undone: {}", step.what);
            let gone = step.gone.iter().flatten();
            gone.for_each(|trial| say!("{trial} is no longer there, and did not come back"));
            return Ok(());
        }
    };
    if step.moves.is_empty() {
        say!("nothing to change");
        return Ok(());
    }
    moved(&step);
    let trials = show::counted(step.moves.len(), "trial");
    say!("{}: {trials}; `surfaced library undo {}` takes it back", step.what, library.display());
    Ok(())
}

fn named(label: &str) -> Done<String> {
    match label.trim() {
        "" => Err(Failure::usage("an empty label; give it a name, such as oak")),
        label => Ok(normal(label)),
    }
}

/// Fails if `label` has trials already, unless it is the normal form of the old label `surface`, or nothing
/// has the old label, which the edit itself says.
fn is_free(library: &Path, surface: &str, label: &str) -> Done {
    let listed = edit::list(library, &Scene::lmt108())?;
    let trials = |label: &str| listed.iter().filter(|trial| trial.key.surface == label).count();
    let old = normal(surface);
    match trials(label) {
        0 => Ok(()),
        _ if old == *label || trials(&old) == 0 => Ok(()),
        n => {
            let there = format!("{label} is there already, with {}", show::counted(n, "trial"));
            let merge = format!("to put {surface} and {label} together, add --merge");
            Err(Failure::usage_at(library, format!("{there}; {merge}")))
        }
    }
}

fn editor(library: &Path) -> Done<Editor> {
    Ok(Editor::open(library, &Scene::lmt108())?)
}

fn moved(step: &Step) {
    // A trial that only gets another session stays where it is.
    for one in step.moves.iter().filter(|one| one.from != one.to) {
        say!("{} → {}", one.from, one.to);
    }
}

fn reference(args: &ReferenceArgs) -> Done {
    let library = &args.library;
    let Some(surface) = args.surface.as_deref().map(normal) else { return drift(args) };
    if dataset::is_foreign(library) {
        let problem = "this is a copy of LMT108, in which a station keeps no scans";
        return Err(Failure::usage_at(library, problem));
    }
    if args.none {
        if !references(library)?.contains_key(&surface) {
            return Err(Failure::usage_at(library, format!("{surface} is no reference")));
        }
        set_reference(library, &surface, None)?;
        say!("{surface} is no reference any more");
        return Ok(());
    }
    let listed = edit::list(library, &Scene::lmt108())?;
    if !listed.iter().any(|trial| trial.key.surface == surface) {
        let problem = format!("there is no surface {surface}; enrol it first");
        return Err(Failure::usage_at(library, problem));
    }
    set_reference(library, &surface, Some(Timestamp::now()))?;
    say!(
        "{surface} is a reference from now on: scan it now and then, always in the same way; drift is \
         stated after {BASELINE} scans"
    );
    Ok(())
}

fn drift(args: &ReferenceArgs) -> Done {
    let folder = args.library.join(history::FOLDER);
    let history = if folder.exists() { History::read(&folder)? } else { History::default() };
    history.refer(&references(&args.library)?);
    let drift = history.drift();
    if drift.references.is_empty() {
        say!(
            "no surface is a reference; `surfaced library reference LIBRARY SURFACE` makes it one"
        );
    }
    let head = "reference,quantity,channel,>scans,>at first,>now,>limit,>finds,drift";
    let head: Vec<&str> = head.split(',').collect();
    show::result(args.json, &*drift, |drift| show::table(&head, chart_rows(drift)));
    drift.doubts.iter().for_each(|doubt| say!("drift: {doubt}"));
    Ok(())
}

fn chart_rows(drift: &Drift) -> impl Iterator<Item = Vec<String>> + '_ {
    let row = |surface: &str, chart: &ChartView| {
        let number = |x: Option<f64>| x.map_or("-".into(), |x| format!("{x:.2}"));
        let channel = chart.source.as_ref().zip(chart.channel);
        let drifted = match (chart.average, chart.drifted) {
            (None, _) => format!("not yet known, from {} scans on", drift.needed + 1),
            (_, true) => "yes".into(),
            (_, false) => "no".into(),
        };
        vec![
            surface.to_string(),
            chart.quantity.to_string(),
            channel.map_or("-".into(), |(source, channel)| format!("{source} {channel}")),
            chart.scans.to_string(),
            number(chart.centre),
            number(chart.average),
            number(chart.limit),
            number(chart.finds),
            drifted,
        ]
    };
    let of = move |of: &ReferenceView| match of.series.is_empty() {
        true => vec![[&*of.surface, "-", "-", "0"].map(String::from).to_vec()],
        false => of.series.iter().map(|chart| row(&of.surface, chart)).collect(),
    };
    drift.references.iter().flat_map(of)
}

#[derive(Serialize)]
struct LibraryRow {
    #[serde(flatten)]
    listed: ListedTrial,
    /// Whether the trial is named right when it is left out; `None` with `--quick`.
    verdict: Option<TrialVerdict>,
    named: Option<String>,
    margin: Option<f64>,
    flaws: Vec<String>,
}

fn list(args: &ListArgs) -> Done {
    let scene = Scene::lmt108();
    let lock = LibraryLock::for_reading(&args.library);
    if let Ok(opened) = dataset::open_usable(&args.library, &scene) {
        bad_files::skip(&args.library, opened.bad)?;
    }
    let list = if args.removed { edit::list_removed } else { edit::list };
    let listed = list(&args.library, &scene)?;
    let mut checked: BTreeMap<TrialKey, TrialCheck> = BTreeMap::new();
    if !args.quick && !args.removed {
        let how = args.comparing.resolve(None)?;
        let (report, _) = check::audit(&args.library, &how, &WhereArgs::default(), &say::progress)?;
        checked.extend(report.each.into_iter().map(|trial| (trial.key.clone(), trial)));
    }
    drop(lock);
    let row = |listed: ListedTrial| {
        let of = checked.remove(&listed.key);
        let verdict = of.as_ref().map(|of| of.verdict);
        let (named, margin, flaws) =
            of.map_or((None, None, Vec::new()), |of| (of.named, of.margin, of.flaws));
        LibraryRow { listed, verdict, named, margin, flaws }
    };
    let rows: Vec<LibraryRow> = listed.into_iter().map(row).collect();
    let head = ["trial", "surface", "user", "session", "recorded", ">length", "left out", "flaws"];
    show::result(args.json, &rows, |rows| show::table(&head, rows.iter().map(cells)));
    Ok(())
}

fn cells(row: &LibraryRow) -> Vec<String> {
    let ListedTrial { trial, key, started_at, seconds, .. } = &row.listed;
    let verdict = match (row.verdict, &row.named) {
        (Some(TrialVerdict::Right), _) => "right".into(),
        (Some(TrialVerdict::Wrong), Some(named)) => format!("wrong: {named}"),
        (Some(TrialVerdict::Wrong), None) => "wrong: not named".into(),
        (Some(TrialVerdict::Untested), _) => "not tested".into(),
        (None, _) => String::new(),
    };
    let started_at = started_at.clone().unwrap_or_else(|| "-".into());
    let (surface, user) = (key.surface.clone(), key.user.clone());
    let session = key.session.clone().unwrap_or_else(|| "-".into());
    let length = format!("{seconds:.1} s");
    vec![trial.clone(), surface, user, session, started_at, length, verdict, row.flaws.join("; ")]
}
