use std::fs;

use super::edited::{copy_trial, held, library, one};
use super::*;

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
fn a_letter_is_the_same_in_both_of_its_forms() {
    let (dir, scene) = library();
    let root = dir.path();
    let mut edit = Editor::open(root, &scene).unwrap();
    edit.rename("ash", "e\u{301}rable").unwrap();
    edit.rename("oak", "\u{e9}rable").unwrap();
    let surfaces: BTreeSet<_> =
        trials(root, &scene).unwrap().into_iter().map(|entry| entry.key.surface).collect();
    assert_eq!(surfaces, BTreeSet::from(["\u{e9}rable".to_string()]));
}
