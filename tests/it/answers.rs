//! Answers during a scan, when they are settled, and scans of surfaces that are not in the
//! library: on the real sounds where they are there, and on made ones.

use std::process::Output;
use std::sync::Arc;

use crate::common::{id, real_sounds};
use assert_cmd::Command;
use serde_json::Value;
use surfaced::dataset::synth;
use surfaced::evaluate::{Evaluation, Over, SettledOutcome, UnknownOutcome};
use surfaced::library::Entry;
use surfaced::recognise::{
    Embedding, EmbeddingModel, EmbeddingOptions, FollowOptions, Follower, FreshFrames, GuessSoFar,
    LOOK_S, LibraryShape, Model, Ranking, Reference, ReferenceOptions, RejectionError, TrialFrames,
    without_flawed,
};
use surfaced::scene::{Phase, Scene};
use surfaced::station::{LibraryState, Recogniser};
use surfaced::trial::{Doubt, Image, Series, SeriesFlaws, Signal, Trial, TrialKey};

fn embedding(scene: &Scene) -> Embedding {
    Embedding::new(scene.clone(), EmbeddingOptions::default())
}

/// A small synthetic library, its model, and a scan by somebody else.
fn made() -> (Scene, Arc<EmbeddingModel>, Trial) {
    let size = synth::Parameters { surfaces: 4, trials: 4, users: 1, ..Default::default() };
    let library = synth::library(&synth::Parameters { drag_seconds: 1.73, ..size });
    let scene = library.scene.only(&["ca1", "fr", "me", "mi1", "mi2"].map(id)).unwrap();
    let trials: Vec<Trial> =
        library.entries.iter().map(|e| e.clone().within(&scene).load().unwrap()).collect();
    let (experts, users): (Vec<Trial>, Vec<Trial>) =
        trials.into_iter().partition(|trial| trial.key.user == "expert");
    let entries: Vec<Entry> = experts.into_iter().map(Entry::in_memory).collect();
    let shape = Arc::new(LibraryShape::of(&entries.iter().collect::<Vec<_>>()).unwrap());
    let frames = |entry: &Entry| {
        let trial = entry.load().unwrap();
        Arc::new(TrialFrames::new(&entry.key, &trial, &scene, &shape, Some(1)).unwrap())
    };
    let model = embedding(&scene).train(entries.iter().map(frames).collect(), &shape).unwrap();
    (scene, Arc::new(model), users[1].clone())
}

/// The guesses at the looks at a scan whose frames come in pieces of that many seconds.
fn said(follower: &mut Follower, scene: &Scene, trial: &Trial, piece_s: f64) -> Vec<GuessSoFar> {
    follower.begin();
    let mut said = Vec::new();
    let pieces = (1.73 / piece_s).ceil() as usize;
    for piece in 0..pieces {
        for (source, signal) in &trial.signals {
            let series = match signal {
                Signal::Image(picture) if piece == 0 => {
                    follower.add_picture(source, picture);
                    continue;
                }
                Signal::Image(_) => continue,
                Signal::Series(series) => series,
            };
            let (rate_hz, channels) = (series.rate_hz(), series.channels());
            let at = |piece: usize| {
                let frames = (piece as f64 * piece_s * rate_hz).round() as usize;
                frames.min(series.frames()) * channels
            };
            let is_drag = scene.get(source.as_str()).unwrap().phase == Phase::Drag;
            let samples = match (is_drag, piece) {
                (true, _) => &series.samples()[at(piece)..at(piece + 1)],
                (false, 0) => series.samples(),
                (false, _) => continue,
            };
            follower.add(FreshFrames { source, rate_hz, channels, samples }).unwrap();
        }
        let scan_s = (piece + 1) as f64 * piece_s;
        said.extend(follower.look(scan_s.min(1.73)).unwrap());
    }
    said
}

#[test]
fn what_is_said_does_not_depend_on_the_pieces_and_is_what_the_beginning_of_the_scan_says() {
    let (scene, model, scan) = made();
    let mut follower = model.clone().follow(&FollowOptions::default());
    let fine = said(&mut follower, &scene, &scan, 0.01);
    assert_eq!(fine.len(), 17, "one look each {LOOK_S} s");
    let settled = fine.last().unwrap().settled.clone().expect("four easy surfaces");
    for piece_s in [0.1, 0.037, 0.45, 2.0] {
        let coarse = said(&mut follower, &scene, &scan, piece_s);
        assert!(coarse.iter().all(|guess| fine.contains(guess)), "pieces of {piece_s} s");
        assert_eq!(coarse.last(), fine.last());
    }
    for guess in &fine {
        let until = scan.clone().first_seconds(guess.scan_s, |source| {
            scene.get(source.as_str()).unwrap().phase == Phase::Drag
        });
        let ranking = model.rank_trial(until).unwrap();
        assert_eq!(guess.named[0].0, ranking.surface());
        let probability = ranking.confidence.unwrap();
        assert!((guess.named[0].1 - probability).abs() < 1e-4, "at {} s", guess.scan_s);
        assert_eq!(guess.settled.is_some(), guess.scan_s >= settled.1);
    }
}

#[test]
fn a_source_with_samples_that_are_no_numbers_is_passed_over() {
    let (scene, model, scan) = made();
    let mut follower = model.follow(&FollowOptions::default());
    let mut without = scan.clone();
    without.signals.remove(&id("fr"));
    let expected = said(&mut follower, &scene, &without, 0.1);
    follower.begin();
    let broken = vec![f32::NAN; 2 * 17_300];
    let fresh = FreshFrames { source: &id("fr"), rate_hz: 1e4, channels: 2, samples: &broken };
    // The begin of `said` forgets this; it must not be remembered.
    follower.add(fresh).unwrap();
    assert_eq!(said(&mut follower, &scene, &without, 0.1), expected);
    follower.begin();
    follower.add(fresh).unwrap();
    for (source, signal) in &without.signals {
        match signal {
            Signal::Image(picture) => follower.add_picture(source, picture),
            Signal::Series(series) => {
                let (rate_hz, channels) = (series.rate_hz(), series.channels());
                let samples = series.samples();
                follower.add(FreshFrames { source, rate_hz, channels, samples }).unwrap();
            }
        }
    }
    assert_eq!(follower.look(1.73).unwrap().as_ref(), expected.last());
}

#[test]
fn a_dead_or_stuck_source_is_left_out_during_the_scan_as_it_is_at_its_end() {
    let (scene, model, scan) = made();
    let mut follower = model.follow(&FollowOptions::default());
    let mut without = scan.clone();
    without.signals.retain(|source, _| *source != id("fr") && *source != id("ca1"));
    let expected = said(&mut follower, &scene, &without, 0.1);
    let mut flawed = scan.clone();
    // One channel of two, and a covered lens.
    if let Some(Signal::Series(forces)) = flawed.signals.get_mut(&id("fr")) {
        forces.view_mut().column_mut(1).fill(0.3);
    }
    let black = vec![0; 3 * Image::ROWS * Image::COLS];
    let black = Image::new(Image::COLS, Image::ROWS, black).unwrap();
    flawed.signals.insert(id("ca1"), Signal::Image(black));
    assert_eq!(said(&mut follower, &scene, &flawed, 0.1), expected);
    let (left, _) = without_flawed(flawed, &scene, |_| &[]);
    assert_eq!(left, without);
    // A source that stops halfway counts until it has rested for half of what came.
    let mut halfway = scan.clone();
    if let Some(Signal::Series(forces)) = halfway.signals.get_mut(&id("fr")) {
        let stop = forces.frames() / 4;
        let last = forces.view().row(stop).to_owned();
        forces.view_mut().rows_mut().into_iter().skip(stop).for_each(|mut row| row.assign(&last));
    }
    halfway.signals.remove(&id("ca1"));
    let halfway_said = said(&mut follower, &scene, &halfway, 0.1);
    assert_eq!(halfway_said.last().unwrap().named, expected.last().unwrap().named);
    assert!((2..8).any(|look| halfway_said[look] != expected[look]));
}

#[test]
fn a_scan_that_was_followed_is_named_as_a_scan_that_was_not() {
    let (scene, model, scan) = made();
    let whole = |trial: &Trial| {
        let (sound, _) = without_flawed(trial.clone(), &scene, |id| model.rests(id));
        model.rank_trial(sound).unwrap()
    };
    let mut stuck = scan.clone();
    if let Some(Signal::Series(forces)) = stuck.signals.get_mut(&id("fr")) {
        forces.view_mut().column_mut(1).fill(0.3);
    }
    for trial in [&scan, &stuck] {
        let expected = whole(trial);
        for followed_s in [0.0, 0.1, 1.04, 1.73] {
            let beginning = trial.clone().first_seconds(followed_s, |id| scene.is_dragged(id));
            let mut follower = model.clone().follow(&FollowOptions::default());
            if followed_s > 0.0 {
                said(&mut follower, &scene, &beginning, 0.1);
            }
            let ranking = follower.finish(trial).unwrap();
            let surfaces =
                |r: &Ranking| r.ranked.iter().map(|one| one.surface.clone()).collect::<Vec<_>>();
            assert_eq!(surfaces(&ranking), surfaces(&expected), "followed for {followed_s} s");
            assert_eq!(
                (ranking.nearest, ranking.sources, ranking.p_value),
                (expected.nearest.clone(), expected.sources.clone(), expected.p_value)
            );
            assert!((ranking.margin - expected.margin).abs() < 1e-3 * expected.margin);
            for (id, signal) in &trial.signals {
                if let (Some(found), Signal::Series(series)) = (follower.doubts(id), signal) {
                    assert_eq!(found, SeriesFlaws::of(series).doubts(id, model.rests(id)), "{id}");
                }
            }
            assert_eq!(
                follower.doubts(&id("fr")).map(|found| found.len()),
                Some(usize::from(trial == &stuck))
            );
        }
    }
}

#[test]
fn a_scan_that_is_another_than_was_followed_is_not_finished() {
    let (scene, model, scan) = made();
    let mut follower = model.follow(&FollowOptions::default());
    let shorter = scan.clone().first_seconds(0.5, |id| scene.is_dragged(id));
    let mut without = scan.clone();
    without.signals.remove(&id("mi1"));
    let mut unlike = scan.clone();
    unlike.signals.retain(|_, signal| matches!(signal, Signal::Image(_)));
    for other in [shorter, without, unlike] {
        assert!(!said(&mut follower, &scene, &scan, 0.1).is_empty());
        assert_eq!(follower.finish(&other), None);
    }
}

#[test]
fn settled_answers_on_real_sounds_take_half_the_scan_and_lose_little() {
    let Some((scene, entries, folds)) = real_sounds(2) else { return };
    let method = embedding(&scene);
    let prepared = Evaluation::new(&scene, &entries, &folds).prepare(&method).unwrap();
    let run = || SettledOutcome::of(&prepared, 0.01, Over::Queries).unwrap();
    let outcome = run();
    assert!(outcome.scan_s_mean <= 0.5 * outcome.whole_s_mean, "{outcome:?}");
    assert!(outcome.share.value() >= outcome.accuracy_whole - 0.05, "{outcome:?}");
    assert!(outcome.settled * 10 >= outcome.queries * 9, "{outcome:?}");
    for rule in &outcome.rules {
        assert!(rule.shown && rule.loss_high <= 0.01, "{rule:?}");
    }
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap().install(run);
    assert_eq!(one.rules, outcome.rules, "the number of threads does not matter");
    assert_eq!((one.scan_s_mean, one.share), (outcome.scan_s_mean, outcome.share));
}

#[test]
fn unknown_surfaces_are_caught_and_known_ones_are_not() {
    let Some((scene, entries, folds)) = real_sounds(2) else { return };
    let method = embedding(&scene);
    let run = Evaluation::new(&scene, &entries, &folds).prepare(&method).unwrap();
    let outcome = UnknownOutcome::of(&run, 5, Some(0.01)).unwrap();
    assert_eq!((outcome.unknown.of, outcome.known.of), (40, 160));
    // One person's library: excerpts stand for another hand, which costs surfaces that are near.
    assert!(outcome.unknown.value() >= 0.25, "{outcome:?}");
    assert!(outcome.known.value() <= 0.03, "{outcome:?}");
    assert_eq!(outcome.stated.trials, 16 * 9);
}

#[test]
fn a_method_or_a_library_that_gives_no_p_value_says_so() {
    let (scene, model, _) = made();
    let error = model.rejection(Some(0.01)).unwrap_err();
    assert_eq!(error, RejectionError::TooFew { rate: 0.01, needed: 99, trials: 16 });
    assert!(model.rejection(Some(0.1)).is_ok(), "16 trials are enough for 10 %");
    let reference = Reference::new(scene.clone(), ReferenceOptions::default()).model(&[]).unwrap();
    let mut by = Recogniser::new(Arc::new(reference), scene, LibraryState::default());
    let error = by.reject_unknown(Some(0.01)).unwrap_err();
    assert_eq!(error, RejectionError::NoPValue);
    assert!(error.to_string().contains("the method `embedding` can"), "{error}");
}

fn surfaced(args: &[&str]) -> Output {
    Command::cargo_bin("surfaced").unwrap().args(args).output().unwrap()
}

#[test]
fn replay_and_eval_report_the_scan_time_used_and_agree_on_it() {
    let dir = tempfile::tempdir().unwrap();
    let lib = dir.path().join("scene");
    let lib = lib.to_str().unwrap();
    let size = ["--surfaces", "4", "--trials", "4", "--users", "0", "--seconds", "1.5"];
    assert!(surfaced(&[&["synth", lib], &size[..]].concat()).status.success());
    let common = ["--protocol", "leave-one-trial-out", "--sources", "mi2,ir", "--method"];
    let run = |command: &str, more: &[&str]| {
        let output = surfaced(&[&[command, lib], &common[..], more].concat());
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        (output, stderr)
    };
    // Twelve left-out trials can show a rate of 1 in 13.
    let (_, stderr) = run("replay", &["embedding", "--verbose"]);
    assert!(stderr.contains("at most 7.7 % of scans of known surfaces"), "{stderr}");
    let (output, stderr) = run("replay", &["embedding", "--false-rejections", "0", "--json"]);
    assert!(output.status.success(), "{stderr}");
    let lines = String::from_utf8_lossy(&output.stdout).into_owned();
    let lines: Vec<Value> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(lines.len(), 16);
    let used = |line: &Value| line["settled_s"].as_f64().or(line["scan_s"].as_f64()).unwrap();
    let mean_s = lines.iter().map(used).sum::<f64>() / 16.0;
    assert!(lines.iter().all(|line| line["confidence"].as_f64().unwrap() > 0.0));

    let (output, stderr) = run("eval", &["embedding", "--settle", "--json"]);
    assert!(output.status.success(), "{stderr}");
    let eval: Value = serde_json::from_slice(&output.stdout).unwrap();
    let expected = eval["settled"]["scan_s_mean"].as_f64().unwrap();
    assert!((mean_s - expected).abs() < 1e-9, "{mean_s} in replay, {expected} in eval");
    assert!(expected < 1.5, "some settle before their end");

    let (output, stderr) = run("replay", &["embedding", "--false-rejections", "0.01"]);
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("takes 99 trials"), "{stderr}");
    let (output, stderr) = run("eval", &["reference", "--settle"]);
    assert_eq!(output.status.code(), Some(2), "{stderr}");
    assert!(stderr.contains("--settle follows scans in progress"), "{stderr}");
}

/// A library of two surfaces with a moving sensor and a skin of three taxels. A taxel is 0 most of the
/// time, and taxel 3 is touched in a third of the trials only.
fn skin() -> (Scene, Arc<EmbeddingModel>, impl Fn(&str, u32, bool) -> Trial) {
    let toml =
        "format = 1\n[sources.ir]\nrate_hz = 200\n[sources.skin]\nrate_hz = 200\nchannels = 3\n";
    let scene = Scene::from_toml(toml).unwrap();
    let trial = |surface: &str, number: u32, touched: bool| {
        let rough = if surface == "oak" { 0.9 } else { 0.2 };
        let noise = |i: usize, c: usize| {
            ((i * 7919 + c * 104_729 + number as usize * 1_299_709) as f32 * 0.618_034).fract()
                - 0.5
        };
        let ir = (0..600).map(|i| (i as f32 * rough).sin() + 0.2 * noise(i, 9)).collect();
        let taxel = |i: usize, c: usize| {
            let at = (60 * c + 40 * number as usize) % 400;
            let touches =
                touched && (c < 2 || number.is_multiple_of(3)) && (at..at + 90).contains(&i);
            if touches { 1.0 + noise(i, c) } else { 0.0 }
        };
        let skin = (0..600).flat_map(|i| (0..3).map(move |c| taxel(i, c))).collect();
        let series = |channels, x| Signal::Series(Series::new(200.0, channels, x).unwrap());
        let signals = [(id("ir"), series(1, ir)), (id("skin"), series(3, skin))].into();
        Trial { key: TrialKey::new(surface, "expert", number), signals }
    };
    let all = ["ash", "oak"].into_iter().flat_map(|s| (1..=9).map(move |n| trial(s, n, true)));
    let entries: Vec<Entry> = all.map(Entry::in_memory).collect();
    let shape = Arc::new(LibraryShape::of(&entries.iter().collect::<Vec<_>>()).unwrap());
    let frames = |entry: &Entry| {
        let trial = entry.load().unwrap();
        Arc::new(TrialFrames::new(&entry.key, &trial, &scene, &shape, Some(1)).unwrap())
    };
    let model = embedding(&scene).train(entries.iter().map(frames).collect(), &shape).unwrap();
    (scene, Arc::new(model), trial)
}

#[test]
fn a_taxel_that_nothing_touches_is_not_broken_and_a_sensor_that_always_moves_is() {
    let (scene, model, trial) = skin();
    let doubts = |trial: Trial| without_flawed(trial, &scene, |id| model.rests(id)).1;
    assert_eq!(doubts(trial("oak", 12, true)), []);
    assert_eq!(doubts(trial("oak", 12, false)), [], "untouched for a whole scan");
    let mut broken = trial("oak", 12, true);
    if let Some(Signal::Series(ir)) = broken.signals.get_mut(&id("ir")) {
        ir.view_mut().fill(0.0);
    }
    let (source, share) = (id("ir"), 1.0);
    assert_eq!(doubts(broken), [Doubt::Stuck { source, channel: 1, value: 0.0, share }]);
}
