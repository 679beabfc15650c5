//! Properties of every disturbance.

use std::collections::{BTreeMap, BTreeSet};

use super::*;
use crate::dataset::synth::{self, Parameters};
use crate::library::Entry;
use crate::scene::Scene;
use crate::scene::SourceId;
use crate::seed;
use crate::trial::TrialKey;
use crate::trial::{Series, Signal};

fn trial() -> Trial {
    let small =
        Parameters { surfaces: 1, trials: 1, users: 0, drag_seconds: 1.0, ..Default::default() };
    synth::library(&small).entries[0].load().unwrap()
}

fn disturbed(d: &Disturbance, level: f64, trial: &Trial, scene: &Scene, seed: u64) -> Trial {
    let Kind::Query(change) = d.kind else { panic!("{} is for the library", d.name) };
    let mut trial = trial.clone();
    change(&mut trial, &mut Setting { level, scene, rng: seed::rng(seed, &[b"test"]) });
    trial
}

fn of_queries() -> Vec<Disturbance> {
    all().into_iter().filter(|d| matches!(d.kind, Kind::Query(_))).collect()
}

#[test]
fn names_are_distinct_and_axes_run_one_way() {
    let all = all();
    assert_eq!(all.iter().map(|d| d.name).collect::<BTreeSet<_>>().len(), all.len());
    for d in all {
        let rising = d.levels.is_sorted_by(|a, b| a < b);
        assert!(rising || d.levels.is_sorted_by(|a, b| a > b), "{}", d.name);
    }
}

#[test]
fn every_level_changes_what_it_touches_and_nothing_else() {
    let (trial, scene) = (trial(), Scene::lmt108());
    for d in of_queries() {
        for &level in d.levels {
            let after = disturbed(&d, level, &trial, &scene, 1);
            assert_eq!(after, disturbed(&d, level, &trial, &scene, 1), "{}: seeded", d.name);
            let mut changed = 0;
            for (id, signal) in &trial.signals {
                let touched = (d.touches)(scene.get(id.as_str()).unwrap());
                assert!(touched || after.signals[id] == *signal, "{} changed {id}", d.name);
                changed += usize::from(after.signals[id] != *signal);
            }
            // Cutting to a second or more leaves this drag of 1 s as it is, and rare lift-offs and
            // gaps may by chance not occur.
            let may_rest = ["short-scan", "lift-offs", "gaps"].contains(&d.name);
            assert!(changed > 0 || may_rest, "{} at {level}", d.name);
        }
    }
}

#[test]
fn the_most_absurd_level_leaves_finite_samples_of_the_same_kind() {
    let (trial, scene) = (trial(), Scene::lmt108());
    for d in of_queries() {
        let after = disturbed(&d, *d.levels.last().unwrap(), &trial, &scene, 2);
        for (id, signal) in &after.signals {
            let Signal::Series(series) = signal else { continue };
            assert!(series.samples().iter().all(|x| x.is_finite()), "{} {id}", d.name);
            assert_eq!(series.channels(), scene.get(id.as_str()).unwrap().channels);
        }
    }
}

#[test]
fn white_noise_has_the_level_that_it_says() {
    let d = all().into_iter().find(|d| d.name == "white-noise").unwrap();
    let (trial, scene) = (trial(), Scene::lmt108());
    let after = disturbed(&d, 20.0, &trial, &scene, 3);
    let (Signal::Series(a), Signal::Series(b)) = (&trial.signals["mi2"], &after.signals["mi2"])
    else {
        panic!("sound is a series");
    };
    let noise: Vec<f64> = a.channel(0).zip(b.channel(0)).map(|(a, b)| b - a).collect();
    let ratio =
        ChannelSpread::of(a.channel(0)).deviation / ChannelSpread::of(noise.into_iter()).deviation;
    assert!((20.0 * ratio.log10() - 20.0).abs() < 0.1, "{ratio}");
}

#[test]
fn the_given_number_of_sensors_is_dead_and_one_is_left() {
    let d = all().into_iter().find(|d| d.name == "dead-sensors").unwrap();
    let (trial, scene) = (trial(), Scene::lmt108());
    for (level, expected) in [(1.0, 1), (3.0, 3), (99.0, 7)] {
        let after = disturbed(&d, level, &trial, &scene, 4);
        let dead = trial.signals.iter().filter(|(id, s)| after.signals[*id] != **s).count();
        // The metal detector is never picked, being a switch.
        assert!(dead == expected, "{dead} of {expected}");
    }
}

fn library() -> Vec<Entry> {
    let entry = |(surface, number): (&str, u32)| {
        let series = Series::new(10.0, 1, vec![1.0, 2.0, 3.0, number as f32]).unwrap();
        let signals = BTreeMap::from([(SourceId::new("ir").unwrap(), Signal::Series(series))]);
        let key = TrialKey::new(surface, "expert", number);
        Entry::in_memory(Trial { key, signals })
    };
    ["a", "b", "c"].into_iter().flat_map(|s| (1..=10).map(move |n| (s, n))).map(entry).collect()
}

#[test]
fn libraries_get_smaller_wrong_or_double() {
    let rng = || seed::rng(1, &[b"library"]);
    let few = super::few(library(), 2.0, &mut rng());
    assert_eq!(few.len(), 6);
    let wrong = super::mislabelled(library(), 0.5, &mut rng());
    let moved = wrong.iter().zip(library()).filter(|(a, b)| a.key.surface != b.key.surface).count();
    assert!((8..23).contains(&moved), "{moved}");
    let keys: BTreeSet<_> = wrong.iter().map(|e| e.key.clone()).collect();
    assert_eq!(keys.len(), wrong.len(), "no trial is there twice");
    let twins = super::twins(library(), 10.0, &mut rng());
    assert_eq!(twins.len(), 60);
    assert_ne!(twins[30].load().unwrap().signals, twins[0].load().unwrap().signals);
}
