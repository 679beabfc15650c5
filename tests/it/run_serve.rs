//! `--serve` of the program as a process: a live station, with a stylus on a pseudo-terminal, at
//! which a program enrols what it then has named; and a replay.

use std::io::{BufRead, BufReader};
use std::os::unix::process::ExitStatusExt;
use std::process::{Command, Stdio};
use std::time::Instant;

use crate::bench::{Bench, CHANNELS, SCANNED, Surfaced, opened, synthetic, trial};
use crate::common::http::{Client, SOON};
use crate::common::stylus::Fake;
use serde_json::{Value, json};

/// The address that a station said it serves at.
pub fn served(run: &Surfaced) -> Client {
    run.until_said("http://", None);
    let said = run.said();
    let address = said.lines().find_map(|line| line.strip_prefix("http://")).unwrap();
    Client(address.parse().unwrap())
}

/// Asks until the answer is as wanted, while the stylus keeps sending.
fn until(
    station: Client,
    path: &str,
    fake: &mut Fake,
    mut wanted: impl FnMut(&Value) -> bool,
) -> Value {
    let limit = Instant::now() + SOON;
    loop {
        let json = station.get(path).json();
        if wanted(&json) {
            return json;
        }
        assert!(Instant::now() < limit, "{path} stays {json}");
        fake.serve(0.1);
    }
}

#[test]
fn what_a_program_enrols_at_a_live_station_is_named_reloaded_and_on_the_page() {
    let data = synthetic(1.5);
    let mut bench = Bench::new();
    let library = bench.path("mine");
    std::fs::create_dir(&library).unwrap();
    let path = library.to_str().unwrap().to_string();
    let mut run = bench.surfaced(&["run", "--library", &path, "--serve=127.0.0.1:0"]);
    let station = served(&run);
    let page = station.get("/");
    assert!(page.status == 200 && page.body.contains("<title>surfaced</title>"));
    let mut fake = bench.stylus();
    fake.wait_for_start();
    let empty =
        until(station, "/api/v1/state", &mut fake, |state| state["advice"]["do"] == "enroll");
    assert!(empty["library"]["problem"].is_string(), "{empty}");

    // Two surfaces, two trials each; the library is read anew by itself after each.
    for surface in 0..2 {
        let label = data.surfaces()[surface];
        let body = json!({ "surface": label, "user": "anna", "trials": 2 }).to_string();
        assert_eq!(station.post("/api/v1/enroll", &body).status, 202);
        let state = until(station, "/api/v1/state", &mut fake, |s| s["enrolling"].is_object());
        let ordered = json!({"surface": label, "user": "anna", "wanted": 2, "trials": 2, "kept": 0,
            "asked": 0, "right": 0, "refused": null, "ordered_by": null});
        assert_eq!(state["enrolling"], ordered);
        for number in 1..=2 {
            let seconds = bench.play(&fake, &trial(&data, surface, number), 1.5);
            fake.serve(seconds);
            let line = run.line(&mut fake);
            assert_eq!(
                (&line["surface"], &line["trial"]),
                (&json!(label), &json!(number)),
                "{line}"
            );
        }
    }
    let ready = |state: &Value| state["library"]["problem"].is_null() && state["reading"] == false;
    let state = until(station, "/api/v1/state", &mut fake, ready);
    let surfaces: Vec<Value> = data.surfaces()[..2]
        .iter()
        .map(|surface| json!({ "surface": surface, "trials": 2 }))
        .collect();
    assert_eq!(state["library"]["surfaces"], json!(surfaces));
    assert_eq!(state["library"]["sources"], json!(CHANNELS));

    for (scan, surface) in [(5, 1), (6, 0)] {
        let seconds = bench.play(&fake, &trial(&data, surface, SCANNED), 1.5);
        fake.serve(seconds);
        let line = run.line(&mut fake);
        assert_eq!(line["surface"], data.surfaces()[surface], "{line} {}", run.said());
        // The page shows the same as the line.
        let at = format!("/api/v1/scans/{scan}");
        let answer = until(station, &at, &mut fake, |answer| answer["scan"] == scan);
        assert_eq!(answer["surface"], line["surface"]);
        assert_eq!(answer["lost_samples"], 0);
        if scan == 5 {
            assert_eq!(station.post("/api/v1/reload", "").status, 202);
            until(station, "/api/v1/state", &mut fake, ready);
        }
    }
    let counts = station.get("/api/v1/state").json()["counts"].clone();
    assert_eq!((&counts["enrolled"], &counts["scans"]), (&json!(4), &json!(2)), "{counts}");
    assert_eq!(counts["lost_samples"], 0, "{counts}");
    run.signal("TERM");
    assert_eq!(run.end(&mut fake).code(), Some(0), "{}", run.said());
}

#[test]
fn an_enrolment_on_the_page_interrupts_a_recording_from_the_next_scan_on_and_does_not_end_it() {
    let data = synthetic(1.5);
    let mut bench = Bench::new();
    let path = bench.path("mine");
    let library = path.to_str().unwrap().to_string();
    let mut record = bench.surfaced(&["record", "--library", &library, "--serve=127.0.0.1:0"]);
    let station = served(&record);
    let mut fake = bench.stylus();
    fake.wait_for_start();
    let in_force = |fake: &mut Fake, surface: &str| {
        until(station, "/api/v1/state", fake, |s| s["enrolling"]["surface"] == surface)
    };
    let state = in_force(&mut fake, "unlabelled");
    assert_eq!(state["enrolling"]["wanted"], Value::Null, "every scan");
    let order = json!({ "surface": "oak", "trials": 1 }).to_string();
    for (scan, surface) in [(1, "unlabelled"), (2, "oak"), (3, "unlabelled")] {
        let seconds = bench.play(&fake, &trial(&data, 0, 1 + scan % 2), 1.5);
        // In the middle of the first drag.
        fake.serve(seconds - 0.5);
        if scan == 1 {
            assert_eq!(station.get("/api/v1/state").json()["phase"], "drag");
            assert_eq!(station.post("/api/v1/enroll", &order).status, 202);
            in_force(&mut fake, "oak");
        }
        fake.serve(0.5);
        let line = record.line(&mut fake);
        assert_eq!(
            (&line["surface"], &line["outcome"]),
            (&json!(surface), &json!("kept")),
            "{line}"
        );
        in_force(&mut fake, if scan == 1 { "oak" } else { "unlabelled" });
    }
    record.signal("TERM");
    assert_eq!(record.end(&mut fake).code(), Some(0), "{}", record.said());
    let kept = opened(&path);
    let kept: Vec<_> =
        kept.entries.iter().map(|e| (e.key.surface.as_str(), e.key.number)).collect();
    assert_eq!(kept, [("oak", 1), ("unlabelled", 1), ("unlabelled", 2)]);
}

#[test]
fn a_replay_is_on_the_page_before_its_models_are_made() {
    let mut replay = Command::new(env!("CARGO_BIN_EXE_surfaced"))
        .args(["replay", "--speed", "1.0", "--json", "--serve=127.0.0.1:0"])
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut said = BufReader::new(replay.stderr.take().unwrap()).lines().map_while(Result::ok);
    let address = said.find_map(|line| Some(line.strip_prefix("http://")?.parse().unwrap()));
    let station = Client(address.unwrap());
    assert_eq!(station.get("/").status, 200);
    let state = station.until("/api/v1/state", |state| state["reading"] == true);
    assert_eq!((&state["advice"]["do"], &state["library"]), (&json!("wait"), &json!(null)));
    // Nothing has begun that would have to be ended first.
    assert!(Command::new("kill").arg(replay.id().to_string()).status().unwrap().success());
    assert_eq!(replay.wait().unwrap().signal(), Some(15));
}
