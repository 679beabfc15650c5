//! Signals, their flaws, the sources that are left out for them, and the shape of a library.

use std::collections::BTreeMap;

use surfaced::library::Entry;
use surfaced::recognise::{LibraryShape, SourceShape, without_flawed};
use surfaced::scene::{Scene, SourceId};
use surfaced::trial::{Doubt, Image, Series, SeriesFlaws, Signal, Trial, TrialKey};

#[test]
fn a_nan_is_named_by_channel_and_sample() {
    let error = Series::new(1.0, 2, vec![0.0, 1.0, 2.0, f32::NAN]).unwrap_err();
    assert!(error.to_string().starts_with("channel 2 is NaN at sample 2"), "{error}");
}

#[test]
fn a_picture_on_its_side_is_turned_upright() {
    let mut rgb = vec![0; 480 * 320 * 3];
    // The left bottom corner of a picture becomes its left top corner.
    rgb[319 * 480 * 3] = 200;
    let image = Image::new(480, 320, rgb).unwrap();
    assert_eq!(image.pixel(0, 0), [200, 0, 0]);
}

#[test]
fn cropping_keeps_at_least_one_frame() {
    let series = Series::new(10.0, 1, vec![1.0, 2.0, 3.0]).unwrap();
    assert_eq!(series.crop(0, 0).frames(), 1);
    assert_eq!(series.crop(9, 99).samples(), [3.0]);
}

fn id(name: &str) -> SourceId {
    SourceId::new(name).unwrap()
}

fn doubts(channels: usize, samples: Vec<f32>) -> Vec<Doubt> {
    SeriesFlaws::of(&Series::new(100.0, channels, samples).unwrap()).doubts(&id("ir"), &[])
}

fn one_channel(values: impl Iterator<Item = f32>) -> Vec<Doubt> {
    doubts(1, values.collect())
}

#[test]
fn a_stuck_channel_is_found_and_its_neighbour_is_not() {
    let samples = (0..100).flat_map(|i| [i as f32, 4.0]).collect();
    let found = doubts(2, samples);
    let source = id("ir");
    assert_eq!(found, [Doubt::Stuck { source, channel: 2, value: 4.0, share: 1.0 }]);
    assert!(found[0].to_string().contains("stuck at 4"));
}

#[test]
fn a_clipped_sine_is_saturated_and_a_whole_one_is_not() {
    let sine = |i: i32| (i as f32 * 0.01).sin();
    assert_eq!(one_channel((0..10_000).map(sine)), []);
    let clipped = one_channel((0..10_000).map(|i| sine(i).clamp(-0.7, 0.7)));
    let [Doubt::Clipped { channel: 1, value, share, .. }] = clipped[..] else {
        panic!("{clipped:?}")
    };
    assert!(value.abs() == 0.7 && share > 0.3, "{clipped:?}");
}

#[test]
fn a_limit_counts_wherever_it_is_reached_first_and_no_value_that_is_passed_later() {
    let ramp = |i: i32| (i % 50) as f32;
    let begins_high = (0..1000).map(|i| if i < 100 { 49.0 } else { ramp(i) });
    let clipped = Doubt::Clipped { source: id("ir"), channel: 1, value: 49.0, share: 0.1 };
    assert_eq!(one_channel(begins_high), [clipped]);
    let rests_below = (0..1000).map(|i| if i < 100 { 40.0 } else { ramp(i) });
    assert_eq!(one_channel(rests_below), []);
}

#[test]
fn a_switch_is_not_saturated() {
    assert_eq!(one_channel((0..1000).map(|i| if i < 500 { 0.0 } else { 1.0 })), []);
}

#[test]
fn values_that_are_merely_coarse_or_repeated_are_not_saturated() {
    let sine = |i: i32| (i as f32 * 0.01).sin();
    for steps in [8.0, 20.0, 100.0] {
        assert_eq!(one_channel((0..10_000).map(|i| (sine(i) * steps).round())), [], "{steps}");
    }
    // Noise with each value five times; then a coarse sine that is clipped.
    let noise = |i: i32| ((i / 5) as f32 * 12.9898).sin() * 43_758.547;
    assert_eq!(one_channel((0..5000).map(|i| (noise(i).fract() * 9.0).round())), []);
    let clipped = (0..10_000).map(|i| (sine(i) * 20.0).round().clamp(-10.0, 10.0));
    assert!(matches!(one_channel(clipped)[..], [Doubt::Clipped { share, .. }] if share > 0.5));
}

#[test]
fn a_channel_at_zero_has_a_loose_cable_and_no_gain_to_lower() {
    let loose = |i: i32| if i % 100 < 30 { i as f32 } else { 0.0 };
    let found = one_channel((0..1000).map(loose));
    assert!(matches!(found[..], [Doubt::AtZero { .. }]), "{found:?}");
    assert!(found[0].to_string().contains("check its cable"));
    let lifted = |i: i32| if i % 100 < 70 { i as f32 } else { 0.0 };
    assert_eq!(one_channel((0..1000).map(lifted)), []);
}

fn query(sources: &[(&str, Vec<f32>)]) -> Trial {
    let series =
        |samples: &Vec<f32>| Signal::Series(Series::new(10.0, 1, samples.clone()).unwrap());
    let signals: BTreeMap<_, _> =
        sources.iter().map(|(id, x)| (SourceId::new(id).unwrap(), series(x))).collect();
    Trial { key: TrialKey::new("a", "expert", 1), signals }
}

fn kept(trial: Trial) -> (Vec<String>, usize) {
    let (trial, remarks) = without_flawed(trial, &Scene::lmt108(), |_| &[]);
    (trial.signals.keys().map(SourceId::to_string).collect(), remarks.len())
}

#[test]
fn a_dead_source_goes_with_a_word_and_a_switch_stays() {
    let alive = vec![1.0, 2.0, 1.5, 0.3];
    let trial = query(&[("ir", vec![0.0; 4]), ("mi2", alive.clone()), ("me", vec![0.0; 4])]);
    let (after, remarks) = without_flawed(trial.clone(), &Scene::lmt108(), |_| &[]);
    assert_eq!(remarks[0].to_string(), "ir: channel 1 is stuck at 0; check its cable");
    assert!(after.signals.contains_key("me") && !after.signals.contains_key("ir"));
    let halfway: Vec<f32> = (0..70).map(|i| if i < 30 { i as f32 } else { 3.0 }).collect();
    assert_eq!(kept(query(&[("ir", halfway), ("mi2", alive)])), (vec!["mi2".into()], 1));
}

#[test]
fn a_channel_that_rests_in_the_library_may_rest_in_a_query() {
    let trial = query(&[("ir", vec![0.0; 4]), ("mi2", vec![1.0, 2.0, 1.5, 0.3])]);
    let (after, remarks) = without_flawed(trial, &Scene::lmt108(), |id| match id.as_str() {
        "ir" => &[1.0],
        _ => &[],
    });
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

#[test]
fn a_shape_has_the_median_length_of_the_trials_that_have_the_source() {
    let trial = |number: u32, ir: Option<usize>| {
        let series =
            |frames: usize| Signal::Series(Series::new(100.0, 2, vec![0.5; 2 * frames]).unwrap());
        let id = |name: &str| SourceId::new(name).unwrap();
        let mut signals = BTreeMap::from([(id("fr"), series(10 * number as usize))]);
        signals.extend(ir.map(|frames| (id("ir"), series(frames))));
        Entry::in_memory(Trial { key: TrialKey::new("oak", "expert", number), signals })
    };
    let trials = [trial(3, None), trial(1, Some(7)), trial(2, None)];
    let shape = LibraryShape::of(&trials.iter().collect::<Vec<_>>()).unwrap();
    let of = |name: &str| shape.get(&SourceId::new(name).unwrap());
    let fr = SourceShape { rate_hz: 100.0, channels: 2, median_frames: 20 };
    assert_eq!(of("fr"), Some(fr));
    assert_eq!(of("ir"), Some(SourceShape { median_frames: 7, ..fr }));
    assert_eq!(of("mi2"), None);
    assert_ne!(shape.key(), LibraryShape::default().key());
}
