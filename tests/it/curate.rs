//! `surfaced library`, `check` and `history` as a person types them.

use std::io::Read;
use std::path::Path;
use std::process::{Output, Stdio};
use std::time::Duration;

use assert_cmd::Command;
use serde_json::Value;
use surfaced::record::edit::LibraryLock;

fn surfaced(arguments: &[&str]) -> Output {
    Command::cargo_bin("surfaced").unwrap().args(arguments).output().unwrap()
}

fn done(arguments: &[&str]) -> String {
    let output = surfaced(arguments);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{arguments:?}: {said}");
    String::from_utf8(output.stdout).unwrap()
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// A synthetic library of three surfaces, four trials each.
fn library(dir: &Path) -> String {
    let path = dir.join("library").to_str().unwrap().to_string();
    let size = ["--surfaces", "3", "--trials", "4", "--users", "0", "--seconds", "1"];
    done(&[&["synth", path.as_str()], &size[..]].concat());
    path
}

fn trials(library: &str) -> Vec<(String, String)> {
    let rows: Value =
        serde_json::from_str(&done(&["library", "list", library, "--quick", "--json"])).unwrap();
    let text = |row: &Value, key: &str| row[key].as_str().unwrap().to_string();
    rows.as_array().unwrap().iter().map(|row| (text(row, "trial"), text(row, "surface"))).collect()
}

#[test]
fn a_library_is_edited_and_every_edit_is_taken_back() {
    let dir = tempfile::tempdir().unwrap();
    let library = library(dir.path());
    let before = trials(&library);
    assert_eq!(before.len(), 12);
    let (first, surface) = before[0].clone();
    done(&["library", "rename", &library, &surface, "slate"]);
    assert_eq!(trials(&library).iter().filter(|(_, s)| s == "slate").count(), 4);
    done(&["library", "undo", &library]);
    assert_eq!(trials(&library), before);
    done(&["library", "remove", &library, &first]);
    assert_eq!(trials(&library).len(), 11);
    assert!(done(&["library", "list", &library, "--removed"]).contains(&first));
    done(&["library", "restore", &library, &first]);
    done(&["library", "move", &library, &first, "--to", "elm"]);
    assert_eq!(trials(&library).iter().filter(|(_, s)| s == "elm").count(), 1);
    (0..3).for_each(|_| drop(done(&["library", "undo", &library])));
    assert_eq!(trials(&library), before);
    for wrong in [&["library", "remove", &library, "nothing"][..], &["library", "undo", &library]] {
        let output = surfaced(wrong);
        assert_eq!(output.status.code(), Some(1), "{wrong:?}: {}", said(&output));
    }
}

#[test]
fn a_check_names_what_to_mend_and_one_bad_file_does_not_stop_it() {
    let dir = tempfile::tempdir().unwrap();
    let library = library(dir.path());
    let all = trials(&library);
    // A copy of a trial under another number, and a file that is cut short.
    let source = Path::new(&library).join(&all[0].0);
    let copy = source.with_file_name("copy-09");
    std::fs::create_dir(&copy).unwrap();
    for file in std::fs::read_dir(&source).unwrap().flatten() {
        if file.file_name() != "trial.toml" {
            std::fs::copy(file.path(), copy.join(file.file_name())).unwrap();
        }
    }
    let bad = Path::new(&library).join(&all[5].0).join("ir.wav");
    let bytes = std::fs::read(&bad).unwrap();
    std::fs::write(&bad, &bytes[..bytes.len() / 2]).unwrap();
    let output = surfaced(&["check", &library, "--json"]);
    assert_eq!(output.status.code(), Some(3), "{}", said(&output));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    let mend = report["mend"].to_string();
    assert!(mend.contains("is a copy of") && mend.contains("ir.wav"), "{mend}");
    assert_eq!(report["trials"], 13);
    assert!(report["accuracy"].as_f64().unwrap() > 0.5, "{report}");
    let counted: u64 =
        report["surfaces"].as_array().unwrap().iter().map(|s| s["queries"].as_u64().unwrap()).sum();
    assert_eq!(counted, 13);
    let text = surfaced(&["check", &library]);
    let text = String::from_utf8(text.stdout).unwrap();
    assert!(text.contains("cross-validated accuracy") && text.contains("needs fixing:"), "{text}");
}

/// Sets all samples of the ir recordings of the trials to 0, as of a broken cable.
fn mute<'a>(library: &str, trials: impl Iterator<Item = &'a String>) {
    for trial in trials {
        let path = Path::new(library).join(trial).join("ir.wav");
        let mut bytes = std::fs::read(&path).unwrap();
        let data = bytes.windows(4).position(|four| four == b"data").unwrap() + 8;
        bytes[data..].fill(0);
        std::fs::write(&path, bytes).unwrap();
    }
}

#[test]
fn a_source_that_is_muted_on_a_surface_or_in_a_whole_library_is_no_sound_one() {
    let dir = tempfile::tempdir().unwrap();
    let library = library(dir.path());
    let all = trials(&library);
    let has = "ir: channel 1 has one value in all trials";
    let everywhere = format!("{has}: check its cable");
    let on_one = format!("{has} of {}, and moves on others: check its cable", all[0].1);
    for (muted, expected) in [(4, on_one), (12, everywhere)] {
        mute(&library, all[..muted].iter().map(|(trial, _)| trial));
        let check = surfaced(&["check", &library]);
        let text = String::from_utf8(check.stdout).unwrap();
        assert_eq!(check.status.code(), Some(3), "{text}");
        assert!(text.contains(&expected), "{text}");
        let eval = said(&surfaced(&["eval", &library]));
        assert!(eval.contains(&expected), "{eval}");
    }
}

#[test]
fn a_copy_under_another_label_is_to_be_removed_where_it_looks_mislabelled() {
    let dir = tempfile::tempdir().unwrap();
    let library = library(dir.path());
    let all = trials(&library);
    let (from, copy) = (&all[11].0, format!("{}/expert-09", all[0].1));
    std::fs::create_dir(Path::new(&library).join(&copy)).unwrap();
    for file in std::fs::read_dir(Path::new(&library).join(from)).unwrap().flatten() {
        if file.file_name() != "trial.toml" {
            let to = Path::new(&library).join(&copy).join(file.file_name());
            std::fs::copy(file.path(), to).unwrap();
        }
    }
    let text = String::from_utf8(surfaced(&["check", &library]).stdout).unwrap();
    let says = format!("copies under two labels: {copy} and {from}; {copy} looks mislabelled\n");
    assert!(text.contains(&says), "{text}");
    assert!(text.contains(&format!("surfaced library remove {library} {copy}\n")), "{text}");
    assert!(text.contains(&format!("taken for others: {copy} ({})\n", all[11].1)), "{text}");
}

#[test]
fn an_edit_that_changes_nothing_does_not_promise_to_be_taken_back() {
    let dir = tempfile::tempdir().unwrap();
    let library = library(dir.path());
    let surface = trials(&library)[0].1.clone();
    for same in
        [&["rename", &library, &surface, &surface][..], &["session", &library, &surface, "--none"]]
    {
        let output = surfaced(&[&["library"], same].concat());
        assert!(output.status.success() && said(&output).contains("nothing to change"), "{same:?}");
        assert!(!said(&output).contains("undo"), "{}", said(&output));
    }
    let output = surfaced(&["library", "rename", &library, "nothing", &surface]);
    assert!(said(&output).contains("is called \"nothing\""), "{}", said(&output));
}

#[test]
fn a_library_without_past_scans_says_how_to_keep_them() {
    let dir = tempfile::tempdir().unwrap();
    let output = surfaced(&["history", dir.path().to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(1));
    assert!(said(&output).contains("surfaced run --library"), "{}", said(&output));
}

#[test]
fn a_reader_of_a_library_waits_for_an_edit_under_way_and_says_for_whom() {
    let dir = tempfile::tempdir().unwrap();
    let library = library(dir.path());
    let out = dir.path().join("out.svg").to_str().unwrap().to_string();
    let trial = format!("{library}/{}", trials(&library)[0].0);
    let _editing = LibraryLock::for_editing(Path::new(&library)).unwrap();
    let readers = [
        &["duration", &library][..],
        &["plan", &library],
        &["stress", &library, "--out", &out],
        &["chart", &library, "--out", &out],
        &["compare", &trial, &trial],
        &["export", &trial, &out],
        &["export", &library, &out],
        &["library", "list", &library, "--quick"],
    ];
    // A build without MCAP refuses before it reads.
    let readers = readers.into_iter().filter(|r| r[0] != "export" || cfg!(feature = "mcap"));
    let mut children: Vec<_> = readers
        .map(|reader| {
            let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_surfaced"));
            let child = command.args(reader).stdout(Stdio::null()).stderr(Stdio::piped()).spawn();
            (reader, child.unwrap())
        })
        .collect();
    std::thread::sleep(Duration::from_secs(4));
    for (reader, child) in &mut children {
        assert!(child.try_wait().unwrap().is_none(), "{reader:?} reads what is being edited");
        child.kill().unwrap();
        let mut said = String::new();
        child.stderr.take().unwrap().read_to_string(&mut said).unwrap();
        let who = format!("(process {}), which edits it", std::process::id());
        assert!(said.contains("waiting for ") && said.contains(&who), "{reader:?}: {said}");
    }
}

#[test]
fn an_edit_that_cannot_be_done_changes_nothing_and_one_that_was_cut_short_is_finished() {
    let dir = tempfile::tempdir().unwrap();
    let library = library(dir.path());
    let before = trials(&library);
    let surface = &before[0].1;
    std::fs::write(Path::new(&library).join("beech"), "").unwrap();
    let output = surfaced(&["library", "rename", &library, surface, "beech"]);
    assert_eq!(output.status.code(), Some(1), "{}", said(&output));
    assert!(said(&output).contains("a file stands where"), "{}", said(&output));
    assert_eq!(trials(&library), before);
    assert!(said(&surfaced(&["library", "undo", &library])).contains("no step to undo"));
    // As if a rename had been killed after its first trial had moved.
    done(&["library", "rename", &library, surface, "slate"]);
    let steps = Path::new(&library).join(".removed/steps.jsonl");
    let text = std::fs::read_to_string(&steps).unwrap();
    std::fs::write(&steps, text.strip_suffix("\"done\"\n").unwrap()).unwrap();
    let moved = trials(&library).iter().find(|(_, s)| s == "slate").unwrap().0.clone();
    std::fs::write(&steps, text.strip_suffix("\"done\"\n").unwrap()).unwrap();
    let back = Path::new(&library).join(&before[0].0);
    std::fs::create_dir_all(back.parent().unwrap()).unwrap();
    std::fs::rename(Path::new(&library).join(moved), &back).unwrap();
    let opened = surfaced(&["library", "list", &library, "--quick"]);
    assert!(said(&opened).contains("was cut short, and is finished now"), "{}", said(&opened));
    assert_eq!(trials(&library).iter().filter(|(_, s)| s == "slate").count(), 4);
    done(&["library", "undo", &library]);
    assert_eq!(trials(&library), before);
}

#[test]
fn nothing_is_enrolled_into_a_library_in_the_layout_of_lmt108() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir_all(dir.path().join("SoundScans/Movement/Training")).unwrap();
    let output = surfaced(&["enroll", "oak", "--library", dir.path().to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(1), "{}", said(&output));
    assert!(said(&output).contains("never read"), "{}", said(&output));
}

#[test]
fn eval_and_replay_wait_for_an_edit_under_way() {
    let dir = tempfile::tempdir().unwrap();
    let library = library(dir.path());
    for reader in [&["eval", &library, "--json"][..], &["replay", &library, "--json"]] {
        let editing = LibraryLock::for_editing(Path::new(&library)).unwrap();
        let mut child = std::process::Command::new(env!("CARGO_BIN_EXE_surfaced"))
            .args(reader)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        std::thread::sleep(Duration::from_secs(1));
        assert!(child.try_wait().unwrap().is_none(), "{reader:?} reads what is being edited");
        drop(editing);
        assert!(child.wait().unwrap().success(), "{reader:?}");
    }
}

#[test]
fn sessions_and_keys_of_ones_own_are_set_listed_and_chosen_by() {
    let dir = tempfile::tempdir().unwrap();
    let library = library(dir.path());
    let surface = trials(&library)[0].1.clone();
    done(&["library", "session", &library, &surface, "--to", "2026-11-25T10:42"]);
    let listed = done(&["library", "list", &library, "--quick"]);
    assert!(listed.contains("session") && listed.contains("2026-11-25T10:42"), "{listed}");
    for (at, (trial, _)) in trials(&library).iter().enumerate() {
        let path = Path::new(&library).join(trial).join("trial.toml");
        let text = std::fs::read_to_string(&path).unwrap();
        std::fs::write(&path, format!("{text}[meta]\nforce_n = {}\n", at % 4)).unwrap();
    }
    let evaluated = |wheres: &[&str]| {
        let wheres = wheres.iter().flat_map(|one| ["--where", one]);
        let first = ["eval", &library, "--no-cache", "--json"].into_iter();
        surfaced(&first.chain(wheres).collect::<Vec<_>>())
    };
    let queries = |wheres: &[&str]| {
        let output = evaluated(wheres);
        assert!(output.status.success(), "{}", said(&output));
        serde_json::from_slice::<Value>(&output.stdout).unwrap()["queries"].clone()
    };
    assert_eq!(queries(&[]), 12);
    assert_eq!(queries(&["force_n>=1"]), 9);
    assert_eq!(queries(&["force_n>=1", "force_n!=3"]), 6);
    for (condition, expected) in [
        ("forse_n>=1", "no trial has the key `forse_n`"),
        ("force_n>9", "no trial fits force_n>9"),
        ("force_n=hard", "cannot be compared with hard"),
    ] {
        let output = evaluated(&[condition]);
        assert_eq!(output.status.code(), Some(2), "{condition}");
        assert!(said(&output).contains(expected), "{}", said(&output));
    }
    let figure = |name| [name, "--out", "x.svg"];
    for command in [
        &["check"][..],
        &["duration"],
        &["replay"],
        &["plan"],
        &["train", "--out", "x.surfaced"],
        &figure("chart"),
        &figure("stress"),
    ] {
        let wrong = [command, &[&library, "--where", "forse_n=1"]].concat();
        assert!(said(&surfaced(&wrong)).contains("no trial has the key"), "{command:?}");
    }
    let alone = ["library", "session", &library, &surface, "--none"];
    done(&alone);
    assert!(!done(&["library", "list", &library, "--quick"]).contains("10:42"));
    done(&["library", "undo", &library]);
    assert!(done(&["library", "list", &library, "--quick"]).contains("10:42"));
}
