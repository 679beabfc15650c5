//! Edits of a library on disk: each can be undone, and none loses anything.

use std::fs;
use std::path::Path;

use crate::common::edited::{copy_trial, held, library, one};
use surfaced::record::edit::{Editor, LibraryLock, last_step, list, list_removed};

#[test]
fn every_step_can_be_undone_and_leaves_the_bytes_as_they_were() {
    let (dir, scene) = library();
    let root = dir.path();
    let wav = || fs::read(root.join("oak/anna-02/ir.wav")).unwrap();
    let before = (held(root, &scene), wav());
    let edit = || Editor::open(root, &scene).unwrap();
    edit().rename("oak", "ash").unwrap();
    assert_eq!(held(root, &scene), ["ash/1", "ash/2", "ash/3"]);
    assert!(!root.join("oak").exists());
    edit().undo().unwrap();
    assert_eq!((held(root, &scene), wav()), before);
    edit().move_to(&["oak/anna-02".into()], "elm").unwrap();
    assert_eq!(held(root, &scene), ["ash/1", "elm/2", "oak/1"]);
    edit().remove(&["elm".into(), "oak/anna-01".into()]).unwrap();
    assert_eq!(held(root, &scene), ["ash/1"]);
    let gone = list_removed(root, &scene).unwrap();
    let names: Vec<_> = gone.iter().map(|gone| gone.trial.as_str()).collect();
    assert_eq!(names, ["elm/anna-02", "oak/anna-01"]);
    assert!(last_step(root).unwrap().unwrap().what.starts_with("remove elm"));
    (0..2).for_each(|_| drop(edit().undo().unwrap()));
    assert_eq!((held(root, &scene), wav()), before);
    assert!(edit().undo().unwrap_err().to_string().contains("no step to undo"));
}

#[test]
fn a_session_is_read_and_stays_through_every_edit() {
    let (dir, scene) = library();
    let root = dir.path();
    let about = root.join("oak/anna-02/trial.toml");
    let text = fs::read_to_string(&about).unwrap();
    fs::write(&about, format!("session = \"monday\"\n{text}")).unwrap();
    let edit = || Editor::open(root, &scene).unwrap();
    let session = |surface: &str| {
        let listed = list(root, &scene).unwrap();
        listed
            .into_iter()
            .find(|t| t.key.surface == surface && t.key.number == 2)
            .unwrap()
            .key
            .session
    };
    assert_eq!(session("oak").as_deref(), Some("monday"));
    edit().move_to(&["oak/anna-02".into()], "elm").unwrap();
    assert_eq!(session("elm").as_deref(), Some("monday"));
    edit().remove(&["elm".into()]).unwrap();
    edit().restore(&["elm".into()]).unwrap();
    assert_eq!(session("elm").as_deref(), Some("monday"));
    assert!(
        fs::read_to_string(root.join("elm/anna-02/trial.toml")).unwrap().contains("\"monday\"")
    );
}

#[test]
fn what_was_removed_comes_back_beside_what_came_in_its_place() {
    let (dir, scene) = library();
    let root = dir.path();
    let edit = || Editor::open(root, &scene).unwrap();
    edit().remove(&["oak/anna-02".into()]).unwrap();
    edit().move_to(&["ash/anna-01".into()], "oak").unwrap();
    edit().remove(&["oak/anna-01".into()]).unwrap();
    edit().restore(&["oak".into()]).unwrap();
    assert_eq!(held(root, &scene), ["oak/1", "oak/2", "oak/3"]);
    assert!(list_removed(root, &scene).unwrap().is_empty());
}

#[test]
fn a_trial_that_cannot_be_read_can_be_removed_and_nothing_outside_can() {
    let (dir, scene) = library();
    let root = dir.path();
    fs::write(root.join("oak/anna-01/trial.toml"), "what is this").unwrap();
    let edit = || Editor::open(root, &scene).unwrap();
    edit().remove(&["oak/anna-01".into()]).unwrap();
    assert!(root.join(".removed/oak/anna-01/ir.wav").exists());
    for name in ["../oak", "oak/../ash", ".removed/oak", "oak/", "/etc"] {
        let error = edit().remove(&[name.into()]).unwrap_err().to_string();
        assert!(error.contains("no surface or trial"), "{error}");
    }
}

#[test]
fn nothing_moves_while_somebody_reads() {
    let (dir, scene) = library();
    let root = dir.path().to_path_buf();
    let reading = LibraryLock::for_reading(&root);
    let editing = std::thread::spawn(move || {
        Editor::open(&root, &scene).unwrap().remove(&["oak".into()]).unwrap();
    });
    std::thread::sleep(std::time::Duration::from_millis(200));
    assert!(dir.path().join("oak/anna-01").exists());
    drop(reading);
    editing.join().unwrap();
    assert!(!dir.path().join("oak").exists());
}

#[test]
fn files_without_trial_folders_are_edited_and_keep_their_names() {
    let (dir, scene) = library();
    let root = dir.path();
    fs::create_dir(root.join("Esche, ge\u{f6}lt")).unwrap();
    let (old, flat) = (root.join("ash/anna-01"), root.join("Esche, ge\u{f6}lt/ir_7.wav"));
    fs::copy(old.join("ir.wav"), root.join("ash/ir \u{dc} 3.wav")).unwrap();
    fs::rename(old.join("ir.wav"), &flat).unwrap();
    fs::remove_dir_all(old).unwrap();
    let names = || -> Vec<String> {
        let mut all: Vec<_> =
            list(root, &scene).unwrap().into_iter().map(|one| one.trial).collect();
        all.retain(|name| !name.starts_with("oak/"));
        all
    };
    let before = ["Esche, ge\u{f6}lt/ir_7.wav", "ash/ir \u{dc} 3.wav"];
    assert_eq!(names(), before);
    let edit = || Editor::open(root, &scene).unwrap();
    // The file goes to the folder of the other surface, and keeps its name.
    edit().rename("Esche, ge\u{f6}lt", "ash").unwrap();
    assert_eq!(names(), ["ash/ir \u{dc} 3.wav", "ash/ir_7.wav"]);
    edit().remove(&one("ash/ir_7.wav")).unwrap();
    assert_eq!(list_removed(root, &scene).unwrap()[0].trial, "ash/ir_7.wav");
    fs::copy(root.join("ash/ir \u{dc} 3.wav"), root.join("ash/ir_7.wav")).unwrap();
    edit().restore(&one("ash/ir_7.wav")).unwrap();
    assert!(root.join("ash/ir_7-2.wav").exists());
    fs::remove_file(root.join("ash/ir_7.wav")).unwrap();
    edit().move_to(&one("ash/ir \u{dc} 3.wav"), "elm.1").unwrap();
    assert_eq!(names(), ["ash/ir_7-2.wav", "elm.1/ir \u{dc} 3.wav"]);
    for label in ["a/b", "library.toml", ".x"] {
        let error = edit().rename("ash", label).unwrap_err().to_string();
        assert!(error.contains("no folder can be called"), "{error}");
    }
    (0..4).for_each(|_| drop(edit().undo().unwrap()));
    assert_eq!(names(), before);
    // A file that cannot be read can be removed and restored.
    fs::write(root.join("ash/notes.wav"), "what is this").unwrap();
    edit().remove(&one("ash/notes.wav")).unwrap();
    assert_eq!(list_removed(root, &scene).unwrap()[0].trial, "ash/notes.wav");
    edit().restore(&one("ash/notes.wav")).unwrap();
    assert!(root.join("ash/notes.wav").exists());
}

#[test]
fn a_place_that_is_taken_is_left_alone_and_undo_takes_a_free_one() {
    let (dir, scene) = library();
    let root = dir.path();
    let edit = || Editor::open(root, &scene).unwrap();
    edit().remove(&one("oak/anna-02")).unwrap();
    // Another program puts a trial in the former place.
    let copied = root.join("oak/anna-02");
    fs::create_dir(&copied).unwrap();
    for file in ["ir.wav", "trial.toml"] {
        fs::copy(root.join(".removed/oak/anna-02").join(file), copied.join(file)).unwrap();
    }
    let undone = edit().undo().unwrap();
    assert_eq!(undone.moves[0].to, "oak/anna-03");
    assert_eq!(held(root, &scene), ["ash/1", "oak/1", "oak/2", "oak/3"]);
    assert!(edit().undo().is_err(), "the step is done with");
}

#[test]
fn what_cannot_be_moved_is_refused_before_anything_is_labelled() {
    let (dir, scene) = library();
    let root = dir.path();
    fs::write(root.join("beech"), "").unwrap();
    let error = Editor::open(root, &scene).unwrap().rename("oak", "beech").unwrap_err().to_string();
    assert!(error.contains("a file stands where"), "{error}");
    assert_eq!(held(root, &scene), ["ash/1", "oak/1", "oak/2"]);
    assert_eq!(last_step(root).unwrap(), None);
    // A surface on another disk, if the machine has one.
    let Ok(other) = tempfile::tempdir_in("/dev/shm") else { return };
    copy_trial(&root.join("oak/anna-01"), &other.path().join("anna-07"));
    std::os::unix::fs::symlink(other.path(), root.join("far")).unwrap();
    let about = fs::read_to_string(other.path().join("anna-07/trial.toml")).unwrap();
    let about = about.replace("oak", "far").replace("trial = 1", "trial = 7");
    fs::write(other.path().join("anna-07/trial.toml"), about).unwrap();
    let all = ["ash/1", "far/7", "oak/1", "oak/2"];
    assert_eq!(held(root, &scene), all);
    let moved = Editor::open(root, &scene).unwrap().move_to(&["oak".into(), "far".into()], "elm");
    if let Err(error) = moved {
        assert!(error.to_string().contains("another disk"), "{error}");
        assert_eq!(
            (held(root, &scene), last_step(root).unwrap()),
            (all.map(String::from).into(), None)
        );
    }
}

#[test]
fn removed_trials_have_the_sources_of_their_library_and_a_damaged_one_hides_no_other() {
    let (dir, scene) = library();
    let root = dir.path();
    fs::write(
        root.join("library.toml"),
        "format = 1\n[sources.pac]\ndomain = \"time\"\nchannels = 1\nrate_hz = 10000\n",
    )
    .unwrap();
    fs::rename(root.join("ash/anna-01/ir.wav"), root.join("ash/anna-01/pac.wav")).unwrap();
    let mut edit = Editor::open(root, &scene).unwrap();
    edit.remove(&["ash".into(), "oak/anna-01".into()]).unwrap();
    fs::write(root.join(".removed/oak/anna-01/trial.toml"), "what is this").unwrap();
    let gone = list_removed(root, &scene).unwrap();
    let names_of: Vec<_> =
        gone.iter().map(|gone| (gone.trial.as_str(), gone.sources.len())).collect();
    assert_eq!(names_of, [("ash/anna-01", 1), ("oak/anna-01", 0)]);
    edit.restore(&["ash".into(), "oak/anna-01".into()]).unwrap();
    assert!(root.join("ash/anna-01/pac.wav").exists() && root.join("oak/anna-01/ir.wav").exists());
}

#[test]
fn a_trial_that_is_a_relative_link_still_leads_where_it_did() {
    let (dir, scene) = library();
    let (root, elsewhere) = (dir.path().join("library"), dir.path().join("elsewhere"));
    fs::create_dir_all(root.join("oak")).unwrap();
    copy_trial(&dir.path().join("oak/anna-01"), &elsewhere);
    std::os::unix::fs::symlink("../../elsewhere", root.join("oak/anna-01")).unwrap();
    let mut edit = Editor::open(&root, &scene).unwrap();
    edit.remove(&one("oak/anna-01")).unwrap();
    assert!(root.join(".removed/oak/anna-01/ir.wav").exists());
    let error = edit.restore(&one("oak")).and_then(|_| edit.rename("oak", "ash")).unwrap_err();
    assert!(error.to_string().contains("it is a link"), "{error}");
    assert_eq!(fs::read_link(root.join("oak/anna-01")).unwrap(), Path::new("../../elsewhere"));
}

#[test]
fn a_label_that_means_something_else_leaves_the_library_readable() {
    let (dir, scene) = library();
    let root = dir.path();
    for label in [
        "library.toml",
        "SoundScans",
        "DataLMT108",
        "Library",
        "TestingSet",
        "AccelScansComponents",
    ] {
        Editor::open(root, &scene).unwrap().move_to(&one("ash"), label).unwrap();
        let opened = surfaced::dataset::open(root, &scene).unwrap();
        assert!(opened.surfaces().contains(&label), "{label}: {:?}", opened.surfaces());
        Editor::open(root, &scene).unwrap().undo().unwrap();
        // A folder with such a name, written by an earlier version, can be read.
        if label != "library.toml" {
            fs::rename(root.join("ash"), root.join(label)).unwrap();
            assert_eq!(surfaced::dataset::open(root, &scene).unwrap().entries.len(), 3, "{label}");
            fs::rename(root.join(label), root.join("ash")).unwrap();
        }
    }
}
