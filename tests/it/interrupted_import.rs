//! Imports that are killed, or find the disk full: no library is left that looks whole.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use crate::common::{open, says, temp, write_file};
use crate::plan::{said, surfaced, text};

/// A folder with a short table, and one that takes long to read.
fn tables(path: &Path) {
    write_file(&path.join("oak/1.csv"), "ax\n".to_owned() + &"0.25\n-0.5\n".repeat(200));
    write_file(&path.join("oak/2.csv"), "ax\n".to_owned() + &"0.25\n-0.5\n".repeat(1_000_000));
}

fn arguments<'a>(tables: &'a Path, out: &'a Path) -> [&'a str; 7] {
    ["import", "csv", text(tables), "--out", text(out), "--rate", "1000"]
}

/// The names of what lies in a folder, in order.
fn names(folder: &Path) -> Vec<String> {
    let items = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<String> =
        items.map(|item| item.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// The folder in which an import of `tables` was killed after its first trial.
fn killed(tables: &Path, out: &Path) -> PathBuf {
    let left = out.with_file_name(".out.importing");
    let mut command = Command::new(env!("CARGO_BIN_EXE_surfaced"));
    let mut import = command.args(arguments(tables, out)).stderr(Stdio::null()).spawn().unwrap();
    while !left.join("oak/expert-01").exists() {
        assert!(import.try_wait().unwrap().is_none(), "it ended before it could be killed");
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    import.kill().unwrap();
    import.wait().unwrap();
    left
}

#[test]
fn a_killed_import_leaves_no_library_and_the_next_starts_over() {
    let (dir, path) = temp();
    let out = dir.path().join("made/out");
    tables(&path);
    let left = killed(&path, &out);
    assert!(!out.exists());
    for command in ["check", "replay", "eval"] {
        let refused = surfaced(&[command, text(&left)]);
        assert!(!refused.status.success(), "{command} takes half a library for whole");
        says(&said(&refused), &[".out.importing", "was interrupted", "run it again"]);
        let beside = surfaced(&[command, text(out.parent().unwrap())]);
        says(&said(&beside), &["no recordings found"]);
    }
    let again = surfaced(&arguments(&path, &out));
    says(&said(&again), &["was interrupted before; it starts over", "wrote 2 trials"]);
    assert_eq!(open(&out).unwrap().entries.len(), 2);
    assert_eq!(names(out.parent().unwrap()), ["out"]);
}

/// Runs an import that can write no file of more than `blocks` of 512 bytes, as if the disk were full.
#[cfg(unix)]
fn with_little_room(tables: &Path, out: &Path, blocks: u32) -> Output {
    let script = format!("trap '' XFSZ; ulimit -f {blocks}; exec \"$0\" \"$@\"");
    let mut command = Command::new("sh");
    command.args(["-c", &script, env!("CARGO_BIN_EXE_surfaced")]);
    command.args(arguments(tables, out)).output().unwrap()
}

#[cfg(unix)]
#[test]
fn an_import_onto_a_full_disk_leaves_nothing() {
    let (dir, path) = temp();
    let out = dir.path().join("made/out");
    tables(&path);
    let full = with_little_room(&path, &out, 100);
    assert!(!full.status.success(), "{}", said(&full));
    says(&said(&full), &["too large"]);
    assert!(names(out.parent().unwrap()).is_empty(), "{:?}", names(out.parent().unwrap()));
}
