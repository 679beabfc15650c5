//! The commands as a person or a script meets them: exit codes, messages, JSON.

use std::path::Path;
use std::process::Output;

use crate::common;
use assert_cmd::Command;
use serde_json::Value;

fn surfaced(args: &[&str]) -> Output {
    Command::cargo_bin("surfaced").unwrap().args(args).output().unwrap()
}

/// What a command that succeeds prints.
fn printed(args: &[&str]) -> String {
    let output = surfaced(args);
    assert!(output.status.success(), "{args:?}: {}", stderr(&output));
    String::from_utf8(output.stdout).unwrap()
}

fn json(args: &[&str]) -> Value {
    serde_json::from_str(&printed(args)).unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[track_caller]
fn refused(args: &[&str], code: i32, parts: &[&str]) {
    let output = surfaced(args);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(code), "{args:?}: {said}");
    assert!(output.stdout.is_empty(), "nothing but JSON belongs on stdout");
    for part in parts {
        assert!(said.contains(part), "{args:?}: expected `{part}` in: {said}");
    }
}

/// A small synthetic dataset, `scene` in a folder: 3 surfaces, 2 expert trials, 2 users.
fn scene() -> (tempfile::TempDir, String) {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("scene").to_str().unwrap().to_string();
    let args = ["--surfaces", "3", "--trials", "2", "--users", "2", "--seconds", "0.3"];
    printed(&[&["synth", &out], &args[..]].concat());
    (dir, out)
}

/// Writes a file into a folder, and gives its path.
fn write(dir: &tempfile::TempDir, name: &str, text: &str) -> String {
    let path = dir.path().join(name);
    std::fs::write(&path, text).unwrap();
    path.to_str().unwrap().into()
}

fn golden(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(name);
    path.to_str().unwrap().into()
}

fn golden_cases(name: &str) -> Vec<Vec<String>> {
    let text = std::fs::read_to_string(golden(name)).unwrap();
    text.lines().skip(1).map(|line| line.split(',').map(String::from).collect()).collect()
}

#[test]
fn golden_scores_come_out_of_the_command_line() {
    let score = |case: &str, id: &str, more: &[&str]| {
        let (z, y) = (golden(&format!("{case}_{id}_z.csv")), golden(&format!("{case}_{id}_y.csv")));
        json(&[&["compare", "--samples", &z, &y, "--json"], more].concat())
    };
    let agrees = |ours: &Value, golden: &str| {
        let (ours, golden) = (ours.as_f64().unwrap(), golden.parse::<f64>().unwrap());
        assert!((ours - golden).abs() <= 1e-9 * golden.max(1e-2), "{ours} but golden {golden}");
    };
    for case in golden_cases("mmd_cases.csv") {
        let align: &[&str] = if case[3] == "1" { &["--align-mean"] } else { &[] };
        let result = score("mmd", &case[0], align);
        assert_eq!(result["dims"].to_string(), case[1]);
        agrees(&result["sigma"], &case[4]);
        agrees(&result["score"], &case[5]);
        assert_eq!(result["n"].to_string(), case[2]);
        let n_mmd2 = result["mmd2"].as_f64().unwrap() * 400.0;
        assert!((result["score"].as_f64().unwrap() / n_mmd2 - 1.0).abs() < 1e-12);
    }
    for case in golden_cases("metal_cases.csv") {
        agrees(&score("metal", &case[0], &["--sigma", "1"])["score"], &case[1]);
    }
}

#[test]
fn an_evaluation_prints_what_was_promised() {
    let (_dir, data) = scene();
    for (protocol, queries, folds) in
        [("expert-vs-users", 6, 2), ("leave-one-trial-out", 6, 2), ("all-vs-one-user", 12, 3)]
    {
        let report = json(&["eval", &data, "--protocol", protocol, "--json", "--n", "50"]);
        assert_eq!(report["queries"], queries, "{protocol}");
        assert_eq!(report["classes"], 3);
        assert_eq!(report["folds"].as_array().unwrap().len(), folds);
        assert_eq!(report["synthetic"], true);
        assert_eq!(report["confusion"]["labels"].as_array().unwrap().len(), 3);
        for fraction in
            ["accuracy", "accuracy_mean", "accuracy_low", "accuracy_high", "precision_mean"]
        {
            assert!((0.0..=1.0).contains(&report[fraction].as_f64().unwrap()), "{fraction}");
        }
        assert!(report["query_ms_p50"].as_f64() <= report["query_ms_p99"].as_f64());
    }
}

#[test]
fn an_evaluation_chooses_a_protocol_and_says_which() {
    let (_dir, data) = scene();
    let output = surfaced(&["eval", &data, "--method", "knn", "--sources", "mi2"]);
    let said = stderr(&output);
    assert!(said.contains("protocol: all-vs-one-user (each person left out in turn)"), "{said}");
    assert!(said.contains("next: surfaced chart "), "{said}");
    let shown = String::from_utf8(output.stdout).unwrap();
    assert!(shown.contains(" of 12 queries, each among 3 surfaces)"), "{shown}");
    assert!(shown.contains(" for other people, by 3"), "{shown}");
    assert!(shown.contains("mean over 3 users: "), "{shown}");
    let shown = printed(&["replay", &data, "--method", "knn", "--sources", "mi2"]);
    assert!(shown.contains(" of 12 scans") && !shown.contains("interval"), "{shown}");
    let knn = ["eval", &data, "--method", "knn", "--enrolled", "2"];
    refused(&knn, 1, &["no user has more than 2 trial(s)"]);
    let within = [&knn[..], &["--protocol", "leave-one-trial-out"]].concat();
    refused(&within, 2, &["--enrolled goes with expert-vs-users"]);
}

#[test]
fn an_evaluation_tells_each_query_and_what_was_not_asked() {
    let (dir, data) = scene();
    let folders = |of: &str| {
        let all = std::fs::read_dir(of).unwrap().map(|entry| entry.unwrap().path());
        let mut all: Vec<_> = all.filter(|path| path.is_dir()).collect();
        all.sort();
        all
    };
    // Nobody else can be asked for a surface that one person recorded.
    let alone = folders(&data)[0].clone();
    for trial in folders(alone.to_str().unwrap()) {
        if !trial.file_name().unwrap().to_str().unwrap().starts_with("expert") {
            std::fs::remove_dir_all(trial).unwrap();
        }
    }
    let table = dir.path().join("queries.csv");
    let args = ["eval", &data, "--json", "--predictions", table.to_str().unwrap()];
    let report = json(&args);
    let alone = alone.file_name().unwrap().to_str().unwrap();
    assert_eq!(report["not_asked"], serde_json::json!({ alone: 2 }));
    assert_eq!(report["interval_over"], "people");
    assert!(report["made_by"]["command"].as_str().unwrap().contains("--predictions"));
    let mut rows = csv::Reader::from_path(&table).unwrap();
    let head = rows.headers().unwrap().clone();
    let column = |name: &str| head.iter().position(|other| other == name).unwrap();
    assert_eq!(head.iter().filter(|name| name.starts_with("p: ")).count(), 3);
    let rows: Vec<csv::StringRecord> = rows.records().map(Result::unwrap).collect();
    assert_eq!(rows.len(), 8);
    for row in &rows {
        let truth = &row[column("truth")];
        assert!(row[column("path")].starts_with(truth), "{row:?}");
        let number = |name: &str| row[column(name)].parse::<f64>().unwrap();
        let of_answer = number(&format!("p: {}", &row[column("answer")]));
        assert!((of_answer - number("confidence")).abs() < 1e-9, "{row:?}");
    }
    let surfaces = report["surfaces"].as_array().unwrap();
    let queries: u64 = surfaces.iter().map(|one| one["queries"].as_u64().unwrap()).sum();
    assert_eq!(queries, 8);
}

/// Everything but what a clock measured.
fn timeless(mut value: Value) -> Value {
    if let Some(map) = value.as_object_mut() {
        map.retain(|key, _| !key.ends_with("_ms") && !key.starts_with("query_ms"));
    }
    value
}

#[test]
fn one_seed_prints_one_document_whatever_the_threads() {
    let (_dir, data) = scene();
    let run = |threads: &str, seed: &str| {
        let mut command = Command::cargo_bin("surfaced").unwrap();
        let args = ["eval", &data, "--protocol", "expert-vs-users", "--json", "--seed", seed];
        let output = command.args(args).args(["--n", "60"]).env("RAYON_NUM_THREADS", threads);
        timeless(serde_json::from_slice(&output.output().unwrap().stdout).unwrap())
    };
    assert_eq!(run("1", "5"), run("2", "5"));
    let margins = |seed| run("2", seed)["predictions"].to_string();
    assert_ne!(margins("5"), margins("6"), "the seed matters");
}

fn lines(args: &[&str]) -> Vec<Value> {
    printed(args).lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// (surface, user, trial, answer) of each scan, sorted.
fn replayed(args: &[&str]) -> Vec<[String; 4]> {
    let of = |line: &Value| ["truth", "user", "trial", "surface"].map(|key| line[key].to_string());
    let mut answers: Vec<_> = lines(args).iter().map(of).collect();
    answers.sort();
    answers
}

fn evaluated(args: &[&str]) -> Vec<[String; 4]> {
    let of = |p: &Value| ["truth", "user", "trial", "answer"].map(|key| p[key].to_string());
    let mut answers: Vec<_> =
        json(args)["predictions"].as_array().unwrap().iter().map(of).collect();
    answers.sort();
    answers
}

#[test]
fn replay_gives_the_labels_of_eval_on_the_real_sounds() {
    let Some(data) = common::shared_lmt108() else { return };
    let data = data.to_str().unwrap();
    // Few samples, so that the test is quick and mistakes are many: labels must agree in each.
    for positions in ["shared", "per-pair"] {
        let same = [data, "--sources", "mi2", "--positions", positions, "--json"];
        let few = ["--n", "60", "--repetitions", "1", "--protocol", "leave-one-trial-out"];
        let settings = [&same[..], &few[..]].concat();
        let by_replay = replayed(&[&["replay"], &settings[..]].concat());
        let by_eval = evaluated(&[&["eval"], &settings[..]].concat());
        assert_eq!(by_replay.len(), 200);
        assert_eq!(by_replay, by_eval);
    }
}

#[test]
fn a_line_of_replay_holds_what_was_promised() {
    let (_dir, data) = scene();
    let all = lines(&["replay", &data, "--json", "--n", "50"]);
    assert_eq!(all.len(), 12, "each person against the others");
    for line in all {
        assert_eq!(line["ranked"].as_array().unwrap().len(), 3);
        assert_eq!(line["lost_samples"], 0);
        assert_eq!(line["synthetic"], true);
        assert_eq!(line["ranked"][0]["surface"], line["surface"]);
        assert!(line["margin"].as_f64().unwrap() >= 0.0);
        assert!(line["latency_ms"].as_f64().unwrap() > 0.0);
        assert!((line["scan_s"].as_f64().unwrap() - 0.3).abs() < 0.01);
        assert_eq!(line["sources"].as_array().unwrap().len(), 8);
    }
}

#[test]
fn trials_are_compared_source_by_source() {
    let (_dir, data) = scene();
    let (a, b) =
        (format!("{data}/Synth001Mesh/expert-01"), format!("{data}/Synth002Stone/user1-01"));
    let report = json(&["compare", &a, &b, "--json", "--permutations", "50"]);
    let sources = report["sources"].as_array().unwrap();
    assert_eq!(sources.len(), 8);
    let product: f64 = sources.iter().map(|s| s["score"].as_f64().unwrap()).product();
    assert!((report["ds"].as_f64().unwrap() / product - 1.0).abs() < 1e-9);
    let alike = |source: &Value| source["neighbours"].as_f64().is_some_and(|r| r > 0.3 && r <= 1.0);
    assert!(sources.iter().any(|s| s["source"] == "ir" && alike(s)), "{sources:?}");
    let shown = printed(&["compare", &a, &b, "--permutations", "50"]);
    assert!(shown.contains("neighbouring samples are alike, so that p is too small: "));
    let itself = json(&["compare", &a, &a, "--json", "--permutations", "50"]);
    assert!(itself["sources"].as_array().unwrap().iter().all(|s| s["p_value"] == 1.0));
}

#[test]
fn wrong_usage_ends_with_code_two_and_says_what_there_is() {
    let (_dir, data) = scene();
    let eval = |option, value, parts: &[&str]| {
        let args = ["eval", &data, "--protocol", "expert-vs-users", option, value];
        refused(&args, 2, parts);
    };
    eval("--sources", "mi9", &["mi9", "ac, ca1"]);
    eval("--n", "0", &["1 or more"]);
    eval("--query-seconds", "0", &["positive number of seconds"]);
    refused(&["replay", &data, "--library", &data], 2, &["meet itself"]);
    let mixed = ["replay", &data, "--method", "embedding", "--n", "50"];
    refused(&mixed, 2, &["goes with --method reference alone, not with embedding"]);
    let mixed = ["replay", &data, "--halving", "--method", "svm"];
    refused(&mixed, 2, &["goes with --method reference alone, not with svm"]);
    refused(&["replay", "--where", "user=anna"], 2, &["surfaced replay DATA --where"]);
    refused(&["replay", "--protocol", "expert-vs-users"], 2, &["DATA"]);
    refused(&["history", &data, "--precision", "--last", "2"], 2, &["--last"]);
}

#[test]
fn bad_data_end_with_code_one_and_say_what_to_do() {
    let (dir, data) = scene();
    refused(&["eval", "/no/such/place", "--protocol", "expert-vs-users"], 1, &["/no/such/place"]);
    refused(&["synth", &data], 1, &["not empty"]);
    refused(&["compare", "nowhere", "nowhere"], 1, &["no such trial", "DATA:SURFACE:NUMBER"]);
    let one = format!("{data}:Synth009:1");
    refused(&["compare", &one, &one], 1, &["no trial 1 of `Synth009`", "Synth001Mesh"]);
    let several = format!("{data}:Synth001Mesh:1");
    refused(&["compare", &several, &several], 1, &["trials 1 of `Synth001Mesh`", "add :USER"]);

    let write = |name: &str, text: &str| write(&dir, name, text);
    let good = write("good.csv", "1,2\n3,4\n");
    let samples = |other: &str, parts: &[&str]| {
        refused(&["compare", "--samples", &good, other], 1, parts);
    };
    samples(&write("nan.csv", "1,2\n3,NaN\n"), &["nan.csv", "line 2", "`NaN`"]);
    samples(&write("ragged.csv", "1,2\n3\n"), &["line 2 has 1 column; the first has 2"]);
    samples(&write("empty.csv", ""), &["empty"]);
    samples(&write("narrow.csv", "1\n2\n"), &["2 columns", "has 1"]);
}

#[test]
fn a_library_of_one_class_or_one_trial_is_refused() {
    let (dir, data) = scene();
    let one_class = dir.path().join("one-class");
    let from = dir.path().join("scene/Synth001Mesh");
    std::fs::create_dir_all(one_class.join("Synth001Mesh")).unwrap();
    for trial in ["expert-01", "expert-02"] {
        std::fs::rename(from.join(trial), one_class.join("Synth001Mesh").join(trial)).unwrap();
    }
    let one = one_class.to_str().unwrap().to_string();
    refused(
        &["replay", &data, "--library", &one],
        1,
        &["2 trial(s) of 1 surface(s)", "at least two surfaces"],
    );
    refused(
        &["eval", &one, "--protocol", "leave-one-trial-out"],
        1,
        &["needs at least two surfaces", "2 trial(s) of 1 surface(s)", "Folders are the surfaces"],
    );
}

#[test]
fn a_stuck_sensor_is_reported() {
    let (dir, data) = scene();
    let file = dir.path().join("scene/Synth001Mesh/user1-01/ir.wav");
    common::write_wav(&file, 10_000, 1, &[500; 3000]);
    let output = surfaced(&["replay", &data, "--n", "50"]);
    assert_eq!(output.status.code(), Some(0));
    let said = stderr(&output);
    assert!(said.contains("ir: channel 1 is stuck at 0.015258789; check its cable"), "{said}");
}

#[test]
fn a_scan_of_eleven_milliseconds_or_of_silence_is_not_named() {
    let (_dir, path) = common::temp();
    let sound = |pitch: f32, frames: usize| -> Vec<i16> {
        let wave = |i: usize| (i as f32 * pitch).sin() + 0.3 * ((i * i % 977) as f32 * 0.7).sin();
        (0..frames).map(|i| (9000.0 * wave(i)) as i16).collect()
    };
    for (surface, pitch) in [("oak", 0.3), ("beech", 0.05)] {
        for trial in 1..=3 {
            let samples = sound(pitch, 44_100 + 100 * trial);
            let wav = path.join(format!("library/{surface}/{trial}/mi2.wav"));
            common::write_wav(&wav, 44_100, 1, &samples);
        }
    }
    for (name, samples) in [("short", sound(0.3, 485)), ("silent", vec![0; 44_100])] {
        let new = path.join(name);
        common::write_wav(&new.join("new/1/mi2.wav"), 44_100, 1, &samples);
        let (new, library) = (new.to_str().unwrap(), path.join("library"));
        let args = ["replay", new, "--library", library.to_str().unwrap()];
        refused(&args, 3, &["too little to name"]);
    }
}

#[test]
fn an_evaluation_that_names_nothing_is_no_success() {
    let (_dir, path) = common::temp();
    for (surface, trial) in [("oak", 1), ("oak", 2), ("beech", 3), ("beech", 4)] {
        // Too short for a single frame.
        common::write_wav(&path.join(format!("{surface}/{trial}.wav")), 44_100, 1, &[trial]);
    }
    let output = surfaced(&["eval", path.to_str().unwrap()]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(3), "{said}");
    assert!(said.contains("no query could be named") && !said.contains("next:"), "{said}");
}

#[test]
fn an_output_takes_the_place_of_nothing_but_its_like() {
    let (dir, data) = scene();
    let wav = dir.path().join("scene/Synth001Mesh/user1-01/ir.wav");
    let (wav, before) = (wav.to_str().unwrap(), std::fs::read(&wav).unwrap());
    let nowhere = dir.path().join("no/x.svg").to_str().unwrap().to_string();
    let kept = &["ir.wav: another file has this name"][..];
    for (command, out, says) in [
        ("train", "--out", kept),
        ("plan", "--out", kept),
        ("eval", "--predictions", kept),
        ("stress", "--out", &["name the picture .svg or .pdf"]),
        ("chart", "--out", &["name the picture .svg or .pdf"]),
        ("duration", "--out", &["name the picture .svg or .pdf"]),
    ] {
        refused(&[command, &data, out, wav], 2, says);
        refused(&[command, &data, out, &nowhere], 2, &["there is no folder "]);
    }
    assert_eq!(std::fs::read(wav).unwrap(), before);
}

#[test]
fn an_option_that_would_change_nothing_is_refused() {
    let (_dir, data) = scene();
    let eval = |more: &[&str], says| refused(&[&["eval", &data], more].concat(), 2, &[says]);
    eval(&["--settle-loss", "0.1"], "--settle-loss goes with --settle");
    eval(&["--false-rejections", "0.1"], "--false-rejections goes with --leave-surfaces-out");
    eval(&["--leave-surfaces-out", "99"], "groups as there are surfaces: 3 surfaces");
    eval(&["--method", "embedding,svm", "--settle"], "svm cannot; use --method embedding");
    let samples = ["compare", "--samples", "x.csv", "y.csv", "--permutations", "5"];
    refused(&samples, 2, &["cannot be used with"]);
}

#[test]
fn dependence_follows_p_and_says_where_pairs_are_not_independent() {
    let dir = tempfile::tempdir().unwrap();
    let write = |name: &str, values: &[f64]| {
        let text: Vec<String> = values.iter().map(f64::to_string).collect();
        write(&dir, name, &text.join("\n"))
    };
    let tested = |x: &[f64], y: &[f64]| {
        printed(&["dependence", &write("x.csv", x), &write("y.csv", y), "--permutations", "200"])
    };
    // Ties: HSIC is above κ by rounding alone.
    let once = |ones: &[usize]| -> Vec<f64> {
        (0..12).map(|at| f64::from(u8::from(ones.contains(&at)))).collect()
    };
    let ties = tested(&once(&[3]), &once(&[0, 3]));
    assert!(ties.contains("p = 0.1791") && ties.contains("no dependence was found"), "{ties}");
    assert!(!ties.contains("neighbouring rows"), "{ties}");
    let slow =
        |period: f64| -> Vec<f64> { (0..60).map(|at| (f64::from(at) / period).sin()).collect() };
    let slow = tested(&slow(9.0), &slow(7.0));
    assert!(slow.contains("neighbouring rows are alike in both files"), "{slow}");
}

#[cfg(not(feature = "mcap"))]
#[test]
fn a_build_without_mcap_says_how_to_get_it() {
    for args in [["export", "my-library", "my-library.mcap"], ["import", "a.mcap", "my-library"]] {
        refused(&args, 2, &["cannot read or write MCAP", "--features mcap"]);
    }
}

#[test]
fn a_configuration_is_checked_as_a_run_reads_it() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("station.toml");
    let text = "format = 1\nserve = \"127.0.0.1:9000\"\n[camera]\npresent = false\n[[lines]]\n\
                port = \"tcp://robot:5000\"\nrate_hz = 12.5\n[lines.sources]\npull = [1, 2]\n\
                [outputs]\nstation = \"press-3\"\nmqtt = \"mqtt://me:secret@broker/hall\"\n";
    let check = |text: &str| {
        std::fs::write(&file, text).unwrap();
        surfaced(&["config", "check", file.to_str().unwrap()])
    };
    let output = check(text);
    let shown = String::from_utf8(output.stdout.clone()).unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    for part in [
        "stylus     a USB serial adapter by FTDI at 10000 Hz: ac (3 channels), ",
        "lines      tcp://robot:5000 at 12.5 Hz: pull (2 channels)\n",
        "contact    shown by ac, fr, or else pull, or else sound\n",
        "outputs    mqtt://broker:1883/hall, as press-3\n",
        "page       http://127.0.0.1:9000, with --serve\n",
    ] {
        assert!(shown.contains(part), "expected `{part}` in: {shown}");
    }
    assert!(!shown.contains("secret") && !shown.contains("camera"), "{shown}");
    let path = file.to_str().unwrap();
    check("format = 1\n[stylus]\nrate_hz = 0\n");
    let mistake = "station.toml, line 3: rate_hz = 0; expected more than 0";
    refused(&["config", "check", path], 2, &[mistake]);
    refused(&["run", "--config", path, "--library", "/"], 2, &[mistake]);
    check(&text.replace(":secret@", "@").replace("[outputs]", "[outputs]\npassword_file = \"pw\""));
    refused(&["config", "check", path], 1, &["pw: "]);
    let none =
        ["stylus", "microphone", "camera"].map(|what| format!("[{what}]\npresent = false\n"));
    check(&format!("format = 1\n{}", none.concat()));
    assert!(stderr(&surfaced(&["config", "check", path])).contains("no device is configured"));
}
