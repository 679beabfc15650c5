//! `surfaced chart`: every method, accuracy against latency and against scan time.

use std::path::PathBuf;

use clap::Parser;

use super::eval::{Also, Evaluation};
use super::method::MethodArgs;
use super::{Done, Failure, SourceArgs, show};
use crate::evaluate::{self, Chart, Point, Protocol, figure};
use crate::library::Entry;
use crate::scene::{Domain, Phase, Scene};
use crate::trial::Signal;

/// Chart accuracy against latency and scan time, for every method
///
/// Each point is measured in this run. JSON is written beside the picture.
#[derive(clap::Args)]
#[command(after_help = "Example: surfaced chart LMT_108_SurfaceMaterials_Database --sources mi2 \
                        --out chart.svg")]
pub struct Args {
    /// Recordings: a library, or the LMT108 database
    lib: PathBuf,
    /// Picture to write, an SVG; the JSON goes beside it
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// How queries and library are split (default: users against the expert where there are users)
    #[arg(long, value_enum)]
    protocol: Option<Protocol>,
    #[command(flatten)]
    sources: SourceArgs,
    /// Print the JSON on stdout, too
    #[arg(long)]
    json: bool,
}

/// Settings that are charted on whole drags, as options of `surfaced eval`.
const SETTINGS: [&str; 8] = [
    "--method reference --n 100 --repetitions 1",
    "--method reference --n 400 --repetitions 1",
    "--method reference --n 100 --repetitions 10",
    "--method reference --n 400 --repetitions 10",
    "--method reference --n 400 --repetitions 10 --halving",
    "--method joint",
    "--method embedding --no-discriminant",
    "--method embedding",
];
/// Settings that are charted on the first seconds of a drag, too.
const TIMED: [&str; 3] =
    ["--method reference --n 400 --repetitions 10", "--method joint", "--method embedding"];
const SECONDS: [f64; 3] = [0.5, 1.0, 2.0];
/// Upper end of the band of the negative control: hum and rumble, of room and session.
const CONTROL_HZ: f64 = 80.0;

/// A method's options without a command around them.
#[derive(Parser)]
struct Options {
    #[command(flatten)]
    method: MethodArgs,
}

/// One thing to measure.
struct Plan {
    setting: String,
    scene: Scene,
    seconds: Option<f64>,
    control: Option<String>,
}

/// Runs the command.
pub fn run(args: &Args) -> Done {
    let library = super::open(&args.lib)?;
    let scene = args.sources.narrow(library.scene.clone())?;
    let entries: Vec<Entry> = (library.entries.iter())
        .map(|entry| entry.clone().within(&scene))
        .filter(|entry| !entry.sources.is_empty())
        .collect();
    let keys: Vec<_> = entries.iter().map(|entry| entry.key.clone()).collect();
    let protocol = args.protocol.unwrap_or_else(|| Protocol::natural(&keys));
    let folds = evaluate::folds(protocol, &keys)?;
    let plans = plans(&scene, &entries);
    let mut points = Vec::new();
    for (done, plan) in plans.iter().enumerate() {
        eprintln!("{}/{}  {}", done + 1, plans.len(), told(plan));
        let words = std::iter::once("surfaced").chain(plan.setting.split(' '));
        // The settings above are options of this very program; a test parses them.
        let options = Options::try_parse_from(words)?;
        let evaluation = Evaluation {
            entries: &entries,
            folds: &folds,
            scene: &plan.scene,
            query_seconds: plan.seconds,
            cache: None,
            also: Also::default(),
        };
        let outcome = options.method.apply(&plan.scene, evaluation)?.outcome;
        let setting = plan.control.as_ref().unwrap_or(&plan.setting);
        let point = Point::new(&outcome, setting, plan.seconds, plan.control.is_some());
        eprintln!("      {}, {:.1} ms", show::percent(point.accuracy), point.query_ms_p50);
        points.push(point);
    }
    let chart = Chart {
        data: library.name.clone(),
        synthetic: library.synthetic,
        protocol: protocol.name().into(),
        library_trials: folds.iter().map(|fold| fold.library.len()).max().unwrap_or(0),
        drag_s: drag_s(&scene, &entries)?,
        points,
    };
    let write = |path: PathBuf, text: String| {
        std::fs::write(&path, text)
            .map_err(|error| Failure::Failed(format!("{}: {error}", path.display())))
    };
    write(args.out.clone(), figure(&chart)?)?;
    write(args.out.with_extension("json"), serde_json::to_string_pretty(&chart)?)?;
    if args.json {
        show::json(&chart);
    }
    Ok(())
}

fn told(plan: &Plan) -> String {
    let seconds = plan.seconds.map(|s| format!(", first {s} s")).unwrap_or_default();
    let control = plan.control.as_ref().map(|c| format!(" (control: {c})")).unwrap_or_default();
    format!("{}{seconds}{control}", plan.setting)
}

fn plans(scene: &Scene, entries: &[Entry]) -> Vec<Plan> {
    let plan = |setting: &str, scene: &Scene, seconds| Plan {
        setting: setting.into(),
        scene: scene.clone(),
        seconds,
        control: None,
    };
    let mut plans: Vec<Plan> = SETTINGS.iter().map(|s| plan(s, scene, None)).collect();
    for seconds in SECONDS {
        plans.extend(TIMED.iter().map(|setting| plan(setting, scene, Some(seconds))));
    }
    let held = |id: &crate::scene::SourceId| entries.iter().any(|e| e.sources.contains(id));
    let sources: Vec<_> = scene.sources().filter(|spec| held(&spec.id)).collect();
    for spec in &sources {
        let id = std::slice::from_ref(&spec.id);
        if let (true, Ok(alone)) = (sources.len() > 1, scene.clone().only(id)) {
            plans.push(plan("--method embedding", &alone, None));
        }
        // Sounds alone: what a room and a session give away below all that a surface says.
        if let (Domain::Spectrum { .. }, Ok(alone)) = (&spec.domain, scene.clone().only(id)) {
            let below = alone.changed(|spec| {
                spec.domain = Domain::Spectrum { band_hz: (0.0, CONTROL_HZ) };
                spec.align_mean = false;
            });
            let control = Some(format!("{} below {CONTROL_HZ} Hz alone", spec.id));
            plans.push(Plan { control, ..plan("--method embedding", &below, None) });
        }
    }
    plans
}

/// The longest drag of the first trial that has one.
fn drag_s(scene: &Scene, entries: &[Entry]) -> Result<Option<f64>, Failure> {
    let is_drag = |id: &crate::scene::SourceId| {
        scene.get(id.as_str()).is_some_and(|spec| spec.phase == Phase::Drag)
    };
    let Some(entry) = entries.iter().find(|e| e.sources.iter().any(is_drag)) else {
        return Ok(None);
    };
    let trial = entry.load()?;
    let lengths = trial.signals.iter().filter_map(|(id, signal)| match signal {
        Signal::Series(series) if is_drag(id) => Some(series.duration_s()),
        _ => None,
    });
    Ok(lengths.max_by(f64::total_cmp))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_setting_is_one_of_this_program() {
        for setting in SETTINGS.iter().chain(&TIMED) {
            let words = std::iter::once("surfaced").chain(setting.split(' '));
            assert!(Options::try_parse_from(words).is_ok(), "{setting}");
        }
    }
}
