//! Runs a method over the folds of a protocol.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use super::outcome::{Outcome, Prediction};
use super::{EvaluateError, Fold};
use crate::library::Entry;
use crate::recognise::features::FeatureVector;
use crate::recognise::{
    LibraryShape, Method, Model, Prepared, PreparedLibrary, Ranking, RecogniseError,
    prepare_library,
};
use crate::scene::{Phase, Scene};
use crate::trial::TrialKey;

/// Told after each step: what is being done, how much is done, how much there is to do.
pub type Progress<'a> = &'a (dyn Fn(&'static str, usize, usize) + Sync);

const PREPARING: &str = "preparing the library";

/// Names every query of every fold.
///
/// Library trials are prepared once and shared by the folds. Queries are named one after the
/// other, so that the latencies are those of a single query with the machine to itself: from its
/// raw samples in memory to the answer. `as_query` turns an entry into a query (cut short, say);
/// the library keeps it as it is.
///
/// # Errors
/// If a trial cannot be read or compared.
pub fn run(
    method: &dyn Method,
    entries: &[Entry],
    folds: &[Fold],
    as_query: impl Fn(&Entry) -> Entry,
    progress: Progress<'_>,
) -> Result<(Outcome, Vec<Prediction>), EvaluateError> {
    let prepared = prepare_folds(method, entries, folds, None, progress)?;
    run_prepared(method, entries, folds, &prepared, as_query, progress)
}

/// Prepares the libraries of all folds, each trial once. `beside` is the folder of the data, where
/// prepared trials are kept; without it none are.
///
/// # Errors
/// If a trial cannot be read or does not fit the scene.
pub fn prepare_folds(
    method: &dyn Method,
    entries: &[Entry],
    folds: &[Fold],
    beside: Option<&Path>,
    progress: Progress<'_>,
) -> Result<PreparedLibrary, RecogniseError> {
    let told = |done, of| progress(PREPARING, done, of);
    prepare_library(method, entries, &in_libraries(folds), beside, &told)
}

/// Trials that stand in the library of some fold.
fn in_libraries(folds: &[Fold]) -> BTreeSet<usize> {
    folds.iter().flat_map(|fold| fold.library.clone()).collect()
}

/// [`run`], with the libraries prepared before by [`prepare_folds`].
///
/// # Errors
/// If a trial cannot be read or compared.
pub fn run_prepared(
    method: &dyn Method,
    entries: &[Entry],
    folds: &[Fold],
    prepared: &PreparedLibrary,
    as_query: impl Fn(&Entry) -> Entry,
    progress: Progress<'_>,
) -> Result<(Outcome, Vec<Prediction>), EvaluateError> {
    let as_query = |_: &Arc<dyn Model>, _: usize, entry: &Entry| as_query(entry);
    let mut all = run_variants(method, entries, folds, prepared, 1, as_query, progress)?;
    Ok(all.swap_remove(0))
}

/// The same for several variants of each query, told apart by the first argument of `as_query`; the
/// model of a fold serves all of them.
///
/// # Errors
/// If a trial cannot be read or compared.
pub fn run_variants(
    method: &dyn Method,
    entries: &[Entry],
    folds: &[Fold],
    prepared: &PreparedLibrary,
    variants: usize,
    as_query: impl Fn(&Arc<dyn Model>, usize, &Entry) -> Entry,
    progress: Progress<'_>,
) -> Result<Vec<(Outcome, Vec<Prediction>)>, EvaluateError> {
    let keys = |i: usize| &entries[i].key;
    name_queries(method, &keys, folds, prepared, variants, progress, |model, i, variant| {
        let entry = as_query(model, variant, &entries[i]);
        let trial = entry.load().map_err(RecogniseError::from)?;
        let start = Instant::now();
        let query = model.prepare(&entry, &trial)?;
        Ok((model.rank(&query)?, start))
    })
}

/// [`run`] on trials of which only features are known. Latencies are from the features to the
/// answer.
///
/// # Errors
/// If a trial cannot be compared, or the method needs recordings.
pub fn run_features(
    method: &dyn Method,
    trials: &[FeatureVector],
    folds: &[Fold],
    progress: Progress<'_>,
) -> Result<(Outcome, Vec<Prediction>), EvaluateError> {
    let prepare = |trial: &FeatureVector| Prepared::Features(Arc::new(trial.clone()));
    let queries: Vec<Prepared> = trials.iter().map(prepare).collect();
    let library = PreparedLibrary {
        shape: Arc::new(LibraryShape::default()),
        trials: queries.iter().cloned().map(Some).collect(),
        remarks: Vec::new(),
        from_cache: 0,
    };
    let keys = |i: usize| &trials[i].key;
    let mut all = name_queries(method, &keys, folds, &library, 1, progress, |model, i, _| {
        let start = Instant::now();
        Ok((model.rank(&queries[i])?, start))
    })?;
    Ok(all.swap_remove(0))
}

/// Names the queries of all folds, one after the other, each in all its variants; `answer` is asked
/// for query and variant, and also says when it began.
fn name_queries<'a>(
    method: &dyn Method,
    keys: &dyn Fn(usize) -> &'a TrialKey,
    folds: &[Fold],
    prepared: &PreparedLibrary,
    variants: usize,
    progress: Progress<'_>,
    answer: impl Fn(&Arc<dyn Model>, usize, usize) -> Result<(Ranking, Instant), RecogniseError>,
) -> Result<Vec<(Outcome, Vec<Prediction>)>, EvaluateError> {
    let total = variants * folds.iter().map(|fold| fold.queries.len()).sum::<usize>();
    let mut predictions: Vec<Vec<Prediction>> = vec![Vec::new(); variants];
    let mut done = 0;
    for (index, fold) in folds.iter().enumerate() {
        let model = prepared.fit(method, &fold.library)?;
        for (variant, predictions) in predictions.iter_mut().enumerate() {
            for &query in &fold.queries {
                let (ranking, start) = answer(&model, query, variant)?;
                let query_ms = start.elapsed().as_secs_f64() * 1e3;
                predictions.push(Prediction {
                    key: keys(query).clone(),
                    fold: index,
                    surface: ranking.surface().into(),
                    margin: ranking.margin,
                    query_ms,
                    sources: ranking.sources,
                });
                done += 1;
                progress("naming queries", done, total);
            }
        }
    }
    let names: Vec<_> = folds.iter().map(|fold| fold.name.clone()).collect();
    let labels: BTreeSet<_> =
        in_libraries(folds).iter().map(|&i| keys(i).surface.clone()).collect();
    let largest = folds.iter().map(|fold| fold.library.len()).max().unwrap_or(0);
    let sum_up = |predictions: Vec<Prediction>| {
        let labels = labels.iter().cloned().collect();
        let outcome = Outcome::new(&predictions, &names, labels, largest, method.name());
        // `folds` gives no fold without queries, so there is a prediction to sum up.
        (outcome.expect("every fold has queries"), predictions)
    };
    Ok(predictions.into_iter().map(sum_up).collect())
}

/// The entry with its drag cut to the first seconds.
pub fn first_seconds(entry: &Entry, scene: &Scene, seconds: Option<f64>) -> Entry {
    let Some(seconds) = seconds else { return entry.clone() };
    let scene = scene.clone();
    entry.clone().changed(move |trial| {
        trial.first_seconds(seconds, |id| {
            scene.get(id.as_str()).is_some_and(|spec| spec.phase == Phase::Drag)
        })
    })
}
