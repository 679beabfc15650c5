//! `surfaced plan`: the cheapest setting that names a library's surfaces well enough.

use std::path::{Path, PathBuf};

use super::choose::choose;
use super::common::share;
use super::figure::write;
use super::method::MethodArgs;
use super::show::quoted;
use super::{Done, Failure, SourceArgs, say, show};
use crate::evaluate::Protocol;
use crate::evaluate::plan::{Plan, PlanOptions, Planned, search};
use crate::library::Library;
use crate::recognise::MethodSpec;
use crate::scene::Scene;

/// Find the cheapest setting that names this library's surfaces well enough
///
/// Tries sources, scan times and methods by cross-validation inside the library, and writes what
/// it found as a file that `surfaced replay --plan` takes.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  surfaced plan my-library --target 0.99 --out plan.toml\n\nTime: 10 s for LMT108's 200 dragging sounds, on two cores; minutes with eight sources"
)]
pub struct Args {
    /// Recordings: a library, or the LMT108 database
    lib: PathBuf,
    /// The share of scans to be named right
    #[arg(long, default_value_t = 0.99, value_name = "SHARE", value_parser = share)]
    target: f64,
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

/// How to compare, or a plan that says so, for commands that name scans.
#[derive(clap::Args)]
pub struct ComparingArgs {
    #[command(flatten)]
    sources: SourceArgs,
    #[command(flatten)]
    method: MethodArgs,
    /// Compare as this plan says, which `surfaced plan` has written
    #[arg(long, value_name = "FILE", conflicts_with_all = [
        "sources", "method", "n", "repetitions", "positions", "neighbours",
        "halving"
    ])]
    plan: Option<PathBuf>,
}

impl ComparingArgs {
    /// What the plan says, if there is one, or else the other arguments; says so.
    ///
    /// # Errors
    /// Wrong usage, if the plan cannot be read.
    pub fn resolve(&self, query_seconds: Option<f64>) -> Result<Comparing, Failure> {
        let (sources, cache) = (self.sources.clone(), self.method.uses_cache());
        let Some(path) = &self.plan else {
            let method = self.method.spec()?;
            return Ok(Comparing { plan: None, sources, method, cache, query_seconds });
        };
        let plan = Plan::read(path).map_err(|error| Failure::Usage(error.to_string()))?;
        let names: Vec<&str> = plan.sources.iter().map(|id| id.as_str()).collect();
        let used = plan.scan_s.map(|s| format!(", first {s} s of the drag")).unwrap_or_default();
        say!(
            "plan for {}: {} by {}{used}",
            plan.library,
            names.join(" + "),
            plan.method.name().as_str()
        );
        let (method, query_seconds) = (self.method.planned(&plan.method), plan.scan_s);
        Ok(Comparing { plan: Some(plan), sources, method, cache, query_seconds })
    }
}

/// How scans are compared.
#[derive(Clone)]
pub struct Comparing {
    /// The plan that says so, if one does.
    pub plan: Option<Plan>,
    sources: SourceArgs,
    /// The method.
    pub method: MethodSpec,
    /// Whether prepared trials are kept beside the library.
    cache: bool,
    /// How much of each drag is used, in seconds, if not all of it.
    pub query_seconds: Option<f64>,
}

impl Comparing {
    /// Where prepared trials of a folder are kept, if they are.
    pub fn cache_in(&self, folder: &Path) -> Option<PathBuf> {
        self.cache.then(|| folder.to_path_buf())
    }

    /// How long the plan lets scans last, in seconds, if there is one that says so.
    pub fn planned_s(&self) -> Option<f64> {
        self.plan.as_ref()?.scan_s
    }

    /// The scene with the sources that are compared.
    ///
    /// # Errors
    /// Wrong usage, if the scene lacks one.
    pub fn narrow(&self, scene: Scene) -> Result<Scene, Failure> {
        match &self.plan {
            Some(plan) => plan.narrow(scene).map_err(|error| Failure::Usage(error.to_string())),
            None => self.sources.narrow(scene),
        }
    }
}

/// Runs the command.
pub fn run(args: &Args) -> Done {
    let library = super::open(&args.lib)?;
    let scene = args.sources.narrow(library.scene.clone())?;
    let chosen = choose(&library, scene, args.protocol)?;
    let protocol = chosen.protocol;
    let library = Library { scene: chosen.scene, entries: chosen.entries, ..library };
    let steps = show::Steps::new();
    let options = PlanOptions { target: args.target, protocol, cache: None };
    let planned = search(&library, options, &|step, done, of| steps.show(step, done, of))?;
    drop(steps);
    let text = planned.plan.to_toml();
    if let Some(out) = &args.out {
        write(out, &text)?;
    }
    say::results_aside(args.json);
    if args.json {
        show::json(&planned);
    }
    print(&planned);
    if args.out.is_none() {
        result!("\n{text}");
    }
    advise(args);
    verdict(args, &planned)
}

/// Says what the plan is good for.
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
    result!("\nsource       alone   latency    scan");
    for cost in &planned.sources {
        result!(
            "{:<8} {:>9} {:>6.2} ms {:>5.1} s",
            cost.source,
            show::percent(cost.accuracy),
            cost.latency_ms,
            cost.scan_s
        );
    }
    result!();
    for step in &planned.steps {
        result!("{step}");
    }
    for warning in &planned.warnings {
        say!("warning: {warning}");
    }
    let e = &planned.plan.expected;
    let sources: Vec<&str> = planned.plan.sources.iter().map(|id| id.as_str()).collect();
    let mark = if planned.plan.synthetic { " (synthetic)" } else { "" };
    result!(
        "plan: {} by {}, {:.1} s of scan, {:.2} ms",
        sources.join(" + "),
        planned.plan.method.name().as_str(),
        e.scan_s,
        e.latency_ms
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
    if e.reached && !e.shown {
        result!(
            "{} queries are too few to show {}, even without a mistake: more trials would",
            e.queries,
            show::percent(e.target)
        );
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
