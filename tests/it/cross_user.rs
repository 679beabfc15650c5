//! Scans by other people than the library's, on the real recordings across users; skipped, with a
//! word, where these are absent.

use crate::common::shared;
use surfaced::dataset;
use surfaced::evaluate::{self, Evaluation, Fold, Prediction, Protocol};
use surfaced::library::Entry;
use surfaced::recognise::{Embedding, EmbeddingOptions};
use surfaced::scene::{Scene, SourceId};
use surfaced::trial::EXPERT;

/// Queries of a test, at most.
const QUERIES: usize = 150;

/// The answers to all queries of some folds, whose libraries are prepared once.
fn predictions(scene: &Scene, entries: &[Entry], folds: &[Fold]) -> Vec<Prediction> {
    let method = Embedding::new(scene.clone(), EmbeddingOptions::default());
    let run = Evaluation::new(scene, entries, folds).prepare(&method).unwrap();
    run.measure().unwrap().predictions
}

/// Share of queries named right.
fn share(predictions: &[Prediction]) -> f64 {
    let right = predictions.iter().filter(|prediction| prediction.is_correct()).count();
    right as f64 / predictions.len() as f64
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
        let fold = &folds[0];
        // The scene also describes sources that these recordings lack.
        let mut sources: Vec<SourceId> = scene.sources().map(|spec| spec.id.clone()).collect();
        sources.retain(|id| entries.iter().any(|entry| entry.sources.contains(id)));
        // Every query once more for each source that it lacks, all named by one model.
        let (mut both, mut lacking) = (entries.clone(), Vec::new());
        for dropped in &sources {
            for &query in &fold.queries {
                let dropped = dropped.clone();
                lacking.push(both.len());
                both.push(entries[query].clone().changed(move |mut trial| {
                    trial.signals.remove(&dropped);
                    trial
                }));
            }
        }
        let named = predictions(&scene, &both, &[Fold { queries: lacking, ..fold.clone() }]);
        assert_eq!(named.len(), sources.len() * fold.queries.len());
        for (dropped, named) in sources.iter().zip(named.chunks(fold.queries.len())) {
            let others: Vec<SourceId> =
                sources.iter().filter(|id| *id != dropped).cloned().collect();
            let fewer = scene.clone().only(&others).unwrap();
            let never_had = share(&predictions(&fewer, &entries, &folds));
            let dropped_from_queries = share(named);
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
    let least = [
        ("boreal", [(Protocol::ExpertVsUsers, 0.72), (Protocol::AllVsOneUser, 0.82)]),
        ("fabric", [(Protocol::ExpertVsUsers, 0.74), (Protocol::AllVsOneUser, 0.95)]),
    ];
    for (set, protocols) in least {
        let Some(path) = shared(&format!("data/cross_user/{set}")) else { return };
        let library = dataset::open(&path, &Scene::lmt108()).unwrap();
        // The limits are for the others as queries, by the expert and by everybody else.
        let others = |protocol| {
            let folds = folds(&library.entries, protocol).into_iter();
            folds.filter(|fold| fold.name != EXPERT).collect::<Vec<_>>()
        };
        let of = protocols.map(|(protocol, _)| others(protocol));
        let named = predictions(&library.scene, &library.entries, &of.concat());
        for ((protocol, least), from_fold) in protocols.into_iter().zip([0, of[0].len()]) {
            let folds = from_fold..from_fold + of[usize::from(from_fold > 0)].len();
            let named: Vec<Prediction> =
                named.iter().filter(|p| folds.contains(&p.fold)).cloned().collect();
            let share = share(&named);
            println!("{set} {}: {share:.3}", protocol.name());
            assert!(share >= least, "{set} {}: {share}", protocol.name());
        }
    }
}
