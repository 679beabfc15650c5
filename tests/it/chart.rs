//! `surfaced chart`: what it measures and writes.

use std::path::Path;
use std::process::Output;

use assert_cmd::Command;
use serde_json::{Value, json};
use surfaced::recognise::MethodName;

fn surfaced(args: &[&str]) -> Output {
    Command::cargo_bin("surfaced").unwrap().args(args).output().unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn read(path: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

#[test]
fn a_chart_has_every_method_and_its_controls() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name).to_str().unwrap().to_string();
    let (data, svg, json_path) = (at("scene"), at("chart.svg"), at("chart.json"));
    let synth = ["synth", &data, "--surfaces", "4", "--trials", "3", "--users", "1"];
    assert!(surfaced(&[&synth[..], &["--seconds", "0.8"]].concat()).status.success());
    let said = ["chart", &data, "--sources", "mi2,ir", "--surfaces", "3", "--out", &svg];
    let output = surfaced(&[&said[..], &["--protocol", "expert-vs-users"]].concat());
    assert!(output.status.success() && output.stdout.is_empty(), "{}", stderr(&output));
    assert!(stderr(&output).contains("to go)"), "it says how far it is");

    let chart = read(Path::new(&json_path));
    assert_eq!(chart["synthetic"], true);
    assert_eq!((&chart["surfaces"], &chart["library_trials"]), (&json!(3), &json!(9)));
    assert_eq!(chart["sources"], json!(["ir", "mi2"]));
    let points = chart["points"].as_array().unwrap().clone();
    let with = |key: &str, value: Value| points.iter().filter(|p| p[key] == value).count();
    // Of the scan times, half a second alone is shorter than these drags.
    for method in MethodName::ALL {
        let least = if method == MethodName::Reference { 3 } else { 1 };
        assert!(with("method", json!(method.as_str())) >= least, "{method:?}");
    }
    assert_eq!(with("control", json!(true)), 2);
    // One setting of each method is measured on the first half of a second, too.
    assert_eq!(with("query_seconds", json!(0.5)), MethodName::ALL.len());
    assert_eq!(with("sources", json!(["ir"])), 1);
    for point in &points {
        let of = |key: &str| point[key].as_f64().unwrap();
        assert!(of("accuracy_low") <= of("accuracy") && of("accuracy") <= of("accuracy_high"));
        assert!(of("query_ms_p50") > 0.0 && of("queries") == 3.0);
        let user = &point["users"][0];
        assert_eq!((&user["name"], &user["accuracy"]), (&json!("user1"), &point["accuracy"]));
    }
    let picture = std::fs::read_to_string(&svg).unwrap();
    assert!(picture.contains("control: ") && picture.contains("SYNTHETIC"));
}

#[test]
fn a_brief_chart_has_one_setting_of_each_method_and_all_of_the_drag() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name).to_str().unwrap().to_string();
    let data = at("scene");
    let synth = ["synth", &data, "--surfaces", "3", "--trials", "2", "--users", "1"];
    assert!(surfaced(&[&synth[..], &["--seconds", "0.8"]].concat()).status.success());
    let said = ["chart", &data, "--sources", "ir", "--brief", "--out", &at("brief.svg")];
    let output = surfaced(&said);
    assert!(output.status.success(), "{}", stderr(&output));
    let chart = read(&dir.path().join("brief.json"));
    let points = chart["points"].as_array().unwrap();
    // Nothing of a spectrum to control.
    assert_eq!(points.len(), MethodName::ALL.len());
    assert!(points.iter().all(|point| point["query_seconds"].is_null()));
}

#[test]
fn an_earlier_chart_is_refused_with_what_draws_it() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("chart.json");
    std::fs::write(&path, "{}").unwrap();
    let output = surfaced(&["chart", path.to_str().unwrap(), "--out", "never.svg"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("tools/peers/run --draw"), "{}", stderr(&output));
}
