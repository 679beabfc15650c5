//! Tests of edits, and tests that kill an edit, or let the disk refuse a change, at each change on disk
//! in turn.
//!
//! A killed program makes no further changes. So it leaves the same files as a program that still
//! runs, but whose changes the disk refuses from that moment on.

use std::fs;

use super::disk::stops::refusing;
use super::edited::{copy_trial, held, library, one};
use super::*;
use crate::library::About;

#[test]
fn a_trial_that_undo_put_elsewhere_is_found_there_by_the_next_undo() {
    let (dir, scene) = library();
    let root = dir.path();
    let mut edit = Editor::open(root, &scene).unwrap();
    edit.move_to(&one("oak/anna-02"), "elm").unwrap();
    edit.remove(&one("elm/anna-02")).unwrap();
    let there = identity(&root.join(".removed/elm/anna-02"));
    copy_trial(&root.join(".removed/elm/anna-02"), &root.join("elm/anna-02"));
    assert_eq!(edit.undo().unwrap().moves[0].to, "elm/anna-03");
    drop(edit);
    let mut edit = Editor::open(root, &scene).unwrap();
    assert_eq!(edit.undo().unwrap().moves[0].to, "oak/anna-02");
    assert_eq!(identity(&root.join("oak/anna-02")), there);
    assert_eq!(held(root, &scene), ["ash/1", "elm/2", "oak/1", "oak/2"]);
}

#[test]
fn a_number_of_a_removed_trial_is_not_given_out_again() {
    let (dir, scene) = library();
    let root = dir.path();
    let mut edit = Editor::open(root, &scene).unwrap();
    edit.remove(&one("oak/anna-02")).unwrap();
    let of = ("oak".to_string(), "anna".to_string());
    assert_eq!(numbers_after(root, &scene).unwrap()[&of], 3);
    assert_eq!(crate::record::number_by_names(root, "oak"), 3);
    // A trial that moves to this surface does not get the removed trial's number.
    edit.move_to(&one("ash"), "oak").unwrap();
    assert_eq!(held(root, &scene), ["oak/1", "oak/3"]);
    (0..2).for_each(|_| drop(edit.undo().unwrap()));
    assert_eq!(held(root, &scene), ["ash/1", "oak/1", "oak/2"]);
}

#[test]
fn a_list_of_steps_leads_nowhere_else() {
    let (dir, scene) = library();
    let root = dir.path().join("library");
    fs::create_dir_all(root.join(".removed")).unwrap();
    let victim = dir.path().join("oak/anna-01").to_str().unwrap().to_string();
    for from in ["../oak/anna-01", &victim, "oak/../../oak", ".removed/../../oak/anna-01"] {
        let steps = format!(
            "{{\"what\":\"x\",\"at\":\"\",\"moves\":[{{\"from\":\"ash/x-1\",\"to\":\"{from}\",\"was\":null,\"is\":null}}]}}\n"
        );
        fs::write(root.join(".removed").join(steps::STEPS), steps).unwrap();
        let error = Editor::open(&root, &scene).unwrap().undo().unwrap_err().to_string();
        assert!(error.contains("no step to undo"), "{from}: {error}");
    }
    assert!(dir.path().join("oak/anna-01/ir.wav").exists());
}

#[test]
fn steps_of_version_0_2_are_known_and_many_are_halved() {
    let (dir, scene) = library();
    let root = dir.path();
    let mut edit = Editor::open(root, &scene).unwrap();
    edit.rename("oak", "elm").unwrap();
    drop(edit);
    let path = root.join(".removed").join(steps::STEPS);
    let step = serde_json::to_string(&last_step(root).unwrap().unwrap()).unwrap();
    fs::write(&path, (step + "\n").repeat(1000) + "{\"began\":{\"wh").unwrap();
    let mut edit = Editor::open(root, &scene).unwrap();
    edit.rename("ash", "yew").unwrap();
    drop(edit);
    assert_eq!(steps::read(root).unwrap().0.len(), 501);
    let mut edit = Editor::open(root, &scene).unwrap();
    (0..2).for_each(|_| drop(edit.undo().unwrap()));
    assert_eq!(held(root, &scene), ["ash/1", "oak/1", "oak/2"]);
}

#[test]
fn a_session_is_set_in_place_and_edits_keep_it_and_keys_of_ones_own() {
    let (dir, scene) = library();
    let root = dir.path();
    let path = root.join("oak/anna-01/trial.toml");
    let text = fs::read_to_string(&path).unwrap();
    let meta = "[meta]\nforce_n = 1.5\ntool = \"steel\"\nwet = true\n";
    fs::write(&path, text + meta).unwrap();
    let mut edit = Editor::open(root, &scene).unwrap();
    let about = |name: &str| About::read(&root.join(name)).unwrap();
    let step = edit.set_session(&one("oak/anna-01"), Some("monday")).unwrap();
    assert_eq!((&*step.moves[0].from, &*step.moves[0].to), ("oak/anna-01", "oak/anna-01"));
    assert_eq!(about("oak/anna-01").session.as_deref(), Some("monday"));
    assert_eq!(about("oak/anna-02").session, None);
    // A session that a trial already has makes no step.
    assert!(edit.set_session(&one("oak/anna-01"), Some("monday")).unwrap().moves.is_empty());
    edit.rename("oak", "elm").unwrap();
    let moved = about("elm/anna-01");
    assert_eq!(moved.session.as_deref(), Some("monday"));
    assert_eq!(format!("[meta]\n{}", toml::to_string(&moved.meta).unwrap()), meta);
    (0..2).for_each(|_| drop(edit.undo().unwrap()));
    assert_eq!(about("oak/anna-01").session, None);
    assert_eq!(held(root, &scene), ["ash/1", "oak/1", "oak/2"]);
}

#[test]
fn a_trial_without_a_folder_gets_no_session() {
    let (dir, scene) = library();
    let root = dir.path();
    fs::create_dir(root.join("elm")).unwrap();
    fs::copy(root.join("oak/anna-01/ir.wav"), root.join("elm/scan 1.wav")).unwrap();
    let mut edit = Editor::open(root, &scene).unwrap();
    let error = edit.set_session(&one("elm"), Some("monday")).unwrap_err().to_string();
    assert!(error.contains("no trial.toml"), "{error}");
    assert_eq!(last_step(root).unwrap(), None);
}

#[test]
fn a_letter_is_the_same_in_both_of_its_forms() {
    let (dir, scene) = library();
    let root = dir.path();
    let mut edit = Editor::open(root, &scene).unwrap();
    edit.rename("ash", "e\u{301}rable").unwrap();
    edit.rename("oak", "\u{e9}rable").unwrap();
    let surfaces: BTreeSet<_> =
        trials(root, &scene).unwrap().into_iter().map(|entry| entry.key.surface).collect();
    assert_eq!(surfaces, BTreeSet::from(["\u{e9}rable".to_string()]));
    assert_eq!(edit.rename("e\u{301}rable", "elm").unwrap().moves.len(), 3);
}

#[cfg(target_os = "linux")]
#[test]
fn a_library_that_cannot_be_locked_costs_no_patience() {
    use std::os::unix::fs::OpenOptionsExt;

    let (dir, _) = library();
    // A handle by `O_PATH` has no locks, as on a file system without them.
    let open = fs::OpenOptions::new().read(true).custom_flags(libc::O_PATH).open(dir.path());
    for patience in [None, Some(PATIENCE)] {
        let waited = wait(open.as_ref().unwrap(), dir.path(), patience);
        assert!(matches!(waited, Err(TryLockError::Error(_))), "{waited:?}");
    }
}

/// Maps the data of each trial, present or removed, to the trial's name.
fn state(root: &Path, scene: &Scene) -> BTreeMap<Vec<u8>, String> {
    let mut state = BTreeMap::new();
    let of = |entries: Vec<Entry>, place: &str| -> Vec<_> {
        let one = |entry: &Entry| {
            let bytes = fs::read(entry.places()[0].join("ir.wav")).unwrap();
            (bytes, format!("{place}{}", entry.key))
        };
        entries.iter().map(one).collect()
    };
    for (bytes, name) in
        [of(trials(root, scene).unwrap(), ""), of(removed(root, scene).unwrap(), "removed ")]
            .concat()
    {
        assert_eq!(state.insert(bytes, name), None, "a trial is there twice");
    }
    state
}

fn scratch() -> tempfile::TempDir {
    tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).unwrap()
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for item in fs::read_dir(from).unwrap().flatten() {
        match item.path().is_dir() {
            true => copy(&item.path(), &to.join(item.file_name())),
            false => drop(fs::copy(item.path(), to.join(item.file_name())).unwrap()),
        }
    }
}

type Edit = fn(&mut Editor) -> Result<Step, LibraryError>;

/// The test cases: name, edits that prepare the library, and the edit that is cut short.
const EDITS: [(&str, &[Edit], Edit); 11] = [
    ("rename", &[], |e| e.rename("oak", "ash")),
    ("move", &[], |e| e.move_to(&["oak/anna-02".into(), "ash".into()], "elm")),
    ("move all", &[], |e| e.move_to(&["oak".into(), "ash".into()], "elm")),
    ("undo a move", &[|e| e.move_to(&["oak".into(), "ash".into()], "elm")], Editor::undo),
    ("session", &[], |e| e.set_session(&one("oak"), Some("monday"))),
    (
        "undo a session",
        &[
            |e| e.set_session(&one("oak"), Some("monday")),
            |e| e.set_session(&one("oak/anna-02"), None),
        ],
        Editor::undo,
    ),
    ("remove", &[], |e| e.remove(&one("oak"))),
    ("restore", &[|e| e.remove(&one("oak"))], |e| e.restore(&one("oak"))),
    ("undo a rename", &[|e| e.rename("oak", "ash")], Editor::undo),
    ("undo a removal", &[|e| e.remove(&one("oak"))], Editor::undo),
    (
        "undo a restoring",
        &[|e| e.remove(&one("oak")), |e| e.restore(&one("oak/anna-01"))],
        Editor::undo,
    ),
];

/// A library after the edits that prepare a test case, and its number of steps.
struct Before {
    dir: tempfile::TempDir,
    scene: Scene,
    steps: usize,
}

impl Before {
    fn new(prepare: &[Edit]) -> Self {
        let (dir, scene) = library();
        let mut editor = Editor::open(dir.path(), &scene).unwrap();
        prepare.iter().for_each(|edit| drop(edit(&mut editor).unwrap()));
        drop(editor);
        let steps = steps::read(dir.path()).unwrap().0.len();
        Self { dir, scene, steps }
    }

    fn again(&self) -> tempfile::TempDir {
        let dir = scratch();
        copy(self.dir.path(), dir.path());
        dir
    }

    /// Opens a library after an interrupted edit. Trials and steps must be as before the edit or as
    /// `after` it, and undoing all steps must lead back to the beginning.
    fn check(&self, root: &Path, after: &BTreeMap<Vec<u8>, String>, at: &str) {
        let before = state(self.dir.path(), &self.scene);
        drop(LibraryLock::for_reading(root));
        let found = state(root, &self.scene);
        assert!(found == before || found == *after, "{at}: {found:?}");
        let (steps, _) = steps::read(root).unwrap();
        assert!(steps.iter().all(|step| step.left().is_none()), "{at}");
        assert_eq!(steps.len() == self.steps, found == before, "{at}: {}", steps.len());
        for _ in 0..steps.len() {
            Editor::open(root, &self.scene).unwrap().undo().unwrap();
        }
        assert_eq!(held(root, &self.scene), ["ash/1", "oak/1", "oak/2"], "{at}");
        for surface in ["oak", "ash"] {
            let left = fs::read_dir(root.join(surface)).unwrap().flatten();
            assert!(left.into_iter().all(|item| item.path().is_dir()), "{at}");
        }
    }
}

#[test]
fn an_edit_that_is_killed_at_any_change_is_finished_or_taken_back_by_the_next_opening() {
    let mut kills = 0;
    for (what, prepare, edit) in EDITS {
        let before = Before::new(prepare);
        let done = before.again();
        edit(&mut Editor::open(done.path(), &before.scene).unwrap()).unwrap();
        let after = state(done.path(), &before.scene);
        for first in 0.. {
            let dir = before.again();
            let open = || Editor::open(dir.path(), &before.scene);
            let (_, reached) = refusing(first..u32::MAX, || edit(&mut open()?));
            if !reached {
                break;
            }
            kills += 1;
            let cut_short = scratch();
            copy(dir.path(), cut_short.path());
            before.check(dir.path(), &after, &format!("{what}, killed at {first}"));
            // The next opening repairs the library. This kills the repair, too.
            for second in 0.. {
                let dir = scratch();
                copy(cut_short.path(), dir.path());
                let open = || drop(LibraryLock::for_reading(dir.path()));
                if !refusing(second..u32::MAX, open).1 {
                    break;
                }
                kills += 1;
                let at = format!("{what}, killed at {first}, and again at {second}");
                before.check(dir.path(), &after, &at);
            }
        }
    }
    assert!(kills >= 1000, "{kills} kills");
    eprintln!("{kills} kills");
}

#[test]
fn an_edit_of_which_the_disk_refuses_any_one_change_changes_nothing() {
    for (what, prepare, edit) in EDITS {
        let before = Before::new(prepare);
        let is_before =
            |root: &Path| state(root, &before.scene) == state(before.dir.path(), &before.scene);
        let done = before.again();
        edit(&mut Editor::open(done.path(), &before.scene).unwrap()).unwrap();
        let after = state(done.path(), &before.scene);
        for change in 0.. {
            let dir = before.again();
            let work = || edit(&mut Editor::open(dir.path(), &before.scene)?);
            let (result, reached) = refusing(change..change + 1, work);
            if !reached {
                break;
            }
            let at = format!("{what}, refused at {change}: {result:?}");
            assert_eq!(result.is_err(), is_before(dir.path()), "{at}");
            before.check(dir.path(), &after, &at);
        }
    }
}
