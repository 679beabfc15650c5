//! Recordings in the forms that people have them: FLAC, files without trial folders, stereo, names
//! in capitals, other rates.

use std::path::Path;

use crate::common::{self, id, open, real_sounds, says, temp, write_file, write_wav};
use realfft::RealFftPlanner;
use surfaced::evaluate::{Evaluation, Fold};
use surfaced::library::Entry;
use surfaced::recognise::{Embedding, EmbeddingOptions, Reference, ReferenceOptions};
use surfaced::scene::Scene;
use surfaced::trial::{Series, Signal, Trial, TrialKey};

fn fixture(name: &str) -> Vec<u8> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name);
    std::fs::read(path).unwrap()
}

/// The content of the fixtures.
fn ramp() -> Vec<i16> {
    (0..64).map(|i| 500 * i - 16000).collect()
}

#[test]
fn flac_is_read_as_the_same_samples_in_wav() {
    let (_dir, path) = temp();
    write_wav(&path.join("Oak/1/mi2.wav"), 44_100, 1, &ramp());
    write_file(&path.join("Oak/2/mi2.flac"), fixture("tone.flac"));
    write_file(&path.join("Oak/3/mi2.FLAC"), fixture("tone.flac"));
    let library = open(&path).unwrap();
    common::assert_outlines_are_true(&library);
    let trials: Vec<Trial> = library.entries.iter().map(|entry| entry.load().unwrap()).collect();
    assert_eq!(trials.len(), 3, "{:?}", library.remarks);
    assert!(trials.iter().all(|trial| trial.signals == trials[0].signals));
}

#[test]
fn a_damaged_flac_file_is_refused() {
    let (_dir, path) = temp();
    let whole = fixture("tone.flac");
    let refused = |bytes: &[u8]| {
        write_file(&path.join("Oak/1/mi2.flac"), bytes);
        let read = open(&path).and_then(|library| library.entries[0].load());
        read.unwrap_err().to_string()
    };
    for end in [3, 20, 60, whole.len() - 20, whole.len() - 1] {
        says(&refused(&whole[..end]), &["mi2.flac: not a FLAC file that can be read", "copy it"]);
    }
    says(&refused(&[]), &["the file is empty"]);
    says(&refused(b"RIFF once more"), &["not a FLAC file"]);
    let mut other = whole.clone();
    // A bit of the checksum of all samples, at the end of the stream's description.
    other[30] ^= 1;
    says(&refused(&other), &["its checksum is not that of its samples"]);
    let mut endless = whole;
    // 36 bits of the number of samples.
    endless[21] |= 0x0f;
    endless[22..26].fill(0xff);
    says(&refused(&endless), &["minutes are too long for a trial"]);
}

#[test]
fn stereo_is_mixed_down_where_the_source_has_one_channel_and_said_once() {
    let (_dir, path) = temp();
    write_file(&path.join("Oak/1/mi2.flac"), fixture("stereo.flac"));
    for number in 2..=4 {
        write_wav(&path.join(format!("Oak/{number}/mi2.wav")), 44_100, 2, &[100, 300, -50, 50]);
    }
    let library = open(&path).unwrap();
    common::assert_outlines_are_true(&library);
    let read = library.entries[1].load().unwrap();
    let mean = Series::new(44_100.0, 1, vec![200.0 / 32768.0, 0.0]).unwrap();
    assert_eq!(read.signals["mi2"], Signal::Series(mean));
    let remarks = library.remarks;
    let first = "Oak/1/mi2.flac and 3 more: stereo, mixed down to the one channel of source `mi2`";
    assert_eq!(remarks, [first]);
    write_file(&path.join("library.toml"), "format = 1\n[sources.mi2]\nchannels = 2\n");
    let library = open(&path).unwrap();
    let Signal::Series(series) = &library.entries[1].load().unwrap().signals["mi2"] else {
        panic!("a sound is a series")
    };
    assert_eq!((series.channels(), library.remarks.len()), (2, 0));
}

#[test]
fn files_without_trial_folders_are_trials_of_a_drag_s_sound() {
    let (_dir, path) = temp();
    for name in ["scan 1", "scan 2", "scan 10"] {
        write_wav(&path.join(format!("oak/{name}.WAV")), 44_100, 1, &[1, 2]);
    }
    write_file(&path.join("beech/first.flac"), fixture("tone.flac"));
    write_file(&path.join("beech/second.flac"), fixture("tone.flac"));
    write_wav(&path.join("felt/mi2_1.wav"), 44_100, 1, &[1, 2]);
    write_wav(&path.join("felt/ac_1.wav"), 10_000, 3, &[1, 2, 3]);
    let library = open(&path).unwrap();
    let keys: Vec<&TrialKey> = library.entries.iter().map(|entry| &entry.key).collect();
    let key = |surface, number| TrialKey::new(surface, "expert", number);
    let oak = [key("oak", 1), key("oak", 2), key("oak", 10)];
    let others = [key("beech", 1), key("beech", 2), key("felt", 1)];
    assert!(oak.iter().chain(&others).all(|key| keys.contains(&key)), "{keys:?}");
    assert_eq!(keys.len(), 6);
    let felt = library.entries.iter().find(|entry| entry.key.surface == "felt").unwrap();
    assert_eq!(felt.sources, [id("ac"), id("mi2")], "one number is one trial");
    says(&library.remarks.join("\n"), &["and 4 more: read as sound of a drag (`mi2`)"]);
}

#[test]
fn files_named_after_the_folder_of_their_take_are_of_one_source() {
    let (_dir, path) = temp();
    for take in ["ZOOM0001", "ZOOM0002"] {
        write_wav(&path.join(format!("oak/{take}/{take}_LR.WAV")), 48_000, 2, &[1, 2]);
    }
    let library = open(&path).unwrap();
    assert!(library.entries.len() == 2 && library.entries.iter().all(|e| e.sources == [id("LR")]));
}

#[test]
fn where_no_source_is_usual_the_names_of_files_tell_it() {
    let (_dir, path) = temp();
    for name in ["pac_1", "scan2"] {
        write_wav(&path.join(format!("Oak/{name}.wav")), 1000, 1, &[1, 2]);
    }
    let scene = Scene::from_toml("format = 1\n[sources.pac]\ndomain = \"time\"\n").unwrap();
    let library = surfaced::dataset::open(&path, &scene).unwrap();
    assert_eq!((library.entries.len(), library.entries[0].sources[0].as_str()), (1, "pac"));
    says(&library.remarks.join("\n"), &["Oak/scan2.wav: not used, its name begins with no source"]);
}

#[test]
fn a_file_or_a_folder_of_files_is_unlabelled_trials() {
    let (_dir, path) = temp();
    for name in ["a.wav", "b.wav"] {
        write_wav(&path.join(name), 44_100, 1, &[1, 2]);
    }
    let numbers = |path: &Path| -> Vec<(String, u32)> {
        let library = open(path).unwrap();
        library.entries.into_iter().map(|e| (e.key.surface, e.key.number)).collect()
    };
    let unlabelled = |number| ("unlabelled".to_string(), number);
    assert_eq!(numbers(&path), [unlabelled(1), unlabelled(2)]);
    assert_eq!(numbers(&path.join("b.wav")), [unlabelled(1)]);
    write_wav(&path.join("oak/1/mi2.wav"), 44_100, 1, &[1, 2]);
    assert_eq!(numbers(&path), [("oak".into(), 1)], "a library's own files are no trials");
}

#[test]
fn trials_enrolled_beside_such_files_keep_them() {
    let (_dir, path) = temp();
    write_wav(&path.join("oak/a.wav"), 44_100, 1, &[1, 2]);
    write_wav(&path.join("oak/b.wav"), 44_100, 1, &[1, 2]);
    write_wav(&path.join("oak/expert-01/mi2.wav"), 44_100, 1, &[1, 2]);
    let numbers: Vec<u32> =
        open(&path).unwrap().entries.iter().map(|entry| entry.key.number).collect();
    assert_eq!(numbers, [1, 2, 3]);
}

/// Band-limited interpolation by the transform of the whole, padded by nothing: 44.1 to 48 kHz.
fn at_48_khz(mut trial: Trial) -> Trial {
    let resampled = |signal: &Signal| {
        let Signal::Series(series) = signal else { panic!("a sound is a series") };
        let blocks = series.frames() / 147;
        let (from, to) = (147 * blocks, 160 * blocks);
        let mut planner = RealFftPlanner::<f64>::new();
        let (forth, back) = (planner.plan_fft_forward(from), planner.plan_fft_inverse(to));
        let mut input: Vec<f64> = series.samples()[..from].iter().map(|&x| x.into()).collect();
        let (mut bins, mut wider) = (forth.make_output_vec(), back.make_input_vec());
        forth.process(&mut input, &mut bins).unwrap();
        let kept = bins.len() - 1;
        wider[..kept].copy_from_slice(&bins[..kept]);
        let mut output = back.make_output_vec();
        back.process(&mut wider, &mut output).unwrap();
        let samples = output.iter().map(|x| (x / from as f64) as f32).collect();
        Signal::Series(Series::new(48_000.0, 1, samples).unwrap())
    };
    trial.signals.values_mut().for_each(|signal| *signal = resampled(signal));
    trial
}

#[test]
fn queries_at_48_khz_cost_next_to_nothing_against_a_library_at_44_1() {
    let Some((scene, entries, folds)) = real_sounds(3) else { return };
    let trials = entries.len();
    let faster = entries.iter().map(|entry| entry.clone().changed(at_48_khz));
    let both: Vec<Entry> = entries.iter().cloned().chain(faster).collect();
    let resampled = |fold: &Fold| Fold {
        queries: fold.queries.iter().map(|query| query + trials).collect(),
        ..fold.clone()
    };
    let other: Vec<Fold> = folds.iter().map(resampled).collect();
    let method = Embedding::new(scene.clone(), EmbeddingOptions::default());
    let right = |folds: &[Fold]| {
        let run = Evaluation::new(&scene, &both, folds).prepare(&method).unwrap();
        run.measure().unwrap().outcome.share.right
    };
    let (same, different) = (right(&folds), right(&other));
    println!("right at 44.1 kHz: {same}, at 48 kHz: {different}");
    assert!(different + 1 >= same, "{different} of {same} right ones are left");

    let quick = ReferenceOptions { samples: 20, repetitions: 1, ..ReferenceOptions::default() };
    let reference = Reference::new(scene.clone(), quick);
    let run = Evaluation::new(&scene, &both, &other);
    let refused = match run.prepare(&reference) {
        Ok(run) => run.measure().unwrap_err().to_string(),
        Err(error) => error.to_string(),
    };
    says(&refused, &["48000 Hz", "44100 Hz"]);
}
