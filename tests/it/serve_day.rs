//! The server's answers to an operator, beside names: scans that have none, and the camera.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use crate::common::http::{Events, Served, answer, serve};
use crate::common::id;
use serde_json::{Value, json};
use surfaced::device::camera::{FlashState, Viewfinder};
use surfaced::history::{History, Keeper};
use surfaced::record::edit::Editor;
use surfaced::record::{TrialOptions, write_trial};
use surfaced::scan::Scan;
use surfaced::scene::Scene;
use surfaced::serve::{LibraryFolder, Settings};
use surfaced::station::{Answer, AnswerState, AnsweredScan, Listener, StationEvent};
use surfaced::trial::{Doubt, Series, Signal, Trial, TrialKey};

#[test]
fn a_scan_that_cannot_be_named_is_among_the_past_scans_with_its_reason() {
    let mut served = serve(|_| {});
    let mut events = Events::open(&served, "?types=state,unnamed,warning");
    events.next("state");
    let why = "too little to name it";
    let answer = Arc::new(Answer {
        state: AnswerState::Unnamed,
        doubts: vec![Doubt::NotNamed { why: why.into() }],
        ranked: Vec::new(),
        confidence: None,
        ..answer(4, None)
    });
    let text = format!("scan 4 was not named: {why}");
    served.report([StationEvent::Unnamed(answer)]);
    let row = served.until("/api/v1/scans/4", |scan| scan["state"] == "unnamed");
    assert_eq!((&row["reasons"], &row["surface"]), (&json!([why]), &Value::Null));
    let state = served.until("/api/v1/state", |state| state["counts"]["unnamed"] == 1);
    assert_eq!(state["counts"]["scans"], 0);
    assert_eq!((&state["answer"], &state["warnings"][0]["text"]), (&Value::Null, &json!(text)));
    assert!(served.get("/metrics").body.contains("surfaced_scans_total{answer=\"unnamed\"} 1"));
    served.post("/api/v1/scans/4/correct", r#"{"surface": "oak"}"#);
    let history = served.get("/api/v1/history").json();
    assert_eq!(history["precision"], json!([]), "it was no answer, neither right nor wrong");
    assert_eq!(events.next("unnamed")["scan"], 4);
    assert_eq!(events.next("warning")["text"], text);
}

#[test]
fn the_camera_is_shown_whole_with_its_region_and_its_light() {
    let finder = Viewfinder::new(id("ca1"));
    finder.light(FlashState::Off);
    let served = serve(|settings| settings.viewfinder = Some(finder.clone()));
    let mut events = Events::open(&served, "?types=camera,state");
    let none = json!({"source": "ca1", "region": null, "flash": "off"});
    assert_eq!(events.next("state")["camera"], none);
    assert_eq!(served.get("/api/v1/pictures/whole-ca1.jpg").status, 404);
    finder.show(image::RgbImage::from_pixel(720, 720, image::Rgb([90; 3])));
    finder.light(FlashState::On);
    let view = loop {
        let view = events.next("camera");
        if view["flash"] == "on" {
            break view;
        }
    };
    let region = &view["region"];
    assert_eq!((region["top"].as_f64(), region["height"].as_f64()), (Some(0.0), Some(1.0)));
    assert!((region["width"].as_f64().unwrap() - 2.0 / 3.0).abs() < 1e-9, "{region}");
    let picture = served.get("/api/v1/pictures/whole-ca1.jpg");
    assert_eq!(picture.status, 200);
    assert!(picture.head.contains("content-type: image/jpeg"), "{}", picture.head);
    for other in ["whole-ca2.jpg", "ca1.jpg", "whole-.jpg", "whole-ca1.png"] {
        assert_eq!(served.get(&format!("/api/v1/pictures/{other}")).status, 404, "{other}");
    }
}

/// A station with a library of one trial of oak, and a scan of each number among the past ones.
fn reviewed(dir: &Path, scans: u32) -> Served {
    reviewed_with(dir, scans, |_| {})
}

/// The same with settings changed by `change`.
pub fn reviewed_with(dir: &Path, scans: u32, change: impl FnOnce(&mut Settings)) -> Served {
    let (library, scene) = (dir.join("library"), Scene::lmt108());
    let signals = || {
        let samples = (0..2000).map(|i| (i % 7) as f32 / 8.0).collect();
        BTreeMap::from([(id("ir"), Signal::Series(Series::new(10_000.0, 1, samples).unwrap()))])
    };
    let trial = Trial { key: TrialKey::new("oak", "anna", 1), signals: signals() };
    write_trial(&library, &trial, &scene, &TrialOptions::default()).unwrap();
    let history = Arc::new(History::open(&library.join(".history"), 1 << 24).unwrap());
    let mut keeper = Keeper::start(history.clone(), scene.clone(), BTreeMap::new(), None).unwrap();
    for number in 1..=scans {
        let scan = Box::new(Scan { scan_s: 0.2, ..Scan::of_signals(number, signals()) });
        let answer = Arc::new(answer(number, Some("oak")));
        let whole = AnsweredScan { scan, answer, by: None };
        keeper.on_event(&StationEvent::Scan(Arc::new(whole)));
    }
    drop(keeper);
    serve(|settings| {
        settings.history = history;
        settings.library = Some(LibraryFolder { folder: library, scene });
        change(settings);
    })
}

fn trials(served: &Served) -> Vec<String> {
    trials_in(&served.get("/api/v1/library/trials").json())
}

/// The names of the trials in what a server says of its library.
pub fn trials_in(shelf: &Value) -> Vec<String> {
    let name = |trial: &Value| trial["trial"].as_str().unwrap().to_string();
    shelf["trials"].as_array().unwrap().iter().map(name).collect()
}

#[test]
fn a_scan_that_many_keep_at_once_becomes_one_trial_and_undo_takes_that_back() {
    let dir = tempfile::tempdir().unwrap();
    let served = reviewed(dir.path(), 1);
    served.post("/api/v1/scans/1/correct", r#"{"surface": "oak"}"#);
    let keep = || served.post("/api/v1/scans/1/keep", r#"{"user": "anna"}"#).status;
    let mut statuses: Vec<u16> = std::thread::scope(|scope| {
        let all: Vec<_> = (0..12).map(|_| scope.spawn(keep)).collect();
        all.into_iter().map(|one| one.join().unwrap()).collect()
    });
    statuses.sort_unstable();
    assert_eq!((statuses[0], &statuses[1..]), (200, &[400; 11][..]));
    assert_eq!(trials(&served), ["oak/anna-01", "oak/anna-02"]);
    let undone = served.post("/api/v1/library/undo", "").json();
    assert!(undone["what"].as_str().unwrap().starts_with("keep scan "), "{undone}");
    assert_eq!(trials(&served), ["oak/anna-01"]);
    // Once it is removed, it may be kept again: the same trial comes back.
    assert_eq!((keep(), keep()), (200, 400));
    assert_eq!(trials(&served), ["oak/anna-01", "oak/anna-02"]);
    assert_eq!(served.get("/api/v1/library/trials").json()["removed"], json!([]));
}

#[test]
fn correcting_a_scan_that_was_kept_takes_its_trial_along() {
    let dir = tempfile::tempdir().unwrap();
    let served = reviewed(dir.path(), 1);
    let correct = |was: &str| served.post("/api/v1/scans/1/correct", was).json();
    correct(r#"{"surface": "oak"}"#);
    served.post("/api/v1/scans/1/keep", "");
    assert_eq!(trials(&served), ["oak/anna-01", "oak/expert-01"]);
    assert_eq!(correct(r#"{"surface": "ash"}"#)["became"], "ash/expert-01");
    assert_eq!(trials(&served), ["ash/expert-01", "oak/anna-01"]);
    // Also after somebody has given it another label.
    served.post("/api/v1/library/rename", r#"{"surface": "ash", "to": "elm"}"#);
    assert_eq!(served.get("/api/v1/scans/1").json()["became"], "elm/expert-01");
    assert_eq!(correct(r#"{"surface": "yew"}"#)["became"], "yew/expert-01");
    assert_eq!(correct(r#"{"unknown": true}"#)["became"], Value::Null);
    assert_eq!(trials(&served), ["oak/anna-01"]);
    // And after the trial has come back, here or by another program.
    served.post("/api/v1/library/undo", "");
    assert_eq!(served.get("/api/v1/scans/1").json()["became"], "yew/expert-01");
    assert_eq!(correct(r#"{"bad": true}"#)["became"], Value::Null);
    Editor::open(&dir.path().join("library"), &Scene::lmt108()).unwrap().undo().unwrap();
    assert_eq!(correct(r#"{"surface": "fir"}"#)["became"], "fir/expert-01");
    assert_eq!(trials(&served), ["fir/expert-01", "oak/anna-01"]);
    correct("{}");
    correct(r#"{"surface": "oak"}"#);
    assert_eq!(served.post("/api/v1/scans/1/keep", "").status, 200);
}

#[test]
fn a_player_may_ask_for_a_part_of_a_sound() {
    let dir = tempfile::tempdir().unwrap();
    let served = reviewed(dir.path(), 1);
    let get = |range: &str| served.request("GET", "/api/v1/scans/1/ir.wav", &[range], "");
    let head = get("Range: bytes=0-3");
    assert_eq!((head.status, head.body.as_str()), (206, "RIFF"));
    assert!(head.head.contains("content-range: bytes 0-3/"), "{}", head.head);
    assert_eq!((get("Range: bytes=8-11").body.as_str(), get("Range: x=1").status), ("WAVE", 200));
    assert_eq!(get("Range: bytes=5-2").status, 200);
    assert_eq!(get("Range: bytes=999999999-").status, 416);
    assert_eq!(get("Range: bytes=-4").status, 206);
}
