//! `surfaced eval` with several methods and seeds, and with folds of one's own.

use std::fmt::Write as _;
use std::path::Path;
use std::process::Output;

use assert_cmd::Command;
use serde_json::{Value, json};

fn surfaced(args: &[&str]) -> Output {
    Command::cargo_bin("surfaced").unwrap().args(args).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn done(args: &[&str]) -> String {
    let output = surfaced(args);
    assert!(output.status.success(), "{args:?}: {}", text(&output.stderr));
    text(&output.stdout)
}

fn document(args: &[&str]) -> Value {
    serde_json::from_str(&done(args)).unwrap()
}

#[track_caller]
fn refused(args: &[&str], parts: &[&str]) {
    let output = surfaced(args);
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{args:?}: {said}");
    parts.iter().for_each(|part| assert!(said.contains(part), "expected `{part}` in: {said}"));
}

/// A library of 3 surfaces with 4 trials each by one person, made by a generator.
fn library(dir: &Path) -> String {
    let path = dir.join("lib").to_str().unwrap().to_string();
    let size = ["--surfaces", "3", "--trials", "4", "--users", "0", "--seconds", "0.5"];
    done(&[&["synth", path.as_str()], &size[..]].concat());
    path
}

/// The folders of the trials, as commands name them.
fn trials(library: &str) -> Vec<String> {
    let rows: Value =
        serde_json::from_str(&done(&["library", "list", library, "--quick", "--json"])).unwrap();
    rows.as_array().unwrap().iter().map(|row| row["trial"].as_str().unwrap().into()).collect()
}

#[test]
fn several_methods_name_the_same_queries_and_are_tested_in_pairs() {
    let dir = tempfile::tempdir().unwrap();
    let library = library(dir.path());
    let table = dir.path().join("answers.csv");
    let some = ["eval", &library, "--method", "embedding,svm,knn", "--sources", "ir,mi2"];
    let more = ["--json", "--predictions", table.to_str().unwrap()];
    let report = document(&[&some[..], &more].concat());
    let methods = report["methods"].as_array().unwrap();
    let names: Vec<_> = methods.iter().map(|one| one["method"].as_str().unwrap()).collect();
    assert_eq!(names, ["embedding", "svm", "knn"]);
    assert!(methods.iter().all(|one| one["folds"] == methods[0]["folds"] || one["queries"] == 12));
    let pairs = report["paired"].as_array().unwrap();
    assert_eq!(pairs.len(), 3);
    for pair in pairs {
        let p = |key: &str| pair[key].as_f64().unwrap();
        assert_eq!(pair["test_over"], "queries");
        assert!(p("p_value") <= p("p_value_holm") && p("p_value_holm") <= 1.0, "{pair}");
    }
    // A method gives the same number alone.
    let alone = document(&["eval", &library, "--method", "svm", "--sources", "ir,mi2", "--json"]);
    assert_eq!(alone["accuracy"], methods[1]["accuracy"]);
    let mut rows = csv::Reader::from_path(&table).unwrap();
    assert_eq!(rows.headers().unwrap().iter().next(), Some("method"));
    assert_eq!(rows.records().count(), 3 * 12);
    let shown = done(&some);
    for part in ["on synthetic data", "p against ", "McNemar's exact test over queries", "3 pairs"]
    {
        assert!(shown.contains(part), "expected `{part}` in: {shown}");
    }
    refused(&["eval", &library, "--method", "svm,knn", "--n", "9"], &["--method reference alone"]);
}

#[test]
fn several_seeds_give_a_mean_and_a_spread_where_a_method_has_a_seed() {
    let dir = tempfile::tempdir().unwrap();
    let library = library(dir.path());
    let of = |method| ["eval", &library, "--sources", "ir", "--seeds", "3", "--method", method];
    let forest = of("random-forest");
    let report = document(&[&forest[..], &["--json", "--seed", "7"]].concat());
    let seeds = &report["seeds"];
    assert_eq!(seeds["first_seed"], 7);
    let all: Vec<f64> =
        seeds["accuracies"].as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect();
    assert_eq!((all.len(), all[0]), (3, report["accuracy"].as_f64().unwrap()));
    let mean = all.iter().sum::<f64>() / 3.0;
    assert!((seeds["mean"].as_f64().unwrap() - mean).abs() < 1e-12);
    // The second seed of these is the first of another run.
    let next = document(&[
        "eval",
        &library,
        "--sources",
        "ir",
        "--seed",
        "8",
        "--json",
        "--method",
        "random-forest",
    ]);
    assert_eq!(next["accuracy"].as_f64().unwrap(), all[1]);
    assert!(done(&forest).contains("seeds      1 to 3, random-forest: "));
    refused(&of("svm"), &["svm draws nothing at random"]);
    let both = document(&[&of("svm,random-forest")[..], &["--json"]].concat());
    let has = |at: usize| both["methods"][at]["seeds"].is_object();
    assert!(!has(0) && has(1));
}

#[test]
fn a_table_splits_trials_and_what_does_not_fit_is_named_by_line_or_trial() {
    let dir = tempfile::tempdir().unwrap();
    let library = library(dir.path());
    let all = trials(&library);
    let table = dir.path().join("folds.csv");
    let at = table.to_str().unwrap();
    let fixed = ["eval", &library, "--sources", "ir", "--method", "knn", "--split", at];
    let write = |fold: &dyn Fn(usize) -> &'static str| {
        let mut text = String::from("trial,fold\n");
        all.iter().enumerate().for_each(|(i, name)| writeln!(text, "{name}, {}", fold(i)).unwrap());
        std::fs::write(&table, &text).unwrap();
        text
    };
    let text = write(&|i| if i % 4 == 0 { "test" } else { "train" });
    let report = document(&[&fixed[..], &["--json"]].concat());
    assert_eq!((&report["queries"], &report["library_trials"]), (&json!(3), &json!(9)));
    assert_eq!(report["protocol"], "split");
    let left_out = report["left_out"].as_str().unwrap();
    assert!(left_out.ends_with("of one session are on both sides: another day will be worse"));
    write(&|i| ["a", "b", "c", "d"][i % 4]);
    let report = document(&[&fixed[..], &["--json"]].concat());
    assert_eq!((&report["queries"], report["folds"].as_array().unwrap().len()), (&json!(12), 4));
    // The chart splits in the same way.
    let out = dir.path().join("chart.svg").to_str().unwrap().to_string();
    let chart =
        ["chart", &library, "--sources", "ir", "--brief", "--methods", "knn", "--out", &out];
    let chart = document(&[&chart[..], &["--split", at, "--json"]].concat());
    let point = chart["points"].as_array().unwrap().iter().find(|p| p["method"] == "knn").unwrap();
    assert_eq!(point["accuracy"], report["accuracy"]);

    let line = |line: &str| std::fs::write(&table, text.clone() + line).unwrap();
    line("slate/trial9,test\n");
    refused(&fixed, &["folds.csv: line 14: the data have no trial `slate/trial9`", "such as "]);
    line(&format!("{},test\n", all[0]));
    refused(&fixed, &["line 14", "has a fold already"]);
    line("one\n");
    refused(&fixed, &["line 14: expected two cells"]);
    std::fs::write(&table, text.replacen("train", "b", 1)).unwrap();
    refused(&fixed, &["line 3: `b` and `test` do not go together"]);
    let without: Vec<&str> = text.lines().filter(|line| !line.starts_with(&all[5])).collect();
    std::fs::write(&table, without.join("\n")).unwrap();
    refused(&fixed, &[&all[5], "has no line"]);
    // A trial that --where leaves out may have a line.
    write(&|i| if i % 4 == 0 { "test" } else { "train" });
    let some = document(&[&fixed[..], &["--where", "trial<=3", "--json"]].concat());
    assert_eq!(some["library_trials"], 6);
}

#[test]
fn trials_are_grouped_by_a_key_of_their_own() {
    let dir = tempfile::tempdir().unwrap();
    let library = library(dir.path());
    let all = trials(&library);
    let tools = ["brass", "steel", "wood"];
    for (i, name) in all.iter().enumerate() {
        let about = Path::new(&library).join(name).join("trial.toml");
        let text = std::fs::read_to_string(&about).unwrap();
        std::fs::write(&about, format!("{text}\n[meta]\ntool = \"{}\"\n", tools[i % 4 % 3]))
            .unwrap();
    }
    let by = |key| ["eval", &library, "--sources", "ir", "--method", "knn,svm", "--group-by", key];
    let report = document(&[&by("tool")[..], &["--json"]].concat());
    assert_eq!(report["protocol"], "group-by tool");
    let first = &report["methods"][0];
    let folds = first["folds"].as_array().unwrap();
    assert_eq!(folds.iter().map(|fold| fold["name"].as_str().unwrap()).collect::<Vec<_>>(), tools);
    assert_eq!(first["interval_over"], "groups");
    assert_eq!(report["paired"][0]["test_over"], "groups");
    let shown = done(&by("tool"));
    for part in [
        "each tool left out in turn; trials of one session",
        "sign test over 3 groups, at best 0.25",
    ] {
        assert!(shown.contains(part), "expected `{part}` in: {shown}");
    }
    refused(&by("force"), &["has no `force`", "[meta]", &all[0]]);
}

#[test]
fn a_digest_changes_with_a_sample_or_a_label_and_not_with_folders() {
    let dir = tempfile::tempdir().unwrap();
    let library = library(dir.path());
    let made = || {
        let args =
            ["eval", &library, "--sources", "ir", "--method", "knn", "--json", "--seed", "3"];
        let mut made = document(&args)["made_by"].take();
        assert_eq!(made["seed"], 3);
        made["library"].take().as_str().unwrap().to_string()
    };
    let before = made();
    assert_eq!(before.len(), 16);
    assert_eq!(made(), before);
    let check = surfaced(&["check", &library, "--json"]);
    let check: Value = serde_json::from_slice(&check.stdout).unwrap();
    let duration = document(&["duration", &library, "--source", "ir", "--json"]);
    for other in [&check, &duration] {
        assert_eq!(other["made_by"]["library"], before.as_str());
        assert!(other["made_by"]["command"].as_str().unwrap().starts_with("surfaced "));
    }
    // A folder's name is no label, and orders files, where trial.toml says more.
    let trial = Path::new(&library).join(&trials(&library)[0]);
    let moved = trial.with_file_name("zzz");
    std::fs::rename(&trial, &moved).unwrap();
    assert_eq!(made(), before);
    let wav = moved.join("ir.wav");
    let mut bytes = std::fs::read(&wav).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    std::fs::write(&wav, &bytes).unwrap();
    let changed = made();
    assert_ne!(changed, before);
    let first = trials(&library)[0].clone();
    done(&["library", "move", &library, &first, "--to", "slate"]);
    assert_ne!(made(), changed);
}
