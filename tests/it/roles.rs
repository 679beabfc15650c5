//! Two roles at the station, the names of persons, the audit log, and corrections of many scans.

use std::path::Path;

use crate::common::http::{Client, Events, Reply, Served, answer, serve};
use crate::serve_day::{reviewed_with, trials_in};
use serde_json::{Value, json};
use surfaced::serve::{ServeError, Server, Settings, Token};
use surfaced::station::{Command, StationEvent};

const ADMINISTRATOR: &str = "Authorization: Bearer 0123456789abcdef";
const OPERATOR: &str = "Authorization: Bearer operator-of-a-day";

fn two_tokens(settings: &mut Settings) {
    settings.token = Some(Token::new("0123456789abcdef").unwrap());
    settings.operator_token = Some(Token::new("operator-of-a-day").unwrap());
}

fn word(reply: &Reply) -> (u16, String) {
    (reply.status, reply.json()["error"].as_str().unwrap_or_default().into())
}

/// A request of a person with a role.
fn post_by(client: &Client, role: &str, person: &str, (path, body): (&str, &str)) -> Reply {
    let person = format!("X-Surfaced-Person: {person}");
    client.request("POST", &format!("/api/v1/{path}"), &[role, &person], body)
}

fn changes(client: &Client, query: &str) -> Vec<Value> {
    let path = format!("/api/v1/audit{query}");
    let reply = client.request("GET", &path, &[ADMINISTRATOR], "");
    reply.json()["changes"].as_array().unwrap().clone()
}

fn trials(served: &Served) -> Vec<String> {
    trials_in(&served.request("GET", "/api/v1/library/trials", &[ADMINISTRATOR], "").json())
}

/// Some fields of each change.
fn of_each(changes: &[Value], fields: &[&str]) -> Vec<Value> {
    let of = |change: &Value| fields.iter().map(|field| change[*field].clone()).collect();
    changes.iter().map(of).collect()
}

#[test]
fn an_operator_sees_scans_and_corrects_and_is_refused_all_else() {
    let dir = tempfile::tempdir().unwrap();
    let served = reviewed_with(dir.path(), 2, two_tokens);
    let operator = |method: &str, path: &str, body: &str| {
        served.request(method, &format!("/api/v1/{path}"), &[OPERATOR], body)
    };
    for path in ["state", "scans", "library/trials", "check", "scans.csv", "history"] {
        assert_eq!(operator("GET", path, "").status, 200, "{path}");
    }
    assert_eq!(served.request("GET", "/metrics", &[OPERATOR], "").status, 200);
    for path in ["start", "stop"] {
        assert_eq!(operator("POST", path, "").status, 202, "{path}");
    }
    let ash = r#"{"surface": "ash"}"#;
    assert_eq!(operator("POST", "scans/1/correct", ash).json()["correction"]["surface"], "ash");
    assert_eq!(operator("POST", "scans/1/correct", "{}").json()["correction"], Value::Null);
    let many = r#"{"ids": ["1", "2"], "bad": true}"#;
    assert_eq!(operator("POST", "scans/correct", many).json()["corrected"], 2);
    assert_eq!(served.orders.try_iter().collect::<Vec<_>>(), [Command::Start, Command::Stop]);
    for (path, body) in [
        ("reload", ""),
        ("enroll", ash),
        ("enroll/keep", r#"{"scan": 1}"#),
        ("enroll/end", ""),
        ("scans/1/keep", "{}"),
        ("library/rename", r#"{"surface": "oak", "to": "ash"}"#),
        ("library/move", r#"{"trials": ["oak/anna-01"], "to": "ash"}"#),
        ("library/remove", r#"{"trials": ["oak/anna-01"]}"#),
        ("library/restore", r#"{"trials": ["oak/anna-01"]}"#),
        ("library/undo", ""),
        ("check", ""),
    ] {
        let reply = operator("POST", path, body);
        assert_eq!(word(&reply), (403, "administrator_needed".into()), "{path}");
        assert!(reply.json()["message"].as_str().unwrap().contains("only an administrator"));
    }
    for path in ["audit", "audit.jsonl"] {
        assert_eq!(
            word(&operator("GET", path, "")),
            (403, "administrator_needed".into()),
            "{path}"
        );
    }
    assert!(served.orders.is_empty());
    assert_eq!(trials(&served), ["oak/anna-01"], "nothing moved");
}

#[test]
fn each_token_has_its_role_on_every_way_in_and_without_tokens_everyone_is_administrator() {
    let served = serve(two_tokens);
    let role = |header: &str| served.request("GET", "/api/v1/me", &[header], "");
    for (header, is) in [
        (ADMINISTRATOR, "administrator"),
        (OPERATOR, "operator"),
        ("Cookie: surfaced_token=0123456789abcdef", "administrator"),
        ("Cookie: surfaced_token=operator-of-a-day", "operator"),
    ] {
        assert_eq!(role(header).json(), json!({ "role": is }), "{header}");
    }
    assert_eq!(word(&role("Accept: */*")), (401, "token_needed".into()));
    assert_eq!(role("Authorization: Bearer operator-of-a-daY").status, 401);
    let enter = served.get("/?token=operator-of-a-day");
    assert_eq!(enter.status, 303);
    assert!(enter.head.contains("set-cookie: surfaced_token=operator-of-a-day;"), "{}", enter.head);
    assert_eq!(serve(|_| {}).get("/api/v1/me").json(), json!({ "role": "administrator" }));
    // Paths that need no token stay open to those who give an old one.
    assert_eq!(served.request("GET", "/healthz", &["Cookie: surfaced_token=old"], "").status, 200);
}

#[test]
fn an_operators_token_needs_an_administrators_that_is_another_one() {
    let start = |change: fn(&mut Settings)| {
        let mut settings =
            Settings { address: "127.0.0.1:0".parse().unwrap(), ..Settings::default() };
        two_tokens(&mut settings);
        change(&mut settings);
        Server::start(&settings, crossbeam_channel::bounded(1).0).map(drop)
    };
    assert!(start(|_| {}).is_ok());
    let alone = start(|settings| settings.token = None).unwrap_err();
    assert!(matches!(alone, ServeError::OperatorAlone));
    assert!(alone.to_string().contains("SURFACED_TOKEN, the administrator's token, is not"));
    let same = start(|settings| settings.operator_token = settings.token.clone()).unwrap_err();
    assert!(matches!(same, ServeError::SameToken), "{same}");
}

#[test]
fn the_program_says_which_token_is_wrong_and_shows_none() {
    for (token, operator, says) in [
        (None, "operator-of-a-day", "SURFACED_OPERATOR_TOKEN is set, but SURFACED_TOKEN"),
        (
            Some("0123456789abcdef"),
            "0123456789abcdef",
            "SURFACED_OPERATOR_TOKEN equals SURFACED_TOKEN",
        ),
        (
            Some("0123456789abcdef"),
            "too-short",
            "SURFACED_OPERATOR_TOKEN: the token must be 16 to 256",
        ),
    ] {
        let mut command = assert_cmd::Command::cargo_bin("surfaced").unwrap();
        command.args(["replay", "--serve=127.0.0.1:0"]).env("SURFACED_OPERATOR_TOKEN", operator);
        match token {
            Some(token) => command.env("SURFACED_TOKEN", token),
            None => command.env_remove("SURFACED_TOKEN"),
        };
        let output = command.output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.contains(says) && !said.contains(operator), "{said}");
    }
}

#[test]
fn a_person_is_kept_with_what_they_order_and_correct() {
    let dir = tempfile::tempdir().unwrap();
    let served = reviewed_with(dir.path(), 1, two_tokens);
    let ash = ("scans/1/correct", r#"{"surface": "ash"}"#);
    let was = post_by(&served, OPERATOR, "J%C3%BCrgen%20M.", ash).json()["correction"].clone();
    assert_eq!(was, json!({ "was": "surface", "surface": "ash", "person": "Jürgen M." }));
    let unnamed = served.request("POST", "/api/v1/scans/1/correct", &[OPERATOR], ash.1).json();
    assert_eq!(unnamed["correction"]["person"], Value::Null);
    post_by(&served, ADMINISTRATOR, "anna", ("enroll", r#"{"surface": "elm", "user": "ben"}"#));
    let (surface, user, ordered_by) = ("elm".into(), "ben".into(), Some("anna".into()));
    let order = Command::Enroll { surface, user, trials: 1, ordered_by };
    assert_eq!(served.orders.try_recv(), Ok(order));
    for bad in ["%FF", "a%0Ab", &"x".repeat(65), "50%"] {
        let reply = post_by(&served, OPERATOR, bad, ("start", ""));
        assert_eq!(word(&reply), (400, "bad_request".into()), "{bad}");
        assert!(reply.json()["message"].as_str().unwrap().contains("`X-Surfaced-Person`"), "{bad}");
    }
    assert!(served.orders.is_empty());
}

#[test]
fn the_audit_log_says_who_changed_what_and_stays_when_scans_go() {
    let dir = tempfile::tempdir().unwrap();
    let served = reviewed_with(dir.path(), 1, two_tokens);
    let id = "20260921-143000.001-01";
    let anna = |path, body| post_by(&served, ADMINISTRATOR, "anna", (path, body)).status;
    post_by(&served, OPERATOR, "ben", ("scans/1/correct", r#"{"surface": "oak"}"#));
    assert_eq!(anna("scans/1/keep", r#"{"user": "ben"}"#), 200);
    let trial = || {
        let scan = served.request("GET", "/api/v1/scans/1", &[OPERATOR], "").json();
        json!([scan["became"], scan["became_by"]])
    };
    assert_eq!(trial(), json!(["oak/ben-01", "anna"]));
    let ben = r#"{"surface": "ash"}"#;
    assert_eq!(post_by(&served, OPERATOR, "ben", ("scans/1/correct", ben)).status, 200);
    assert_eq!(trial(), json!(["ash/ben-01", "ben"]));
    // The trial stays where it is, and so who moved it stays.
    assert_eq!(anna("scans/1/correct", ben), 200);
    assert_eq!(trial(), json!(["ash/ben-01", "ben"]));
    assert_eq!(anna("library/move", r#"{"trials": ["ash/ben-01"], "to": "elm"}"#), 200);
    assert_eq!(trial(), json!(["elm/ben-01", "anna"]));
    let csv = served.request("GET", "/api/v1/scans.csv", &[OPERATOR], "").body;
    assert!(csv.lines().any(|line| line.ends_with(",anna,anna")), "{csv}");
    assert_eq!(anna("library/undo", ""), 200);
    assert_eq!(anna("scans/1/correct", r#"{"unknown": true}"#), 200);
    served.orders.try_iter().for_each(drop);
    assert_eq!(anna("reload", ""), 202);
    assert_eq!(anna("enroll", r#"{"surface": "fir", "user": "ben", "trials": 2}"#), 202);
    // A request that is refused, or only begins a scan, changes nothing.
    assert_eq!(anna("start", ""), 202);
    assert_eq!(anna("scans/9/correct", "{}"), 404);
    let fields = ["person", "role", "action", "subject", "before", "after"];
    let expected = json!([
        ["anna", "administrator", "enroll", "fir", null, "2 trials of ben"],
        ["anna", "administrator", "reload", null, null, null],
        ["anna", "administrator", "correct", id, "ash", "(unknown)"],
        ["anna", "administrator", "remove", "ash/ben-01", "ash/ben-01", null],
        ["anna", "administrator", "undo", "elm/ben-01", "elm/ben-01", "ash/ben-01"],
        ["anna", "administrator", "move", "ash/ben-01", "ash/ben-01", "elm/ben-01"],
        ["anna", "administrator", "correct", id, "ash", "ash"],
        ["ben", "operator", "correct", id, "oak", "ash"],
        ["ben", "operator", "move", "oak/ben-01", "oak/ben-01", "ash/ben-01"],
        ["anna", "administrator", "keep", id, null, "oak/ben-01"],
        ["ben", "operator", "correct", id, null, "oak"],
    ]);
    let all = changes(&served, "");
    assert_eq!(json!(of_each(&all, &fields)), expected);
    assert!(all[0]["unix_ms"].as_u64() > Some(1_700_000_000_000));
    let page = changes(&served, &format!("?limit=2&before={}", all[1]["id"]));
    assert_eq!(page, all[2..4]);
    let bad = served.request("GET", "/api/v1/audit?before=x", &[ADMINISTRATOR], "");
    assert_eq!(word(&bad), (400, "bad_request".into()));
    let lines = served.request("GET", "/api/v1/audit.jsonl", &[ADMINISTRATOR], "");
    assert!(lines.head.contains("content-type: application/jsonl"), "{}", lines.head);
    assert!(lines.body.contains("\"person\":\"ben\""), "{}", lines.body);
    let path = dir.path().join("library/.history/audit.jsonl");
    assert_eq!(std::fs::read_to_string(path).unwrap().lines().count(), all.len());
}

/// The ids and words of the scans that were not corrected.
fn not_done(reply: &Value) -> Vec<(String, String)> {
    let text = |value: &Value| value.as_str().unwrap().to_string();
    let each = reply["each"].as_array().unwrap().iter();
    let failed = each.filter(|one| !one["error"].is_null());
    failed.map(|one| (text(&one["id"]), text(&one["error"]))).collect()
}

#[test]
fn many_scans_are_corrected_at_once_each_is_accounted_for_and_it_is_undone_as_one() {
    let dir = tempfile::tempdir().unwrap();
    let served = reviewed_with(dir.path(), 9, |_| {});
    let correct = |body: &str| served.post("/api/v1/scans/correct", body);
    let mut events = Events::open(&served, "?types=state,correction");
    events.next("state");
    let ids = r#""ids": ["1", "20260921-143000.002-02", "77", "3"]"#;
    let said = correct(&format!("{{{ids}, \"surface\": \"ash\"}}")).json();
    assert_eq!((&said["corrected"], &said["failed"]), (&json!(3), &json!(1)));
    assert_eq!(not_done(&said), [("77".into(), "not_found".into())]);
    assert_eq!(said["each"][2]["message"], "there is no scan 77");
    let surfaces = |served: &Served| {
        let scans = served.get("/api/v1/scans").json()["scans"].clone();
        let was = |scan: &Value| scan["correction"]["surface"].as_str().map(String::from);
        scans.as_array().unwrap().iter().rev().map(was).collect::<Vec<_>>()
    };
    let ash = || Some("ash".to_string());
    assert_eq!(surfaces(&served)[..4], [ash(), ash(), ash(), None]);
    assert_eq!(events.next("correction")["correction"]["surface"], "ash");
    assert_eq!(correct(&format!("{{{ids}}}")).json()["corrected"], 3);
    assert!(surfaces(&served).iter().all(Option::is_none));
    for (body, why) in [
        (r#"{"surface": "ash"}"#.to_string(), "missing field `ids`"),
        (r#"{"ids": []}"#.into(), "0 ids; expected 1 to 1000"),
        (format!("{{\"ids\": [{}\"1\"]}}", "\"1\",".repeat(1000)), "1001 ids; expected 1 to 1000"),
        (r#"{"ids": ["1"], "bad": true, "unknown": true}"#.into(), "give only one of"),
        (r#"{"ids": ["1"], "surface": "../x"}"#.into(), "begins with a dot"),
    ] {
        let reply = correct(&body);
        assert_eq!(word(&reply), (400, "bad_request".into()), "{why}");
        assert!(reply.json()["message"].as_str().unwrap().contains(why), "{}", reply.body);
    }
}

#[test]
fn trials_of_many_corrected_scans_move_in_one_step_or_are_said_to_have_stayed() {
    let dir = tempfile::tempdir().unwrap();
    let served = reviewed_with(dir.path(), 3, |_| {});
    let correct = |body: &str| served.post("/api/v1/scans/correct", body).json();
    correct(r#"{"ids": ["1", "2", "3"], "surface": "oak"}"#);
    for scan in [1, 2] {
        assert_eq!(served.post(&format!("/api/v1/scans/{scan}/keep"), "").status, 200);
    }
    let said = correct(r#"{"ids": ["1", "2", "3"], "surface": "ash"}"#);
    assert_eq!(said["corrected"], 3);
    assert_eq!(trials(&served), ["ash/expert-01", "ash/expert-02", "oak/anna-01"]);
    assert_eq!(served.get("/api/v1/scans/2").json()["became"], "ash/expert-02");
    served.post("/api/v1/library/undo", "");
    assert_eq!(trials(&served), ["oak/anna-01", "oak/expert-01", "oak/expert-02"], "one step");
    block(&dir.path().join("library"), "elm");
    let said = correct(r#"{"ids": ["1", "2", "3"], "surface": "elm"}"#);
    assert_eq!((&said["corrected"], &said["failed"]), (&json!(1), &json!(2)), "{said}");
    let word = |id: &str| (id.to_string(), "failed".to_string());
    assert_eq!(not_done(&said), [word("1"), word("2")]);
    assert_eq!(served.get("/api/v1/scans/1").json()["correction"]["surface"], "ash");
    assert_eq!(trials(&served), ["oak/anna-01", "oak/expert-01", "oak/expert-02"]);
}

/// Puts a file where a surface would have its folder.
fn block(library: &Path, surface: &str) {
    std::fs::write(library.join(surface), "").unwrap();
}

#[test]
fn a_station_without_a_history_on_disk_keeps_its_changes_in_memory() {
    let mut served = serve(|_| {});
    served.report([StationEvent::Answer(std::sync::Arc::new(answer(1, Some("oak"))))]);
    served.until("/api/v1/scans/1", |scan| scan["surface"] == "oak");
    served.post("/api/v1/scans/1/correct", r#"{"bad": true}"#);
    let all = served.get("/api/v1/audit").json()["changes"].clone();
    assert_eq!((&all[0]["after"], &all[0]["role"]), (&json!("(bad)"), &json!("administrator")));
    assert_eq!(served.get("/api/v1/audit.jsonl").body.matches("\"correct\"").count(), 1);
}
