//! Scans by other people than the library's, on the real recordings across users; skipped, with a
//! word, where these are absent.

use crate::common::shared;
use surfaced::dataset;
use surfaced::evaluate::{self, Evaluation, Fold, Protocol};
use surfaced::library::Entry;
use surfaced::recognise::{Embedding, EmbeddingOptions};
use surfaced::scene::{Scene, SourceId};

/// Queries of a test, at most.
const QUERIES: usize = 150;

/// Share of queries named right.
fn accuracy(scene: &Scene, entries: &[Entry], folds: &[Fold]) -> f64 {
    let method = Embedding::new(scene.clone(), EmbeddingOptions::default());
    let run = Evaluation::new(scene, entries, folds).prepare(&method).unwrap();
    let outcome = run.measure().unwrap().outcome;
    outcome.right() as f64 / outcome.queries as f64
}

/// Folds with a part of their queries, [`QUERIES`] in all or fewer, evenly spread.
fn folds(entries: &[Entry], protocol: Protocol) -> Vec<Fold> {
    let keys: Vec<_> = entries.iter().map(|entry| entry.key.clone()).collect();
    let mut folds = evaluate::folds(protocol, &keys).unwrap();
    let all: usize = folds.iter().map(|fold| fold.queries.len()).sum();
    let step = all.div_ceil(QUERIES);
    folds
        .iter_mut()
        .for_each(|fold| fold.queries = fold.queries.iter().step_by(step).copied().collect());
    folds
}

#[test]
fn a_query_that_lacks_a_source_is_named_as_by_a_library_that_lacks_it() {
    for set in ["boreal", "fabric"] {
        let Some(path) = shared(&format!("data/cross_user/{set}")) else { return };
        let library = dataset::open(&path, &Scene::lmt108()).unwrap();
        let (scene, entries) = (library.scene, library.entries);
        let mut folds = folds(&entries, Protocol::ExpertVsUsers);
        // All have the expert's library: one is as good as another.
        folds.truncate(1);
        let sources: Vec<SourceId> = scene.sources().map(|spec| spec.id.clone()).collect();
        for dropped in &sources {
            let others: Vec<SourceId> =
                sources.iter().filter(|id| *id != dropped).cloned().collect();
            let without = |entry: &Entry| {
                let dropped = dropped.clone();
                entry.clone().changed(move |mut trial| {
                    trial.signals.remove(&dropped);
                    trial
                })
            };
            let both: Vec<Entry> =
                entries.iter().cloned().chain(entries.iter().map(without)).collect();
            let lacking = |fold: &Fold| Fold {
                queries: fold.queries.iter().map(|query| query + entries.len()).collect(),
                ..fold.clone()
            };
            let lacking: Vec<Fold> = folds.iter().map(lacking).collect();
            let dropped_from_queries = accuracy(&scene, &both, &lacking);
            let fewer = scene.clone().only(&others).unwrap();
            let never_had = accuracy(&fewer, &entries, &folds);
            println!(
                "{set} without {dropped}: {dropped_from_queries:.3}, trained so: {never_had:.3}"
            );
            assert!(
                dropped_from_queries >= never_had - 0.02,
                "{set} without {dropped}: {dropped_from_queries} against {never_had}"
            );
        }
    }
}

#[test]
fn other_people_are_named_far_more_often_than_by_chance() {
    for (set, protocol, least) in [
        ("boreal", Protocol::ExpertVsUsers, 0.72),
        ("boreal", Protocol::AllVsOneUser, 0.82),
        ("fabric", Protocol::ExpertVsUsers, 0.74),
        ("fabric", Protocol::AllVsOneUser, 0.95),
    ] {
        let Some(path) = shared(&format!("data/cross_user/{set}")) else { return };
        let library = dataset::open(&path, &Scene::lmt108()).unwrap();
        let folds = folds(&library.entries, protocol);
        let share = accuracy(&library.scene, &library.entries, &folds);
        println!("{set} {}: {share:.3}", protocol.name());
        assert!(share >= least, "{set} {}: {share}", protocol.name());
    }
}
