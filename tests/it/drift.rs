//! Drift: a reference surface is set from a terminal, and its scans warn before answers go wrong.

use std::collections::BTreeMap;
use std::sync::Arc;

use assert_cmd::Command;
use serde_json::Value;
use surfaced::station::{Answer, ChannelLevel, LibraryState, StationEvent};

use crate::common::http::{Events, answer, serve};
use crate::common::id;

fn library_command(arguments: &[&str]) -> (bool, String, String) {
    let output =
        Command::cargo_bin("surfaced").unwrap().arg("library").args(arguments).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.success(), text(output.stdout), text(output.stderr))
}

#[test]
fn a_surface_is_made_a_reference_shown_and_made_none() {
    let dir = tempfile::tempdir().unwrap();
    let library = dir.path().join("library").to_str().unwrap().to_string();
    let synth = ["synth", &library, "--surfaces", "2", "--trials", "2", "--users", "0"];
    Command::cargo_bin("surfaced").unwrap().args(synth).assert().success();
    let text = || std::fs::read_to_string(format!("{library}/library.toml")).unwrap();
    let before = text();
    let (done, out, said) = library_command(&["reference", &library, "--json"]);
    let drift: Value = serde_json::from_str(&out).unwrap();
    assert!(done && said.contains("no surface is a reference"), "{said}");
    assert_eq!((&drift["references"], &drift["needed"]), (&Value::Array(vec![]), &25.into()));
    let (done, _, said) = library_command(&["reference", &library, "mahogany"]);
    assert!(!done && said.contains("there is no surface mahogany"), "{said}");
    let mut surfaces = std::fs::read_dir(&library).unwrap().filter_map(|item| {
        let item = item.unwrap();
        item.path().is_dir().then(|| item.file_name().into_string().unwrap())
    });
    let surface = surfaces.find(|name| !name.starts_with('.')).unwrap();
    let (done, _, said) = library_command(&["reference", &library, &surface]);
    assert!(done && said.contains("is a reference from now on"), "{said}");
    let (done, out, _) = library_command(&["reference", &library]);
    assert!(done && out.contains(&surface), "{out}");
    let (done, _, said) = library_command(&["list", &library, "--quick"]);
    assert!(done, "the library still opens: {said}");
    assert!(library_command(&["reference", &library, &surface, "--none"]).0);
    assert_eq!(text(), before);
    let (done, _, said) = library_command(&["reference", &library, &surface, "--none"]);
    assert!(!done && said.contains("is no reference"), "{said}");
}

#[test]
fn a_drift_is_in_state_events_warnings_metrics_and_charts() {
    let mut served = serve(|_| {});
    let reference = BTreeMap::from([("oak".to_string(), 0)]);
    let library = LibraryState { reference, ..LibraryState::default() };
    served.report([StationEvent::Library(library)]);
    let mut events = Events::open(&served, "?types=drift,warning");
    let named = |scan: u32| {
        let moved_db = if scan > 30 { 3.0 } else { 0.1 * f64::from(scan % 3) };
        let (source, noise_db) = (id("ac"), None);
        let level = ChannelLevel { source, channel: 1, level_db: moved_db - 20.0, noise_db };
        let answer = Answer { levels: vec![level], ..answer(scan, Some("oak")) };
        StationEvent::Answer(Arc::new(answer))
    };
    served.report((1..=30).map(named));
    let state = served.until("/api/v1/state", |state| state["counts"]["scans"] == 30);
    assert_eq!(state["drift"], Value::Array(vec![]));
    served.report((31..=40).map(named));
    let state = served.until("/api/v1/state", |state| state["drift"][0].is_object());
    let doubt = &state["drift"][0];
    assert_eq!((&doubt["kind"], &doubt["source"]), (&"level_drift".into(), &"ac".into()));
    assert_eq!(events.next("drift")[0]["kind"], "level_drift");
    let warning = &state["warnings"][0]["text"];
    assert!(warning.as_str().unwrap().starts_with("drift: ac: channel 1 is louder"), "{warning}");
    let charts = served.until("/api/v1/drift", |drift| drift["references"][0]["scans"] == 40);
    let series = charts["references"][0]["series"].as_array().unwrap();
    let level = series.iter().find(|series| series["quantity"] == "level").unwrap();
    assert_eq!((&level["drifted"], level["points"].as_array().unwrap().len()), (&true.into(), 40));
    assert!(level["points"][24]["average"].is_null() && level["points"][25]["average"].is_number());
    let metrics = served.get("/metrics").body;
    for line in
        ["surfaced_reference_scans{surface=\"oak\"} 40", "surfaced_drifted{quantity=\"level\"} 1"]
    {
        assert!(metrics.lines().any(|other| other == line), "{line}: {metrics}");
    }
}
