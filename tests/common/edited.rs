//! A small library to edit, and what it then holds.

use std::fs;
use std::path::Path;

use surfaced::record::edit::{ListedTrial, list};
use surfaced::record::{TrialOptions, write_trial};
use surfaced::scene::{Scene, SourceId};
use surfaced::trial::{Series, Signal, Trial, TrialKey};

pub fn library() -> (tempfile::TempDir, Scene) {
    let (dir, scene) = (tempfile::tempdir().unwrap(), Scene::lmt108());
    for (surface, number) in [("oak", 1), ("oak", 2), ("ash", 1)] {
        let first = u32::from(surface.as_bytes()[0]);
        let samples = (0..200).map(|i| (i * number + first) as f32 / 128.0).collect();
        let series = Signal::Series(Series::new(10_000.0, 1, samples).unwrap());
        let signals = [(SourceId::new("ir").unwrap(), series)].into();
        let trial = Trial { key: TrialKey::new(surface, "anna", number), signals };
        write_trial(dir.path(), &trial, &scene, &TrialOptions::default()).unwrap();
    }
    (dir, scene)
}

pub fn held(root: &Path, scene: &Scene) -> Vec<String> {
    let name = |e: &ListedTrial| format!("{}/{}", e.key.surface, e.key.number);
    list(root, scene).unwrap().iter().map(name).collect()
}

/// A list of one name, of a trial or a surface, as edits expect it.
pub fn one(name: &str) -> [String; 1] {
    [name.to_string()]
}

pub fn copy_trial(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for file in ["ir.wav", "trial.toml"] {
        fs::copy(from.join(file), to.join(file)).unwrap();
    }
}
