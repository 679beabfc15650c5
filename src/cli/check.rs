//! `surfaced check`: audits a library.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::condition::WhereArgs;
use super::method::{Comparing, ComparingArgs};
use super::show::Made;
use super::{Done, Failure, say, show};
use crate::dataset;
use crate::evaluate::{Audited, CheckReport, Finding, ProgressFn, TrialCheck, TrialVerdict, check};
use crate::library::Library;
use crate::printable::some_of;
use crate::record::edit::LibraryLock;
use crate::scene::Scene;
use crate::trial::TrialKey;

/// Most trials of a surface that are shown as taken for others.
const SHOWN: usize = 3;

/// Audit a library: cross-validated accuracy, confusions, likely mislabels, damage, advice
///
/// Each trial in turn is left out, and named by a library of the others. Bad files are skipped. The exit
/// code is 3 if something needs fixing.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced check my-library\n  \
                        surfaced check my-library --json > check.json\n\nTime: up to ten \
                        models of the library; seconds for tens of trials, minutes for a thousand")]
pub(super) struct Args {
    /// The library: a folder of labelled trials
    library: PathBuf,
    #[command(flatten)]
    comparing: ComparingArgs,
    #[command(flatten)]
    only: WhereArgs,
    /// Print one JSON document on stdout
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Done {
    let how = args.comparing.resolve(None)?;
    let (report, library) = audit(&args.library, &how, &args.only, &say::progress)?;
    let digest = if args.json { library.digest() } else { String::new() };
    let made = Made::new(report, how.seed, digest);
    let names = library.entries.iter().map(|entry| (&entry.key, entry.name_in(&args.library)));
    let names: BTreeMap<&TrialKey, String> = names.collect();
    show::result(args.json, &made, |made| print(&made.of, &names));
    match made.of.findings.len() {
        0 => Ok(()),
        n => Err(Failure::Damaged(format!("{} to fix", show::counted(n, "thing")))),
    }
}

/// Audits the library at a path. Returns the trials that were used, too.
pub(super) fn audit(
    library: &Path,
    how: &Comparing,
    only: &WhereArgs,
    progress: ProgressFn<'_>,
) -> Done<(CheckReport, Library)> {
    let _lock = LibraryLock::for_reading(library);
    let mut opened = dataset::open_usable(library, &Scene::lmt108())?;
    only.keep(library, &mut opened.library)?;
    let scene = how.narrow(opened.library.scene.clone())?;
    let method = how.method.build(&scene);
    let cache = how.cache_in(library);
    let audited = Audited {
        root: library,
        editable: !dataset::is_foreign(library),
        scene: &scene,
        method: &*method,
        cache: cache.as_deref(),
    };
    let used = opened.library.clone();
    Ok((check(opened, &audited, progress), used))
}

/// The trials of a surface that were named another one, each with that name.
fn taken(
    report: &CheckReport,
    surface: &str,
    names: &BTreeMap<&TrialKey, String>,
) -> Option<String> {
    let wrong =
        |one: &&TrialCheck| one.key.surface == surface && one.verdict == TrialVerdict::Wrong;
    let named =
        |one: &TrialCheck| Some(format!("{} ({})", names.get(&one.key)?, one.named.as_ref()?));
    let taken: Vec<String> = report.each.iter().filter(wrong).filter_map(named).collect();
    (!taken.is_empty()).then(|| some_of(&taken, SHOWN, ", "))
}

fn print(report: &CheckReport, names: &BTreeMap<&TrialKey, String>) {
    let trials = show::counted(report.trials, "trial");
    let surfaces = show::counted(report.surfaces.len(), "surface");
    result!("{trials} of {surfaces}");
    if let Some((share, interval)) = report.share {
        let [accuracy, low, high] = [share.value(), interval.low, interval.high].map(show::percent);
        let over = show::over(interval.over);
        result!("cross-validated accuracy: {accuracy} (95 % interval {low} to {high} {over})");
        result!("{}", report.left_out);
        let missed = report.not_asked.iter().map(|(surface, n)| format!("{surface} ({n})"));
        let missed = show::listed(missed);
        if !missed.is_empty() {
            result!("not counted, since no library without them has their surface: {missed}");
        }
    }
    result!();
    let rows = report.surfaces.iter().map(|surface| {
        let (share, interval) = surface.share;
        let right = format!("{}/{}", share.right, share.of);
        let interval = interval.map_or("-".into(), |one| show::ends((one.low, one.high)));
        let taken = surface.taken_for.iter().map(|(other, count)| format!("{other} {count}"));
        let trials = surface.trials.to_string();
        vec![surface.surface.clone(), trials, right, interval, show::listed(taken)]
    });
    show::table(&["surface", ">trials", ">right", "95 %", "taken for"], rows);
    let surfaces = report.surfaces.iter();
    let taken = surfaces.filter_map(|surface| taken(report, &surface.surface, names));
    taken.for_each(|line| result!("taken for others: {line}"));
    if !report.findings.is_empty() {
        result!("\nneeds fixing:");
    }
    for Finding { text, command, .. } in &report.findings {
        result!("  {text}");
        command.iter().for_each(|command| result!("    {command}"));
    }
    if let (Some(mended), Some((share, _))) = (report.accuracy_mended, report.share) {
        let (mended, now) = (show::percent(mended), show::percent(share.value()));
        result!("  without the damaged trials, the accuracy is {mended} instead of {now}");
    }
    if !report.advice.is_empty() {
        result!("\nnext:");
    }
    report.advice.iter().for_each(|line| result!("  {line}"));
}
