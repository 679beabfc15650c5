//! Synthetic scenes: repeatable, in range, and as difficult as they are said to be.

use rayon::prelude::*;
use surfaced::dataset::synth::{Difficulty, Parameters, embedded, library};
use surfaced::library::Entry;
use surfaced::scene::{Scene, SourceId};
use surfaced::trial::{EXPERT, Image, Series, Signal, Trial};

fn small() -> Parameters {
    Parameters { surfaces: 10, trials: 3, users: 2, drag_seconds: 0.3, ..Parameters::default() }
}

fn load_all(parameters: &Parameters) -> Vec<Trial> {
    library(parameters).entries.iter().map(|entry| entry.load().unwrap()).collect()
}

fn series<'a>(trial: &'a Trial, source: &str) -> &'a Series {
    match &trial.signals[source] {
        Signal::Series(series) => series,
        Signal::Image(_) => panic!("{source} is an image"),
    }
}

fn image<'a>(trial: &'a Trial, source: &str) -> &'a Image {
    match &trial.signals[source] {
        Signal::Image(image) => image,
        Signal::Series(_) => panic!("{source} is a series"),
    }
}

#[test]
fn the_same_seed_gives_the_same_trials() {
    assert_eq!(load_all(&small()), load_all(&small()));
}

#[test]
fn another_seed_gives_other_signals_in_every_source_but_metal() {
    let other = load_all(&Parameters { seed: 2, ..small() });
    for (a, b) in load_all(&small()).iter().zip(&other) {
        assert_eq!(a.key, b.key);
        for (id, signal) in a.signals.iter().filter(|(id, _)| id.as_str() != "me") {
            assert_ne!(signal, &b.signals[id], "{id} of {}", a.key);
        }
    }
}

#[test]
fn a_trial_does_not_depend_on_what_else_is_made_or_on_which_thread() {
    let all = load_all(&small());
    let larger = library(&Parameters { surfaces: 20, trials: 5, users: 4, ..small() });
    let same: Vec<_> = larger
        .entries
        .par_iter()
        .filter(|entry| all.iter().any(|trial| trial.key == entry.key))
        .map(|entry| entry.load().unwrap())
        .collect();
    assert_eq!(all, same);
}

#[test]
fn a_full_trial_has_the_shapes_of_lmt108() {
    let parameters = Parameters { surfaces: 1, trials: 1, users: 0, ..Parameters::default() };
    let trial = load_all(&parameters).remove(0);
    let shape = |source| {
        let series = series(&trial, source);
        (series.rate_hz(), series.frames(), series.channels())
    };
    assert_eq!(shape("mi1"), (44_100.0, 10_501, 1));
    assert_eq!(shape("mi2"), (44_100.0, 211_611, 1));
    assert_eq!(shape("ac"), (10_000.0, 48_000, 3));
    assert_eq!(shape("fr"), (10_000.0, 48_000, 2));
    assert_eq!(shape("ir"), (10_000.0, 48_000, 1));
    assert_eq!(shape("me"), (10_000.0, 48_000, 1));
    assert_eq!(image(&trial, "ca1").rgb().len(), 480 * 320 * 3);
    assert_eq!(image(&trial, "ca2").rgb().len(), 480 * 320 * 3);
}

#[test]
fn every_signal_is_finite_in_range_and_moves() {
    for trial in load_all(&small()) {
        for source in ["mi1", "mi2", "ac", "fr", "ir"] {
            let samples = series(&trial, source).samples();
            assert!(samples.iter().all(|x| (-1.0..=1.0).contains(x)), "{source} {}", trial.key);
            let full = samples.iter().filter(|x| x.abs() > 0.999).count();
            assert!(full * 100 < samples.len(), "{source} of {} is saturated", trial.key);
            assert!(samples.iter().any(|x| *x != samples[0]), "{source} {}", trial.key);
        }
        assert!(series(&trial, "me").samples().iter().all(|x| *x == 0.0 || *x == 1.0));
    }
}

#[test]
fn only_meshes_and_glossy_surfaces_are_metal_and_most_are() {
    let parameters = Parameters { trials: 2, users: 0, ..Parameters::default() };
    let library = library(&parameters);
    let only_metal = library.scene.clone().only(&[SourceId::new("me").unwrap()]).unwrap();
    let mut metal = std::collections::BTreeSet::new();
    for entry in library.entries {
        let trial = entry.within(&only_metal).load().unwrap();
        assert_eq!(trial.signals.len(), 1, "only what is wanted is made");
        let surface = trial.key.surface.clone();
        if series(&trial, "me").samples().contains(&1.0) {
            assert!(surface.ends_with("Mesh") || surface.ends_with("Glossy"), "{surface}");
            metal.insert(surface);
        }
    }
    assert!((10..24).contains(&metal.len()), "{metal:?}");
}

#[test]
fn a_scene_says_that_it_is_synthetic() {
    let library = library(&small());
    assert!(library.synthetic && library.name.starts_with("synthetic"));
    assert!(embedded().synthetic);
}

#[test]
fn user_u_makes_trial_u_of_every_surface() {
    let library = library(&small());
    for surface in library.surfaces() {
        let keys: Vec<_> = library.entries.iter().map(|e| &e.key).collect();
        let keys: Vec<_> = keys.into_iter().filter(|k| k.surface == surface).collect();
        let expected = [(EXPERT, 1), (EXPERT, 2), (EXPERT, 3), ("user1", 1), ("user2", 2)];
        let found: Vec<_> = keys.iter().map(|k| (k.user.as_str(), k.number)).collect();
        assert_eq!(found, expected);
    }
}

#[test]
fn drags_of_no_length_and_of_no_number_still_have_a_sample() {
    for drag_seconds in [0.0, -1.0, f64::NAN] {
        let parameters = Parameters { surfaces: 1, trials: 1, users: 0, drag_seconds, ..small() };
        assert_eq!(series(&load_all(&parameters)[0], "ac").frames(), 1);
    }
}

/// Mean colour of a picture.
fn colour(trial: &Trial) -> Vec<f64> {
    let rgb = image(trial, "ca1").rgb();
    let mean = |c: usize| rgb[c..].iter().step_by(3).map(|&x| f64::from(x)).sum::<f64>();
    (0..3).map(|c| mean(c) / (rgb.len() / 3) as f64).collect()
}

/// ln of the energy in three parts of a tap: before and at the touch, just after, and the rest.
fn tap(trial: &Trial) -> Vec<f64> {
    let samples = series(trial, "mi1").samples();
    let energy = |part: &[f32]| part.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>().ln();
    vec![energy(&samples[..1_100]), energy(&samples[1_100..2_000]), energy(&samples[2_000..])]
}

#[test]
fn surfaces_differ_more_than_trials_of_one_surface() {
    let trials = load_all(&Parameters { users: 0, drag_seconds: 0.01, ..small() });
    for (name, feature) in [("ca1", colour as fn(&Trial) -> Vec<f64>), ("mi1", tap)] {
        let features: Vec<_> = trials.iter().map(|t| (&t.key.surface, feature(t))).collect();
        let (mut same, mut other) = (Vec::new(), Vec::new());
        for (i, (surface, x)) in features.iter().enumerate() {
            for (surface2, y) in &features[..i] {
                let d2: f64 = x.iter().zip(y).map(|(x, y)| (x - y).powi(2)).sum();
                if surface == surface2 { same.push(d2) } else { other.push(d2) }
            }
        }
        let mean = |x: &[f64]| x.iter().sum::<f64>() / x.len() as f64;
        assert!(mean(&other) > 4.0 * mean(&same), "{name}: {} {}", mean(&other), mean(&same));
    }
}

/// Accuracy of the method `reference`, with few samples, on one source of 20 surfaces.
fn accuracy(source: &str, shift: bool, difficulty: Difficulty) -> f64 {
    use surfaced::evaluate::{Evaluation, Protocol, folds};
    use surfaced::recognise::{Reference, ReferenceOptions};

    let scene = Scene::lmt108().only(&[SourceId::new(source).unwrap()]).unwrap();
    let scene = scene.changed(|spec| spec.align_mean &= shift);
    let size = Parameters { surfaces: 20, trials: 3, users: 3, ..Parameters::default() };
    let library = library(&Parameters { difficulty, ..size });
    let entries: Vec<_> = library.entries.into_iter().map(|e| e.within(&scene)).collect();
    let keys: Vec<_> = entries.iter().map(|e| e.key.clone()).collect();
    let folds = folds(Protocol::ExpertVsUsers, &keys).unwrap();
    let options = ReferenceOptions { samples: 200, repetitions: 2, ..Default::default() };
    let method = Reference::new(scene.clone(), options);
    let run = Evaluation::new(&scene, &entries, &folds).prepare(&method).unwrap();
    run.measure().unwrap().outcome.accuracy_mean
}

#[test]
fn the_calibrated_scene_is_harder_for_cameras_and_easier_for_taps_than_the_demonstration() {
    let [camera, tap] = ["ca2", "mi1"].map(|source| {
        let of = |difficulty| accuracy(source, true, difficulty);
        (of(Difficulty::lmt108()), of(Difficulty::default()))
    });
    assert!(camera.0 < camera.1 - 0.1 && camera.0 > 0.3, "{camera:?}");
    assert!(tap.0 > tap.1, "{tap:?}");
}

#[test]
fn between_users_of_the_calibrated_scene_reflectance_says_little_without_the_shift() {
    let [with, without] = [true, false].map(|shift| accuracy("ir", shift, Difficulty::lmt108()));
    assert!(with > without + 0.15, "{with} {without}");
}

#[test]
fn what_is_known_of_a_trial_before_it_is_generated_is_what_is_generated() {
    let parameters =
        Parameters { surfaces: 1, trials: 1, drag_seconds: 0.731, ..Default::default() };
    let entry = &library(&parameters).entries[0];
    let generated = Entry::in_memory(entry.load().unwrap());
    assert_eq!(entry.outlines().unwrap(), generated.outlines().unwrap());
}
