//! The desk: one scan time for all commands, folders as people have them, and what mends them.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::bench::Bench;
use crate::common::http::Client;
use crate::common::{says, simulate, temp, write_file, write_wav};
use crate::plan::{said, surfaced, text};
use serde_json::Value;
use surfaced::seed;

/// A dragging sound of 16 bits: noise with a correlation time of `tau` samples.
fn sound(tau: f64, seconds: f64, rate_hz: u32, seed: u64) -> Vec<i16> {
    let mut rng = seed::rng(seed, &[b"desk"]);
    let frames = (seconds * f64::from(rate_hz)) as usize;
    simulate::ar1(frames, tau, &mut rng).iter().map(|x| (x * 2500.0) as i16).collect()
}

/// A FLAC file of one channel: whole frames, not compressed (RFC 9639).
fn flac(rate_hz: u32, samples: &[i16]) -> Vec<u8> {
    const BLOCK: usize = 4096;
    let crc = |bytes: &[u8], width: u32, polynomial: u32| {
        let top = 1u32 << (width - 1);
        bytes.iter().fold(0u32, |crc, &byte| {
            (0..8).fold(crc ^ u32::from(byte) << (width - 8), |crc, _| {
                let next = crc << 1;
                let next = if crc & top == 0 { next } else { next ^ polynomial };
                next & (top << 1).wrapping_sub(1)
            })
        })
    };
    let mut bytes = b"fLaC\x80\0\0\x22".to_vec();
    bytes.extend((BLOCK as u16).to_be_bytes().repeat(2));
    bytes.extend([0; 6]);
    // 20 bits of rate, 3 of channels - 1, 5 of bits - 1, 36 of samples.
    let of_stream = u64::from(rate_hz) << 44 | 15 << 36 | samples.len() as u64;
    bytes.extend(of_stream.to_be_bytes());
    bytes.extend([0; 16]);
    for (number, block) in samples.chunks(BLOCK).enumerate() {
        let mut frame = vec![0xFF, 0xF8, 0x70, 0x08, u8::try_from(number).unwrap()];
        assert!(number < 128, "a longer number has more bytes");
        frame.extend((block.len() as u16 - 1).to_be_bytes());
        frame.push(crc(&frame, 8, 0x07) as u8);
        frame.push(0x02);
        frame.extend(block.iter().flat_map(|sample| sample.to_be_bytes()));
        frame.extend((crc(&frame, 16, 0x8005) as u16).to_be_bytes());
        bytes.extend(frame);
    }
    bytes
}

/// The seconds in a line such as `drag for at least 0.9 s: …`.
fn seconds(line: &str) -> String {
    let words = line.trim_start_matches("drag for ").trim_start_matches("at least ");
    words.split(' ').next().unwrap().to_string()
}

/// The answer of a live station about a library that its stylus can be compared with.
fn at_the_station(library: &Path) -> String {
    let bench = Bench::new();
    let run = bench.surfaced(&["run", "--library", text(library), "--serve=127.0.0.1:0"]);
    run.until_said("http://", None);
    let said = run.said();
    let address = said.lines().find_map(|line| line.strip_prefix("http://")).unwrap();
    let station = Client(address.parse().unwrap());
    for _ in 0..600 {
        let state = station.get("/api/v1/state").json();
        let remarks = state["library"]["remarks"].as_array().cloned().unwrap_or_default();
        let mut lines = remarks.iter().filter_map(Value::as_str);
        if let Some(line) = lines.find(|line| line.starts_with("drag for ")) {
            return seconds(line);
        }
        std::thread::sleep(std::time::Duration::from_millis(100));
    }
    panic!("the station has no scan time: {}", run.said());
}

#[test]
fn duration_plan_replay_and_the_station_give_one_scan_time_for_five_libraries() {
    let dir = tempfile::tempdir().unwrap();
    let library = |name: &str| dir.path().join(name);
    let wav = |path: PathBuf, (rate_hz, tau, seconds): (u32, f64, f64), seed: u64| {
        write_wav(&path, rate_hz, 1, &sound(tau, seconds, rate_hz, seed));
    };
    for (at, (surface, tau)) in [("oak", 20.0), ("felt", 5.0)].into_iter().enumerate() {
        let seed = |n: u64| 100 * at as u64 + n;
        for n in 1..=5 {
            wav(library("ten").join(format!("{surface}/{n}.wav")), (44_100, tau, 1.0), seed(n));
        }
        for n in 1..=20 {
            let trial = format!("{surface}/trial{n}/ir.wav");
            wav(library("clear").join(&trial), (10_000, tau, 1.2), seed(n));
            let near = 8.0 + tau / 5.0;
            wav(library("close").join(&trial), (10_000, near, 0.5 + 0.04 * n as f64), seed(n));
            wav(library("48 kHz").join(format!("{surface}/{n}.wav")), (48_000, tau, 0.8), seed(n));
        }
        for (user, n) in (0..3).flat_map(|u| (1..=9).map(move |n| (u, n))) {
            let of_user = 200 * (user as u64 + 1);
            let user = ["anna", "ben", "cleo"][user];
            let trial = library("people").join(format!("{surface}/{user}{n}"));
            wav(trial.join("ir.wav"), (10_000, tau, 1.0), seed(of_user + n));
            write_file(&trial.join("trial.toml"), format!("user = \"{user}\"\n"));
        }
    }
    for name in ["ten", "clear", "close", "48 kHz", "people"] {
        let path = library(name);
        let stricter = if name == "close" { Some("0.9999") } else { Some("0.9") };
        for accuracy in [None, stricter] {
            let option = |name| accuracy.map_or(vec![], |share| vec![name, share]);
            let found = surfaced(
                &[&["duration", text(&path), "--json"], &option("--accuracy")[..]].concat(),
            );
            let answer: Value = serde_json::from_slice(&found.stdout).unwrap();
            let scan_s = answer["answer"]["scan_s"].as_f64();
            assert_eq!(found.status.success(), scan_s.is_some(), "{name}: {}", said(&found));
            let planned =
                surfaced(&[&["plan", text(&path), "--json"], &option("--accuracy")[..]].concat());
            let plan: Value = serde_json::from_slice(&planned.stdout).unwrap();
            assert_eq!(plan["plan"]["scan_s"].as_f64(), scan_s, "{name}: {answer} {plan}");
            let replayed =
                surfaced(&[&["replay", text(&path), "--json"], &option("--accuracy")[..]].concat());
            if let Some(scan_s) = scan_s {
                if let Some(asked) = accuracy.filter(|_| answer["answer"]["more_trials"].is_null())
                {
                    let reached = answer["answer"]["accuracy"].as_f64().unwrap();
                    assert!(reached >= asked.parse::<f64>().unwrap(), "{answer}");
                }
                let lines = String::from_utf8_lossy(&replayed.stdout).into_owned();
                let needed = lines.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
                let needed: Vec<f64> =
                    needed.map(|line| line["needed_s"].as_f64().unwrap()).collect();
                assert!(
                    !needed.is_empty() && needed.iter().all(|s| *s == scan_s),
                    "{name}: {lines}"
                );
            } else {
                assert_eq!(replayed.status.code(), Some(1), "{name}: {}", said(&replayed));
                says(&said(&replayed), &["no scan time reaches"]);
            }
            if accuracy.is_none() && ["clear", "close", "people"].contains(&name) {
                let scan_s = scan_s.unwrap();
                assert_eq!(at_the_station(&path), format!("{scan_s:.1}"), "{name}");
            }
        }
    }
    let few = surfaced(&["duration", text(&library("ten"))]);
    let first = String::from_utf8_lossy(&few.stdout).lines().next().unwrap().to_string();
    assert!(first.starts_with("drag for 1.0 s, as long as your trials: 10 are too few"), "{first}");
}

/// A folder of files as people have them, in which six are no good.
fn messy() -> (tempfile::TempDir, PathBuf) {
    let (dir, path) = temp();
    for (at, (surface, tau)) in [("K\u{fc}che alt", 40.0), ("Jeans", 3.0)].into_iter().enumerate() {
        let folder = path.join(surface);
        for n in 1..=8u64 {
            let samples = sound(tau, 2.0, 16_000, 50 * at as u64 + n);
            match n {
                1 => write_file(&folder.join("Flac 1.FLAC"), flac(16_000, &samples)),
                2 => write_wav(&folder.join("\u{c4} 2.WAV"), 16_000, 1, &samples),
                n => write_wav(&folder.join(format!("aufnahme {n}.wav")), 16_000, 1, &samples),
            }
        }
    }
    let kitchen = path.join("K\u{fc}che alt");
    write_file(&kitchen.join("leer 11.wav"), "");
    write_file(&kitchen.join("notiz 12.wav"), "Das ist ein Text.\n");
    let loud: Vec<i16> =
        sound(40.0, 2.0, 16_000, 90).iter().map(|x| x.saturating_mul(20)).collect();
    write_wav(&kitchen.join("\u{fc}bersteuert 13.wav"), 16_000, 1, &loud);
    write_wav(&kitchen.join("stille 14.wav"), 16_000, 1, &[0; 32_000]);
    write_wav(&kitchen.join("falsch 15.wav"), 16_000, 1, &sound(3.0, 2.0, 16_000, 91));
    write_wav(&kitchen.join("kurz 16.wav"), 16_000, 1, &sound(40.0, 0.2, 16_000, 92));
    (dir, path)
}

#[test]
fn a_messy_folder_stops_no_command_and_check_prints_what_mends_it() {
    let (dir, path) = messy();
    let out = dir.path().join("out.svg");
    let single = path.join("Jeans/aufnahme 3.wav");
    let commands = [
        &["eval", text(&path)][..],
        &["duration", text(&path)],
        &["plan", text(&path), "--target", "0.5"],
        &["replay", text(&path)],
        &["replay", text(&single), "--library", text(&path)],
        &["library", "list", text(&path)],
        &["chart", text(&path), "--brief", "--out", text(&out)],
    ];
    for command in commands {
        let output = surfaced(command);
        assert_eq!(output.status.code(), Some(3), "{command:?}: {}", said(&output));
        says(&said(&output), &["2 files are not used", "leer 11.wav"]);
        assert_eq!(said(&output).matches("leer 11.wav").count(), 1, "{}", said(&output));
        let strict = surfaced(&[command, &["--strict"]].concat());
        assert_eq!(strict.status.code(), Some(1), "{command:?}: {}", said(&strict));
        says(&said(&strict), &["leer 11.wav", "notiz 12.wav"]);
    }

    let checked = surfaced(&["check", text(&path), "--json"]);
    assert_eq!(checked.status.code(), Some(3), "{}", said(&checked));
    let report: Value = serde_json::from_slice(&checked.stdout).unwrap();
    let findings = report["findings"].as_array().unwrap();
    let found: BTreeSet<(&str, String)> = findings
        .iter()
        .flat_map(|one| {
            let trials = one["trials"].as_array().unwrap().iter();
            trials.map(|trial| (one["kind"].as_str().unwrap(), trial.to_string()))
        })
        .collect();
    let expected = [
        ("unreadable", "leer 11"),
        ("unreadable", "notiz 12"),
        ("clipped", "\u{fc}bersteuert 13"),
        ("silent", "stille 14"),
        ("mislabelled", "falsch 15"),
        ("short", "kurz 16"),
    ];
    let expected: BTreeSet<(&str, String)> =
        expected.map(|(kind, name)| (kind, format!("\"K\u{fc}che alt/{name}.wav\""))).into();
    assert_eq!(found, expected, "{findings:?}");
    // Nothing is promised for another label.
    let [mended, accuracy] =
        ["accuracy_mended", "accuracy"].map(|key| report[key].as_f64().unwrap());
    assert!(accuracy < mended && mended < 1.0, "{report}");

    // The commands as a person pastes them.
    let program = assert_cmd::cargo::cargo_bin("surfaced");
    let shown = surfaced(&["check", text(&path)]);
    let shown = String::from_utf8_lossy(&shown.stdout).into_owned();
    let printed = shown.lines().filter_map(|line| line.trim().strip_prefix("surfaced "));
    let printed: Vec<&str> = printed.collect();
    assert_eq!(printed.len(), findings.len(), "{shown}");
    for line in printed {
        let line = format!("'{}' {line}", text(&program));
        let done = std::process::Command::new("sh").args(["-c", &line]).output().unwrap();
        assert!(done.status.success(), "{line}: {}", said(&done));
    }
    let clean = surfaced(&["check", text(&path)]);
    let text_of = String::from_utf8_lossy(&clean.stdout).into_owned();
    assert!(clean.status.success(), "{text_of} {}", said(&clean));
    assert!(text_of.contains("100.0 %") && path.join("Jeans/falsch 15.wav").exists(), "{text_of}");
    let output = surfaced(&["eval", text(&path)]);
    assert!(output.status.success(), "{}", said(&output));
}

#[test]
fn a_session_that_differs_is_named_with_what_differs_and_its_labels_are_not_suspected() {
    let (_dir, path) = temp();
    let days = ["monday", "tuesday", "wednesday", "thursday", "friday"];
    let each =
        days.iter().enumerate().flat_map(|(day, name)| (1..=6).map(move |n| (6 * day + n, *name)));
    for (n, day) in each {
        for (surface, tau) in [("oak", 40.0), ("felt", 3.0)] {
            // On Friday something lies between the stylus and oak.
            let is_odd = day == "friday" && surface == "oak";
            if day == "friday" && !is_odd && n % 2 == 0 {
                continue;
            }
            let trial = path.join(format!("{surface}/trial{n}"));
            let samples =
                sound(if is_odd { 1.5 } else { tau }, 1.0, 10_000, n as u64 + tau as u64 * 1000);
            write_wav(&trial.join("ir.wav"), 10_000, 1, &samples);
            write_file(&trial.join("trial.toml"), format!("session = \"{day}\"\n"));
        }
    }
    let checked = surfaced(&["check", text(&path), "--json"]);
    assert_eq!(checked.status.code(), Some(3), "{}", said(&checked));
    let report: Value = serde_json::from_slice(&checked.stdout).unwrap();
    let findings = report["findings"].as_array().unwrap();
    let kinds: Vec<&str> = findings.iter().map(|one| one["kind"].as_str().unwrap()).collect();
    assert_eq!(kinds, ["session"], "{report}");
    let trials = findings[0]["trials"].as_array().unwrap();
    assert!(trials.len() >= 3 && findings[0]["command"].is_null(), "{report}");
    let said = findings[0]["text"].as_str().unwrap();
    says(said, &["session friday of expert differs", "ir has ", " times the band"]);
    assert!(!said.contains("the rate"), "{said}");
    assert!(report["accuracy_mended"].is_null(), "nothing is promised: {report}");
    assert_eq!(
        (&report["interval_over"], &report["left_out"]),
        (&"sessions".into(), &"each session left out in turn".into())
    );
    // The number is that of `eval`.
    let measured = surfaced(&["eval", text(&path), "--json"]);
    let measured: Value = serde_json::from_slice(&measured.stdout).unwrap();
    for key in ["accuracy", "accuracy_low", "accuracy_high"] {
        assert_eq!(measured[key], report[key], "{key}");
    }
}

#[test]
fn files_of_a_flat_folder_are_edited_by_name_and_a_rename_onto_a_surface_asks() {
    let (_dir, path) = temp();
    for name in ["table/1.wav", "table/2.wav", "jeans/1.wav"] {
        write_wav(&path.join(name), 44_100, 1, &sound(5.0, 0.2, 44_100, name.len() as u64));
    }
    let lib = text(&path);
    let done = |args: &[&str]| {
        let output = surfaced(&[&["library"], args].concat());
        assert!(output.status.success(), "{args:?}: {}", said(&output));
        String::from_utf8(output.stdout).unwrap()
    };
    let names = || -> Vec<String> {
        let rows: Value = serde_json::from_str(&done(&["list", lib, "--quick", "--json"])).unwrap();
        let rows = rows.as_array().unwrap().iter();
        rows.map(|row| row["trial"].as_str().unwrap().to_string()).collect()
    };
    let before = names();
    assert_eq!(before, ["jeans/1.wav", "table/1.wav", "table/2.wav"]);
    let refused = surfaced(&["library", "rename", lib, "table", "jeans"]);
    assert_eq!(refused.status.code(), Some(2));
    says(&said(&refused), &["jeans is there already, with 1 trial", "--merge"]);
    assert_eq!(names(), before);
    done(&["rename", lib, "table", "jeans", "--merge"]);
    assert_eq!(names(), ["jeans/1-2.wav", "jeans/1.wav", "jeans/2.wav"]);
    done(&["undo", lib]);
    assert_eq!(names(), before);
    done(&["move", lib, "table/1.wav", "--to", "B\u{f6}den (alt)"]);
    assert!(path.join("B\u{f6}den (alt)/1.wav").exists());
    done(&["remove", lib, "table/2.wav"]);
    assert!(done(&["list", lib, "--removed"]).contains("table/2.wav"));
    done(&["restore", lib, "table/2.wav"]);
    (0..3).for_each(|_| drop(done(&["undo", lib])));
    assert_eq!(names(), before);
}

#[test]
fn tables_become_a_library_and_a_dry_run_writes_nothing() {
    let (dir, tables) = temp();
    for (surface, tau) in [("Eiche", 30.0), ("Filz", 4.0)] {
        for n in 1..=3u64 {
            let samples = sound(tau, 1.0, 500, n + surface.len() as u64);
            let row =
                |(i, x): (usize, &i16)| format!("{};{};{}\n", 2 * i, x, x / 3).replace('.', ",");
            let rows: String = samples.iter().enumerate().map(row).collect();
            let text = format!("time_ms;acc_x;acc_y\n{rows}");
            write_file(&tables.join(format!("{surface}/anna_{n}.csv")), text);
        }
    }
    for bad in ["anna_8", "anna_9"] {
        let text = "time_ms;acc_x;acc_y\n0;1;x\n2;1;2\n";
        write_file(&tables.join(format!("Filz/{bad}.csv")), text);
    }
    let out = dir.path().join("mine");
    let names = "{surface}/{user}_{trial}";
    let import = |more: &[&str]| {
        let args = ["import", "csv", text(&tables), "--out", text(&out), "--names", names];
        surfaced(&[&args[..], more].concat())
    };
    let dry = import(&["--dry-run"]);
    assert_eq!(dry.status.code(), Some(3), "{}", said(&dry));
    let understood = String::from_utf8_lossy(&dry.stdout).into_owned();
    says(&understood, &["acc_x, acc_y", "500 Hz", "Eiche", "anna", "1.0 s"]);
    says(&said(&dry), &["2 files are not used; --strict names all: ", "nothing is written"]);
    says(&said(&dry), &["anna_8.csv: line 2, column `acc_y`"]);
    says(&said(&import(&["--dry-run", "--strict"])), &["anna_8.csv: line 2", "anna_9.csv: line 2"]);
    assert!(!out.exists());
    let written = import(&[]);
    assert_eq!(written.status.code(), Some(3), "{}", said(&written));
    let listed = surfaced(&["library", "list", text(&out), "--quick", "--json"]);
    let rows: Value = serde_json::from_slice(&listed.stdout).unwrap();
    assert_eq!(rows.as_array().unwrap().len(), 6);
    assert_eq!((&rows[0]["surface"], &rows[0]["user"]), (&"Eiche".into(), &"anna".into()));
    assert_eq!(rows[0]["sources"], serde_json::json!(["acc"]));
    let eval = surfaced(&["eval", text(&out), "--json"]);
    let report: Value = serde_json::from_slice(&eval.stdout).unwrap();
    assert_eq!(
        (&report["accuracy"], &report["queries"]),
        (&1.0.into(), &6.into()),
        "{}",
        said(&eval)
    );
    let again = import(&[]);
    assert_eq!(again.status.code(), Some(2), "{}", said(&again));
    let no_rate = dir.path().join("plain.csv");
    write_file(&no_rate, "1,2\n3,4\n");
    let refused =
        surfaced(&["import", "csv", text(&no_rate), "--out", text(&dir.path().join("x"))]);
    assert_eq!(refused.status.code(), Some(2));
    says(&said(&refused), &["--rate HZ, or --time COLUMN"]);
}
