//! What a chart measures: settings of methods, subsets of the sources, and negative controls.

use crate::recognise::{MethodName, MethodSpec, ReferenceOptions, STAGES};
use crate::scene::{Domain, Scene, SourceId, SourceSpec};

/// Scan times in seconds, besides whole drags.
const SECONDS: [f64; 3] = [0.5, 1.0, 2.0];
/// Upper end of the band of a negative control, which holds hum and rumble of room and session.
const CONTROL_HZ: f64 = 80.0;

/// Settings in a chart; those with `true` are also measured on the first seconds of drags.
pub fn settings() -> [(MethodSpec, bool); 8] {
    [
        (reference(100, 1, false), false),
        (reference(400, 1, false), false),
        (reference(100, 10, false), false),
        (reference(400, 10, false), true),
        (reference(400, 10, true), false),
        (on_subsets(), true),
        (MethodName::Svm.into(), false),
        (MethodName::RandomForest.into(), false),
    ]
}

fn reference(samples: usize, repetitions: usize, halving: bool) -> MethodSpec {
    let halving = if halving { STAGES.to_vec() } else { Vec::new() };
    let usual = ReferenceOptions::default();
    MethodSpec::Reference(ReferenceOptions { samples, repetitions, halving, ..usual })
}

/// Settings in a brief chart: the cheapest useful one of each method.
fn few_settings() -> [MethodSpec; 4] {
    let [svm, forest] = [MethodName::Svm, MethodName::RandomForest].map(MethodSpec::from);
    [reference(400, 1, false), on_subsets(), svm, forest]
}

/// The method for subsets of the sources and for the control of low frequencies.
fn on_subsets() -> MethodSpec {
    MethodName::Embedding.into()
}

/// One run of a chart.
#[derive(Clone, Debug)]
pub struct Charted {
    pub what: Comparer,
    pub scene: Scene,
    /// The first seconds of each query's drag to use, for each measurement; `None` for all of it.
    pub seconds: Vec<Option<f64>>,
}

/// A method or a control.
#[derive(Clone, Debug, PartialEq)]
pub enum Comparer {
    /// A method that users can choose.
    Method(MethodSpec),
    /// A negative control: a method on data that should tell little, and a name of these data.
    Control(MethodSpec, String),
    /// A negative control: loudness alone, and a name of the control, which lists the sources.
    Loudness(String),
}

impl Charted {
    pub fn is_control(&self) -> bool {
        !matches!(self.what, Comparer::Method(_))
    }
}

fn whole(what: Comparer, scene: &Scene) -> Charted {
    Charted { what, scene: scene.clone(), seconds: vec![None] }
}

/// The runs of a brief chart: each method once, on whole drags with all sources, and the controls.
pub fn brief(scene: &Scene) -> Vec<Charted> {
    let settings = few_settings().into_iter().map(|method| whole(Comparer::Method(method), scene));
    settings.chain(controls(scene)).collect()
}

/// The runs of a full chart of a scene whose drags last `drag_s` seconds.
pub fn charted(scene: &Scene, drag_s: Option<f64>) -> Vec<Charted> {
    let shorter = SECONDS.into_iter().filter(|&s| drag_s.is_some_and(|whole| s < whole));
    let timed: Vec<Option<f64>> = std::iter::once(None).chain(shorter.map(Some)).collect();
    let of_setting = |(method, is_timed): (MethodSpec, bool)| {
        let seconds = if is_timed { timed.clone() } else { vec![None] };
        Charted { seconds, ..whole(Comparer::Method(method), scene) }
    };
    let mut all: Vec<Charted> = settings().into_iter().map(of_setting).collect();
    for subset in subsets(scene) {
        all.push(whole(Comparer::Method(on_subsets()), &subset));
    }
    all.extend(controls(scene));
    all
}

/// Negative controls, which show how much room and session alone reveal: the lowest band of spectra
/// that extend far above it, and loudness.
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
        whole(Comparer::Control(on_subsets(), of_band), &below)
    });
    let spectra = of_domain(scene, |domain| matches!(domain, Domain::Spectrum { .. }));
    let loudness = spectra.map(|sounds| {
        whole(Comparer::Loudness(format!("loudness of {} alone", named(&sounds))), &sounds)
    });
    band.into_iter().chain(loudness).collect()
}

/// Each source alone, and all sources of each domain, except the whole scene.
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

/// The sources of a domain, if there are any.
fn of_domain(scene: &Scene, is: impl Fn(&Domain) -> bool) -> Option<Scene> {
    let of = scene.sources().filter(|spec| is(&spec.domain));
    let ids: Vec<SourceId> = of.map(|spec| spec.id.clone()).collect();
    let scene = scene.clone().only(&ids).ok()?;
    (!ids.is_empty()).then_some(scene)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_chart_has_its_controls_and_subsets_where_there_are_several_sources() {
        let scene = Scene::lmt108();
        let control_count = |all: &[Charted]| all.iter().filter(|one| one.is_control()).count();
        let all = charted(&scene, Some(4.8));
        assert_eq!(control_count(&all), 2);
        // Eight single sources; together three spectra, three series, and two pictures.
        assert_eq!(all.len(), settings().len() + 8 + 3 + 2);
        let mi2 = scene.only(&[SourceId::new("mi2").unwrap()]).unwrap();
        let alone = charted(&mi2, Some(0.8));
        assert_eq!((control_count(&alone), alone.len()), (2, settings().len() + 2));
        assert_eq!(alone[3].seconds, [None, Some(0.5)]);
        let few = brief(&mi2);
        assert_eq!((control_count(&few), few.len()), (2, few_settings().len() + 2));
        assert!(few.iter().all(|one| one.seconds == [None]));
    }

    #[test]
    fn a_spectrum_without_much_above_80_hz_is_no_negative_control() {
        let scene = Scene::lmt108().only(&[SourceId::new("ac").unwrap()]).unwrap();
        let narrow = scene.changed(|spec| spec.domain = Domain::Spectrum { band_hz: (0.5, 49.0) });
        let controls: Vec<Comparer> =
            controls(&narrow).into_iter().map(|control| control.what).collect();
        assert_eq!(controls, [Comparer::Loudness("loudness of ac alone".into())]);
    }
}
