//! What the operator of a day gets from the server beside names: scans that have none, and the camera.

use std::sync::Arc;

use crate::common::http::{Events, answer, serve};
use crate::common::id;
use serde_json::{Value, json};
use surfaced::device::camera::{FlashState, Rgb, Turn, Viewfinder};
use surfaced::station::{Answer, AnswerState, StationEvent, Unnamed};

#[test]
fn a_scan_that_cannot_be_named_is_among_the_past_scans_with_its_reason() {
    let mut served = serve(|_| {});
    let mut events = Events::open(&served, "?types=state,unnamed,warning");
    events.next("state");
    let why = "too little to name it";
    let answer = Arc::new(Answer {
        state: AnswerState::Unnamed,
        reasons: vec![why.into()],
        ranked: Vec::new(),
        confidence: None,
        ..answer(4, None)
    });
    let text = format!("scan 4 was not named: {why}");
    let unnamed = Unnamed { answer, text: text.clone(), too_little: true };
    served.report([StationEvent::Unnamed(unnamed)]);
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
    finder.show(Rgb { width: 720, height: 720, bytes: vec![90; 720 * 720 * 3] }, Turn::None);
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
