//! A real dragging sound, played into a real sound server, is recorded and named by `surfaced run`.
#![cfg(feature = "microphone")]

mod common;

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use common::http::SOON;
use common::shared_lmt108;
use common::sound::{SINK, Server};
use crossbeam_channel::unbounded;
use serde_json::Value;
use surfaced::dataset;
use surfaced::record::{TrialOptions, write_trial};
use surfaced::scene::Scene;

/// The trial of each surface that is played, and in no library.
const PLAYED: u32 = 10;
const STATION: &str = "format = 1\n[stylus]\npresent = false\n[camera]\npresent = false\n\
                       [microphone]\nsources = [\"mi2\"]\n";

/// Writes the trials that are not played into a library; gives its surfaces.
fn library(data: &Path, to: &Path) -> Vec<String> {
    let data = dataset::open(data, &Scene::lmt108()).unwrap();
    let options = TrialOptions { durable: false, ..TrialOptions::default() };
    for entry in data.entries.iter().filter(|entry| entry.key.number != PLAYED) {
        let mut trial = entry.load().unwrap();
        trial.signals.retain(|id, _| id.as_str() == "mi2");
        if !trial.signals.is_empty() {
            write_trial(to, &trial, &data.scene, &options).unwrap();
        }
    }
    data.surfaces().into_iter().map(String::from).collect()
}

#[test]
fn dragging_sounds_are_named_against_the_other_trials() {
    let Some(data) = shared_lmt108() else { return };
    let Some(server) = Server::start() else { return };
    let dir = tempfile::tempdir().unwrap();
    let (to, config) = (dir.path().join("library"), dir.path().join("station.toml"));
    std::fs::write(&config, STATION).unwrap();
    let surfaces = library(&data, &to);
    let mut run = Command::new(env!("CARGO_BIN_EXE_surfaced"))
        .args(["run", "--json", "--method", "embedding", "--library", to.to_str().unwrap()])
        .args(["--config", config.to_str().unwrap()])
        .env("ALSA_CONFIG_PATH", server.alsa())
        .env("HOME", dir.path())
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let (sender, lines) = unbounded();
    let (out, err) = (run.stdout.take().unwrap(), run.stderr.take().unwrap());
    let said = sender.clone();
    std::thread::spawn(move || {
        BufReader::new(out).lines().for_each(|line| drop(sender.send((true, line.unwrap()))));
    });
    std::thread::spawn(move || {
        BufReader::new(err).lines().for_each(|line| drop(said.send((false, line.unwrap()))));
    });
    let mut log = String::new();
    // The next line of JSON, or the line for people that holds this.
    let mut until = |text: Option<&str>| -> String {
        let limit = Instant::now() + SOON;
        loop {
            let (json, line) = lines.recv_deadline(limit).unwrap_or_else(|_| panic!("{log}"));
            log.push_str(&line);
            log.push('\n');
            match text {
                None if json => return line,
                Some(text) if !json && line.contains(text) => return line,
                _ => {}
            }
        }
    };
    // In any order: both are there before the first sound.
    until(Some("is streaming"));
    std::thread::sleep(Duration::from_secs(2));
    let (mut right, mut answers) = (0, Vec::new());
    let chosen = surfaces.iter().step_by(5);
    let count = chosen.clone().count();
    for surface in chosen {
        let name =
            format!("SoundScans/Movement/Training/{surface}_Sound_Movement_train{PLAYED}.wav");
        let player = server.client("paplay").args(["-d", SINK]).arg(data.join(name)).status();
        assert!(player.unwrap().success(), "paplay failed");
        let line: Value = serde_json::from_str(&until(None)).unwrap();
        assert_eq!(line["lost_samples"], 0, "{line}");
        assert_eq!(line["spoiled"], serde_json::json!([]), "{line}");
        assert_eq!(line["ranked"].as_array().unwrap().len(), surfaces.len());
        // All of the sound, except its quiet ends.
        assert!((3.5..5.2).contains(&line["scan_s"].as_f64().unwrap()), "{line}");
        right += usize::from(line["surface"] == *surface);
        answers.push((surface.clone(), line["surface"].clone(), line["scan_s"].clone()));
        // The room is quiet before the next one.
        std::thread::sleep(Duration::from_secs(1));
    }
    let id = run.id().to_string();
    assert!(Command::new("kill").args(["-s", "TERM", &id]).status().unwrap().success());
    let status = run.wait().unwrap();
    until(Some("received: "));
    eprintln!("{right} of {count} named right: {answers:?}");
    assert_eq!(status.code(), Some(0), "{log}");
    // Twenty surfaces: chance names one of them right in five such tests.
    assert_eq!(right, count, "{answers:?}\n{log}");
}

/// An ALSA configuration whose `default` is on a card that is not there.
const NO_CARD: &str = "</usr/share/alsa/alsa.conf>\n\
                       pcm.!default { type hw card \"absent\" }\n\
                       ctl.!default { type hw card \"absent\" }\n";
/// How long a microphone is looked for.
const LOOKED_FOR: Duration = Duration::from_secs(10);

#[test]
fn a_microphone_that_is_not_there_is_one_line_however_often_it_is_looked_for() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    std::fs::write(path("asound.conf"), NO_CARD).unwrap();
    std::fs::write(path("station.toml"), STATION).unwrap();
    let surfaced = || Command::new(env!("CARGO_BIN_EXE_surfaced"));
    let synth = ["--surfaces", "2", "--trials", "2", "--users", "0"];
    let made = surfaced().arg("synth").arg(path("library")).args(synth).output().unwrap();
    assert!(made.status.success());
    let run = surfaced()
        .args(["run", "--method", "embedding", "--library"])
        .arg(path("library"))
        .arg("--config")
        .arg(path("station.toml"))
        .env("ALSA_CONFIG_PATH", path("asound.conf"))
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    std::thread::sleep(LOOKED_FOR);
    let id = run.id().to_string();
    assert!(Command::new("kill").args(["-s", "TERM", &id]).status().unwrap().success());
    let said = String::from_utf8(run.wait_with_output().unwrap().stderr).unwrap();
    // ALSA itself says several lines at each look.
    assert!(!said.contains("ALSA lib"), "{said}");
    assert_eq!(said.matches("is not there").count(), 1, "{said}");
    assert!(said.lines().count() < 12, "{said}");
}
