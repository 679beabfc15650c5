//! The plan of a scene: one cheap source where that is enough, more where it is not; a file that
//! says so, and a replay that keeps to it.

use std::path::Path;
use std::process::Output;

use crate::common::id;
use assert_cmd::Command;
use serde_json::Value;
use surfaced::dataset::synth::{self, Parameters};
use surfaced::evaluate::plan::{Plan, PlanOptions, Planned, search};
use surfaced::evaluate::{self, Evaluation, Protocol};
use surfaced::library::{Entry, Library};
use surfaced::recognise::{Embedding, EmbeddingOptions};

/// A synthetic scene with some of its sources.
fn scene(surfaces: usize, trials: u32, sources: &[&str]) -> Library {
    let parameters =
        Parameters { surfaces, trials, users: 0, drag_seconds: 1.2, ..Parameters::default() };
    let library = synth::library(&parameters);
    let ids: Vec<_> = sources.iter().map(|name| id(name)).collect();
    let scene = library.scene.only(&ids).unwrap();
    let entries = library.entries.into_iter().map(|entry| entry.within(&scene)).collect();
    Library { scene, entries, ..library }
}

fn plan(library: &Library, target: f64) -> Planned {
    let protocol = Protocol::LeaveOneTrialOut;
    search(library, PlanOptions { target, accuracy: Some(target), protocol }, &|_, _, _| ())
        .unwrap()
}

fn names(plan: &Plan) -> Vec<&str> {
    plan.sources.iter().map(|source| source.as_str()).collect()
}

#[test]
fn five_easy_surfaces_need_one_cheap_source() {
    let all = ["ac", "ca1", "fr", "ir", "me", "mi1", "mi2"];
    let library = scene(5, 4, &all);
    let planned = plan(&library, 0.99);
    assert_eq!(planned.plan.sources.len(), 1, "{:?}", planned.steps);
    let expected = &planned.plan.expected;
    assert!(expected.reached && expected.accuracy == 1.0);
    assert!(!expected.shown, "20 queries cannot show 99 %");
    assert_eq!((expected.queries, expected.surfaces), (20, 5));
    // None of the cheaper ones would have been enough.
    let costs = planned.sources.iter().map(|cost| cost.source.as_str());
    let cheaper: Vec<_> = costs.take_while(|name| !names(&planned.plan).contains(name)).collect();
    for name in cheaper {
        let alone = planned.sources.iter().find(|cost| cost.source.as_str() == name).unwrap();
        assert!(alone.accuracy < 1.0, "{name} is cheaper and as good: {:?}", planned.sources);
    }
    assert_eq!(names(&plan(&library, 0.99).plan), names(&planned.plan), "the same again");
}

/// 108 surfaces without camera and sound: no source is enough.
#[test]
fn a_hundred_and_eight_surfaces_need_several() {
    let library = scene(108, 3, &["fr", "ir", "me"]);
    let planned = plan(&library, 0.75);
    assert!(planned.sources.iter().all(|cost| cost.accuracy < 0.75), "{:?}", planned.sources);
    let best = planned.sources.iter().map(|cost| cost.accuracy).fold(0.0, f64::max);
    let plan = &planned.plan;
    assert!(plan.sources.len() >= 2, "{:?}", planned.steps);
    assert!(plan.expected.accuracy > best, "{best} alone, {:?}", plan.expected);
    assert_eq!(plan.expected.surfaces, 108);
    assert!(plan.synthetic);

    // The search's sum over single sources is the method's answer by all of them.
    let scene = library.scene.clone().only(&plan.sources).unwrap();
    let entries: Vec<Entry> =
        library.entries.iter().map(|entry| entry.clone().within(&scene)).collect();
    let keys: Vec<_> = entries.iter().map(|entry| entry.key.clone()).collect();
    let folds = evaluate::folds(Protocol::LeaveOneTrialOut, &keys).unwrap();
    let method = Embedding::new(scene.clone(), EmbeddingOptions::default());
    let evaluation = Evaluation::new(&scene, &entries, &folds);
    let run = Evaluation { query_seconds: plan.scan_s, ..evaluation }.prepare(&method).unwrap();
    let outcome = run.measure().unwrap().outcome;
    let said = planned.steps.last().unwrap();
    let right = (outcome.accuracy_mean * outcome.queries as f64).round();
    assert!(said.ends_with(&format!(": {right} of 324 right")), "{said}, but {right}");
}

pub fn surfaced(args: &[&str]) -> Output {
    Command::cargo_bin("surfaced").unwrap().args(args).output().unwrap()
}

pub fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

pub fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn replay_keeps_to_the_plan() {
    let dir = tempfile::tempdir().unwrap();
    let (lib, file) = (dir.path().join("scene"), dir.path().join("plan.toml"));
    let size = ["--surfaces", "3", "--trials", "3", "--users", "0", "--seconds", "1"];
    assert!(surfaced(&[&["synth", text(&lib)], &size[..]].concat()).status.success());
    let args = ["plan", text(&lib), "--sources", "mi1,ir", "--out", text(&file), "--json"];
    let output = surfaced(&args);
    assert!(output.status.success(), "{}", said(&output));
    let json: Value = serde_json::from_slice(&output.stdout).unwrap();
    let plan = Plan::read(&file).unwrap();
    assert_eq!(json["plan"]["sources"][0], plan.sources[0].as_str());
    assert!(std::fs::read_to_string(&file).unwrap().contains("99.0 % is not certain"));

    let output = surfaced(&["replay", text(&lib), "--plan", text(&file), "--json"]);
    assert!(output.status.success(), "{}", said(&output));
    let lines: Vec<Value> = String::from_utf8_lossy(&output.stdout)
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    assert_eq!(lines.len(), 9);
    for line in &lines {
        assert_eq!(line["sources"].as_array().unwrap().len(), plan.sources.len(), "{line}");
        assert_eq!(line["sources"][0], plan.sources[0].as_str());
    }
    let right = lines.iter().filter(|line| line["surface"] == line["truth"]).count();
    assert_eq!(right as f64 / 9.0, plan.expected.accuracy, "as was expected");
}

#[test]
fn a_plan_that_cannot_be_is_wrong_usage() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("plan.toml");
    let refused = |args: &[&str], part: &str| {
        let output = surfaced(args);
        assert_eq!(output.status.code(), Some(2), "{}", said(&output));
        assert!(said(&output).contains(part), "expected `{part}` in: {}", said(&output));
    };
    refused(&["replay", "--plan", text(&file)], "plan.toml: there is no such file");
    std::fs::write(&file, "format = 1\nsauces = [\"mi2\"]\n").unwrap();
    refused(&["replay", "--plan", text(&file)], "sauces");
    refused(&["replay", "--plan", text(&file), "--n", "3"], "cannot be used with");
    refused(&["plan", text(dir.path()), "--target", "1.5"], "fraction");
}

/// Noise names nothing: the target is missed, and that is no success.
#[test]
fn a_target_that_nothing_reaches_is_a_failure_and_the_best_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let (lib, file) = (dir.path().join("scene"), dir.path().join("plan.toml"));
    let size = ["--surfaces", "6", "--trials", "3", "--users", "0", "--seconds", "0.5"];
    assert!(surfaced(&[&["synth", text(&lib)], &size[..]].concat()).status.success());
    let output = surfaced(&["plan", text(&lib), "--sources", "me", "--out", text(&file)]);
    assert_eq!(output.status.code(), Some(1), "{}", said(&output));
    assert!(said(&output).contains(" of whole scans"), "{}", said(&output));
    assert!(said(&output).contains("(wanted: 99.0 %, and at most"), "{}", said(&output));
    assert!(!Plan::read(&file).unwrap().expected.reached);
}
