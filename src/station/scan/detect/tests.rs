use std::collections::BTreeMap;

use super::*;
use crate::dataset::synth;
use crate::station::config::StationConfig;
use crate::trial::Signal;

const RATE_HZ: f64 = 10_000.0;

fn detector(rate_hz: f64) -> Detector {
    Detector::new(StationConfig::embedded().detection.detector, hop_s(rate_hz))
}

/// The events of a detector for the levels of this many hops; `None` is a hop in a gap.
fn events(hops: u64, level: impl Fn(u64) -> Option<f64>) -> Vec<DetectorEvent> {
    let mut detector = detector(RATE_HZ);
    (0..hops).filter_map(|hop| detector.hop(level(hop), false)).collect()
}

/// Pseudo-random noise of this amplitude, determined by its seed.
fn noise(frames: usize, amplitude: f32, seed: &mut u32) -> Vec<f32> {
    let mut next = || {
        *seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        ((*seed >> 8) as f32 / (1 << 24) as f32 - 0.5) * 2.0 * amplitude
    };
    (0..frames).map(|_| next()).collect()
}

/// The levels of a stream, and the events that a detector finds in these levels.
fn find(
    kind: SensorKind,
    channels: usize,
    rate_hz: f64,
    samples: &[f32],
) -> (Vec<f64>, Vec<DetectorEvent>) {
    let (mut level, mut detector) = (StreamLevel::new(kind, channels, rate_hz), detector(rate_hz));
    let (mut levels, mut found) = (Vec::new(), Vec::new());
    let begin = |hop: usize| (hop as f64 * hop_frames(rate_hz)).round() as usize * channels;
    for hop in (0..).take_while(|hop| begin(hop + 1) <= samples.len()) {
        let frames = &samples[begin(hop)..begin(hop + 1)];
        let x = level.hop(frames, [], detector.in_contact());
        levels.extend(x);
        let pressed = kind == SensorKind::Force && x >= Some(detector.config.quiet);
        let event = detector.hop(x, pressed);
        if detector.rest_rose {
            level.adopt_lowest();
        }
        found.extend(event);
    }
    found.extend(detector.finish());
    (levels, found)
}

/// The events of a drag.
fn drag(tap: Option<(u64, u64)>, start: u64, end: u64, cut: bool) -> [DetectorEvent; 2] {
    [DetectorEvent::Drag { tap, start }, DetectorEvent::End { end, cut }]
}

fn synthetic(source: &str, entry: usize) -> (f64, Vec<f32>) {
    let trial = synth::embedded().entries[entry].load().unwrap();
    let signals: BTreeMap<_, _> = trial.signals;
    match &signals[source] {
        Signal::Series(series) => (series.rate_hz(), series.samples().to_vec()),
        Signal::Image(_) => panic!("{source} is no series"),
    }
}

/// The rate, the sound (silence, tap, silence, drag, silence), and the times in s of tap, drag and end.
fn joined(entry: usize) -> (f64, Vec<f32>, [f64; 3]) {
    let (rate_hz, tap) = synthetic("mi1", entry);
    let (_, drag) = synthetic("mi2", entry);
    // The level of the recording's room noise, before the stylus touches the surface.
    let quiet = (tap[..800].iter().map(|x| x * x).sum::<f32>() / 800.0).sqrt();
    let seed = &mut 7;
    let mut silence = |seconds: f64| noise((seconds * rate_hz) as usize, quiet * 1.7, seed);
    let mut all = silence(1.0);
    let tap_s = all.len() as f64 / rate_hz + 0.02;
    all.extend(&tap);
    all.extend(silence(0.6));
    let start_s = all.len() as f64 / rate_hz;
    all.extend(&drag);
    let end_s = all.len() as f64 / rate_hz;
    all.extend(silence(1.0));
    (rate_hz, all, [tap_s, start_s, end_s])
}

#[test]
fn tap_and_drag_are_found_in_the_sound_of_every_synthetic_surface() {
    let mut worst = 0.0_f64;
    for entry in (0..synth::embedded().entries.len()).step_by(7) {
        let (rate_hz, samples, [tap_s, start_s, end_s]) = joined(entry);
        let (_, found) = find(SensorKind::Vibration, 1, rate_hz, &samples);
        let [DetectorEvent::Drag { tap: Some((tap, _)), start }, DetectorEvent::End { end, .. }] =
            found[..]
        else {
            panic!("entry {entry}: {found:?}, expected {tap_s} {start_s} {end_s}");
        };
        for (hop, true_s) in [(tap, tap_s), (start, start_s), (end, end_s)] {
            let error = hop as f64 * HOP_S - true_s;
            worst = worst.max(error.abs());
            assert!(error.abs() <= 0.02, "entry {entry}: {hop} for {true_s}");
        }
    }
    println!("worst error of a begin or an end: {:.1} ms", worst * 1e3);
}

#[test]
fn a_drag_is_found_in_force_above_what_rests_on_the_sensor() {
    let seed = &mut 3;
    let mut samples: Vec<f32> = noise(30_000, 0.001, seed).iter().map(|x| 0.1 + x).collect();
    let push = noise(20_000, 0.02, seed).into_iter().map(|x| 0.3 + x);
    samples.splice(8_000..28_000, push);
    let (_, found) = find(SensorKind::Force, 1, RATE_HZ, &samples);
    assert_eq!(found, drag(None, 160, 560, false));
}

#[test]
fn noise_alone_is_nothing_and_a_louder_room_is_learnt() {
    let seed = &mut 5;
    let mut samples = noise(40_000, 0.01, seed);
    assert_eq!(find(SensorKind::Vibration, 1, RATE_HZ, &samples).1, []);
    samples.extend(noise(650_000, 0.1, seed));
    let (_, found) = find(SensorKind::Vibration, 1, RATE_HZ, &samples);
    assert_eq!(found[1..], [DetectorEvent::NoiseTimeout], "{found:?}");
}

#[test]
fn drags_end_and_are_apart_where_the_noise_at_rest_has_risen() {
    // Rest of 0.004, drags of 2 s, and rests of 1.5 s that are louder than at the begin, or that follow
    // constant values.
    let run = |begin: f32, risen_s: usize| {
        let seed = &mut 11;
        let frames = |seconds: usize| seconds * 400;
        let mut samples = noise(3 * frames(3), begin, seed);
        samples.extend(noise(3 * frames(risen_s), 0.016, seed));
        for _ in 0..4 {
            samples.extend(noise(3 * frames(2), 0.3, seed));
            samples.extend(noise(3 * 600, 0.016, seed));
        }
        find(SensorKind::Vibration, 3, 400.0, &samples).1
    };
    let lengths = |found: &[DetectorEvent]| {
        let (mut lengths, mut start) = (Vec::new(), 0);
        for event in found {
            match event {
                DetectorEvent::Drag { start: at, .. } => start = *at,
                DetectorEvent::End { end, cut: false } => lengths.push(end - start),
                _ => lengths.push(0),
            }
        }
        lengths
    };
    for (begin, risen_s) in [(0.004, 1), (0.004, 12), (0.0, 0), (0.0, 3), (0.002, 2)] {
        let found = lengths(&run(begin, risen_s));
        // At most the first drag is given up, with the noise before it.
        let (first, rest) = found.split_first().unwrap();
        let whole = |hops: &u64| (400..=420).contains(hops);
        assert!((*first == 0 || whole(first)) && rest.len() == 3, "{begin}, {risen_s}: {found:?}");
        assert!(rest.iter().all(whole), "{begin}, {risen_s}: {found:?}");
    }
}

#[test]
fn a_soft_drag_after_a_bump_or_a_loud_part_is_one_drag() {
    let level = |hop: u64| match hop {
        100..=110 => 80.0,
        111..=300 => 60.0,
        301..=360 => 9.0,
        361..=700 => 30.0,
        _ => 1.0,
    };
    let found = events(1000, |hop| Some(level(hop)));
    assert_eq!(found, drag(None, 100, 701, false));
}

#[test]
fn a_pause_within_the_drag_does_not_end_it_and_a_long_one_does() {
    let level = |hop: u64| match hop {
        100..=109 => 20.0,
        200..=399 | 440..=599 => 10.0,
        // between the limits, so this level neither begins nor ends a contact
        600..=649 => 4.0,
        _ => 1.0,
    };
    let found = events(1000, |hop| Some(level(hop)));
    assert_eq!(found, drag(Some((100, 110)), 200, 650, false));
}

#[test]
fn a_tap_long_ago_belongs_to_no_drag_and_the_last_of_two_taps_does() {
    let run = |taps: [u64; 2], drag: u64| {
        let on = |hop: u64| taps.iter().any(|t| (*t..t + 8).contains(&hop)) || hop >= drag;
        events(drag + 100, |hop| Some(if on(hop) { 9.0 } else { 0.0 }))[0]
    };
    assert_eq!(run([100, 150], 300), DetectorEvent::Drag { tap: Some((150, 158)), start: 300 });
    assert_eq!(run([100, 150], 800), DetectorEvent::Drag { tap: None, start: 800 });
}

#[test]
fn a_constant_offset_between_two_streams_is_read_off_their_taps() {
    for offset_s in [-0.2, -0.03, 0.0, 0.07, 0.25] {
        let seed = &mut 11;
        let mut stream = |rate_hz: f64, tap_s: f64| {
            let mut samples = noise((2.0 * rate_hz) as usize, 0.002, seed);
            let tap = noise((0.06 * rate_hz) as usize, 0.5, seed);
            let at = (tap_s * rate_hz) as usize;
            samples[at..at + tap.len()].copy_from_slice(&tap);
            let levels = find(SensorKind::Vibration, 1, rate_hz, &samples).0;
            levels.into_iter().map(Some).collect::<Vec<_>>()
        };
        let (lead, other) = (stream(10_000.0, 1.0), stream(44_100.0, 1.0 + offset_s));
        let tap = onset_in(&lead, 0, 60..400, 6.0).unwrap();
        let seen = onset_in(&other, 0, tap - 60..tap + 60, 6.0).unwrap();
        let found_s = (seen as f64 - tap as f64) * HOP_S;
        assert!((found_s - offset_s).abs() <= 0.02, "{offset_s}: {found_s}");
    }
}

#[test]
fn infinite_samples_do_not_stop_detection_for_good() {
    for kind in [SensorKind::Vibration, SensorKind::Force] {
        let mut seed = 7;
        let mut samples = noise(10_000, 1e-3, &mut seed);
        samples[2_000..3_000].fill(f32::INFINITY);
        samples[3_000..3_500].fill(f32::NAN);
        samples.extend(noise(10_000, 1e-3, &mut seed));
        // A drag, and silence.
        samples.extend(noise(10_000, 0.3, &mut seed).iter().map(|x| x + 0.5));
        samples.extend(noise(10_000, 1e-3, &mut seed));
        let (levels, found) = find(kind, 1, RATE_HZ, &samples);
        assert!(levels.iter().all(|level| level.is_finite()), "{kind:?}");
        let [DetectorEvent::Drag { start, .. }, DetectorEvent::End { .. }] = found[..] else {
            panic!("{kind:?}: {found:?}");
        };
        assert!(start.abs_diff(400) <= 2, "{kind:?}: {start}");
    }
}

#[test]
fn drags_are_found_in_slow_streams() {
    for rate_hz in [12.5, 20.0, 25.0, 50.0, 100.0, 119.0, 150.0, 199.0] {
        for channels in [1, 3] {
            let seed = &mut (rate_hz as u32 + channels as u32);
            let part = |seconds: f64, amplitude: f32, seed: &mut u32| {
                let still = noise((seconds * rate_hz) as usize * channels, amplitude, seed);
                still.into_iter().map(|x| 0.5 + x)
            };
            let (mut samples, mut drags) =
                (part(10.0, 0.004, seed).collect::<Vec<_>>(), Vec::new());
            for _ in 0..6 {
                let start = samples.len() / channels;
                samples.extend(part(3.0, 0.3, seed));
                drags.push((start, samples.len() / channels));
                samples.extend(part(3.0, 0.004, seed));
            }
            let (_, found) = find(SensorKind::Vibration, channels, rate_hz, &samples);
            let found: Vec<_> = found
                .chunks(2)
                .map(|pair| match pair {
                    [DetectorEvent::Drag { start, .. }, DetectorEvent::End { end, cut: false }] => {
                        (*start as usize, *end as usize)
                    }
                    other => panic!("{rate_hz} Hz, {channels} channels: {other:?}"),
                })
                .collect();
            assert_eq!(found.len(), drags.len(), "{rate_hz} Hz, {channels} channels: {found:?}");
            // A frame of a drag may be as still as rest.
            let off =
                found.iter().zip(&drags).map(|(a, b)| a.0.abs_diff(b.0).max(a.1.abs_diff(b.1)));
            let most = off.max().unwrap();
            let allowed = (0.05 * rate_hz).max(3.0) as usize;
            assert!(most <= allowed, "{rate_hz} Hz, {channels} channels: {most} frames off");
        }
    }
}

#[test]
fn slow_streams_at_rest_have_no_drag() {
    for (rate_hz, channels) in [(12.5, 1), (20.0, 1), (50.0, 1), (100.0, 3), (199.0, 1)] {
        let frames = (1200.0 * rate_hz) as usize * channels;
        // A sum of six, so that some samples lie far from 0.
        let parts = [1, 2, 3, 4, 5, 6].map(|seed| noise(frames, 0.002, &mut { seed }));
        let samples: Vec<f32> =
            (0..frames).map(|i| parts.iter().map(|part| part[i]).sum()).collect();
        assert_eq!(find(SensorKind::Vibration, channels, rate_hz, &samples).1, [], "{rate_hz} Hz");
    }
}

/// Levels of a drag from hop 100 to 300, with a gap; the events.
fn with_gap(gap: std::ops::Range<u64>) -> Vec<DetectorEvent> {
    let level = |hop: u64| if (100..300).contains(&hop) { 9.0 } else { 1.0 };
    events(1500, |hop| (!gap.contains(&hop)).then(|| level(hop)))
}

#[test]
fn a_gap_neither_begins_nor_holds_nor_ends_a_drag_and_a_drag_that_it_cut_says_so() {
    assert_eq!(with_gap(0..50), drag(None, 100, 300, false));
    assert_eq!(with_gap(400..900), drag(None, 100, 300, false));
    assert_eq!(with_gap(180..220), drag(None, 100, 300, true), "within the drag");
    assert_eq!(with_gap(80..150), drag(None, 150, 300, true), "where it begins");
    assert_eq!(with_gap(250..400), drag(None, 100, 250, true), "where it ends");
    assert_eq!(with_gap(310..400), drag(None, 100, 300, true), "where its quiet is");
    assert_eq!(with_gap(200..1300), drag(None, 100, 200, true), "a long gap ends it");
    assert_eq!(with_gap(50..350), []);
}

#[test]
fn a_floor_outlasts_a_gap_as_long_as_its_memory_and_filled_frames_do_not_lower_it() {
    let rate_hz = 400.0;
    for (gap_s, forgets) in [(0.3, false), (2.0, false), (9.0, false), (11.0, true)] {
        let mut level = StreamLevel::new(SensorKind::Vibration, 1, rate_hz);
        let seed = &mut 23;
        let mut hops = |level: &mut StreamLevel, amplitude: f32, hops: usize| -> Vec<f64> {
            (0..hops).filter_map(|_| level.hop(&noise(2, amplitude, seed), [], false)).collect()
        };
        hops(&mut level, 0.004, 400);
        for _ in 0..(gap_s / HOP_S) as usize {
            assert_eq!(level.hop(&[0.1; 2], std::iter::once(0..2), false), None);
        }
        let after = hops(&mut level, 0.004, 200);
        assert!(after.iter().all(|x| *x < 6.0), "{gap_s} s: {after:?}");
        assert_eq!(after[..50].iter().all(|x| *x == 0.0), forgets, "{gap_s} s");
    }
}
