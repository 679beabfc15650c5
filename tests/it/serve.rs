//! The interface for programs: what its page promises is what a server answers.

use std::sync::Arc;

use crate::common::http::{Events, Served, answer, serve, session};
use crate::common::{self, id};
use serde_json::{Value, json};
use surfaced::device::DeviceState;
use surfaced::scan::{Fresh, Totals, Trace};
use surfaced::serve::Token;
use surfaced::station::{
    Command, Enrolled, EnrolledOutcome, Enrolling, LibraryState, StationEvent,
};

/// A server that a short session was reported to.
fn short_session() -> Served {
    let mut served = serve(|_| {});
    served.report(session());
    served.until("/api/v1/state", |state| state["guess"].is_object());
    served
}

/// Values that a clock or a release number decides.
fn timeless(mut value: Value) -> Value {
    match &mut value {
        Value::Object(map) => {
            for (key, value) in map {
                let of_clock = key.ends_with("unix_ms") || key == "version";
                *value = if of_clock { json!(0) } else { timeless(value.take()) };
            }
        }
        Value::Array(list) => list.iter_mut().for_each(|value| *value = timeless(value.take())),
        _ => {}
    }
    value
}

/// The requests of the page and the answers that it shows: indented blocks that begin with
/// `$ curl`, each followed by its answer.
fn documented() -> Vec<(String, String)> {
    let section = include_str!("../../src/serve/README.md");
    let mut samples: Vec<(String, String)> = Vec::new();
    let mut within = false;
    for line in section.lines() {
        let Some(line) = line.strip_prefix("    ") else {
            within = false;
            continue;
        };
        if let Some(command) = line.strip_prefix("$ curl ") {
            within = true;
            samples.push((command.into(), String::new()));
        } else if let Some((_, answer)) = samples.last_mut().filter(|_| within) {
            answer.push_str(line);
            answer.push('\n');
        }
    }
    samples
}

/// Does what a documented `curl` does.
fn curl(served: &Served, command: &str) -> String {
    let (options, address) = command.rsplit_once(' ').unwrap_or(("", command));
    let path = address.trim_matches('\'').strip_prefix("http://127.0.0.1:8080").unwrap();
    let body = options.split_once("-d ").map_or("", |(_, body)| body.trim_matches('\''));
    let posts = options.contains("-X POST") || !body.is_empty();
    match posts {
        true => served.post(path, body).body,
        false => served.get(path).body,
    }
}

#[test]
fn every_answer_that_the_page_shows_is_what_a_server_says() {
    let samples = documented();
    assert!(samples.len() >= 8, "the page shows an answer of each kind: {samples:#?}");
    let mut wrong = String::new();
    for (command, shown) in samples {
        // Each is answered as if it were the first.
        let served = short_session();
        let said = curl(&served, &command);
        if command.ends_with("/metrics") {
            for line in shown.lines().filter(|line| *line != "…") {
                if !said.lines().any(|l| l == line) {
                    wrong += &format!("{command}: no {line:?} in\n{said}\n");
                }
            }
            continue;
        }
        let shown: Value = serde_json::from_str(&shown)
            .unwrap_or_else(|error| panic!("{command}: {error} in\n{shown}"));
        let said: Value = serde_json::from_str(&said).unwrap();
        let (shown, said) = (timeless(shown), timeless(said));
        if shown != said {
            wrong += &format!("{command}: shown\n{shown}\nsaid\n{said}\n");
        }
    }
    assert!(wrong.is_empty(), "{wrong}");
}

#[test]
fn orders_reach_the_station_and_nothing_else_does() {
    let served = short_session();
    let enroll = |surface: &str, user: &str, trials| {
        let (surface, user) = (surface.into(), user.into());
        Command::Enroll { surface, user, trials, ordered_by: None }
    };
    for (path, body, order) in [
        ("start", "", Command::Start),
        ("stop", "", Command::Stop),
        ("reload", "", Command::Reload),
        ("enroll/end", "", Command::EndEnroll),
        ("enroll/keep", r#"{"scan": 7}"#, Command::KeepRefused(7)),
        ("enroll", r#"{"surface": "ash", "user": "anna", "trials": 3}"#, enroll("ash", "anna", 3)),
        ("enroll", r#"{"surface": " oak "}"#, enroll("oak", "expert", 1)),
    ] {
        let reply = served.post(&format!("/api/v1/{path}"), body);
        assert_eq!((reply.status, reply.json()["accepted"].as_str()), (202, Some(path)));
        assert_eq!(served.orders.try_recv(), Ok(order));
    }
    for path in ["quit", "record", "start/now", "../start"] {
        assert_eq!(served.post(&format!("/api/v1/{path}"), "").status, 404, "{path}");
    }
    assert!(served.orders.is_empty());
}

#[test]
fn a_station_that_is_busy_or_gone_is_said_to_be() {
    let mut served = short_session();
    for _ in 0..4 {
        assert_eq!(served.post("/api/v1/start", "").status, 202);
    }
    let busy = served.post("/api/v1/start", "");
    assert_eq!((busy.status, busy.json()["error"].as_str()), (503, Some("busy")));
    assert_eq!(served.get("/healthz").status, 200);
    served.report([StationEvent::Finished(Arc::new(Totals::default()))]);
    served.until("/api/v1/state", |state| state["finished"] == true);
    let ended = served.post("/api/v1/start", "");
    assert_eq!((ended.status, ended.json()["error"].as_str()), (409, Some("ended")));
    assert_eq!(served.get("/healthz").status, 503);
    let metrics = served.get("/metrics").body;
    assert!(metrics.contains("\nsurfaced_healthy 0\n") && metrics.contains("\nsurfaced_ready 0\n"));
    let ready = served.get("/readyz");
    assert_eq!((ready.status, &ready.json()["lacking"][0]), (503, &"ended".into()));
}

#[test]
fn a_library_that_is_being_read_is_said_to_be() {
    let mut served = serve(|_| {});
    let mut events = Events::open(&served, "");
    assert_eq!(events.next("state")["reading"], false);
    served.report([StationEvent::Reading]);
    assert_eq!(events.next("reading"), json!(true));
    let advice = events.next("advice");
    assert_eq!((&advice["do"], &advice["text"]), (&json!("wait"), &json!("reading the library")));
    assert_eq!(served.get("/api/v1/state").json()["reading"], true);
    served.report([StationEvent::Library(LibraryState::default())]);
    assert_eq!(events.next("advice")["text"], "wait for the devices");
    assert_eq!(served.get("/api/v1/state").json()["reading"], false);
}

#[test]
fn a_station_without_a_library_to_keep_scans_in_says_so() {
    let served = serve(|settings| settings.enrolls = false);
    let reply = served.post("/api/v1/enroll", r#"{"surface": "ash"}"#);
    assert_eq!((reply.status, reply.json()["error"].as_str()), (409, Some("no_library")));
    assert!(served.orders.is_empty());
}

#[test]
fn the_stream_of_events_begins_with_the_state_and_reports_what_changes() {
    let mut served = short_session();
    let mut events = Events::open(&served, "");
    assert_eq!(events.next("state")["scan"], 3);
    served.report([
        StationEvent::Phase { scan: 3, phase: None },
        StationEvent::Answer(Arc::new(answer(3, Some("beech")))),
        StationEvent::Device {
            device: "stylus".into(),
            state: DeviceState::Lost,
            detail: "unplugged".into(),
        },
    ]);
    assert_eq!(events.next("phase"), json!({ "scan": 3, "phase": null }));
    let answer = events.next("answer");
    assert_eq!((&answer["scan"], &answer["surface"]), (&json!(3), &json!("beech")));
    assert_eq!(events.next("device")["state"], "lost");
    assert_eq!(events.next("advice")["do"], "wait", "without the stylus there is nothing to do");
    served.post("/api/v1/enroll", r#"{"surface": "ash", "trials": 2, "replace": false}"#);
    let ash = |wanted| {
        let (surface, user) = ("ash".into(), "anna".into());
        let (trials, wanted) = (Some(2), Some(wanted));
        let (kept, asked, right, refused, ordered_by) = (0, 0, 0, None, None);
        let left =
            Enrolling { surface, user, wanted, trials, kept, asked, right, refused, ordered_by };
        StationEvent::Enrolling(Some(left).filter(|left| left.wanted > Some(0)))
    };
    served.report([ash(2)]);
    let ordered = json!({"surface": "ash", "user": "anna", "wanted": 2, "trials": 2, "kept": 0,
        "asked": 0, "right": 0,
        "refused": null, "ordered_by": null});
    assert_eq!(events.next("enrolling"), ordered);
    // Nobody's order is replaced unseen.
    let refused = served.post("/api/v1/enroll", r#"{"surface": "elm", "replace": false}"#);
    assert_eq!((refused.status, &refused.json()["error"]), (409, &json!("enrolling")));
    assert!(refused.body.contains("anna enrols ash now"), "{}", refused.body);
    assert_eq!(served.post("/api/v1/enroll", r#"{"surface": "elm"}"#).status, 202);
    for wanted in [1, 0] {
        let enrolled = StationEvent::Enrolled(Enrolled {
            scan: 4,
            surface: "ash".into(),
            user: "anna".into(),
            outcome: EnrolledOutcome::Kept,
            trial: Some(1),
            nearest: Some("ash".into()),
            probability: Some(0.75),
            known: Some(2),
            wanted: Some(wanted),
            ..Enrolled::default()
        });
        served.report([enrolled, ash(wanted)]);
        let enrolled = events.next("enrolled");
        assert_eq!(enrolled["wanted"], wanted);
        let before = [&enrolled["nearest"], &enrolled["probability"], &enrolled["known"]];
        assert_eq!(before, [&json!("ash"), &json!(0.75), &json!(2)]);
        let left = events.next("enrolling");
        assert_eq!(left["wanted"], if wanted == 0 { Value::Null } else { json!(wanted) });
    }
}

#[test]
fn a_reader_gets_the_types_that_it_names() {
    let mut served = short_session();
    let mut events = Events::open(&served, "?types=trace,answer");
    let fresh = |start| Fresh {
        source: id("ac"),
        rate_hz: 10_000.0,
        channels: 3,
        start,
        samples: (0..3 * 500).map(|at| at as f32).collect(),
    };
    // The reader may come a moment later than the first.
    let begin = std::time::Instant::now();
    for n in 0.. {
        served.report([StationEvent::Trace(Arc::new(Trace {
            fresh: vec![fresh(n * 500)],
            images: vec![],
        }))]);
        std::thread::sleep(std::time::Duration::from_millis(20));
        let metrics = served.get("/metrics").body;
        if metrics.contains("surfaced_readers 1") && n > 3 {
            break;
        }
        assert!(begin.elapsed() < common::http::SOON);
    }
    served.report([StationEvent::Answer(Arc::new(answer(4, None)))]);
    let trace = events.next("trace");
    let stream = &trace["streams"][0];
    assert_eq!((&stream["source"], &stream["bin_s"]), (&json!("ac"), &json!(0.005)));
    assert_eq!(stream["min"].as_array().unwrap().len(), 3, "a list a channel");
    assert_eq!(stream["max"][0][0].as_f64(), Some(147.0), "50 frames a bin");
    assert_eq!(events.next("answer")["surface"], Value::Null);
    let bad = served.get("/api/v1/events?types=everything");
    assert_eq!(bad.status, 400);
    assert!(bad.json()["message"].as_str().unwrap().contains("everything"));
}

#[test]
fn the_page_and_its_files_ask_for_nothing_from_elsewhere() {
    let served = short_session();
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/src/serve/page");
    for file in std::fs::read_dir(folder).unwrap() {
        let file = file.unwrap().file_name().into_string().unwrap();
        let (path, kind) = match file.rsplit_once('.').unwrap() {
            // The form for the token is shown only where one is needed.
            ("token", _) => continue,
            ("index", "html") => ("/".into(), "text/html"),
            (_, "css") => (format!("/{file}"), "text/css"),
            (_, "js") => (format!("/{file}"), "text/javascript"),
            (_, "svg") => (format!("/{file}"), "image/svg+xml"),
            _ => panic!("{file}"),
        };
        let path = path.as_str();
        let reply = served.get(path);
        assert_eq!(reply.status, 200, "{path}");
        assert!(reply.head.contains(&format!("content-type: {kind}")), "{path}: {}", reply.head);
        assert!(reply.head.contains("content-security-policy: default-src 'none'"), "{path}");
        assert!(reply.head.contains("x-content-type-options: nosniff"), "{path}");
        let text = reply.body.replace("http://www.w3.org/2000/svg", "");
        assert!(!text.contains("http:") && !text.contains("https:"), "{path} names another host");
        for markup in ["innerHTML =", "insertAdjacentHTML", "document.write", "eval(", "onclick="] {
            assert!(!text.contains(markup), "{path}: {markup} would take text for markup");
        }
    }
}

#[test]
fn with_a_token_nothing_is_revealed_without_it() {
    let secret = "0123456789abcdef";
    let served = serve(|settings| settings.token = Some(Token::new(secret).unwrap()));
    let with = |line: &str| served.request("GET", "/api/v1/state", &[line], "").status;
    for path in ["/", "/api/v1/state", "/metrics", "/page.js", "/?token=0123456789abcdeF"] {
        let reply = served.get(path);
        assert_eq!((reply.status, reply.json()["error"].as_str()), (401, Some("token_needed")));
    }
    // A person gets a form, which says what was wrong.
    let html = "Accept: text/html,*/*;q=0.8";
    for (path, says) in [("/", false), ("/?token=0123456789abcdeF", true)] {
        let form = served.request("GET", path, &[html], "");
        assert!(form.status == 401 && form.body.contains("name=\"token\""), "{}", form.body);
        assert_eq!(form.body.contains("This token is not right."), says, "{path}");
    }
    assert_ne!(served.get("/readyz").status, 401, "needs no token");
    for path in ["/healthz", "/style.css", "/favicon.svg"] {
        assert_eq!(served.get(path).status, 200, "{path}");
        let old = served.request("GET", path, &["Cookie: surfaced_token=of-last-year-1234"], "");
        assert_eq!(old.status, 200, "{path} with an old token");
    }
    assert_eq!(with("Authorization: Bearer 0123456789abcdeX"), 401);
    assert_eq!(with("Authorization: Basic 0123456789abcdef"), 401);
    assert_eq!(with("Authorization: Bearer 0123456789abcdef"), 200);
    assert_eq!(with("Cookie: a=b; surfaced_token=0123456789abcdef"), 200);
    let enter = served.get(&format!("/?token={secret}"));
    assert_eq!(enter.status, 303);
    assert!(
        enter
            .head
            .contains("set-cookie: surfaced_token=0123456789abcdef; httponly; samesite=strict")
    );
    assert!(enter.head.contains("\r\nlocation: ./\r\n"));
}
