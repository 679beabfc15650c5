//! `surfaced chart`: every method, accuracy against latency and against scan time.

use std::path::PathBuf;
use std::time::Instant;

use super::choose::{Choice, choose};
use super::eval::{Also, Evaluation};
use super::figure::{FigureArgs, earlier, is_earlier, json, write};
use super::method::{at_least_one, options_of};
use super::{Done, Failure, show};
use crate::evaluate::{Chart, Loudness, Outcome, Point, Prediction, figure};
use crate::recognise::{Method, MethodName, MethodSpec, ReferenceOptions, STAGES};
use crate::scene::{Domain, Phase, Scene, SourceId};
use crate::trial::Signal;

/// Chart accuracy against latency and scan time, for every method
///
/// Each point is measured in this run, beside two negative controls: what the band below 80 Hz
/// and loudness alone give away. JSON is written beside the picture. An earlier run's JSON in place
/// of recordings is drawn again, with whatever was joined to it since.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced chart LMT_108_SurfaceMaterials_Database --sources \
                        mi2 --out chart.svg\n  surfaced chart chart.json --out chart.svg")]
pub struct Args {
    /// Recordings (a library, or the LMT108 database), or the JSON of an earlier chart
    lib: PathBuf,
    #[command(flatten)]
    figure: FigureArgs,
    /// Use this many surfaces at most, evenly spread over their names
    #[arg(long, value_name = "N", value_parser = at_least_one)]
    surfaces: Option<usize>,
}

/// Settings that are charted; the flagged ones on the first seconds of a drag, too.
fn settings() -> [(MethodSpec, bool); 6] {
    let reference = |samples, repetitions, halving: bool| {
        let halving = if halving { STAGES.to_vec() } else { Vec::new() };
        let usual = ReferenceOptions::default();
        MethodSpec::Reference(ReferenceOptions { samples, repetitions, halving, ..usual })
    };
    [
        (reference(100, 1, false), false),
        (reference(400, 1, false), false),
        (reference(100, 10, false), false),
        (reference(400, 10, false), true),
        (reference(400, 10, true), false),
        (subsets_by(), true),
    ]
}

/// The setting that subsets of the sources, and the control below, are charted with.
fn subsets_by() -> MethodSpec {
    MethodName::Embedding.into()
}

/// Scan times, in seconds, besides the whole.
const SECONDS: [f64; 3] = [0.5, 1.0, 2.0];
/// Upper end of the band of a negative control: hum and rumble, of room and session.
const CONTROL_HZ: f64 = 80.0;

/// What is measured in one go.
struct Plan {
    /// How the chart calls it.
    setting: String,
    scene: Scene,
    seconds: Vec<Option<f64>>,
    kind: Kind,
}

#[derive(Clone, PartialEq)]
enum Kind {
    /// What a person may choose.
    Method(MethodSpec),
    /// A method on what should say little.
    Control(MethodSpec),
    /// No method at all.
    Loudness,
}

impl Plan {
    fn is_control(&self) -> bool {
        !matches!(self.kind, Kind::Method(_))
    }
}

/// Runs the command.
pub fn run(args: &Args) -> Done {
    args.figure.check()?;
    let drawn_again = is_earlier(&args.lib);
    let chart: Chart = if drawn_again { earlier(&args.lib, "chart")? } else { measured(args)? };
    write(&args.figure.out, &figure(&chart)?)?;
    let beside = args.figure.beside();
    if !drawn_again || beside != args.lib {
        write(&beside, &json(&chart)?)?;
    }
    if args.figure.json {
        show::json(&chart);
    }
    Ok(())
}

fn measured(args: &Args) -> Result<Chart, Failure> {
    let library = super::open(&args.lib)?;
    let scene = args.figure.sources.narrow(library.scene.clone())?;
    let mut choice = choose(&library, scene, args.figure.protocol)?;
    if let Some(most) = args.surfaces {
        choice.keep_surfaces(most)?;
    }
    let sources = choice.held();
    choice.scene = choice.scene.only(&sources)?;
    let drag_s = drag_s(&choice)?;
    let surfaces: std::collections::BTreeSet<&str> = choice.surfaces().collect();
    let chart = Chart {
        data: library.name.clone(),
        synthetic: library.synthetic,
        protocol: choice.protocol.name().into(),
        sources: sources.iter().map(SourceId::to_string).collect(),
        surfaces: surfaces.len(),
        library_trials: choice.folds.iter().map(|fold| fold.library.len()).max().unwrap_or(0),
        threads: rayon::current_num_threads(),
        drag_s,
        points: Vec::new(),
    };
    let points = points(&choice, &plans(&choice.scene, drag_s))?;
    Ok(Chart { points, ..chart })
}

fn points(choice: &Choice, plans: &[Plan]) -> Result<Vec<Point>, Failure> {
    let start = Instant::now();
    let mut points = Vec::new();
    for (done, plan) in plans.iter().enumerate() {
        let so_far_s = start.elapsed().as_secs_f64();
        let left = match done {
            0 => String::new(),
            _ => {
                let left_s = so_far_s * (plans.len() - done) as f64 / done as f64;
                format!("   ({so_far_s:.0} s so far, roughly {left_s:.0} s to go)")
            }
        };
        say!("{}/{}  {}{left}", done + 1, plans.len(), plan.setting);
        for (seconds, (outcome, _)) in plan.seconds.iter().zip(measure(choice, plan)?) {
            let point = Point::new(&outcome, &plan.setting, *seconds, plan.is_control());
            say!(
                "       {}: {} ({} to {}), {:.2} ms",
                seconds.map_or("whole drag".into(), |s| format!("first {s} s")),
                show::percent(point.accuracy),
                show::percent(point.accuracy_low),
                show::percent(point.accuracy_high),
                point.query_ms_p50
            );
            points.push(point);
        }
    }
    Ok(points)
}

fn measure(choice: &Choice, plan: &Plan) -> Result<Vec<(Outcome, Vec<Prediction>)>, Failure> {
    let Choice { entries, folds, .. } = choice;
    let evaluation = Evaluation {
        entries,
        folds,
        scene: &plan.scene,
        seconds: &plan.seconds,
        cache: None,
        also: Also::default(),
    };
    let method: Box<dyn Method> = match &plan.kind {
        Kind::Loudness => match Loudness::new(&plan.scene) {
            Some(loudness) => Box::new(loudness),
            None => return Ok(Vec::new()),
        },
        Kind::Method(method) | Kind::Control(method) => method.build(&plan.scene),
    };
    Ok(evaluation.of(&*method)?.each)
}

fn plans(scene: &Scene, drag_s: Option<f64>) -> Vec<Plan> {
    let timed = || {
        let shorter = SECONDS.into_iter().filter(|&s| drag_s.is_some_and(|whole| s < whole));
        std::iter::once(None).chain(shorter.map(Some)).collect()
    };
    let plan = |setting: &str, scene: &Scene, kind| Plan {
        setting: setting.into(),
        scene: scene.clone(),
        seconds: vec![None],
        kind,
    };
    let of_method =
        |method: MethodSpec, scene: &Scene| plan(&options_of(&method), scene, Kind::Method(method));
    let of_setting = |(method, is_timed): (MethodSpec, bool)| {
        let whole = of_method(method, scene);
        if is_timed { Plan { seconds: timed(), ..whole } } else { whole }
    };
    let mut plans: Vec<Plan> = settings().into_iter().map(of_setting).collect();
    for subset in subsets(scene) {
        plans.push(of_method(subsets_by(), &subset));
    }
    let heard = |domain: &Domain| matches!(domain, Domain::Spectrum { .. });
    if let Some(sounds) = of_domain(scene, heard) {
        let ids: Vec<_> = sounds.sources().map(|spec| spec.id.as_str()).collect();
        let ids = ids.join(", ");
        let below = sounds.clone().changed(|spec| {
            spec.domain = Domain::Spectrum { band_hz: (0.0, CONTROL_HZ) };
            spec.align_mean = false;
        });
        plans.push(plan(
            &format!("{ids} below {CONTROL_HZ} Hz alone"),
            &below,
            Kind::Control(subsets_by()),
        ));
        plans.push(plan(&format!("loudness of {ids} alone"), &sounds, Kind::Loudness));
    }
    plans
}

/// Each source alone, and all of one domain, where that is not all there is.
fn subsets(scene: &Scene) -> Vec<Scene> {
    let all = scene.sources().len();
    let single = |spec: &crate::scene::SourceSpec| {
        let id = std::slice::from_ref(&spec.id);
        scene.clone().only(id).ok()
    };
    let mut subsets: Vec<Scene> = scene.sources().filter_map(single).collect();
    let domains: [fn(&Domain) -> bool; 3] = [
        |domain| matches!(domain, Domain::Spectrum { .. }),
        |domain| matches!(domain, Domain::Time),
        |domain| matches!(domain, Domain::Image),
    ];
    let several = domains.into_iter().filter_map(|is| of_domain(scene, is));
    subsets.extend(several.filter(|subset| subset.sources().len() > 1));
    subsets.retain(|subset| subset.sources().len() < all);
    subsets
}

/// The sources of a domain, if there are any.
fn of_domain(scene: &Scene, is: impl Fn(&Domain) -> bool) -> Option<Scene> {
    let of = scene.sources().filter(|spec| is(&spec.domain));
    let ids: Vec<SourceId> = of.map(|spec| spec.id.clone()).collect();
    let scene = scene.clone().only(&ids).ok()?;
    (!ids.is_empty()).then_some(scene)
}

/// The longest drag of the first trial that has one.
fn drag_s(choice: &Choice) -> Result<Option<f64>, Failure> {
    let is_drag =
        |id: &SourceId| choice.scene.get(id.as_str()).is_some_and(|spec| spec.phase == Phase::Drag);
    let Some(entry) = choice.entries.iter().find(|e| e.sources.iter().any(is_drag)) else {
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
    use clap::Parser;

    use super::*;
    use crate::cli::method::MethodArgs;

    /// A method's options without a command around them.
    #[derive(clap::Parser)]
    struct Options {
        #[command(flatten)]
        method: MethodArgs,
    }

    #[test]
    fn every_setting_is_called_by_the_options_that_ask_for_it() {
        for (method, _) in settings() {
            let words = options_of(&method);
            let words = std::iter::once("surfaced").chain(words.split(' '));
            let asked = Options::try_parse_from(words).unwrap();
            assert_eq!(asked.method.spec().ok(), Some(method));
        }
    }

    #[test]
    fn every_chart_has_its_controls_and_subsets_where_there_are_several_sources() {
        let scene = Scene::lmt108();
        let controls = |plans: &[Plan]| plans.iter().filter(|plan| plan.is_control()).count();
        let all = plans(&scene, Some(4.8));
        assert_eq!(controls(&all), 2);
        // Eight sources alone, three spectra, three series, two pictures.
        assert_eq!(all.len(), settings().len() + 8 + 3 + 2);
        let mi2 = scene.only(&[SourceId::new("mi2").unwrap()]).unwrap();
        let alone = plans(&mi2, Some(0.8));
        assert_eq!((controls(&alone), alone.len()), (2, settings().len() + 2));
        assert_eq!(alone[3].seconds, [None, Some(0.5)]);
    }
}
