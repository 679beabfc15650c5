//! The settings of methods, subsets of the sources, and negative controls that a chart measures.

use crate::recognise::{MethodName, MethodSpec, ReferenceOptions, STAGES};
use crate::scene::{Domain, Scene, SourceId, SourceSpec};

/// The scan times, in seconds, that are measured besides whole drags.
const SECONDS: [f64; 3] = [0.5, 1.0, 2.0];
/// Upper end, in Hz, of a negative control's band, which holds hum and rumble of the room.
const CONTROL_HZ: f64 = 80.0;

/// The settings in a chart. The first flag says whether drags are also cut to their first seconds. The
/// second says whether a brief chart has the setting, as the cheapest useful one of its method.
pub fn settings() -> [(MethodSpec, bool, bool); 8] {
    [
        (reference(100, 1, false), false, false),
        (reference(400, 1, false), false, true),
        (reference(100, 10, false), false, false),
        (reference(400, 10, false), true, false),
        (reference(400, 10, true), false, false),
        (on_subsets(), true, true),
        (MethodName::Svm.into(), false, true),
        (MethodName::RandomForest.into(), false, true),
    ]
}

fn reference(samples: usize, repetitions: usize, halving: bool) -> MethodSpec {
    let halving = if halving { STAGES.to_vec() } else { Vec::new() };
    let usual = ReferenceOptions::default();
    MethodSpec::Reference(ReferenceOptions { samples, repetitions, halving, ..usual })
}

/// The method that compares subsets of the sources, and the low frequencies of the negative control.
fn on_subsets() -> MethodSpec {
    MethodName::Embedding.into()
}

#[derive(Clone, Debug)]
pub struct Charted {
    /// The method; `None` compares loudness alone.
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

/// The runs of a brief chart: each method once, on whole drags with all sources, and the controls.
pub fn brief(scene: &Scene) -> Vec<Charted> {
    let few = settings().into_iter().filter(|(_, _, is_brief)| *is_brief);
    few.map(|(method, ..)| whole(method, scene)).chain(controls(scene)).collect()
}

/// The runs of a full chart of a scene whose drags last `drag_s` seconds.
pub fn charted(scene: &Scene, drag_s: Option<f64>) -> Vec<Charted> {
    let shorter = SECONDS.into_iter().filter(|&s| drag_s.is_some_and(|whole| s < whole));
    let timed: Vec<Option<f64>> = std::iter::once(None).chain(shorter.map(Some)).collect();
    let of_setting = |(method, is_timed, _)| {
        let seconds = if is_timed { timed.clone() } else { vec![None] };
        Charted { seconds, ..whole(method, scene) }
    };
    let mut all: Vec<Charted> = settings().into_iter().map(of_setting).collect();
    all.extend(subsets(scene).iter().map(|subset| whole(on_subsets(), subset)));
    all.extend(controls(scene));
    all
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
        Charted { control: Some(of_band), ..whole(on_subsets(), &below) }
    });
    let spectra = of_domain(scene, |domain| matches!(domain, Domain::Spectrum { .. }));
    let loudness = spectra.map(|sounds| Charted {
        method: None,
        control: Some(format!("loudness of {} alone", named(&sounds))),
        ..whole(on_subsets(), &sounds)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_chart_has_its_controls_and_subsets_where_there_are_several_sources() {
        let scene = Scene::lmt108();
        let control_count =
            |all: &[Charted]| all.iter().filter(|one| one.control.is_some()).count();
        let all = charted(&scene, Some(4.8));
        assert_eq!(control_count(&all), 2);
        // Eight single sources; together three spectra, three series, and two pictures.
        assert_eq!(all.len(), settings().len() + 8 + 3 + 2);
        let mi2 = scene.only(&[SourceId::new("mi2").unwrap()]).unwrap();
        let alone = charted(&mi2, Some(0.8));
        assert_eq!((control_count(&alone), alone.len()), (2, settings().len() + 2));
        assert_eq!(alone[3].seconds, [None, Some(0.5)]);
        let few = brief(&mi2);
        assert_eq!((control_count(&few), few.len()), (2, 4 + 2));
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
