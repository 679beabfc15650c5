//! `surfaced plan`: the cheapest setting that names a library's surfaces well enough.

use std::path::PathBuf;

use super::choose::choose;
use super::common::share;
use super::figure::write;
use super::show::quoted;
use super::{Done, Failure, SourceArgs, bad_files, say, show};
use crate::evaluate::Protocol;
use crate::evaluate::plan::{PlanOptions, Planned, search};
use crate::library::Library;
use crate::printable::table;

/// The share of whole scans to be named right.
const TARGET: f64 = 0.99;

/// Find the cheapest setting that names this library's surfaces well enough
///
/// Tries sources and scan times by cross-validation inside the library, and writes the result as a
/// file that `surfaced replay --plan` takes.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  surfaced plan my-library --target 0.99 --out plan.toml\n\nTime: 10 s for LMT108's 200 dragging sounds, on two cores; minutes with eight sources"
)]
pub struct Args {
    /// Recordings: a library, or the LMT108 database
    lib: PathBuf,
    /// Share of scans that must be named right, also by the scan time (default: 0.99 by whole scans,
    /// and at most 0.01 less by the scan time)
    #[arg(long, visible_alias = "accuracy", value_name = "SHARE", value_parser = share)]
    target: Option<f64>,
    /// File to write the plan to
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// How queries and library are split (default: the first of these that fits)
    #[arg(long, value_enum)]
    protocol: Option<Protocol>,
    #[command(flatten)]
    sources: SourceArgs,
    /// Print the plan, and what it was found by, as one JSON document on stdout
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Done {
    let library = super::open(&args.lib)?;
    let planned = bad_files::work(&args.lib, library, |library| {
        let scene = args.sources.narrow(library.scene.clone())?;
        let chosen = choose(library, scene, args.protocol)?;
        let target = args.target.unwrap_or(TARGET);
        let options = PlanOptions { target, accuracy: args.target, protocol: chosen.protocol };
        let library = Library { scene: chosen.scene, entries: chosen.entries, ..library.clone() };
        let steps = show::Steps::new();
        Ok(search(&library, options, &|step, done, of| steps.show(step, done, of))?)
    })?;
    let text = planned.plan.to_toml();
    if let Some(out) = &args.out {
        write(out, &text)?;
    }
    say::results_aside(args.json);
    if args.json {
        show::json(&planned);
    }
    print(&planned);
    if args.out.is_none() && say::is_verbose() {
        result!("\n{text}");
    }
    advise(args);
    verdict(args, &planned)
}

/// Says what to do next with the plan.
fn advise(args: &Args) {
    let lib = quoted(&args.lib);
    match &args.out {
        Some(out) => {
            show::wrote(&[out]);
            show::next(&format!("surfaced run --library {lib} --plan {}", quoted(out)));
        }
        None => show::next(&format!("surfaced plan {lib} --out plan.toml keeps this plan")),
    }
}

fn print(planned: &Planned) {
    let e = &planned.plan.expected;
    let sources: Vec<&str> = planned.plan.sources.iter().map(|id| id.as_str()).collect();
    let mark = if planned.plan.synthetic { " (synthetic)" } else { "" };
    result!(
        "plan: {} by {}, {:.1} s of scan",
        sources.join(" + "),
        planned.plan.method.name().as_str(),
        e.scan_s
    );
    result!(
        "expected accuracy {} of {} queries of {} surfaces, {} (95 % interval {} to {}){mark}",
        show::percent(e.accuracy),
        e.queries,
        e.surfaces,
        e.protocol,
        show::percent(e.accuracy_low),
        show::percent(e.accuracy_high)
    );
    e.doubt().iter().for_each(|doubt| result!("{doubt}"));
    if say::is_verbose() {
        details(planned);
    }
}

/// The sources and the steps of the search.
fn details(planned: &Planned) {
    let costs = planned.sources.iter().map(|cost| {
        vec![
            cost.source.to_string(),
            show::percent(cost.accuracy),
            format!("{:.2} ms", cost.latency_ms),
            format!("{:.1} s", cost.scan_s),
        ]
    });
    let head = ["source", ">alone", ">raw samples to answer", ">recorded"];
    result!("\n{}", table(&head, &costs.collect::<Vec<_>>()));
    for step in &planned.steps {
        result!("{step}");
    }
}

/// A target that no setting reaches is a failure, though the best plan was written.
fn verdict(args: &Args, planned: &Planned) -> Done {
    let e = &planned.plan.expected;
    if e.reached {
        return Ok(());
    }
    let written = match &args.out {
        Some(out) => format!("the best one is in {}", out.display()),
        None => "the best one is above".into(),
    };
    Err(Failure::Failed(format!(
        "no plan reaches {}; {written}, at {}: enrol more trials, add a sensor, or lower --target",
        show::percent(e.target),
        show::percent(e.accuracy)
    )))
}
