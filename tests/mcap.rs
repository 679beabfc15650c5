//! Recordings as MCAP: every sample is there for other tools, and every file comes back.
#![cfg(feature = "mcap")]

mod common;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use common::{trial, write_file};
use serde_json::Value;
use surfaced::record::{TrialOptions, mcap, write_library_toml, write_trial};
use surfaced::scene::Scene;
use surfaced::trial::Signal;

fn library(dir: &Path) -> PathBuf {
    let (path, scene) = (dir.join("library"), Scene::lmt108());
    write_library_toml(&path, &scene, "mine", false).unwrap();
    for (surface, number) in [("oak", 1), ("oak", 2), ("böhm, 2%", 1)] {
        let options = TrialOptions { durable: false, ..TrialOptions::default() };
        write_trial(&path, &trial(surface, "anna", number), &scene, &options).unwrap();
    }
    write_file(&path.join("oak/anna-01/notes.txt"), "by a script of ours");
    path
}

/// All files below a folder, by their names.
fn files(dir: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut all = BTreeMap::new();
    let mut folders = vec![dir.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for item in std::fs::read_dir(folder).unwrap() {
            let path = item.unwrap().path();
            match path.is_dir() {
                true => folders.push(path),
                false => {
                    let name = path.strip_prefix(dir).unwrap().to_path_buf();
                    all.insert(name, std::fs::read(&path).unwrap());
                }
            }
        }
    }
    all
}

fn exported(recording: &Path, out: &Path) -> usize {
    let library = mcap::open(recording, &Scene::lmt108()).unwrap();
    mcap::export(recording, &library, out).unwrap()
}

#[test]
fn a_library_comes_back_byte_for_byte() {
    let dir = tempfile::tempdir().unwrap();
    let (original, out, back) =
        (library(dir.path()), dir.path().join("out.mcap"), dir.path().join("back"));
    assert_eq!(exported(&original, &out), 3);
    assert_eq!(mcap::import(&out, &back).unwrap(), 3);
    assert_eq!(files(&original), files(&back));
    assert!(mcap::import(&out, &back).is_err(), "nothing is overwritten");
    let one = dir.path().join("one.mcap");
    let trial = original.join("oak/anna-02");
    assert_eq!(exported(&trial, &one), 1);
    let back = dir.path().join("back-of-one");
    assert_eq!(mcap::import(&one, &back).unwrap(), 1);
    assert_eq!(files(&back.join("oak/anna-02")), files(&trial));
    assert!(back.join("library.toml").is_file());
}

#[test]
fn every_sample_is_a_number_in_a_message_at_its_time() {
    let dir = tempfile::tempdir().unwrap();
    let (original, out) = (library(dir.path()).join("oak/anna-01"), dir.path().join("out.mcap"));
    exported(&original, &out);
    let bytes = std::fs::read(&out).unwrap();
    let mut samples: BTreeMap<String, Vec<f32>> = BTreeMap::new();
    let mut pictures = 0;
    for message in ::mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let json: Value = serde_json::from_slice(&message.data).unwrap();
        let about = &message.channel.metadata;
        assert_eq!((about["surface"].as_str(), about["user"].as_str()), ("oak", "anna"));
        let Some(values) = json["values"].as_array() else {
            assert_eq!(json["format"], "jpeg");
            pictures += 1;
            continue;
        };
        let rate_hz: f64 = about["rate_hz"].parse().unwrap();
        let of_source = samples.entry(message.channel.topic.clone()).or_default();
        let at_s = (of_source.len() / values.len()) as f64 / rate_hz;
        assert!((message.log_time as f64 - at_s * 1e9).abs() < 1.0);
        let scale = json["scale"].as_f64().unwrap();
        let channels: Vec<&Vec<Value>> = values.iter().map(|v| v.as_array().unwrap()).collect();
        for frame in 0..channels[0].len() {
            let sample = |of: &&Vec<Value>| (of[frame].as_f64().unwrap() * scale) as f32;
            of_source.extend(channels.iter().map(sample));
        }
    }
    assert_eq!(pictures, 2);
    for (id, signal) in &trial("oak", "anna", 1).signals {
        if let Signal::Series(series) = signal {
            assert_eq!(samples[&format!("/{id}")], series.samples(), "{id}");
        }
    }
}

#[test]
fn what_is_no_export_is_refused_and_writes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let (original, out) = (library(dir.path()), dir.path().join("out.mcap"));
    exported(&original, &out);
    let whole = std::fs::read(&out).unwrap();
    let (broken, back) = (dir.path().join("broken.mcap"), dir.path().join("back"));
    for length in [0, 1, 8, 100, whole.len() / 2, whole.len() - 1] {
        std::fs::write(&broken, &whole[..length]).unwrap();
        let error = mcap::import(&broken, &back).unwrap_err().to_string();
        assert!(error.contains("broken.mcap") && !back.exists(), "{length}: {error}");
    }
    // A file that would lie elsewhere: its name is replaced in its record and in the index.
    let (from, to) = (b"oak/anna-01/notes.txt", b"../../../../notes.txt");
    let mut hostile = whole.clone();
    for at in 0..hostile.len() - from.len() {
        if hostile[at..].starts_with(from) {
            hostile[at..at + to.len()].copy_from_slice(to);
        }
    }
    assert_ne!(hostile, whole);
    std::fs::write(&broken, &hostile).unwrap();
    assert!(mcap::import(&broken, &back).is_err() && !back.exists());
}

#[test]
fn an_export_takes_little_more_than_twice_the_folder() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("library");
    let (scene, mut seed) = (Scene::lmt108(), 1u32);
    let mut noise = || {
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (f32::from((seed >> 16) as i16) / 4.0).trunc() / 32768.0
    };
    let mut signal = |rate_hz, channels: usize, frames| {
        let samples = (0..frames * channels).map(|_| noise()).collect();
        Signal::Series(surfaced::trial::Series::new(rate_hz, channels, samples).unwrap())
    };
    let mut one = trial("oak", "anna", 1);
    one.signals.clear();
    one.signals.insert(common::id("mi2"), signal(44_100.0, 1, 200_000));
    one.signals.insert(common::id("ac"), signal(10_000.0, 3, 50_000));
    let options = TrialOptions { durable: false, ..TrialOptions::default() };
    write_trial(&path, &one, &scene, &options).unwrap();
    let out = dir.path().join("out.mcap");
    exported(&path, &out);
    let folder: usize = files(&path).values().map(Vec::len).sum();
    let ratio = std::fs::metadata(&out).unwrap().len() as f64 / folder as f64;
    assert!(ratio < 2.2, "{ratio:.2} times the folder");
}

#[cfg(unix)]
#[test]
fn a_link_out_of_the_library_is_not_followed() {
    let dir = tempfile::tempdir().unwrap();
    let (path, out) = (library(dir.path()), dir.path().join("out.mcap"));
    let secret = dir.path().join("secret.txt");
    write_file(&secret, "mine alone");
    std::os::unix::fs::symlink(&secret, path.join("oak/anna-01/secret.txt")).unwrap();
    let opened = mcap::open(&path, &Scene::lmt108()).unwrap();
    let error = mcap::export(&path, &opened, &out).unwrap_err().to_string();
    assert!(error.contains("leads out") && !out.exists(), "{error}");
}

#[test]
fn an_lmt108_folder_comes_back_byte_for_byte() {
    let dir = tempfile::tempdir().unwrap();
    let (path, out, back) =
        (dir.path().join("lmt"), dir.path().join("out.mcap"), dir.path().join("back"));
    let sound = "SoundScans/Movement/Training/G1Oak_Sound_Movement_train1.wav";
    common::write_wav(&path.join(sound), 44_100, 1, &[1, -2, 3]);
    assert_eq!(exported(&path, &out), 1);
    mcap::import(&out, &back).unwrap();
    assert_eq!(files(&path), files(&back));
}
