//! Naming without begin and end: stretches, changes, rest, gaps and unknown surfaces.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};

use crate::bench::{self, Bench, SCANNED, synthetic};
use crate::common::{id, simulate};
use serde_json::{Value, json};
use surfaced::device::Replay;
use surfaced::library::Entry;
use surfaced::recognise::{MethodName, MethodSpec, ready_model};
use surfaced::scan::{Fresh, Options, Progress};
use surfaced::scene::Scene;
use surfaced::seed;
use surfaced::station::{
    Answer, AnswerState, Change, Continuous, ContinuousNaming, LibraryState, Listener, Recogniser,
    Station, StationEvent,
};
use surfaced::trial::{Doubt, Series, Signal, Trial, TrialKey};

const RATE_HZ: f64 = 1_000.0;
const WINDOW_S: f64 = 1.0;
const HOW: Continuous = Continuous { hop_s: 0.1, expected_stay_s: 10.0 };
/// Lags at which the noise of a surface repeats, in frames. The library lacks `wool`.
const SURFACES: [(&str, f64); 4] = [("ash", 0.5), ("elm", 3.0), ("oak", 12.0), ("wool", 100.0)];

fn scene() -> Scene {
    Scene::lmt108().only(&[id("ir")]).unwrap()
}

/// Noise that is smooth over as many frames as its surface says.
fn trial(surface: usize, number: u32, seconds: f64) -> Trial {
    let (name, tau) = SURFACES[surface];
    let mut rng = seed::rng(u64::from(number), &[name.as_bytes()]);
    let samples = simulate::ar1((seconds * RATE_HZ) as usize, tau, &mut rng);
    let samples = samples.into_iter().map(|x| 0.05 * x).collect();
    let series = Series::new(RATE_HZ, 1, samples).unwrap();
    let signals = [(id("ir"), Signal::Series(series))].into();
    Trial { key: TrialKey::new(name, format!("user{}", number % 3), number), signals }
}

/// A recogniser of the first three surfaces, which needs scans as long as a window.
fn recogniser() -> Arc<Recogniser> {
    let trials = (0..3).flat_map(|surface| (1..=20).map(move |n| trial(surface, n, 2.0)));
    let entries: Vec<Entry> = trials.map(Entry::in_memory).collect();
    let method = MethodSpec::from(MethodName::Embedding).build(&scene());
    let all: BTreeSet<usize> = (0..entries.len()).collect();
    let model = ready_model(&*method, &entries, &all, None, &|_, _| ()).unwrap().model;
    let mut by = Recogniser::new(model, scene(), LibraryState::of("woods", &entries, false));
    by.reject_unknown(None).unwrap();
    by.needed_s = Some(WINDOW_S);
    Arc::new(by)
}

/// Changes, answers and warnings.
type Heard = (Vec<Change>, Vec<Answer>, Vec<String>);

#[derive(Clone, Default)]
struct Told(Arc<Mutex<Heard>>);

impl Listener for Told {
    fn on_event(&mut self, event: &StationEvent) {
        let (changes, answers, warnings) = &mut *self.0.lock().unwrap();
        match event {
            StationEvent::Change(change) => changes.push(Change::clone(change)),
            StationEvent::Answer(answer) => answers.push(Answer::clone(answer)),
            StationEvent::Unnamed(answer) => warnings.push(format!("unnamed {}", answer.scan)),
            StationEvent::Warning(warning) => warnings.push(warning.text.clone()),
            _ => {}
        }
    }
}

#[test]
fn joined_surfaces_are_told_apart_soon_after_each_joint_and_an_unknown_one_is_unknown() {
    // Stretches of six seconds each, of recordings of two seconds.
    let stretches = [0, 1, 3, 2, 1];
    let parts = stretches.iter().enumerate();
    let trials = parts.flat_map(|(at, &surface)| {
        (0..3).map(move |part| Entry::in_memory(trial(surface, 100 + 3 * at as u32 + part, 2.0)))
    });
    let device = Replay { is_joined: true, ..Replay::new(&scene(), trials.collect()) };
    let told = Told::default();
    let mut station =
        Station::new(vec![Box::new(device)], Options::default()).listener(told.clone());
    station.recogniser = Some(recogniser());
    station.continuous = Some(HOW);
    station.run().unwrap();
    let (changes, answers, warnings) = &*told.0.lock().unwrap();
    assert!(warnings.is_empty(), "{warnings:?}");
    let name = |surface: usize| (surface < 3).then(|| SURFACES[surface].0.to_string());
    let expected: Vec<_> = stretches.map(name).into();
    let found: Vec<_> = changes.iter().map(|change| change.to.surface.clone()).collect();
    assert_eq!(found, expected, "{changes:#?}");
    for (at, change) in changes.iter().enumerate() {
        let (joint_s, at_s) = (6.0 * at as f64, change.at_s);
        assert!((0.05..2.0 * WINDOW_S).contains(&(at_s - joint_s)), "{change:?}");
        assert!((change.since_s - joint_s).abs() < 0.5 * WINDOW_S, "{change:?}");
        let before = at.checked_sub(1).map(|before| changes[before].to.clone());
        assert_eq!((change.scan, &change.from), (1, &before));
        assert_eq!(change.to.state == AnswerState::Unknown, change.to.surface.is_none());
        assert_eq!(change.confidence.is_some(), change.to.surface.is_some());
    }
    // One answer for each stretch; they follow each other without a hole.
    let surfaces: Vec<_> = answers.iter().map(|answer| answer.surface.clone()).collect();
    assert_eq!(surfaces, expected);
    let mut begin_s = 0.0;
    for (answer, surface) in answers.iter().zip(stretches) {
        assert!((answer.begin_s.unwrap() - begin_s).abs() < 1e-9, "{answer:?}");
        assert!(changes.iter().any(|change| (change.since_s - begin_s).abs() < 1e-9));
        begin_s += answer.scan_s;
        assert_eq!(answer.truth.as_deref(), Some(SURFACES[surface].0));
        assert_eq!(answer.confidence.is_some(), surface < 3);
        let state = if surface < 3 { AnswerState::Named } else { AnswerState::Unknown };
        assert_eq!(answer.state, state, "{answer:?}");
    }
    assert!((begin_s - 30.0).abs() < HOW.hop_s + 1e-9, "{begin_s}");
}

/// Hears a signal hop by hop. Hops that begin within `gap` are missing, and so the last frame before them
/// repeats. Gives the changes, and the last stretch.
fn heard(samples: &[f32], gap: std::ops::Range<usize>, says_gap: bool) -> (Vec<Change>, Answer) {
    let (by, mut naming) = (recogniser(), ContinuousNaming::new(HOW));
    let hop = (HOW.hop_s * RATE_HZ) as usize;
    let (mut changes, mut last) = (Vec::new(), 0.0);
    for (number, samples) in samples.chunks_exact(hop).enumerate() {
        let start = number * hop;
        let missing = gap.contains(&start);
        let samples = if missing { vec![last; hop] } else { samples.to_vec() };
        last = samples[hop - 1];
        let (source, rate_hz, channels) = (id("ir"), RATE_HZ, 1);
        let fresh = Fresh { source, rate_hz, channels, start: start as u64, samples };
        let (scan_s, gap) = ((start + hop) as f64 / RATE_HZ, missing && says_gap);
        let fresh = vec![fresh];
        let lost = if gap { hop as u64 } else { 0 };
        let progress = Progress { number: 1, scan_s, fresh, gap, lost, ..Progress::default() };
        changes.extend(naming.hear(&progress, &by).change);
    }
    (changes, Answer::clone(&naming.end().unwrap().answer))
}

fn samples(trial: &Trial) -> Vec<f32> {
    let Some(Signal::Series(series)) = trial.signals.get(&id("ir")) else { panic!("no series") };
    series.samples().to_vec()
}

#[test]
fn a_gap_makes_no_change_but_repeated_frames_would() {
    let all = samples(&trial(0, 200, 12.0));
    let gap = 5_000..7_500;
    let (changes, answer) = heard(&all, gap.clone(), true);
    assert_eq!(changes.len(), 1, "{changes:#?}");
    assert_eq!((answer.surface.as_deref(), answer.begin_s), (Some("ash"), Some(0.0)));
    let lost = gap.len() as u64;
    assert_eq!(answer.lost_samples, lost);
    assert!(answer.doubts.contains(&Doubt::LostSamples { samples: lost }), "{:?}", answer.doubts);
    let (changes, _) = heard(&all, gap, false);
    assert!(changes.len() > 1, "the repeated frames are like no ash");
}

#[test]
fn certainty_is_that_of_the_data_and_not_of_the_number_of_windows() {
    // The same data with ten times as many windows.
    let all = samples(&trial(1, 300, 3.0));
    let sure = |hop_s: f64| {
        let (by, how) = (recogniser(), Continuous { hop_s, expected_stay_s: 1e9 });
        let mut naming = ContinuousNaming::new(how);
        let hop = (hop_s * RATE_HZ) as usize;
        let mut odds = 0.0;
        for (number, samples) in all.chunks_exact(hop).enumerate() {
            let (source, rate_hz, channels) = (id("ir"), RATE_HZ, 1);
            let start = (number * hop) as u64;
            let fresh = Fresh { source, rate_hz, channels, start, samples: samples.to_vec() };
            let (scan_s, fresh) = ((number + 1) as f64 * hop_s, vec![fresh]);
            let progress = Progress { number: 1, scan_s, fresh, ..Progress::default() };
            let guess = naming.hear(&progress, &by).guess;
            if let [first, second, ..] = &guess.named[..] {
                odds = (first.probability / second.probability).ln();
            }
        }
        odds
    };
    let (few, many) = (sure(0.5), sure(0.05));
    assert!(few > 1.0 && (many / few - 1.0).abs() < 0.5, "{few} {many}");
}

#[test]
fn a_station_names_what_moves_for_longer_than_a_drag_may_last_and_says_nothing_at_rest() {
    let data = synthetic(3.0);
    let mut bench = Bench::new();
    let library = bench.library(&data);
    let config = "format = 1\n[microphone]\npresent = false\n[camera]\npresent = false\n\
                  [scan]\nmode = \"continuous\"\nexpected_stay_s = 5\n\
                  [detection]\nlongest_drag_s = 1.0\n";
    std::fs::write(bench.path("station.toml"), config).unwrap();
    // So that windows are shorter than the trials of this small library. From nine trials, every tenth
    // window would be called unknown.
    let short = ["--accuracy", "0.6", "--false-rejections", "0"];
    let args = [&["run", "--library", library.to_str().unwrap()], &short[..]].concat();
    let mut run = bench.surfaced(&args);
    run.until_said("is absent", None);
    let mut fake = bench.stylus();
    fake.wait_for_start();
    run.until_said("9 trials", Some(&mut fake));
    // Two surfaces, one after the other, without a pause.
    let (mut joined, second) = (bench::trial(&data, 0, SCANNED), bench::trial(&data, 2, SCANNED));
    for (id, signal) in &mut joined.signals {
        if let (Signal::Series(first), Signal::Series(second)) = (&*signal, &second.signals[id]) {
            let samples = [first.samples(), second.samples()].concat();
            *signal =
                Signal::Series(Series::new(first.rate_hz(), first.channels(), samples).unwrap());
        }
    }
    let seconds = bench.play(&fake, &joined, 6.0);
    fake.serve(seconds);
    let names = [data.surfaces()[0], data.surfaces()[2]].map(|name| json!(name));
    let lines: Vec<Value> = (0..4).map(|_| run.line(&mut fake)).collect();
    let of = |line: &Value| match line.get("to") {
        Some(to) => json!([line["from"]["surface"], to["surface"]]),
        None => line["surface"].clone(),
    };
    let found: Vec<Value> = lines.iter().map(of).collect();
    let [first, last] = names;
    let expected = [json!([null, first]), first.clone(), json!([first, last]), last.clone()];
    assert_eq!(found, expected, "{lines:#?} {}", run.said());
    let ends = lines[3]["begin_s"].as_f64().unwrap() + lines[3]["scan_s"].as_f64().unwrap();
    assert!((5.5..6.5).contains(&ends), "{lines:#?}");
    // At rest.
    fake.serve(2.0);
    run.signal("TERM");
    assert_eq!(run.end(&mut fake).code(), Some(0), "{}", run.said());
    assert_eq!(run.rest(), Vec::<Value>::new());
    assert!(!run.said().contains("noise"), "{}", run.said());
    // The history holds the stretches.
    let log = std::fs::read_to_string(library.join(".history/answers.jsonl")).unwrap();
    let kept = log.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
    let kept: Vec<Value> = kept.map(|line| line["answer"]["surface"].clone()).collect();
    assert_eq!(kept.into_iter().filter(Value::is_string).collect::<Vec<_>>(), [first, last]);
}
