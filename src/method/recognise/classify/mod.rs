//! The paper's comparison classifiers: naive Bayes, a support vector machine, nearest neighbours,
//! AdaBoost and a random forest, on hand-made [features](crate::features).
//!
//! ```text
//! trial ─► FeatureVector ─► standardised on the library alone ─► Scorer ─► scores ─► rank
//! ```
//!
//! The trees and the class statistics of naive Bayes come from the crate smartcore. Its support vector
//! machine borrows its training data, so a model could not hold it; `svm` therefore has its own
//! solver. Smartcore has neither Mahalanobis neighbours nor AdaBoost.

pub(super) mod neighbours;
pub(super) mod smartcore_models;
pub(super) mod svm;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use ndarray::{Array1, Array2, ArrayView1};

use super::embedding::labels::appearances;
use super::error::{RecogniseError, Result, check_surfaces, nothing_in_common};
use super::method::{Method, Model};
use super::prepared::Prepared;
use super::rank::{Candidate, Ranking, rank};
use crate::features::FeatureVector;
use crate::library::Entry;
use crate::library::shape::LibraryShape;
use crate::scene::{Scene, SourceId};
use crate::seed;
use crate::trial::{Trial, TrialKey};

/// Standardised features are clipped at this distance from 0. A larger value comes from a broken
/// sensor, and must not outweigh all other features.
const FARTHEST: f64 = 10.0;
/// A feature counts as constant if its standard deviation is at most this times 1 + |mean|.
const CONSTANT: f64 = 1e-9;

/// How unlike a query the library is, as logarithms; smaller means more alike.
pub(crate) enum Scores {
    /// One score for each surface, in the order of [`TrainingSet::surfaces`]; perhaps −ln of its
    /// probability.
    Surfaces { log_scores: Vec<f64>, are_probabilities: bool },
    /// One score for each trial of the library, in the order of [`TrainingSet::keys`]. The `k` nearest
    /// trials vote.
    Trials { log_scores: Vec<f64>, k: usize },
}

/// A fitted classifier: scores a query, which must have as many features as the library's trials.
type Scorer = Box<dyn Fn(ArrayView1<'_, f64>) -> Scores + Send + Sync>;

/// Trains a classifier on standardised features.
type Learner = Arc<dyn Fn(&Arc<TrainingSet>) -> Scorer + Send + Sync>;

/// A library in the form that classifiers are trained on.
#[derive(Clone, Debug)]
pub(crate) struct TrainingSet {
    /// Standardised features, shape (trials, features).
    features: Array2<f64>,
    class: Vec<usize>,
    /// The surfaces, in the order of their first trials.
    surfaces: Vec<String>,
    /// The trials, in an order that no name decides.
    keys: Vec<TrialKey>,
}

/// A comparison classifier as a [`Method`].
#[derive(Clone)]
pub(crate) struct OnFeatures {
    name: &'static str,
    scene: Scene,
    learn: Learner,
}

impl OnFeatures {
    pub(crate) fn new(
        name: &'static str,
        scene: Scene,
        learn: impl Fn(&Arc<TrainingSet>) -> Scorer + Send + Sync + 'static,
    ) -> Self {
        Self { name, scene, learn: Arc::new(learn) }
    }

    fn features(&self, entry: &Entry, trial: &Trial) -> Result<Prepared> {
        let features = FeatureVector::new(&entry.key, trial, &self.scene)?;
        Ok(Prepared::Features(Arc::new(features)))
    }
}

/// The place of one source's features among all features, and their means and deviations.
#[derive(Clone, Debug)]
struct Columns {
    first: usize,
    /// Number of features of the source, with or without those that are constant.
    width: usize,
    /// Index, mean and standard deviation of each feature that differs between trials.
    used: Vec<(usize, f64, f64)>,
    rate_hz: f64,
    /// A library trial that has the source, for error messages.
    like: TrialKey,
}

/// A standardised library, and the classifier that was trained on it.
struct FeatureModel {
    method: OnFeatures,
    columns: BTreeMap<SourceId, Columns>,
    training: Arc<TrainingSet>,
    scorer: Scorer,
}

/// Position and standardisation of all features of a library.
fn columns(library: &[Arc<FeatureVector>]) -> Result<BTreeMap<SourceId, Columns>> {
    let ids: BTreeSet<&SourceId> = library.iter().flat_map(|v| v.sources.keys()).collect();
    let mut columns = BTreeMap::new();
    let mut first = 0;
    for id in ids {
        let having: Vec<_> =
            library.iter().filter_map(|v| Some((v.sources.get(id)?, &v.key))).collect();
        // The id comes from the library, so at least one trial has the source.
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
    /// Checks that there are as many features as in the library; a lower rate gives fewer bands.
    fn check(&self, id: &SourceId, values: &[f64], rate_hz: f64) -> Result<()> {
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

/// Number of features used, at least 1: if no feature varies, there is one column of zeros.
fn width(columns: &BTreeMap<SourceId, Columns>) -> usize {
    columns.values().map(|c| c.used.len()).sum::<usize>().max(1)
}

/// The standardised features of a trial. A source that the trial lacks gets 0, the library's mean.
fn standardised(
    columns: &BTreeMap<SourceId, Columns>,
    vector: &FeatureVector,
) -> Result<Array1<f64>> {
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

impl Method for OnFeatures {
    fn name(&self) -> &'static str {
        self.name
    }

    fn settings_key(&self, _: &LibraryShape) -> u64 {
        let sources: Vec<_> = self.scene.sources().collect();
        seed::stable_hash(&[format!("{sources:?}").as_bytes()])
    }

    fn prepare(&self, entry: &Entry, trial: &Trial, _: &LibraryShape) -> Result<Prepared> {
        self.features(entry, trial)
    }

    fn fit(&self, library: Vec<Prepared>, _: &Arc<LibraryShape>) -> Result<Arc<dyn Model>> {
        let library = library.iter().map(|trial| trial.features(self.name()).cloned());
        let mut library: Vec<Arc<FeatureVector>> = library.collect::<Result<_, _>>()?;
        library.sort_by_cached_key(|vector| {
            let values = vector.sources.values().flat_map(|source| &source.values);
            let bytes = values.flat_map(|x| x.to_le_bytes()).collect::<Vec<_>>();
            (seed::stable_hash(&[&bytes]), vector.key.clone())
        });
        let keys: Vec<TrialKey> = library.iter().map(|v| v.key.clone()).collect();
        check_surfaces(keys.iter())?;
        let columns = columns(&library)?;
        let mut features = Array2::zeros((keys.len(), width(&columns)));
        for (mut row, vector) in features.rows_mut().into_iter().zip(&library) {
            row.assign(&standardised(&columns, vector)?);
        }
        let (surfaces, class) = appearances(keys.iter().map(|key| key.surface.as_str()));
        let surfaces = surfaces.into_iter().map(String::from).collect();
        let training = Arc::new(TrainingSet { features, class, surfaces, keys });
        let scorer = (self.learn)(&training);
        Ok(Arc::new(FeatureModel { method: self.clone(), columns, training, scorer }))
    }
}

impl Model for FeatureModel {
    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<Prepared> {
        self.method.features(entry, trial)
    }

    fn rank(&self, query: &Prepared) -> Result<Ranking> {
        let Self { method, columns, training, scorer } = self;
        let query = query.features(method.name)?;
        let sources: Vec<SourceId> =
            query.sources.keys().filter(|id| columns.contains_key(*id)).cloned().collect();
        if sources.is_empty() {
            return Err(nothing_in_common(query.sources.keys(), columns.keys()));
        }
        let row = standardised(columns, query)?;
        let mut confident = false;
        let (candidates, k) = match scorer(row.view()) {
            Scores::Trials { log_scores, k } => {
                let pairs = training.keys.iter().zip(log_scores);
                (pairs.map(|(key, log_ds)| Candidate { key: key.clone(), log_ds }).collect(), k)
            }
            Scores::Surfaces { log_scores, are_probabilities } => {
                confident = are_probabilities;
                (by_surface(training, &log_scores, row.view()), 1)
            }
        };
        // There is at least one candidate, since the library has at least one trial.
        let mut ranking = rank(candidates, k, sources).expect("at least one candidate");
        ranking.confidence = confident.then(|| ranking.ranked[0].score.recip());
        Ok(ranking)
    }
}

/// One candidate for each surface: the trial of the surface that is nearest to the query.
fn by_surface(
    training: &TrainingSet,
    log_scores: &[f64],
    query: ArrayView1<'_, f64>,
) -> Vec<Candidate> {
    let distances = training.features.rows().into_iter().map(|row| squared_distance(row, query));
    let distances: Vec<f64> = distances.collect();
    let candidate = |(class, &log_ds): (usize, &f64)| {
        let of_class = (0..distances.len()).filter(|&i| training.class[i] == class);
        let nearest = of_class.min_by(|&a, &b| distances[a].total_cmp(&distances[b]))?;
        Some(Candidate { key: training.keys[nearest].clone(), log_ds })
    };
    log_scores.iter().enumerate().filter_map(candidate).collect()
}

fn squared_distance(a: ArrayView1<'_, f64>, b: ArrayView1<'_, f64>) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum()
}

#[cfg(test)]
mod tests;
