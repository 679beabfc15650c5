//! The cost of a look at a scan in progress, in memory touched: the same at any length of the scan.

mod common;
#[path = "common/counting.rs"]
mod counting;

use std::sync::atomic::Ordering;

use common::id;
use counting::{ALLOCATED, Counting, HELD};
use surfaced::dataset::synth;
use surfaced::recognise::{
    FollowOptions, Follower, FreshFrames, LOOK_S, MethodName, MethodSpec, ready_model,
};
use surfaced::scene::Phase;
use surfaced::trial::{Signal, Trial};

#[global_allocator]
static COUNTING: Counting = Counting;

/// Passes on the next step of a scan that repeats a trial's drag without end, and looks.
fn step(follower: &mut Follower, trial: &Trial, dragged: impl Fn(&str) -> bool, step: usize) {
    for (source, signal) in &trial.signals {
        let Signal::Series(series) = signal else { continue };
        let (rate_hz, channels) = (series.rate_hz(), series.channels());
        if !dragged(source.as_str()) && step > 1 {
            continue;
        }
        let frames = (LOOK_S * rate_hz) as usize;
        let steps = series.frames() / frames;
        let at = (step - 1) % steps * frames * channels;
        let samples = &series.samples()[at..at + frames * channels];
        follower.add(FreshFrames { source, rate_hz, channels, samples }).unwrap();
    }
    assert!(follower.look(step as f64 * LOOK_S).unwrap().is_some() || step < 5);
}

#[test]
fn a_look_costs_the_same_at_the_hundredth_second_of_a_scan_as_at_its_tenth() {
    let size = synth::Parameters { surfaces: 3, trials: 3, users: 0, ..Default::default() };
    let library = synth::library(&synth::Parameters { drag_seconds: 1.0, ..size });
    let scene = library.scene.only(&["ca1", "fr", "me", "mi1", "mi2"].map(id)).unwrap();
    let entries: Vec<_> =
        library.entries.iter().map(|entry| entry.clone().within(&scene)).collect();
    let method = MethodSpec::from(MethodName::Embedding).build(&scene);
    let all = (0..entries.len()).collect();
    let model = ready_model(&*method, &entries, &all, None, &|_, _| ()).unwrap().model;
    let scan = entries[0].load().unwrap();
    let mut follower = model.embedding().unwrap().follow(&FollowOptions::default());
    let dragged = |source: &str| scene.get(source).unwrap().phase == Phase::Drag;

    // Of a second of looks each: what they allocate, and what is held after them.
    let mut costs = Vec::new();
    follower.begin();
    for second in 0..100 {
        let before = ALLOCATED.load(Ordering::Relaxed);
        (1..=10).for_each(|n| step(&mut follower, &scan, dragged, 10 * second + n));
        costs.push((ALLOCATED.load(Ordering::Relaxed) - before, HELD.load(Ordering::Relaxed)));
    }
    let (tenth, hundredth) = (costs[9], costs[99]);
    println!("bytes allocated and held: {tenth:?} at 10 s, {hundredth:?} at 100 s");
    assert!(tenth.0 > 100_000, "what looks do is not seen: {tenth:?}");
    // A list may be about to grow; a copy of what came since would be a hundred times this.
    let more = hundredth.0 as f64 / tenth.0 as f64;
    assert!((0.9..1.1).contains(&more), "{tenth:?} at 10 s, {hundredth:?} at 100 s");
    assert!((hundredth.1 - tenth.1).abs() < 100_000, "{tenth:?} at 10 s, {hundredth:?} at 100 s");
}
