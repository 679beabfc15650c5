//! The paper's comparison classifiers: naive Bayes, a support vector machine, nearest neighbours,
//! AdaBoost and a random forest, on hand-made [features](super::features).
//!
//! ```text
//! trial ─► FeatureVector ─► standardised on the library alone ─► Classifier ─► scores ─► rank
//! ```
//!
//! The trees and the class statistics of naive Bayes come from the crate smartcore. Its support
//! vector machine borrows its training data and so cannot be kept in a model; hence [`Svm`] has a
//! solver of its own. Smartcore has neither Mahalanobis neighbours nor AdaBoost.

mod naive_bayes;
mod neighbours;
mod svm;
mod trees;

pub use naive_bayes::NaiveBayes;
pub use neighbours::{Distance, Neighbours};
pub use svm::Svm;
pub use trees::{AdaBoost, RandomForest};

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use ndarray::{Array1, Array2, ArrayView1};

use super::checks::{check_surfaces, nothing_in_common};
use super::error::RecogniseError;
use super::features::FeatureVector;
use super::method::{Method, Model};
use super::prepared::Prepared;
use super::rank::{Candidate, Ranking, rank};
use super::shape::LibraryShape;
use crate::library::Entry;
use crate::scene::{Scene, SourceId};
use crate::seed;
use crate::trial::{Trial, TrialKey};

/// Standardised features are clipped at this distance from 0: a larger value comes from a broken
/// sensor and must not outweigh all others.
const FARTHEST: f64 = 10.0;
/// A feature whose deviation is below this share of 1 + |mean| counts as constant.
const CONSTANT: f64 = 1e-9;

/// How unlike a query is, as logarithms; smaller means more alike.
pub enum Scores {
    /// One score for each surface, in the order of [`TrainingSet::surfaces`].
    Surfaces(Vec<f64>),
    /// One score for each trial of the library; the `k` nearest trials vote.
    Trials {
        /// in the order of [`TrainingSet::keys`]
        log_scores: Vec<f64>,
        /// number of nearest trials that vote
        k: usize,
    },
}

/// A way of telling surfaces apart by standardised features.
pub trait Classifier: Clone + Send + Sync + 'static {
    /// The outcome of learning from a library.
    type Model: Send + Sync;

    /// Learns from a library.
    fn train(&self, training: &TrainingSet) -> Self::Model;

    /// Scores a query, which has as many features as the library's trials.
    fn scores(
        &self,
        model: &Self::Model,
        training: &TrainingSet,
        query: ArrayView1<'_, f64>,
    ) -> Scores;

    /// Whether the inverse of a surface's score is a probability.
    fn states_probabilities(&self) -> bool {
        false
    }
}

/// A library in the form that classifiers learn from.
#[derive(Clone, Debug)]
pub struct TrainingSet {
    /// Standardised features, shape (trials, features).
    pub features: Array2<f64>,
    /// Index of each trial's surface.
    pub class: Vec<usize>,
    /// The surfaces, sorted.
    pub surfaces: Vec<String>,
    /// The trials, sorted.
    pub keys: Vec<TrialKey>,
}

impl TrainingSet {
    /// Deals the trials of every surface into `parts` folds, for cross-validation within a library.
    /// For each fold: whether each trial belongs to it.
    pub fn parts(&self, parts: usize) -> Vec<Vec<bool>> {
        let mut seen = vec![0; self.surfaces.len()];
        let part_of: Vec<usize> = (self.class.iter())
            .map(|&class| {
                seen[class] += 1;
                (seen[class] - 1) % parts
            })
            .collect();
        (0..parts).map(|part| part_of.iter().map(|&p| p == part).collect()).collect()
    }
}

/// A comparison classifier, made a [`Method`].
#[derive(Clone, Debug)]
pub struct OnFeatures<C> {
    name: &'static str,
    scene: Scene,
    classifier: C,
}

impl<C: Classifier> OnFeatures<C> {
    /// The method called `name`, for the sources of a scene.
    pub fn new(name: &'static str, scene: Scene, classifier: C) -> Self {
        Self { name, scene, classifier }
    }
}

/// Where a source's features stand among all features, and how they are standardised.
#[derive(Clone, Debug)]
struct Columns {
    first: usize,
    /// Number of the source's features, used or not.
    width: usize,
    /// Index, mean and standard deviation of the features that differ between trials.
    used: Vec<(usize, f64, f64)>,
    rate_hz: f64,
    /// A library trial that has the source, for messages.
    like: TrialKey,
}

/// A standardised library, and what was learnt from it.
pub struct FeatureModel<C: Classifier> {
    method: OnFeatures<C>,
    columns: BTreeMap<SourceId, Columns>,
    training: TrainingSet,
    learnt: C::Model,
}

/// Position and standardisation of all features of a library.
fn columns(library: &[Arc<FeatureVector>]) -> Result<BTreeMap<SourceId, Columns>, RecogniseError> {
    let ids: BTreeSet<&SourceId> = library.iter().flat_map(|v| v.sources.keys()).collect();
    let mut columns = BTreeMap::new();
    let mut first = 0;
    for id in ids {
        let having: Vec<_> =
            library.iter().filter_map(|v| Some((v.sources.get(id)?, &v.key))).collect();
        // The id comes from these trials, so at least one has the source.
        let (like, key) = having[0];
        let (width, rate_hz) = (like.values.len(), like.rate_hz);
        let mut of_source =
            Columns { first, width, used: Vec::new(), rate_hz, like: TrialKey::clone(key) };
        for (source, _) in &having {
            of_source.check(id, &source.values, source.rate_hz)?;
        }
        let n = having.len() as f64;
        for i in 0..width {
            let values = || having.iter().map(|(source, _)| source.values[i]);
            let mean = values().sum::<f64>() / n;
            let spread = (values().map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt();
            if spread > CONSTANT * (1.0 + mean.abs()) {
                of_source.used.push((i, mean, spread));
            }
        }
        first += of_source.used.len();
        columns.insert(id.clone(), of_source);
    }
    Ok(columns)
}

impl Columns {
    /// Checks that there are as many features as in the library: a lower rate gives fewer bands.
    fn check(&self, id: &SourceId, values: &[f64], rate_hz: f64) -> Result<(), RecogniseError> {
        if values.len() == self.width {
            return Ok(());
        }
        Err(RecogniseError::Rates {
            source_name: id.clone(),
            query_hz: rate_hz,
            library_hz: self.rate_hz,
            trial: self.like.to_string(),
        })
    }
}

/// Number of features used. At least 1: a column of zeros where no feature varies.
fn width(columns: &BTreeMap<SourceId, Columns>) -> usize {
    columns.values().map(|c| c.used.len()).sum::<usize>().max(1)
}

/// The standardised features of a trial; 0, the library's mean, for a source that it lacks.
fn standardised(
    columns: &BTreeMap<SourceId, Columns>,
    vector: &FeatureVector,
) -> Result<Array1<f64>, RecogniseError> {
    let mut row = Array1::zeros(width(columns));
    for (id, source) in &vector.sources {
        let Some(columns) = columns.get(id) else { continue };
        columns.check(id, &source.values, source.rate_hz)?;
        for (at, &(i, mean, spread)) in columns.used.iter().enumerate() {
            let z = (source.values[i] - mean) / spread;
            row[columns.first + at] = z.clamp(-FARTHEST, FARTHEST);
        }
    }
    Ok(row)
}

impl<C: Classifier> OnFeatures<C> {
    fn features(&self, entry: &Entry, trial: &Trial) -> Result<Prepared, RecogniseError> {
        let features = FeatureVector::new(&entry.key, trial, &self.scene)?;
        Ok(Prepared::Features(Arc::new(features)))
    }
}

impl<C: Classifier> Method for OnFeatures<C> {
    fn name(&self) -> &'static str {
        self.name
    }

    fn settings_key(&self, _: &LibraryShape) -> u64 {
        let sources: Vec<_> = self.scene.sources().collect();
        seed::stable_hash(&[format!("{sources:?}").as_bytes()])
    }

    fn prepare(
        &self,
        entry: &Entry,
        trial: &Trial,
        _: &LibraryShape,
    ) -> Result<Prepared, RecogniseError> {
        self.features(entry, trial)
    }

    fn fit(
        &self,
        library: Vec<Prepared>,
        _: &Arc<LibraryShape>,
    ) -> Result<Arc<dyn Model>, RecogniseError> {
        let library = library.iter().map(|trial| trial.features(self.name()).cloned());
        let mut library: Vec<Arc<FeatureVector>> = library.collect::<Result<_, _>>()?;
        library.sort_by(|a, b| a.key.cmp(&b.key));
        let keys: Vec<TrialKey> = library.iter().map(|v| v.key.clone()).collect();
        let mut surfaces: Vec<String> = keys.iter().map(|key| key.surface.clone()).collect();
        surfaces.dedup();
        check_surfaces(keys.iter())?;
        let columns = columns(&library)?;
        let mut features = Array2::zeros((keys.len(), width(&columns)));
        for (mut row, vector) in features.rows_mut().into_iter().zip(&library) {
            row.assign(&standardised(&columns, vector)?);
        }
        let class = (keys.iter())
            .map(|key| surfaces.partition_point(|surface| *surface < key.surface))
            .collect();
        let training = TrainingSet { features, class, surfaces, keys };
        let learnt = self.classifier.train(&training);
        Ok(Arc::new(FeatureModel { method: self.clone(), columns, training, learnt }))
    }
}

impl<C: Classifier> Model for FeatureModel<C> {
    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<Prepared, RecogniseError> {
        self.method.features(entry, trial)
    }

    fn rank(&self, query: &Prepared) -> Result<Ranking, RecogniseError> {
        let Self { method: OnFeatures { name, classifier, .. }, columns, training, learnt } = self;
        let query = query.features(name)?;
        let sources: Vec<SourceId> =
            query.sources.keys().filter(|id| columns.contains_key(*id)).cloned().collect();
        if sources.is_empty() {
            return Err(nothing_in_common(query.sources.keys(), columns.keys()));
        }
        let row = standardised(columns, query)?;
        let (candidates, k) = match classifier.scores(learnt, training, row.view()) {
            Scores::Trials { log_scores, k } => {
                let pairs = training.keys.iter().zip(log_scores);
                (pairs.map(|(key, log_ds)| Candidate { key: key.clone(), log_ds }).collect(), k)
            }
            Scores::Surfaces(log_scores) => (by_surface(training, &log_scores, row.view()), 1),
        };
        // A library has trials, and each of them, or each of its surfaces, is a candidate.
        let mut ranking = rank(candidates, k, sources).expect("at least one candidate");
        ranking.confidence =
            classifier.states_probabilities().then(|| ranking.ranked[0].score.recip());
        Ok(ranking)
    }
}

/// One candidate for each surface: the surface's trial nearest to the query.
fn by_surface(
    training: &TrainingSet,
    log_scores: &[f64],
    query: ArrayView1<'_, f64>,
) -> Vec<Candidate> {
    let mut nearest: Vec<Option<(f64, usize)>> = vec![None; training.surfaces.len()];
    for (i, (row, &class)) in training.features.rows().into_iter().zip(&training.class).enumerate()
    {
        let distance = squared_distance(row, query);
        if nearest[class].is_none_or(|(least, _)| distance < least) {
            nearest[class] = Some((distance, i));
        }
    }
    (nearest.into_iter().zip(log_scores))
        .filter_map(|(nearest, &log_ds)| {
            Some(Candidate { key: training.keys[nearest?.1].clone(), log_ds })
        })
        .collect()
}

fn squared_distance(a: ArrayView1<'_, f64>, b: ArrayView1<'_, f64>) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum()
}

/// −ln softmax of `logits`: smaller means more alike.
fn negative_log_softmax(logits: &[f64]) -> Vec<f64> {
    let most = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let sum = logits.iter().map(|x| (x - most).exp()).sum::<f64>().ln() + most;
    logits.iter().map(|x| sum - x).collect()
}

#[cfg(test)]
mod tests;
