//! A trained model that is kept beside its library: it answers as a new one does, and is used only
//! where nothing has changed.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::common::id;
use assert_cmd::Command;
use surfaced::dataset;
use surfaced::library::Entry;
use surfaced::recognise::{
    EmbeddingOptions, FollowOptions, FreshFrames, LOOK_S, Method, MethodSpec, Model, ReadyModel,
    prepare_library, ready_model,
};
use surfaced::scene::Scene;
use surfaced::trial::{Signal, Trial};

const CACHE: &str = ".embedding-model.surfaced-cache";

/// A library of three surfaces on disk, three trials of each, and the trial of somebody else.
fn on_disk(dir: &Path) -> (PathBuf, Trial) {
    let data = dir.join("library");
    let size = ["--surfaces", "3", "--trials", "3", "--users", "1"];
    Command::cargo_bin("surfaced").unwrap().arg("synth").arg(&data).args(size).assert().success();
    let library = dataset::open(&data, &Scene::lmt108()).unwrap();
    let foreign = library.entries.iter().find(|entry| entry.key.user != "expert").unwrap();
    (data, foreign.load().unwrap())
}

/// The method, the trials, and which of them are the expert's, for these sources or all.
fn parts(
    folder: &Path,
    sources: Option<&[&str]>,
    seed: u64,
) -> (Box<dyn Method>, Vec<Entry>, BTreeSet<usize>) {
    let library = dataset::open(folder, &Scene::lmt108()).unwrap();
    let scene = match sources {
        Some(names) => library.scene.clone().only(&names.iter().map(|n| id(n)).collect::<Vec<_>>()),
        None => Ok(library.scene.clone()),
    };
    let scene = scene.unwrap();
    let entries: Vec<_> =
        library.entries.iter().map(|entry| entry.clone().within(&scene)).collect();
    let experts: BTreeSet<usize> =
        (0..entries.len()).filter(|&i| entries[i].key.user == "expert").collect();
    let method = MethodSpec::Embedding(EmbeddingOptions { seed }).build(&scene);
    (method, entries, experts)
}

/// A model of the expert's trials, by these sources or all, and whether it came from the cache.
fn ready(folder: &Path, sources: Option<&[&str]>, seed: u64) -> ReadyModel {
    let (method, entries, experts) = parts(folder, sources, seed);
    ready_model(&*method, &entries, &experts, Some(folder), &|_, _| ()).unwrap()
}

/// All that a model says of a scan, and of its library.
fn said(ready: ReadyModel, scan: &Trial) -> String {
    let model = ready.model;
    let embedding = model.clone().embedding().unwrap();
    let rejection = embedding.rejection(Some(0.2));
    let mut said = format!("{rejection:?} {:?}", embedding.left_out_accuracy());
    let entry = Entry::in_memory(scan.clone());
    let query = model.prepare(&entry, scan).unwrap();
    said += &format!("{:?} {:?}", model.rank(&query), model.explain(&query));
    let fewer = Trial {
        signals: scan.signals.iter().filter(|(id, _)| id.as_str() != "mi2").map(owned).collect(),
        ..scan.clone()
    };
    said += &format!("{:?}", model.rank_trial(fewer));
    for loss in [0.01, 0.2] {
        let options = FollowOptions { loss, rejection: rejection.clone().ok() };
        let mut follower = embedding.clone().follow(&options);
        said += &format!("{:?}", follower.settling());
        follower.begin();
        for (source, signal) in &scan.signals {
            if let Signal::Series(series) = signal {
                let (rate_hz, channels) = (series.rate_hz(), series.channels());
                let samples = series.samples();
                follower.add(FreshFrames { source, rate_hz, channels, samples }).unwrap();
            }
        }
        said += &format!("{:?}", follower.look(5.0 * LOOK_S));
    }
    said
}

fn owned<K: Clone, V: Clone>((key, value): (&K, &V)) -> (K, V) {
    (key.clone(), value.clone())
}

#[test]
fn a_kept_model_says_what_a_new_one_says() {
    let dir = tempfile::tempdir().unwrap();
    let (folder, scan) = on_disk(dir.path());
    let anew = ready(&folder, None, 1);
    let kept = ready(&folder, None, 1);
    assert!(!anew.from_cache && kept.from_cache);
    assert_eq!((anew.remarks.len(), kept.remarks.len()), (0, 0));
    // This model has not measured beginnings before it is asked about one.
    let (method, entries, experts) = parts(&folder, None, 1);
    let library = prepare_library(&*method, &entries, &experts, None, &|_, _| ()).unwrap();
    let fitted = library.fit(&*method, &experts).unwrap();
    let beginning = scan.clone().first_seconds(0.5, |_| true);
    let of_beginning =
        |model: &Arc<dyn Model>| format!("{:?}", model.rank_trial(beginning.clone()));
    assert_eq!(of_beginning(&fitted), of_beginning(&kept.model));
    assert_eq!(said(anew, &scan), said(kept, &scan));
}

#[test]
fn a_model_is_trained_anew_where_anything_has_changed() {
    let dir = tempfile::tempdir().unwrap();
    let (folder, _) = on_disk(dir.path());
    let is_kept = |sources: Option<&[&str]>, seed| ready(&folder, sources, seed).from_cache;
    assert!(!is_kept(None, 1) && is_kept(None, 1));
    assert!(!is_kept(None, 2) && is_kept(None, 2), "another seed");
    assert!(!is_kept(Some(&["mi2", "fr"]), 2) && is_kept(Some(&["mi2", "fr"]), 2), "fewer sources");
    // The file of a trial is written anew.
    let of_trial = |entry: &Entry| entry.places()[0].join("mi2.wav");
    let library = dataset::open(&folder, &Scene::lmt108()).unwrap();
    let experts: Vec<_> = library.entries.iter().filter(|e| e.key.user == "expert").collect();
    let path = of_trial(experts[0]);
    assert!(!is_kept(None, 1) && is_kept(None, 1));
    fs::write(&path, fs::read(&path).unwrap()).unwrap();
    assert!(!is_kept(None, 1) && is_kept(None, 1), "a file has changed");
    // A trial goes.
    fs::remove_dir_all(experts[1].places()[0]).unwrap();
    assert!(!is_kept(None, 1) && is_kept(None, 1), "a trial is gone");
}

#[test]
fn a_damaged_file_costs_time_and_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let (folder, scan) = on_disk(dir.path());
    let expected = said(ready(&folder, None, 1), &scan);
    let good = fs::read(folder.join(CACHE)).unwrap();
    for at in [0, 15, 20, 40, good.len() / 2, good.len() - 2] {
        let mut bytes = good.clone();
        bytes[at] ^= 0x55;
        fs::write(folder.join(CACHE), &bytes).unwrap();
        let ready = ready(&folder, None, 1);
        assert!(!ready.from_cache, "byte {at}");
        assert_eq!(said(ready, &scan), expected, "byte {at}");
        fs::write(folder.join(CACHE), &good[..at]).unwrap();
        assert!(!self::ready(&folder, None, 1).from_cache, "cut at {at}");
    }
    // A folder that cannot be written to.
    fs::remove_file(folder.join(CACHE)).unwrap();
    fs::create_dir(folder.join(CACHE)).unwrap();
    let ready = ready(&folder, None, 1);
    assert!(!ready.from_cache && ready.remarks[0].contains("not kept"), "{:?}", ready.remarks);
}

#[test]
fn a_trial_that_changes_while_it_is_prepared_is_not_kept_as_it_was() {
    let dir = tempfile::tempdir().unwrap();
    let (folder, scan) = on_disk(dir.path());
    let library = dataset::open(&folder, &Scene::lmt108()).unwrap();
    let wanted: BTreeSet<usize> = (0..library.entries.len()).collect();
    let method = MethodSpec::Embedding(EmbeddingOptions { seed: 1 }).build(&library.scene);
    let [first, last] =
        [0, library.entries.len() - 1].map(|at| library.entries[at].places()[0].join("mi2.wav"));
    // As soon as a trial is read, the files of all change places.
    let swap = |_, _| {
        if !folder.join("swapped").exists() {
            fs::write(folder.join("swapped"), "").unwrap();
            let (a, b) = (fs::read(&first).unwrap(), fs::read(&last).unwrap());
            fs::write(&first, b).unwrap();
            fs::write(&last, a).unwrap();
        }
    };
    let torn = ready_model(&*method, &library.entries, &wanted, Some(&folder), &swap).unwrap();
    assert!(!torn.from_cache);
    let ready = |beside: Option<&Path>| {
        let library = dataset::open(&folder, &Scene::lmt108()).unwrap();
        ready_model(&*method, &library.entries, &wanted, beside, &|_, _| ()).unwrap()
    };
    let kept = ready(Some(&folder));
    assert!(!kept.from_cache);
    assert_eq!(said(kept, &scan), said(ready(None), &scan));
}
