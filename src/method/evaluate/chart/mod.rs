//! Measures accuracy against latency and against scan time, for each method.
//!
//! ```text
//! charted (settings, subsets of sources, controls) ─► measure ─► Chart of points ─► figure
//! ```

mod figure;

use figure::ChartPoint;
#[doc(hidden)]
pub use figure::{Chart, figure};

use rayon::prelude::*;

use crate::evaluate::{
    EvaluateError, EvaluatedTrials, Evaluation, Interval, LeftOutSources, Measured, Over, Split,
};
use crate::features::{FeatureVector, SourceFeatures};
use crate::library::Entry;
use crate::recognise::{MethodName, MethodSpec, RecogniseError, ReferenceOptions, STAGES};
use crate::scene::{Domain, Scene, SourceId, SourceSpec};
use crate::trial::{Signal, level_of};

/// The scan times, in seconds, that are measured besides whole drags.
const SECONDS: [f64; 3] = [0.5, 1.0, 2.0];
/// Upper end, in Hz, of a negative control's band, which holds hum and rumble of the room.
const CONTROL_HZ: f64 = 80.0;

/// The settings in a chart: several of `reference`, one of each other method. The first flag says whether
/// drags are also cut to their first seconds. The second says whether a brief chart has the setting, as
/// the cheapest useful one of its method.
pub fn settings() -> Vec<(MethodSpec, bool, bool)> {
    let of_reference = [
        (reference(100, 1, false), false, false),
        (reference(400, 1, false), false, true),
        (reference(100, 10, false), false, false),
        (reference(400, 10, false), true, false),
        (reference(400, 10, true), false, false),
    ];
    let others = MethodName::ALL.into_iter().filter(|name| *name != MethodName::Reference);
    of_reference.into_iter().chain(others.map(|name| (name.into(), true, true))).collect()
}

fn reference(samples: usize, repetitions: usize, halving: bool) -> MethodSpec {
    let halving = if halving { STAGES.to_vec() } else { Vec::new() };
    let usual = ReferenceOptions::default();
    MethodSpec::Reference(ReferenceOptions { samples, repetitions, halving, ..usual })
}

/// The method that compares subsets of the sources, and the low frequencies of the negative control.
const ON_SUBSETS: MethodName = MethodName::Embedding;

#[derive(Clone, Debug)]
pub struct Charted {
    /// The method; `None` compares loudness alone, by nearest neighbours.
    pub method: Option<MethodSpec>,
    /// The name of a negative control, which uses data that should tell little; `None` for a method.
    pub control: Option<String>,
    pub scene: Scene,
    /// For each measurement, the seconds of each query's drag to use; `None` for the whole drag.
    pub seconds: Vec<Option<f64>>,
}

fn whole(method: MethodSpec, scene: &Scene) -> Charted {
    Charted { method: Some(method), control: None, scene: scene.clone(), seconds: vec![None] }
}

/// The runs of a chart of some methods, of a scene whose drags last `drag_s` seconds. A `brief` chart has
/// each method once, on whole drags with all sources, and the controls.
pub fn charted(
    scene: &Scene,
    drag_s: Option<f64>,
    methods: &[MethodName],
    brief: bool,
) -> Vec<Charted> {
    let shorter = SECONDS.into_iter().filter(|&s| drag_s.is_some_and(|whole| s < whole));
    let timed: Vec<Option<f64>> = std::iter::once(None).chain(shorter.map(Some)).collect();
    let of_setting = |(method, is_timed, _)| {
        let seconds = if is_timed && !brief { timed.clone() } else { vec![None] };
        Charted { seconds, ..whole(method, scene) }
    };
    let wanted = settings()
        .into_iter()
        .filter(|(method, _, is_brief)| methods.contains(&method.name()) && (*is_brief || !brief));
    let has_subsets = !brief && methods.contains(&ON_SUBSETS);
    let subsets = if has_subsets { subsets(scene) } else { Vec::new() };
    let of_subsets = subsets.iter().map(|subset| whole(ON_SUBSETS.into(), subset));
    wanted.map(of_setting).chain(of_subsets).chain(controls(scene)).collect()
}

/// The negative controls, which show how much room and session alone reveal. One compares only the band
/// below [`CONTROL_HZ`], of sources with a far wider band; the other compares loudness.
fn controls(scene: &Scene) -> Vec<Charted> {
    let named =
        |scene: &Scene| scene.sources().map(|spec| spec.id.as_str()).collect::<Vec<_>>().join(", ");
    let reaches = |domain: &Domain| matches!(domain, Domain::Spectrum { band_hz } if band_hz.1 >= 2.0 * CONTROL_HZ);
    let band = of_domain(scene, reaches).map(|wide| {
        let of_band = format!("{} below {CONTROL_HZ} Hz alone", named(&wide));
        let below = wide.changed(|spec| {
            spec.domain = Domain::Spectrum { band_hz: (0.0, CONTROL_HZ) };
            spec.align_mean = false;
        });
        Charted { control: Some(of_band), ..whole(ON_SUBSETS.into(), &below) }
    });
    let spectra = of_domain(scene, |domain| matches!(domain, Domain::Spectrum { .. }));
    let loudness = spectra.map(|sounds| Charted {
        method: None,
        control: Some(format!("loudness of {} alone", named(&sounds))),
        ..whole(ON_SUBSETS.into(), &sounds)
    });
    band.into_iter().chain(loudness).collect()
}

/// Parts of the scene: each source alone, and all sources of each domain. Never the whole scene.
fn subsets(scene: &Scene) -> Vec<Scene> {
    let all = scene.sources().len();
    let single = |spec: &SourceSpec| scene.clone().only(std::slice::from_ref(&spec.id)).ok();
    let mut subsets: Vec<Scene> = scene.sources().filter_map(single).collect();
    let domains: [fn(&Domain) -> bool; 3] = [
        |domain| matches!(domain, Domain::Spectrum { .. }),
        |domain| matches!(domain, Domain::Time { .. }),
        |domain| matches!(domain, Domain::Image),
    ];
    let several = domains.into_iter().filter_map(|is| of_domain(scene, is));
    subsets.extend(several.filter(|subset| subset.sources().len() > 1));
    subsets.retain(|subset| subset.sources().len() < all);
    subsets
}

/// The scene with only the sources for whose domain `is` is true; `None` if there are none.
fn of_domain(scene: &Scene, is: impl Fn(&Domain) -> bool) -> Option<Scene> {
    let of = scene.sources().filter(|spec| is(&spec.domain));
    let ids: Vec<SourceId> = of.map(|spec| spec.id.clone()).collect();
    let scene = scene.clone().only(&ids).ok()?;
    (!ids.is_empty()).then_some(scene)
}

/// Measures one setting, with the sources of its own scene. Returns a point for each scan time, and
/// the sources that were left out. `name` is the setting's name in the chart.
pub fn measure(
    entries: &[Entry],
    Split { folds, over, .. }: &Split,
    charted: &Charted,
    name: &str,
) -> Result<(Vec<ChartPoint>, LeftOutSources), EvaluateError> {
    let scene = &charted.scene;
    let by_loudness = charted.method.is_none();
    let levels = if by_loudness { levels(entries, scene)? } else { Vec::new() };
    let mut on = Evaluation::new(scene, entries, folds);
    if by_loudness {
        on.trials = EvaluatedTrials::Features(&levels);
    }
    let method = charted.method.clone().unwrap_or(MethodName::Knn.into()).build(scene);
    let measured = on.prepare(&*method)?.measure_by(folds, &charted.seconds)?;
    let (mut points, mut left_out) = (Vec::new(), LeftOutSources::new());
    for (&query_seconds, Measured { outcome, left_out: of_one, .. }) in
        charted.seconds.iter().zip(measured)
    {
        let control = charted.control.is_some();
        points.push(ChartPoint {
            method: if control { "control".into() } else { outcome.method },
            setting: name.into(),
            sources: outcome.sources.iter().map(SourceId::to_string).collect(),
            query_seconds,
            accuracy: outcome.share.value(),
            interval: Interval::of(&outcome.folds, *over),
            users: if *over == Over::People { outcome.folds } else { Vec::new() },
            query_ms_p50: outcome.query_ms_p50,
            query_ms_p99: outcome.query_ms_p99,
            queries: outcome.queries,
            peer: false,
            control,
        });
        left_out.extend(of_one);
    }
    Ok((points, left_out))
}

/// The level of each series, as the only feature of its source.
fn levels(entries: &[Entry], scene: &Scene) -> Result<Vec<FeatureVector>, RecogniseError> {
    let level = |(id, signal): (&SourceId, &Signal)| {
        let Signal::Series(series) = signal else { return None };
        let values = vec![level_of(series)];
        Some((id.clone(), SourceFeatures { values, rate_hz: series.rate_hz() }))
    };
    let of_entry = |entry: &Entry| {
        let trial = entry.clone().within(scene).load()?;
        let sources = trial.signals.iter().filter_map(level).collect();
        Ok(FeatureVector { key: trial.key.clone(), sources })
    };
    entries.par_iter().map(of_entry).collect()
}

/// Length of a whole drag in seconds: that of the longest drag source in the first trial that has one.
pub fn drag_s(entries: &[Entry], scene: &Scene) -> Result<Option<f64>, RecogniseError> {
    let is_drag = |id: &SourceId| scene.is_dragged(id);
    let Some(entry) = entries.iter().find(|entry| entry.sources.iter().any(is_drag)) else {
        return Ok(None);
    };
    Ok(entry.load()?.longest_s(is_drag))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_chart_has_its_controls_and_subsets_where_there_are_several_sources() {
        let scene = Scene::lmt108();
        let control_count =
            |all: &[Charted]| all.iter().filter(|one| one.control.is_some()).count();
        let every = MethodName::ALL;
        let all = charted(&scene, Some(4.8), &every, false);
        assert_eq!(control_count(&all), 2);
        // Eight single sources; together three spectra, three series, and two pictures.
        assert_eq!(all.len(), settings().len() + 8 + 3 + 2);
        let mi2 = scene.only(&[SourceId::new("mi2").unwrap()]).unwrap();
        let alone = charted(&mi2, Some(0.8), &every, false);
        assert_eq!((control_count(&alone), alone.len()), (2, settings().len() + 2));
        assert_eq!(alone[3].seconds, [None, Some(0.5)]);
        let few = charted(&mi2, Some(0.8), &every, true);
        assert_eq!((control_count(&few), few.len()), (2, every.len() + 2));
        assert_eq!(charted(&mi2, None, &[MethodName::Svm], false).len(), 1 + 2);
        assert!(few.iter().all(|one| one.seconds == [None]));
    }

    #[test]
    fn a_spectrum_without_much_above_80_hz_is_no_negative_control() {
        let loudness =
            |scene: &Scene| controls(scene).pop().filter(|last| last.method.is_none())?.control;
        let named = |name: &str| Some(name.to_string());
        assert_eq!(loudness(&Scene::lmt108()), named("loudness of ac, mi1, mi2 alone"));
        let only = |id| Scene::lmt108().only(&[SourceId::new(id).unwrap()]).unwrap();
        let narrow = only("ac").changed(|spec| {
            spec.domain = Domain::Spectrum { band_hz: (0.5, 49.0) };
        });
        assert_eq!(loudness(&narrow), named("loudness of ac alone"));
        assert_eq!((controls(&narrow).len(), controls(&only("ca1")).len()), (1, 0));
    }
}
