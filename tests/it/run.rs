//! `surfaced run`, `enroll` and `record` as processes, with a stylus on a pseudo-terminal.

use std::fs::File;
use std::io::{ErrorKind, Read, Write};
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use crate::bench::{Bench, CHANNELS, SCANNED, opened, synthetic, trial};
use crate::common;
use crate::common::http::SOON;
use rustix::termios::{Winsize, tcsetwinsize};
use serde_json::Value;
use serialport::{SerialPort, TTYPort};

#[test]
fn scans_on_the_line_are_named_and_a_signal_ends_the_last_one_whole() {
    let data = synthetic(2.0);
    let mut bench = Bench::new();
    let library = bench.library(&data);
    // By a method that needs no training: every source is compared.
    let args = ["run", "--library", library.to_str().unwrap(), "--method", "reference"];
    let mut run = bench.surfaced(&args);
    run.until_said("is absent", None);
    let mut fake = bench.stylus();
    fake.wait_for_start();
    for surface in [1, 0, 2] {
        let seconds = bench.play(&fake, &trial(&data, surface, SCANNED), 2.0);
        fake.serve(seconds);
        let line = run.line(&mut fake);
        assert_eq!(line["surface"], data.surfaces()[surface], "{line} {}", run.said());
        assert_eq!(line["ranked"].as_array().unwrap().len(), 3);
        assert_eq!(line["sources"], serde_json::json!(CHANNELS));
        assert_eq!(line["lost_samples"], 0, "{}", run.said());
        assert!((line["scan_s"].as_f64().unwrap() - 2.0).abs() < 0.05, "{line}");
    }
    // In the middle of a drag.
    let seconds = bench.play(&fake, &trial(&data, 1, SCANNED), 2.0);
    fake.serve(seconds - 1.2);
    run.signal("TERM");
    let line = run.line(&mut fake);
    assert_eq!(line["surface"], data.surfaces()[1], "{line}");
    assert_eq!(line["spoiled"], serde_json::json!([]), "{line}");
    assert!((1.0..1.8).contains(&line["scan_s"].as_f64().unwrap()), "{line}");
    assert_eq!(run.end(&mut fake).code(), Some(0), "{}", run.said());
    for state in ["is absent", "is opening", "is streaming"] {
        assert_eq!(run.said().matches(state).count(), 1, "{state}: {}", run.said());
    }
}

#[test]
fn what_was_enrolled_names_a_new_scan() {
    let data = synthetic(1.5);
    let mut bench = Bench::new();
    let path = bench.path("mine");
    let library = path.to_str().unwrap().to_string();
    let mut fake = bench.stylus();
    for surface in 0..2 {
        let label = data.surfaces()[surface].to_string();
        let args = ["enroll", &label, "--library", &library, "--trials", "2"];
        let mut enroll = bench.surfaced(&args);
        fake.wait_for_start();
        for number in 1..=2 {
            let seconds = bench.play(&fake, &trial(&data, surface, number), 1.5);
            fake.serve(seconds);
            let line = enroll.line(&mut fake);
            assert_eq!(line["trial"], number, "{line} {}", enroll.said());
            assert_eq!(line["wanted"], 2 - number);
        }
        assert_eq!(enroll.end(&mut fake).code(), Some(0), "{}", enroll.said());
    }
    let kept = opened(&path);
    assert_eq!(kept.entries.len(), 4);
    assert!(kept.entries.iter().all(|entry| entry.sources.len() == 4), "{:?}", kept.entries);
    let mut run = bench.surfaced(&["run", "--library", &library]);
    fake.wait_for_start();
    for surface in [1, 0] {
        let seconds = bench.play(&fake, &trial(&data, surface, SCANNED), 1.5);
        fake.serve(seconds);
        assert_eq!(run.line(&mut fake)["surface"], data.surfaces()[surface]);
    }
    run.signal("INT");
    assert_eq!(run.end(&mut fake).code(), Some(0), "{}", run.said());
}

#[test]
fn a_trial_that_is_too_short_by_its_own_t_star_or_clipped_is_refused() {
    let data = synthetic(2.0);
    let mut bench = Bench::new();
    let strict = "format = 1\n[microphone]\npresent = false\n[camera]\npresent = false\n\
                  [enroll]\nt_star = [\"ir\"]\n";
    std::fs::write(bench.path("station.toml"), strict).unwrap();
    let path = bench.path("mine");
    let mut fake = bench.stylus();
    let mut enroll =
        bench.surfaced(&["enroll", "felt", "--library", path.to_str().unwrap(), "--trials", "1"]);
    fake.wait_for_start();
    let seconds = bench.play(&fake, &trial(&data, 0, 1), 0.6);
    fake.serve(seconds);
    let line = enroll.line(&mut fake);
    assert_eq!((&line["trial"], &line["wanted"]), (&Value::Null, &1.into()), "{line}");
    let remarks = line["remarks"].to_string();
    assert!(remarks.contains("s; 1.0 s needed"), "{line}");
    assert!(remarks.contains("ir: 0.6 s is too short: "), "{line}");
    // Half of the drag is at the converter's end.
    let mut loud = trial(&data, 0, 2);
    for (id, signal) in &mut loud.signals {
        if let ("ac", surfaced::trial::Signal::Series(series)) = (id.as_str(), signal) {
            let samples = series.samples().iter().map(|x| (x * 1e4).clamp(-1.0, 1.0)).collect();
            *series = surfaced::trial::Series::new(series.rate_hz(), 3, samples).unwrap();
        }
    }
    let seconds = bench.play(&fake, &loud, 2.0);
    fake.serve(seconds);
    let line = enroll.line(&mut fake);
    assert!(line["trial"].is_null() && line["remarks"].to_string().contains("ac: "), "{line}");
    enroll.signal("TERM");
    assert_eq!(enroll.end(&mut fake).code(), Some(1), "{}", enroll.said());
    assert!(enroll.said().contains("0 of 1 trials were recorded"), "{}", enroll.said());
}

#[test]
fn a_stylus_that_disappears_spoils_its_scan_and_comes_back() {
    let data = synthetic(2.0);
    let mut bench = Bench::new();
    let library = bench.library(&data);
    let mut run = bench.surfaced(&["run", "--library", library.to_str().unwrap()]);
    let mut fake = bench.stylus();
    fake.wait_for_start();
    let seconds = bench.play(&fake, &trial(&data, 0, SCANNED), 2.0);
    fake.serve(seconds - 1.7);
    drop(fake);
    run.until_said("is lost", None);
    let mut fake = bench.stylus();
    let line = run.line(&mut fake);
    // As a gap, or cut short, if the new one took its time.
    assert_ne!(line["spoiled"], serde_json::json!([]), "{line}");
    fake.wait_for_start();
    let seconds = bench.play(&fake, &trial(&data, 2, SCANNED), 2.0);
    fake.serve(seconds);
    let line = run.line(&mut fake);
    assert_eq!(line["surface"], data.surfaces()[2], "{line} {}", run.said());
    assert_eq!(line["spoiled"], serde_json::json!([]), "{line}");
    run.signal("TERM");
    assert_eq!(run.end(&mut fake).code(), Some(3), "{}", run.said());
}

#[test]
fn a_killed_enrolment_leaves_whole_trials() {
    let data = synthetic(1.5);
    let mut bench = Bench::new();
    let path = bench.path("mine");
    let args = ["enroll", "felt", "--library", path.to_str().unwrap(), "--trials", "50"];
    let mut fake = bench.stylus();
    let mut enroll = bench.surfaced(&args);
    fake.wait_for_start();
    for number in 1..=3 {
        let seconds = bench.play(&fake, &trial(&data, 0, 1 + number % 2), 1.5);
        fake.serve(seconds);
        if number < 3 {
            let line = enroll.line(&mut fake);
            assert_eq!(line["trial"], number, "{line} {}", enroll.said());
        }
    }
    // The third may be on its way to the disk, or not.
    enroll.signal("KILL");
    enroll.end(&mut fake);
    let kept = opened(&path);
    assert!((2..=3).contains(&kept.entries.len()), "{:?}", kept.entries);
    for entry in &kept.entries {
        assert_eq!(entry.load().unwrap().signals.len(), 4);
    }
    // And the next one continues where this one was ended.
    let enroll = bench.surfaced(&args);
    fake.wait_for_start();
    let seconds = bench.play(&fake, &trial(&data, 0, 2), 1.5);
    fake.serve(seconds);
    assert_eq!(enroll.line(&mut fake)["trial"], kept.entries.len() + 1);
}

#[test]
fn recording_keeps_every_scan_until_it_is_ended() {
    let data = synthetic(0.8);
    let mut bench = Bench::new();
    let path = bench.path("mine");
    let mut fake = bench.stylus();
    let mut record = bench.surfaced(&["record", "--library", path.to_str().unwrap()]);
    fake.wait_for_start();
    for number in 1..=2 {
        let seconds = bench.play(&fake, &trial(&data, number as usize, 1), 0.8);
        fake.serve(seconds);
        assert_eq!(record.line(&mut fake)["trial"], number);
    }
    record.signal("TERM");
    assert_eq!(record.end(&mut fake).code(), Some(0), "{}", record.said());
    let kept = opened(&path);
    assert_eq!(kept.surfaces(), ["unlabelled"]);
    assert_eq!(kept.entries.len(), 2);
}

#[test]
fn scans_that_cannot_be_written_wait_and_a_recording_that_loses_them_says_so() {
    let data = synthetic(0.8);
    // Some scans are lost, or all of them.
    for (kept, code) in [(1, 3), (0, 1)] {
        let mut bench = Bench::new();
        let path = bench.path("mine");
        let mut fake = bench.stylus();
        let mut record = bench.surfaced(&["record", "--library", path.to_str().unwrap()]);
        fake.wait_for_start();
        for scan in 0..=kept {
            if scan == kept {
                // The folder goes away, and a file is in its place.
                std::fs::rename(&path, bench.path("moved")).unwrap();
                std::fs::write(&path, "").unwrap();
            }
            let seconds = bench.play(&fake, &trial(&data, 0, 1 + scan), 0.8);
            fake.serve(seconds);
            let line = record.line(&mut fake);
            let outcome = if scan == kept { "waiting" } else { "kept" };
            assert_eq!(line["outcome"], outcome, "{line} {}", record.said());
        }
        record.signal("TERM");
        assert_eq!(record.line(&mut fake)["outcome"], "lost", "{}", record.said());
        assert_eq!(record.end(&mut fake).code(), Some(code), "{}", record.said());
        assert!(record.said().contains("1 scan could not be written"), "{}", record.said());
    }
}

#[test]
fn a_station_whose_devices_have_no_source_of_the_library_says_so_at_its_start() {
    let bench = Bench::new();
    let library = bench.path("sounds");
    for (surface, number) in [("oak", 1), ("oak", 2), ("felt", 1), ("felt", 2)] {
        let samples: Vec<i16> = (0..9000).map(|i: i32| (i * i * number % 2003) as i16).collect();
        let path = library.join(format!("{surface}/{number}/mi2.wav"));
        common::write_wav(&path, 44_100, 1, &samples);
    }
    let mut fake = bench.stylus();
    let mut run = bench.surfaced(&["run", "--library", library.to_str().unwrap()]);
    run.until_said("no scan can be named", Some(&mut fake));
    assert!(run.said().contains("mi2") && run.said().contains("surfaced enroll"), "{}", run.said());
    run.signal("TERM");
    let last = run.line(&mut fake);
    assert!(last["warnings"].to_string().contains("no scan can be named"), "{last}");
    assert_eq!(run.end(&mut fake).code(), Some(0), "{}", run.said());
}

#[test]
fn a_configuration_or_a_library_that_cannot_be_is_reported() {
    let bench = Bench::new();
    let said = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_surfaced"));
        let output = command.args(args).stdin(Stdio::null()).output().unwrap();
        assert!(output.stdout.is_empty());
        (output.status.code(), String::from_utf8(output.stderr).unwrap())
    };
    let (code, text) = said(&["run"]);
    assert!(code == Some(2) && text.contains("--library"), "{text}");
    let (code, text) = said(&["run", "--library", "/no/such/folder"]);
    assert!(code == Some(1) && text.contains("surfaced enroll"), "{text}");
    assert!(text.contains("--create") && !text.contains("[y/N]"), "nobody is asked: {text}");
    let wrong = bench.path("wrong.toml");
    std::fs::write(&wrong, "format = 1\n[stylus]\nprot = 1\n").unwrap();
    let (code, text) = said(&["run", "--config", wrong.to_str().unwrap(), "--library", "/"]);
    assert!(code == Some(2) && text.contains("line 3") && text.contains("prot"), "{text}");
    let (code, text) = said(&["enroll", " ", "--library", "/"]);
    assert!(code == Some(2) && text.contains("the name is empty"), "{text}");
    // What cannot be is said before a sensor is learnt.
    let file = wrong.to_str().unwrap();
    let (code, text) = said(&["run", "--library", "/no/such/folder", "--lines", file]);
    assert!(code == Some(1) && text.starts_with("error: /no/such/folder"), "{text}");
    let (code, text) = said(&["enroll", "../oak", "--library", "/", "--lines", file]);
    assert!(code == Some(2) && text.contains("begins with a dot"), "{text}");
    let (code, text) = said(&["devices", "--watch", file]);
    assert!(code == Some(1) && text.contains("is no serial port"), "{text}");
    let (code, text) = said(&["enroll", "oak", "--library", "/", "--lines", "-"]);
    assert!(code == Some(1) && text.contains("standard input is empty"), "{text}");
}

#[test]
fn a_missing_library_is_made_where_that_is_asked_for_or_agreed_to_on_a_terminal() {
    let bench = Bench::new();
    let create = ["run", "--create", "--library", &bench.path("new/one").display().to_string()];
    let mut run = bench.surfaced(&create);
    run.until_said("new/one is made", None);
    run.until_said("is absent", None);
    run.signal("TERM");
    let status = run.end_while(|| std::thread::sleep(Duration::from_millis(20)));
    assert!(status.success() && bench.path("new/one/library.toml").exists(), "{}", run.said());
    for (answer, is_made) in [(&b"\n"[..], false), (b"y\n", true)] {
        let (screen, terminal) = TTYPort::pair().unwrap();
        let name = terminal.name().unwrap();
        let open = || File::options().read(true).write(true).open(&name).unwrap();
        let mut keyboard = screen.try_clone_native().unwrap();
        let shown = watch(screen);
        let mut run = Command::new("setsid")
            .args(["--ctty", "--wait", env!("CARGO_BIN_EXE_surfaced"), "run", "--library"])
            .args([bench.path("two"), "--stylus".into(), bench.path("stylus"), "--config".into()])
            .arg(bench.path("station.toml"))
            .stdin(open())
            .stdout(Stdio::null())
            .stderr(open())
            .spawn()
            .unwrap();
        let until = |text: &str| {
            let limit = Instant::now() + SOON;
            while !shown.lock().unwrap().contains(text) {
                assert!(Instant::now() < limit, "{text}: {}", shown.lock().unwrap());
                std::thread::sleep(Duration::from_millis(20));
            }
        };
        until("make it? [y/N]");
        keyboard.write_all(answer).unwrap();
        if is_made {
            until("is absent");
            keyboard.write_all(b"q").unwrap();
        }
        assert_eq!(run.wait().unwrap().success(), is_made, "{}", shown.lock().unwrap());
        assert_eq!(bench.path("two/library.toml").exists(), is_made);
    }
}

/// Reads a terminal for as long as somebody writes to it.
fn watch(mut screen: TTYPort) -> Arc<Mutex<String>> {
    let shown = Arc::<Mutex<String>>::default();
    let showing = shown.clone();
    std::thread::spawn(move || {
        let mut bytes = [0; 4096];
        loop {
            match screen.read(&mut bytes) {
                Ok(n @ 1..) => {
                    showing.lock().unwrap().push_str(&String::from_utf8_lossy(&bytes[..n]));
                }
                Err(error) if error.kind() == ErrorKind::TimedOut => {}
                _ => return,
            }
        }
    });
    shown
}

#[test]
fn on_a_terminal_keys_are_answered_at_once_and_every_line_stands_above_the_status_line() {
    let data = synthetic(1.0);
    let bench = Bench::new();
    let library = bench.library(&data);
    let (screen, terminal) = TTYPort::pair().unwrap();
    let open = || File::options().read(true).write(true).open(terminal.name().unwrap()).unwrap();
    let size = Winsize { ws_row: 24, ws_col: 100, ws_xpixel: 0, ws_ypixel: 0 };
    tcsetwinsize(open(), size).unwrap();
    let mut keyboard = screen.try_clone_native().unwrap();
    let shown = watch(screen);
    // In front of a terminal of its own.
    let mut run = Command::new("setsid")
        .args(["--ctty", "--wait", env!("CARGO_BIN_EXE_surfaced"), "run", "--method", "reference"])
        .args(["--library", library.to_str().unwrap(), "--json"])
        .args(["--stylus", bench.path("stylus").to_str().unwrap()])
        .args(["--config", bench.path("station.toml").to_str().unwrap()])
        .stdin(open())
        .stdout(Stdio::null())
        .stderr(open())
        .spawn()
        .unwrap();
    let mut fake = bench.stylus();
    fake.wait_for_start();
    let limit = Instant::now() + SOON;
    for (key, says) in [
        (&b""[..], "tap a surface"),
        (b" ", "the key begins a scan"),
        (b" ", "the key ends the scan"),
        (b"q", "received: "),
    ] {
        keyboard.write_all(key).unwrap();
        while !shown.lock().unwrap().contains(says) {
            assert!(Instant::now() < limit, "{says}: {}", shown.lock().unwrap());
            fake.serve(0.1);
        }
        fake.serve(0.5);
    }
    run.wait().unwrap();
    let shown = shown.lock().unwrap().replace("\r\n", "\n");
    // A status line is the only one with this sign.
    let lines: Vec<&str> = shown.split('\n').collect();
    let first = lines.iter().position(|line| line.contains('│')).expect("a status line");
    let until = lines.iter().position(|line| line.contains("received: ")).unwrap();
    for line in &lines {
        let left = line.rsplit("\x1b[2K").next().unwrap();
        assert!(!left.contains('│'), "a status line is left behind: {line:?}");
    }
    for line in &lines[first..until] {
        assert!(line.contains('│'), "no status line below the one before: {line:?}");
    }
}
