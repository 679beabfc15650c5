//! Evaluates a method on folds of trials; every measurement of accuracy goes through here.
//!
//! ```text
//! Evaluation (trials, folds, query changes) ─► prepare ─► Run: each library trial prepared once
//! Run ─► model of a fold ─► queries, one by one ─► Measured (outcome, predictions, left out)
//! ```

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use super::outcome::{Outcome, Prediction};
use super::{EvaluateError, Fold};
use crate::features::FeatureVector;
use crate::library::Entry;
use crate::recognise::{
    LibraryShape, Method, Model, Prepared, PreparedLibrary, RecogniseError, if_enough,
    prepare_library, without_flawed,
};
use crate::scene::Scene;
use crate::trial::{Doubt, Trial, TrialKey};

/// A function that is called after each step with the name of the work, the number of steps done, and
/// their total number.
pub type ProgressFn<'a> = &'a (dyn Fn(&'static str, usize, usize) + Sync);

#[derive(Clone, Copy)]
pub enum EvaluatedTrials<'a> {
    Recordings(&'a [Entry]),
    /// Feature tables without recordings, which cannot be cut to `query_seconds`.
    Features(&'a [FeatureVector]),
}

impl<'a> EvaluatedTrials<'a> {
    pub fn key(self, index: usize) -> &'a TrialKey {
        match self {
            Self::Recordings(entries) => &entries[index].key,
            Self::Features(trials) => &trials[index].key,
        }
    }
}

/// The data of an evaluation, and the part of each query that is used; library trials stay whole.
#[derive(Clone, Copy)]
pub struct Evaluation<'a> {
    pub scene: &'a Scene,
    pub trials: EvaluatedTrials<'a>,
    pub folds: &'a [Fold],
    /// The part of each query's drag that is used, in seconds; `None` for the whole drag.
    pub query_seconds: Option<f64>,
    /// Folder of the library, whose cache of prepared trials is used; `None` for no cache.
    pub cache: Option<&'a Path>,
    pub progress: ProgressFn<'a>,
}

impl<'a> Evaluation<'a> {
    /// An evaluation on whole recordings, without cache and progress.
    pub fn new(scene: &'a Scene, entries: &'a [Entry], folds: &'a [Fold]) -> Self {
        let trials = EvaluatedTrials::Recordings(entries);
        Self { scene, trials, folds, query_seconds: None, cache: None, progress: &|_, _, _| () }
    }

    /// Prepares the libraries of all folds; each trial is prepared only once.
    ///
    /// # Errors
    /// If a trial cannot be read or does not fit the scene.
    pub fn prepare<'m>(self, method: &'m dyn Method) -> Result<Run<'a, 'm>, RecogniseError> {
        let library = match self.trials {
            EvaluatedTrials::Recordings(entries) => {
                let step = |done, of| (self.progress)("preparing the library", done, of);
                prepare_library(method, entries, &in_libraries(self.folds), self.cache, &step)?
            }
            EvaluatedTrials::Features(trials) => {
                let prepare = |trial: &FeatureVector| Prepared::Features(Arc::new(trial.clone()));
                let trials = trials.iter().map(|trial| Some(prepare(trial))).collect();
                let (shape, remarks) = (Arc::new(LibraryShape::default()), Vec::new());
                PreparedLibrary { shape, trials, remarks, from_cache: 0 }
            }
        };
        Ok(Run { on: self, method, library })
    }
}

/// Indices of the trials that are in the library of at least one fold.
pub fn in_libraries(folds: &[Fold]) -> BTreeSet<usize> {
    folds.iter().flat_map(|fold| fold.library.iter().copied()).collect()
}

/// A method, and the library trials of all folds, prepared for it.
pub struct Run<'a, 'm> {
    pub on: Evaluation<'a>,
    pub(crate) method: &'m dyn Method,
    pub library: PreparedLibrary,
}

pub struct Query {
    pub prepared: Prepared,
    pub left_out: Vec<Doubt>,
    /// The moment when the query's raw samples were in memory and preparation began.
    pub started: Instant,
}

/// Why sources were left out of queries, or queries not named, query by query.
pub type LeftOutSources = Vec<(TrialKey, Doubt)>;

#[derive(Clone, Debug)]
pub struct Measured {
    pub outcome: Outcome,
    pub predictions: Vec<Prediction>,
    pub left_out: LeftOutSources,
}

impl Run<'_, '_> {
    /// A model of the library trials with the given indices.
    ///
    /// # Errors
    /// Like [`Method::fit`].
    pub fn fit<'i>(
        &self,
        trials: impl IntoIterator<Item = &'i usize>,
    ) -> Result<Arc<dyn Model>, RecogniseError> {
        self.library.fit(self.method, trials)
    }

    pub(crate) fn recording(&self, index: usize) -> Result<Trial, RecogniseError> {
        match self.on.trials {
            EvaluatedTrials::Recordings(entries) => Ok(entries[index].load()?),
            EvaluatedTrials::Features(_) => {
                Err(RecogniseError::NeedsRecordings(self.method.name()))
            }
        }
    }

    /// Prepares a trial as a query to a model, cut to the first `seconds` of its drag if they are given.
    ///
    /// # Errors
    /// If the trial cannot be read or compared.
    pub fn query(
        &self,
        model: &Arc<dyn Model>,
        index: usize,
        seconds: Option<f64>,
    ) -> Result<Query, RecogniseError> {
        match self.on.trials {
            EvaluatedTrials::Recordings(entries) => {
                let entry = first_seconds(&entries[index], self.on.scene, seconds);
                self.query_of(model, entry.load()?)
            }
            EvaluatedTrials::Features(trials) => Ok(Query {
                prepared: Prepared::Features(Arc::new(trials[index].clone())),
                left_out: Vec::new(),
                started: Instant::now(),
            }),
        }
    }

    /// Like [`Run::query`], for a recording in memory. Leaves out sources with a dead sensor. For
    /// `embedding`, a channel is dead only if it rests for longer than in library trials.
    pub(crate) fn query_of(
        &self,
        model: &Arc<dyn Model>,
        trial: Trial,
    ) -> Result<Query, RecogniseError> {
        let embedding = model.clone().embedding();
        let (trial, left_out) = without_flawed(trial, self.on.scene, |id| {
            embedding.as_ref().map_or(&[], |embedding| embedding.rests(id))
        });
        if let Some(embedding) = embedding {
            embedding.ready_for_length(trial.longest_s(|id| self.on.scene.is_dragged(id)));
        }
        let trial = Arc::new(trial);
        let entry = Entry::in_memory(Arc::clone(&trial));
        let started = Instant::now();
        Ok(Query { prepared: model.prepare(&entry, &trial)?, left_out, started })
    }

    /// Names all queries of all folds.
    ///
    /// Names one query after the other, so that each has the whole machine. The latency of a query
    /// is the time from its raw samples (or features) in memory to its answer.
    ///
    /// # Errors
    /// If a trial cannot be read or compared.
    pub fn measure(&self) -> Result<Measured, EvaluateError> {
        // `measure_by` gets one length of queries, so it returns exactly one result.
        Ok(self.measure_by(self.on.folds, &[self.on.query_seconds])?.swap_remove(0))
    }

    /// Like [`Run::measure`], but on the given folds, and once for each length of queries, in
    /// seconds (`None` for whole drags). One model of a fold serves all lengths.
    pub(crate) fn measure_by(
        &self,
        folds: &[Fold],
        lengths: &[Option<f64>],
    ) -> Result<Vec<Measured>, EvaluateError> {
        let total = lengths.len() * folds.iter().map(|fold| fold.queries.len()).sum::<usize>();
        let mut all = vec![(Vec::new(), LeftOutSources::new()); lengths.len()];
        let mut done = 0;
        for (at, fold) in folds.iter().enumerate() {
            let model = self.fit(&fold.library)?;
            for (&seconds, (predictions, left_out)) in lengths.iter().zip(&mut all) {
                for &query in &fold.queries {
                    let key = self.on.trials.key(query);
                    let (prediction, remarks) = self.name(&model, (at, query), seconds)?;
                    predictions.push(prediction);
                    left_out.extend(remarks.into_iter().map(|doubt| (key.clone(), doubt)));
                    done += 1;
                    (self.on.progress)("naming queries", done, total);
                }
            }
        }
        let sum_up = |(predictions, left_out): (Vec<Prediction>, _)| {
            let outcome = self.sum_up(folds, &predictions);
            Measured { outcome, predictions, left_out }
        };
        Ok(all.into_iter().map(sum_up).collect())
    }

    fn name(
        &self,
        model: &Arc<dyn Model>,
        (fold, index): (usize, usize),
        seconds: Option<f64>,
    ) -> Result<(Prediction, Vec<Doubt>), RecogniseError> {
        let query = self.query(model, index, seconds)?;
        let mut remarks = query.left_out;
        // A query with too little data to name counts as named wrong.
        let ranking = if_enough(model.rank(&query.prepared))?;
        remarks.extend(ranking.is_none().then_some(Doubt::TooLittle));
        let query_ms = query.started.elapsed().as_secs_f64() * 1e3;
        let key = self.on.trials.key(index).clone();
        let nameless = Prediction { key, fold, query_ms, ..Prediction::default() };
        let Some(ranking) = ranking else { return Ok((nameless, remarks)) };
        let surface = ranking.surface().to_string();
        let stated = ranking.probabilities();
        let surfaces = ranking.ranked.into_iter().map(|one| one.surface);
        let prediction = Prediction {
            surface,
            margin: ranking.margin,
            sources: ranking.sources,
            confidence: ranking.confidence,
            p_value: ranking.p_value,
            probabilities: surfaces.zip(stated).collect(),
            ..nameless
        };
        Ok((prediction, remarks))
    }

    /// The outcome of some folds and the predictions for their queries, which are some.
    pub(crate) fn sum_up(&self, folds: &[Fold], predictions: &[Prediction]) -> Outcome {
        let names: Vec<String> = folds.iter().map(|fold| fold.name.clone()).collect();
        let surface = |&i: &usize| &self.on.trials.key(i).surface;
        let surfaces = |fold: &Fold| fold.library.iter().map(surface).collect::<BTreeSet<_>>();
        let labels: BTreeSet<&String> = folds.iter().flat_map(surfaces).collect();
        let labels = labels.into_iter().cloned().collect();
        let largest = folds.iter().map(|fold| fold.library.len()).max().unwrap_or(0);
        let counts = || folds.iter().map(|fold| surfaces(fold).len());
        let candidates = [counts().min(), counts().max()].map(|count| count.unwrap_or(0));
        let outcome = Outcome::new(predictions, &names, labels, largest, self.method.name())
            // Every fold has queries, so there is a prediction.
            .expect("every fold has queries");
        Outcome { candidates, ..outcome }
    }
}

/// The entry, with its drag cut to the first `seconds` if they are given.
pub fn first_seconds(entry: &Entry, scene: &Scene, seconds: Option<f64>) -> Entry {
    let Some(seconds) = seconds else { return entry.clone() };
    let scene = scene.clone();
    entry.clone().changed(move |trial| trial.first_seconds(seconds, |id| scene.is_dragged(id)))
}

/// The entries that have sources of the scene, limited to these sources.
pub fn within(entries: &[Entry], scene: &Scene) -> Vec<Entry> {
    let within = entries.iter().map(|entry| entry.clone().within(scene));
    within.filter(|entry| !entry.sources.is_empty()).collect()
}
