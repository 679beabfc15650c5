use super::*;
use crate::record::{TrialOptions, write_trial};
use crate::scene::SourceId;
use crate::trial::{Series, Signal, Trial};

fn library() -> (tempfile::TempDir, Scene) {
    let (dir, scene) = (tempfile::tempdir().unwrap(), Scene::lmt108());
    for (surface, number) in [("oak", 1), ("oak", 2), ("ash", 1)] {
        let samples = (0..200).map(|i| (i * number) as f32 / 128.0).collect();
        let series = Signal::Series(Series::new(10_000.0, 1, samples).unwrap());
        let signals = [(SourceId::new("ir").unwrap(), series)].into();
        let trial = Trial { key: TrialKey::new(surface, "anna", number), signals };
        write_trial(dir.path(), &trial, &scene, &TrialOptions::default()).unwrap();
    }
    (dir, scene)
}

fn held(root: &Path, scene: &Scene) -> Vec<String> {
    let name = |e: &Entry| format!("{}/{}", e.key.surface, e.key.number);
    trials(root, scene).unwrap().iter().map(name).collect()
}

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
fn files_without_trial_folders_are_listed_and_not_edited() {
    let (dir, scene) = library();
    let root = dir.path();
    fs::rename(root.join("ash/anna-01/ir.wav"), root.join("ash/ir_7.wav")).unwrap();
    fs::remove_dir_all(root.join("ash/anna-01")).unwrap();
    let listed = list(root, &scene).unwrap();
    let names: Vec<_> = listed.iter().map(|one| one.trial.as_str()).collect();
    assert_eq!(names, ["ash/7", "oak/anna-01", "oak/anna-02"]);
    let edit = Editor::open(root, &scene).unwrap();
    let names = |name: &str| [name.to_string()];
    for refused in [edit.rename("ash", "elm"), edit.move_to(&names("ash/7"), "elm")] {
        assert!(refused.unwrap_err().to_string().contains("no folder of their own"));
    }
    assert!(edit.remove(&names("ash")).is_err() && edit.undo().is_err(), "nothing has changed");
}
