//! Model files: answers without the library, what is refused, and a file of this version, which later
//! versions must open or refuse by name.

use std::fs;
use std::path::{Path, PathBuf};

use crate::bench::{Bench, SCANNED, synthetic, trial};
use crate::common::id;
use crate::plan::{said, surfaced, text};
use crate::run_serve::served;
use serde_json::{Value, json};
use surfaced::recognise::{ModelFile, ModelFileError};
use surfaced::record::{TrialOptions, write_library_toml, write_trial};
use surfaced::scene::Scene;
use surfaced::trial::{Series, Signal, Trial, TrialKey};

/// A file of this version, of the drags of [`drag`] by two people, and its answers to three more. `cargo
/// test --test it model_file -- --ignored` writes both.
const CURRENT: &str = "tests/fixtures/models/8.surfaced";
const ANSWERS: &str = "tests/fixtures/model-8-answers.json";
/// A file of an earlier version, which this program refuses by its version.
const EARLIER: &str = "tests/fixtures/models/2.surfaced";

fn path(fixture: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(fixture)
}

fn current() -> Vec<u8> {
    fs::read(path(CURRENT)).unwrap()
}

/// Half a second of a vibration that differs between the surfaces 0, 1, …, and a little between trials.
fn drag(surface: usize, user: &str, number: u32) -> Trial {
    let salt = number + 10 * user.len() as u32;
    let hz = [40.0, 90.0, 210.0][surface] + f64::from(salt % 7);
    let sample = |i: u32| {
        let noise = f64::from((i ^ salt << 9).wrapping_mul(2_654_435_761) >> 16) / 65_536.0 - 0.5;
        let wave = (std::f64::consts::TAU * hz * f64::from(i) / 1000.0).sin();
        (0.2 * wave + 0.1 * noise) as f32
    };
    let series = Series::new(1000.0, 1, (0..500).map(sample).collect()).unwrap();
    let key = TrialKey::new(["cork", "felt", "steel"][surface], user, number);
    Trial { key, signals: [(id("ir"), Signal::Series(series))].into() }
}

/// Writes the model of two surfaces, of which two people have made `trials` drags each.
fn train(trials: u32, out: &Path) {
    let dir = tempfile::tempdir().unwrap();
    let lib = dir.path().join("two");
    let scene = Scene::of_series(id("ir"), 1, 1000.0, Some((20.0, 400.0))).unwrap();
    write_library_toml(&lib, &scene, "two", false).unwrap();
    let options = TrialOptions { durable: false, ..TrialOptions::default() };
    for (surface, user) in [(0, "anna"), (0, "expert"), (1, "anna"), (1, "expert")] {
        for number in 1..=trials {
            write_trial(&lib, &drag(surface, user, number), &scene, &options).unwrap();
        }
    }
    let output = surfaced(&["train", text(&lib), "--out", text(out)]);
    assert!(output.status.success(), "{}", said(&output));
}

#[test]
#[ignore = "writes the fixture"]
fn the_fixture_is_written_anew() {
    train(3, &path(CURRENT));
    let file = ModelFile::decode(&current()).unwrap();
    let recorded =
        json!({ "digest": file.digest, "scan_s": file.scan_s, "answers": answers(&file) });
    fs::write(path(ANSWERS), serde_json::to_string_pretty(&recorded).unwrap() + "\n").unwrap();
}

/// Only some of so many trials are copied, or followed as they grow.
#[test]
fn a_model_of_many_trials_opens_and_names_scans() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("many.surfaced");
    train(230, &out);
    let file = ModelFile::read(&out).unwrap();
    assert_eq!(file.surfaces, [("cork".to_string(), 460), ("felt".to_string(), 460)]);
    let answers = answers(&file);
    assert_eq!((&answers[0]["surface"], &answers[1]["surface"]), (&json!("cork"), &json!("felt")));
    let numbers = |of: &str| [0, 1, 2].map(|at| answers[at][of].as_f64().unwrap());
    let [cork, felt, unknown] = numbers("p_value");
    assert!(cork.min(felt) > 0.05 && unknown < 0.01, "{answers:?}");
    assert!(numbers("confidence")[..2].iter().all(|p| *p > 0.95), "{answers:?}");
}

/// The answers to somebody else's drags over the two surfaces and an unknown one.
fn answers(file: &ModelFile) -> Vec<Value> {
    let answer = |surface: usize| {
        let scan = drag(surface, "bob", 9);
        let found = file.model.rank_trial(scan).unwrap();
        json!({ "surface": found.surface(), "confidence": found.confidence, "p_value": found.p_value })
    };
    (0..3).map(answer).collect()
}

#[test]
fn a_file_of_this_version_opens_and_gives_its_recorded_answers_and_earlier_ones_are_refused() {
    let file = ModelFile::read(&path(CURRENT)).unwrap();
    assert_eq!((file.library.as_str(), file.program.as_str()), ("two", "0.3.0"));
    assert_eq!(file.surfaces, [("cork".to_string(), 6), ("felt".to_string(), 6)]);
    let recorded: Value =
        serde_json::from_str(&fs::read_to_string(path(ANSWERS)).unwrap()).unwrap();
    assert_eq!(
        (&recorded["digest"], &recorded["scan_s"]),
        (&json!(file.digest), &json!(file.scan_s))
    );
    let answers = answers(&file);
    assert_eq!((&answers[0]["surface"], &answers[1]["surface"]), (&json!("cork"), &json!("felt")));
    let p_value = |at: usize| answers[at]["p_value"].as_f64().unwrap();
    assert!(p_value(2) <= p_value(0).min(p_value(1)), "an unknown surface fits least: {answers:?}");
    for (found, recorded) in answers.iter().zip(recorded["answers"].as_array().unwrap()) {
        assert_eq!(found["surface"], recorded["surface"]);
        for number in ["confidence", "p_value"] {
            // Processors round differently.
            let by = found[number].as_f64().unwrap() - recorded[number].as_f64().unwrap();
            assert!(by.abs() < 1e-3, "{number}: {found}, but recorded {recorded}");
        }
    }
    let error = ModelFile::read(&path(EARLIER)).map(drop).unwrap_err().to_string();
    assert!(error.contains("of version 2, but"), "{error}");
}

#[test]
fn a_file_cut_anywhere_or_with_any_byte_altered_is_refused() {
    let opened = |bytes: &[u8]| ModelFile::decode(bytes).map(drop);
    let model = current();
    opened(&model).unwrap();
    for length in 0..model.len() {
        let error = opened(&model[..length]).expect_err("cut");
        let is_right = match length {
            0 => matches!(error, ModelFileError::NotAModel),
            _ => matches!(error, ModelFileError::Length { found, .. } if found == length as u64),
        };
        assert!(is_right, "cut to {length}: {error}");
    }
    let mut bytes = model.clone();
    for at in 0..bytes.len() {
        bytes[at] ^= 1 << (at % 8);
        assert!(opened(&bytes).is_err(), "byte {at}");
        bytes[at] = model[at];
    }
    bytes.push(0);
    assert!(matches!(opened(&bytes), Err(ModelFileError::Length { .. })));
}

#[test]
fn a_file_that_cannot_be_opened_ends_a_command_with_code_1_and_what_to_do() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("model.surfaced");
    let model = current();
    let newer = [&model[..14], &[9, 0], &model[16..]].concat();
    let claims = [&model[..16], &(4u64 << 30).to_le_bytes()[..], &model[24..]].concat();
    let altered = [&model[..999], &[!model[999]], &model[1000..]].concat();
    for (bytes, parts) in [
        (&newer[..], ["of version 9, but this program reads version 8", "make it anew"]),
        (&claims, ["it should have 4294967324 bytes, but has", "copy it again"]),
        (&altered, ["its checksum is wrong", "make it anew"]),
        (&model[..500], ["but has 500", "copy it again"]),
        (b"a text", ["not a model of surfaced", "surfaced train LIB --out FILE"]),
    ] {
        fs::write(&path, bytes).unwrap();
        for args in [
            &["replay", text(dir.path()), "--model", text(&path)][..],
            &["run", "--model", text(&path)],
        ] {
            let output = surfaced(args);
            assert_eq!(output.status.code(), Some(1), "{args:?}: {}", said(&output));
            let error = said(&output);
            assert!(error.contains(text(&path)), "{error}");
            parts.iter().for_each(|part| assert!(error.contains(part), "{part} in {error}"));
        }
    }
}

/// Lines of JSON as they were printed, without what differs from run to run.
fn timeless(stdout: &[u8]) -> Vec<String> {
    let line = |line: &str| {
        let mut line = line.to_string();
        for key in ["\"id\":", "\"link\":", "\"unix_ms\":", "\"latency_ms\":"] {
            if let Some(at) = line.find(key) {
                let end = line[at..].find(',').map_or(line.len(), |length| at + length);
                line.replace_range(at..end, "");
            }
        }
        line
    };
    String::from_utf8(stdout.to_vec()).unwrap().lines().map(line).collect()
}

#[test]
fn a_replay_by_a_model_gives_the_answers_of_its_library_bit_for_bit() {
    let dir = tempfile::tempdir().unwrap();
    let [lib, scans, file, plan] =
        ["lib", "scans", "m.surfaced", "plan.toml"].map(|name| dir.path().join(name));
    let sizes = [
        (&lib, ["--surfaces", "3", "--trials", "4", "--users", "1", "--seconds", "1"]),
        (&scans, ["--surfaces", "4", "--trials", "1", "--users", "2", "--seconds", "1.3"]),
    ];
    for (path, size) in sizes {
        assert!(surfaced(&[&["synth", text(path)], &size[..]].concat()).status.success());
    }
    // Whether the plan is good enough does not matter here.
    surfaced(&["plan", text(&lib), "--sources", "mi2,fr", "--out", text(&plan)]);
    for how in [&[][..], &["--sources", "mi2,fr"], &["--plan", text(&plan)]] {
        let output = surfaced(&[&["train", text(&lib), "--out", text(&file)], how].concat());
        assert!(output.status.success(), "{}", said(&output));
        let by_library = [&["replay", text(&scans), "--library", text(&lib), "--json"], how];
        let by_library = surfaced(&by_library.concat());
        let elsewhere = dir.path().join("elsewhere");
        fs::rename(&lib, &elsewhere).unwrap();
        let by_model = surfaced(&["replay", text(&scans), "--model", text(&file), "--json"]);
        fs::rename(&elsewhere, &lib).unwrap();
        assert!(by_model.status.success(), "{}", said(&by_model));
        let [by_library, by_model] = [by_library, by_model].map(|output| timeless(&output.stdout));
        assert_eq!(by_library.len(), 12);
        assert_eq!(by_model, by_library, "{how:?}");
        let p_values = |from: &str| by_model.iter().filter(|line| line.contains(from)).count();
        let (below, ones) = (p_values("\"p_value\":0."), p_values("\"p_value\":1.0"));
        assert!(below > 0 && below + ones == 12, "{by_model:?}");
    }
}

#[test]
fn only_the_method_embedding_has_model_files_and_what_chooses_a_method_does_not_go_with_one() {
    let output = surfaced(&["train", "lib", "--out", "m.surfaced", "--method", "svm"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(said(&output).contains("there is no model file of it"), "{}", said(&output));
    for option in [
        &["--library", "lib"][..],
        &["--method", "svm"],
        &["--sources", "mi2"],
        &["--plan", "plan.toml"],
        &["--seed", "2"],
    ] {
        let output = surfaced(&[&["replay", "data", "--model", "m.surfaced"], option].concat());
        assert_eq!(output.status.code(), Some(2));
        assert!(said(&output).contains("cannot be used with"), "{}", said(&output));
    }
}

#[test]
fn a_station_with_a_model_names_scans_and_refuses_what_takes_trials() {
    let data = synthetic(1.5);
    let mut bench = Bench::new();
    let (library, model) = (bench.library(&data), bench.path("model.surfaced"));
    let output = surfaced(&["train", text(&library), "--out", text(&model)]);
    assert!(output.status.success(), "{}", said(&output));
    let output = surfaced(&["run", "--model", text(&model), "--create"]);
    assert_eq!(output.status.code(), Some(2), "{}", said(&output));
    fs::remove_dir_all(&library).unwrap();

    let mut run = bench.surfaced(&["run", "--model", text(&model), "--serve=127.0.0.1:0"]);
    let station = served(&run);
    let mut fake = bench.stylus();
    fake.wait_for_start();
    let seconds = bench.play(&fake, &trial(&data, 1, SCANNED), 1.5);
    fake.serve(seconds);
    let line = run.line(&mut fake);
    assert_eq!(line["surface"], data.surfaces()[1], "{line} {}", run.said());

    let state = station.get("/api/v1/state").json();
    assert_eq!(
        (&state["enrolls"], &state["library"]["problem"]),
        (&Value::Bool(false), &Value::Null)
    );
    for (path, body) in [
        ("reload", ""),
        ("enroll", "{\"surface\": \"oak\"}"),
        ("library/rename", "{\"surface\": \"oak\", \"to\": \"ash\"}"),
        ("check", ""),
    ] {
        let reply = station.post(&format!("/api/v1/{path}"), body);
        assert_eq!((reply.status, &reply.json()["error"]), (409, &"no_library".into()), "{path}");
        assert!(reply.body.contains("no trials to change or read again"), "{}", reply.body);
    }
    let id = line["id"].as_str().unwrap();
    let why = station.until(&format!("/api/v1/scans/{id}/why"), |why| why["why"].is_object());
    assert!(why["nearest"].is_null(), "{why}");
    assert!(why["no_nearest"].as_str().unwrap().contains("holds no trials"), "{why}");
    run.signal("TERM");
    assert_eq!(run.end(&mut fake).code(), Some(0), "{}", run.said());
    assert!(bench.path("model.surfaced.kept").is_dir());
}
