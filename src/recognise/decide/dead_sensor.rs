//! Leaves out the sources of a query whose sensor is dead or stuck.

use crate::scene::{Scene, SourceId};
use crate::trial::{Flaw, Signal, Trial, flaws, is_plain};

/// The reason given for leaving out a picture of one colour.
const PLAIN: &str = "the picture is of one colour";

/// Leaves out the sources that have a stuck channel or a picture of one colour. Returns the query,
/// and one line of text for each source left out. A channel that is constant in the library may be
/// constant in the query; so may a switch, which rarely changes. Nothing is left out if no other
/// source would remain.
///
/// `moves` says whether a channel of a source, counted from 0, varies in the library
/// ([`crate::recognise::EmbeddingModel::moves`]). Library trials are not checked here, but when
/// they are enrolled.
pub fn without_flawed(
    mut trial: Trial,
    scene: &Scene,
    moves: impl Fn(&SourceId, usize) -> bool,
) -> (Trial, Vec<String>) {
    let flaw_of = |id: &SourceId, signal: &Signal| match signal {
        Signal::Image(image) => is_plain(image).then(|| PLAIN.to_string()),
        Signal::Series(series) => flaws(series)
            .into_iter()
            .find(|flaw| match flaw {
                Flaw::Constant { .. } | Flaw::Stuck { .. } => moves(id, flaw.channel() - 1),
                Flaw::Saturated { .. } => false,
            })
            .map(|flaw| flaw.to_string()),
    };
    let sources = trial.signals.iter().map(|(id, signal)| (id, flaw_of(id, signal)));
    let left_out = left_out(scene, sources);
    trial.signals.retain(|id, _| !left_out.iter().any(|(other, _)| other == id));
    let remarks =
        left_out.into_iter().map(|(id, flaw)| format!("{id} is left out: {flaw}")).collect();
    (trial, remarks)
}

/// Which of `sources`, given with their flaws, to leave out. Switches (sources with a fixed σ)
/// stay; nothing is left out if no other source of the scene would remain.
pub fn left_out<'a, F>(
    scene: &Scene,
    sources: impl Iterator<Item = (&'a SourceId, Option<F>)>,
) -> Vec<(SourceId, F)> {
    let (mut flawed, mut sound) = (Vec::new(), 0);
    for (id, flaw) in sources {
        let Some(spec) = scene.get(id.as_str()) else { continue };
        match flaw {
            Some(flaw) if spec.sigma.is_none() => flawed.push((id.clone(), flaw)),
            _ => sound += 1,
        }
    }
    if sound == 0 { Vec::new() } else { flawed }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trial::{Image, Series, TrialKey};
    use std::collections::BTreeMap;

    fn query(sources: &[(&str, Vec<f32>)]) -> Trial {
        let series =
            |samples: &Vec<f32>| Signal::Series(Series::new(10.0, 1, samples.clone()).unwrap());
        let signals: BTreeMap<_, _> =
            sources.iter().map(|(id, x)| (SourceId::new(id).unwrap(), series(x))).collect();
        Trial { key: TrialKey::new("a", "expert", 1), signals }
    }

    fn kept(trial: Trial) -> (Vec<String>, usize) {
        let (trial, remarks) = without_flawed(trial, &Scene::lmt108(), |_, _| true);
        (trial.signals.keys().map(SourceId::to_string).collect(), remarks.len())
    }

    #[test]
    fn a_dead_source_goes_with_a_word_and_a_switch_stays() {
        let alive = vec![1.0, 2.0, 1.5, 0.3];
        let trial = query(&[("ir", vec![0.0; 4]), ("mi2", alive.clone()), ("me", vec![0.0; 4])]);
        let (after, remarks) = without_flawed(trial.clone(), &Scene::lmt108(), |_, _| true);
        assert_eq!(remarks, ["ir is left out: channel 1 is stuck at 0; check its cable"]);
        assert!(after.signals.contains_key("me") && !after.signals.contains_key("ir"));
        let halfway: Vec<f32> = (0..70).map(|i| if i < 30 { i as f32 } else { 3.0 }).collect();
        assert_eq!(kept(query(&[("ir", halfway), ("mi2", alive)])), (vec!["mi2".into()], 1));
    }

    #[test]
    fn a_channel_that_rests_in_the_library_may_rest_in_a_query() {
        let trial = query(&[("ir", vec![0.0; 4]), ("mi2", vec![1.0, 2.0, 1.5, 0.3])]);
        let (after, remarks) = without_flawed(trial, &Scene::lmt108(), |id, _| id.as_str() != "ir");
        assert!(after.signals.len() == 2 && remarks.is_empty());
    }

    #[test]
    fn a_covered_lens_is_left_out_and_the_last_source_never() {
        let black = Image::new(Image::COLS, Image::ROWS, vec![7; 480 * 320 * 3]).unwrap();
        let mut trial = query(&[("mi2", vec![1.0, 2.0, 1.0, 0.5])]);
        trial.signals.insert(SourceId::new("ca1").unwrap(), Signal::Image(black));
        assert_eq!(kept(trial), (vec!["mi2".into()], 1));
        assert_eq!(kept(query(&[("ir", vec![0.0; 4])])), (vec!["ir".into()], 0));
    }
}
