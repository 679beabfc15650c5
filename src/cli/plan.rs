//! `surfaced plan`: finds the cheapest setting that names a library's surfaces well enough.

use std::path::PathBuf;

use super::choose::{hardest, protocols, within};
use super::condition::WhereArgs;
use super::figure::{can_write, write};
use super::show::{Made, quoted};
use super::{Done, Failure, SourceArgs, bad_files, one_of, say, share, show};
use crate::evaluate::Protocol;
use crate::evaluate::plan::{Expected, Plan, PlanOptions, Planned, search};
use crate::library::Library;
use crate::trial::TrialKey;

/// The default share of whole scans that must be named right.
const TARGET: f64 = 0.99;

/// Find the cheapest setting that names this library's surfaces well enough
///
/// Tries sources and scan times by cross-validation inside the library, and writes the result as a
/// file that `surfaced replay --plan` takes.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  surfaced plan my-library --target 0.99 --out plan.toml\n\nTime: 10 s for LMT108's 200 dragging sounds, on two cores; minutes with eight sources"
)]
pub(super) struct Args {
    /// Recordings: a library, or the LMT108 database
    lib: PathBuf,
    /// Share of scans that must be named right, whole and at the scan time (default: 0.99 of whole
    /// scans, and at most 0.01 less at the scan time)
    #[arg(long, visible_alias = "accuracy", value_name = "SHARE", value_parser = share)]
    target: Option<f64>,
    /// File to write the plan to
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// How queries and library are split (default: the hardest that the data allow: other people, else other sessions, else other trials)
    #[arg(long, value_parser = one_of(protocols()))]
    protocol: Option<Protocol>,
    #[command(flatten)]
    sources: SourceArgs,
    #[command(flatten)]
    only: WhereArgs,
    /// Print the plan, and the measurements behind it, as one JSON document on stdout
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Done {
    args.out.as_deref().map_or(Ok(()), |path| can_write(path, &["toml"]))?;
    let library = args.only.open(&args.lib)?;
    let (planned, digest) = bad_files::work(&args.lib, library, |library| {
        let scene = args.sources.narrow(library.scene.clone())?;
        let entries = within(library, &scene)?;
        let keys: Vec<TrialKey> = entries.iter().map(|entry| entry.key.clone()).collect();
        let protocol = args.protocol.unwrap_or_else(|| hardest(&keys));
        say!("protocol: {} ({})", protocol.name(), protocol.left_out());
        let target = args.target.unwrap_or(TARGET);
        let options = PlanOptions { target, accuracy: args.target, protocol };
        let digest = if args.json { library.digest() } else { String::new() };
        let library = Library { scene, entries, ..library.clone() };
        Ok((search(&library, options, &say::progress)?, digest))
    })?;
    let text = planned.plan.to_toml();
    if let Some(out) = &args.out {
        write(out, &text)?;
    }
    say::results_aside(args.json);
    if args.json {
        // The search draws with the default seed.
        show::json(&Made::new(&planned, 1, digest));
    }
    print(&planned);
    if args.out.is_none() && say::is_verbose() {
        result!("\n{text}");
    }
    let lib = quoted(&args.lib);
    match &args.out {
        Some(out) => {
            show::wrote(&[out]);
            show::next(&format!("surfaced run --library {lib} --plan {}", quoted(out)));
        }
        None => show::next(&format!("surfaced plan {lib} --out plan.toml keeps this plan")),
    }
    let expected = &planned.plan.expected;
    if expected.reached {
        return Ok(());
    }
    let target = show::percent(expected.target);
    let wanted = match args.target {
        Some(_) => format!("{target} of both"),
        None => format!("{target}, and at most one point less at the scan time"),
    };
    Err(Failure::Failed(format!(
        "no plan reaches its target: {} (wanted: {wanted}): enrol more trials, add a sensor, or lower \
         --target",
        at_both(expected)
    )))
}

/// The accuracies of whole scans and at the scan time.
fn at_both(expected: &Expected) -> String {
    let at = format!("{} of scans of {:.1} s", show::percent(expected.accuracy), expected.scan_s);
    let whole =
        expected.accuracy_whole.map(|whole| format!("{} of whole scans", show::percent(whole)));
    whole.into_iter().chain([at]).collect::<Vec<_>>().join(", ")
}

fn print(planned: &Planned) {
    let Plan { method, sources, expected, .. } = &planned.plan;
    let Expected { queries, surfaces, protocol, scan_s, accuracy_whole, .. } = expected;
    let mark = if planned.plan.synthetic { " (synthetic)" } else { "" };
    let (names, method) = (show::joined(sources, " + "), method.name().as_str());
    result!("plan: {names} by {method}, {scan_s:.1} s of scan");
    let [accuracy, low, high] =
        [expected.accuracy, expected.accuracy_low, expected.accuracy_high].map(show::percent);
    result!(
        "expected accuracy {accuracy} of {queries} queries of {surfaces} surfaces, {protocol} (95 % \
         interval {low} to {high}){mark}"
    );
    if let Some(whole) = accuracy_whole.filter(|_| planned.plan.scan_s.is_some()) {
        result!("of whole scans: {}", show::percent(whole));
    }
    if planned.sources.len() > 1 {
        result!(
            "these queries also chose the sources, so expect less of new scans than this; it is not \
             known how much"
        );
    }
    expected.doubt().iter().for_each(|doubt| result!("{doubt}"));
    if !say::is_verbose() {
        return;
    }
    let costs = planned.sources.iter().map(|cost| {
        vec![
            cost.source.to_string(),
            show::percent(cost.accuracy),
            format!("{:.2} ms", cost.latency_ms),
            format!("{:.1} s", cost.scan_s),
        ]
    });
    let head = ["source", ">alone", ">raw samples to answer", ">recorded"];
    result!();
    show::table(&head, costs);
    result!();
    planned.steps.iter().for_each(|step| result!("{step}"));
}
