//! The method `embedding`: one vector of Fourier features a source and trial, and a shrinkage
//! discriminant on them.
//!
//! The squared distance of two vectors is the MMD² of a kernel that compares values of one band
//! (or of one channel and lag) on a circle, summed over bands: see [`circle`]. With
//! `discriminant` off, the nearest library trial wins, as in `reference`. With it on (the default)
//! a discriminant is trained when the library is loaded, from its trials, windows of them, and
//! copies with noise; distances of several sources add up, each divided by a temperature fitted on
//! left-out library trials, and held back where it is far beyond what those show, so that no
//! source overrules all others. The score of a surface is 1/posterior, so that, as everywhere,
//! smaller is more alike, and the margin is the log of the odds.

pub mod calibrate;
pub mod circle;
pub mod discriminant;
mod follower;
mod left_out;
pub mod linear;
mod source;
mod train;

use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use self::calibrate::{HeldOut, best_temperature, log_posterior};
use self::discriminant::SHRINKAGE;
use self::follower::Follower;
use self::left_out::{LeftOut, drag_s, is_alone};
use self::source::{Window, squared_distance};
use self::train::{Labels, SourceModel, train};
use super::checks::nothing_in_common;
use super::combine::{TrialScores, candidates, medians};
use super::decide::conformal::{Conformity, Rejection, RejectionError, nonconformity};
use super::decide::settle::Settling;
use super::error::RecogniseError;
use super::features::frame_features::{FrameFeatures, SourceFrames, check_rates, sorted_library};
use super::follow::{Follow, FollowOptions};
use super::method::{Evidence, Method, Model, SourceEvidence};
use super::prepared::Prepared;
use super::rank::{Candidate, Ranking, rank};
use super::shape::LibraryShape;
use crate::library::Entry;
use crate::scene::{Scene, SourceId};
use crate::seed;
use crate::trial::{Trial, TrialKey};

/// The least squared distance that enters a logarithm.
const DISTANCE_FLOOR: f64 = 1e-9;

/// The method's name.
const NAME: &str = "embedding";

/// Settings of the method; what is usual is left out where settings are written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct EmbeddingOptions {
    /// Train a discriminant; without it the nearest trial wins.
    #[serde(skip_serializing_if = "is_true")]
    pub discriminant: bool,
    /// Harmonics of each band of a spectrum, 1 to 4; by default 4, and 2 where a source has
    /// several channels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub harmonics: Option<usize>,
    /// Train with copies of the library's spectra to which noise is added.
    #[serde(skip_serializing_if = "is_true")]
    pub noise_copies: bool,
    /// γ of the discriminant.
    #[serde(skip_serializing_if = "is_usual_shrinkage")]
    pub shrinkage: f64,
}

fn is_true(value: &bool) -> bool {
    *value
}

fn is_usual_shrinkage(value: &f64) -> bool {
    *value == SHRINKAGE
}

impl Default for EmbeddingOptions {
    fn default() -> Self {
        Self { discriminant: true, harmonics: None, noise_copies: true, shrinkage: SHRINKAGE }
    }
}

/// The method `embedding`.
#[derive(Clone, Debug)]
pub struct Embedding {
    scene: Scene,
    options: EmbeddingOptions,
}

impl Embedding {
    /// The method for the sources of a scene.
    pub fn new(scene: Scene, options: EmbeddingOptions) -> Self {
        Self { scene, options }
    }
}

/// A library, embedded and trained.
pub struct EmbeddingModel {
    scene: Scene,
    library: Vec<Arc<FrameFeatures>>,
    surfaces: Vec<String>,
    labels: Labels,
    sources: BTreeMap<SourceId, SourceModel>,
    /// τ of the sum over sources.
    temperature: f64,
    /// Combined distances of left-out library trials, with their classes.
    held_out: Vec<HeldOut>,
    /// How strange left-out library trials look.
    conformity: Conformity,
    /// The stop rule that was asked for first: scans are followed by one again and again.
    calibrated: OnceLock<(FollowOptions, Settling)>,
    /// For people: what the library was too small for.
    remarks: Vec<String>,
}

/// How far a query is from each surface, and what that means.
#[derive(Clone, Debug, PartialEq)]
pub struct Posterior {
    /// The surfaces, sorted.
    pub surfaces: Vec<String>,
    /// Combined distance to each, Σ w_s·f_s(d_s/τ_s).
    pub distances: Vec<f64>,
    /// ln of the posterior probability of each.
    pub log_posterior: Vec<f64>,
    /// The sources that were used.
    pub sources: Vec<SourceId>,
    /// As [`Ranking::p_value`]: known where the query has all sources that the model was trained on.
    pub p_value: Option<f64>,
}

impl Posterior {
    /// Index of the most probable surface; the first of equal ones.
    pub fn best(&self) -> usize {
        most_probable(&self.log_posterior)
    }
}

fn most_probable(log_posterior: &[f64]) -> usize {
    let mut best = 0;
    for (i, p) in log_posterior.iter().enumerate() {
        if *p > log_posterior[best] {
            best = i;
        }
    }
    best
}

impl EmbeddingModel {
    /// Combined distances of left-out library trials under models trained without them, with the
    /// index of each trial's surface. Empty where there is nothing to leave out.
    pub fn held_out(&self) -> &[HeldOut] {
        &self.held_out
    }

    /// How probable each surface is. `None` without a discriminant for any of the query's sources.
    ///
    /// # Errors
    /// If the query has no source in common with the library, or a rate that cannot be compared.
    pub fn posterior(&self, query: &FrameFeatures) -> Result<Option<Posterior>, RecogniseError> {
        let vectors = self.embed(query)?;
        Ok(self.posterior_of(query, &vectors))
    }

    /// What each of the query's sources says alone. Where some of a set of sources are trained,
    /// the distances of a model with that set alone are the sums over those.
    fn by_source(&self, query: &FrameFeatures) -> Result<Vec<SourceEvidence>, RecogniseError> {
        let vectors = self.embed(query)?;
        let trained = self.terms(query, &vectors).into_iter();
        let trained =
            trained.map(|(source, terms)| SourceEvidence { source, trained: true, terms });
        let untrained = vectors.iter().filter(|v| v.model.discriminant.is_none()).map(|v| {
            let mut terms = vec![f64::INFINITY; self.surfaces.len()];
            for (of_trial, &class) in v.model.vectors.iter().zip(&self.labels.class) {
                let Some(of_trial) = of_trial else { continue };
                let d2 = squared_distance(&v.vector, of_trial).max(DISTANCE_FLOOR);
                terms[class] = terms[class].min(v.model.spec.weight * d2.ln());
            }
            SourceEvidence { source: v.model.spec.id.clone(), trained: false, terms }
        });
        Ok(trained.chain(untrained).collect())
    }

    fn embed(&self, query: &FrameFeatures) -> Result<Vec<EmbeddedSource<'_>>, RecogniseError> {
        let shared: Vec<(&SourceModel, &SourceFrames)> = (query.sources.iter())
            .filter_map(|(id, source)| Some((self.sources.get(id)?, source)))
            .collect();
        if shared.is_empty() {
            return Err(nothing_in_common(query.sources.keys(), self.sources.keys()));
        }
        for (model, source) in &shared {
            let id = &model.spec.id;
            let like = self.library.iter().find_map(|t| Some((t.sources.get(id)?, &t.key)));
            if let Some((like, key)) = like {
                check_rates(id, source, like, key)?;
            }
        }
        let embed = |(model, source): (&'_ SourceModel, &SourceFrames)| {
            model.embedder.embed(source, Window::Whole)
        };
        let vectors: Vec<Vec<f32>> = shared.par_iter().map(|&pair| embed(pair)).collect();
        let with_model = shared.iter().zip(vectors);
        Ok(with_model.map(|((model, _), vector)| EmbeddedSource { model, vector }).collect())
    }

    fn posterior_of(
        &self,
        query: &FrameFeatures,
        vectors: &[EmbeddedSource<'_>],
    ) -> Option<Posterior> {
        let mut distances = vec![0.0; self.surfaces.len()];
        let terms = self.terms(query, vectors);
        if terms.is_empty() {
            return None;
        }
        for (_, of_source) in &terms {
            distances.iter_mut().zip(of_source).for_each(|(sum, term)| *sum += term);
        }
        let sources: Vec<SourceId> = terms.into_iter().map(|(id, _)| id).collect();
        let trained = self.sources.values().filter(|model| model.discriminant.is_some()).count();
        let p_value = || {
            let scan_s = drag_s(&self.sources, query).unwrap_or(f64::INFINITY);
            self.conformity.p_value(scan_s, nonconformity(&distances)?)
        };
        let p_value = if sources.len() == trained { p_value() } else { None };
        let log_posterior = log_posterior(&distances, self.temperature);
        Some(Posterior {
            surfaces: self.surfaces.clone(),
            distances,
            log_posterior,
            sources,
            p_value,
        })
    }

    /// What each source that has a discriminant says: see [`SourceModel::add_evidence`].
    fn terms(
        &self,
        query: &FrameFeatures,
        vectors: &[EmbeddedSource<'_>],
    ) -> Vec<(SourceId, Vec<f64>)> {
        let alone = is_alone(&self.sources, vectors.iter().map(|v| &v.model.spec.id));
        let term = |EmbeddedSource { model, vector }: &EmbeddedSource<'_>| {
            let length_s = query.sources[&model.spec.id].duration_s;
            let mut term = vec![0.0; self.surfaces.len()];
            let distances = model.discriminant.as_ref()?.distances(vector);
            model.add_evidence(&mut term, distances, length_s, alone);
            Some((model.spec.id.clone(), term))
        };
        vectors.iter().filter_map(term).collect()
    }

    /// Squared distances to library trials, as logarithms, trial by trial.
    fn log_distances(&self, vectors: &[EmbeddedSource<'_>]) -> Vec<TrialScores> {
        let distance = |trial: usize, EmbeddedSource { model, vector }: &EmbeddedSource<'_>| {
            let d2 = squared_distance(vector, model.vectors[trial].as_ref()?);
            Some(d2.max(DISTANCE_FLOOR).ln())
        };
        (0..self.library.len())
            .into_par_iter()
            .map(|trial| vectors.iter().map(|source| distance(trial, source)).collect())
            .collect()
    }

    /// One candidate a surface: its trial nearest to the query, at −ln posterior.
    fn candidates(&self, posterior: &Posterior, vectors: &[EmbeddedSource<'_>]) -> Vec<Candidate> {
        let best = posterior.best();
        let nearness = |i: usize| -> f64 {
            let each = vectors.iter().filter_map(|EmbeddedSource { model, vector }| {
                let d2 = squared_distance(vector, model.vectors[i].as_ref()?);
                Some(model.spec.weight * d2.max(DISTANCE_FLOOR).ln())
            });
            each.sum()
        };
        let key = |class: usize| -> Option<TrialKey> {
            let mut members = (0..self.library.len()).filter(|&i| self.labels.class[i] == class);
            let member = if class == best {
                members.map(|i| (nearness(i), i)).min_by(|a, b| a.0.total_cmp(&b.0))?.1
            } else {
                members.next()?
            };
            Some(self.library[member].key.clone())
        };
        (posterior.log_posterior.iter().enumerate())
            .filter_map(|(class, p)| Some(Candidate { key: key(class)?, log_ds: -p }))
            .collect()
    }
}

struct EmbeddedSource<'a> {
    model: &'a SourceModel,
    vector: Vec<f32>,
}

impl Embedding {
    /// The frames of a trial.
    ///
    /// # Errors
    /// If the trial does not fit the scene.
    pub fn frames(&self, entry: &Entry, trial: &Trial) -> Result<FrameFeatures, RecogniseError> {
        FrameFeatures::new(&entry.key, trial, &self.scene)
    }

    /// Embeds a library and trains on it.
    ///
    /// # Errors
    /// As [`Method::fit`].
    pub fn train(
        &self,
        library: Vec<Arc<FrameFeatures>>,
    ) -> Result<EmbeddingModel, RecogniseError> {
        let library = sorted_library(library)?;
        let labels = Labels::new(library.iter().map(|trial| &trial.key));
        let mut surfaces: Vec<String> =
            library.iter().map(|trial| trial.key.surface.clone()).collect();
        surfaces.dedup();
        let mut sources = BTreeMap::new();
        for spec in self.scene.sources() {
            let trials: Vec<_> = library.iter().map(|trial| trial.sources.get(&spec.id)).collect();
            if trials.iter().any(Option::is_some) {
                sources.insert(spec.id.clone(), train(spec, &trials, &labels, &self.options));
            }
        }
        let left_out = LeftOut { library: &library, labels: &labels, sources: &sources };
        let (held_out, conformity) = (left_out.whole(), left_out.conformity());
        sources.values_mut().for_each(|model| model.held_out = Vec::new());
        let temperature = if held_out.is_empty() { 1.0 } else { best_temperature(&held_out) };
        let remarks = if self.options.discriminant { remarks(&sources) } else { Vec::new() };
        Ok(EmbeddingModel {
            scene: self.scene.clone(),
            library,
            surfaces,
            labels,
            sources,
            temperature,
            held_out,
            conformity,
            calibrated: OnceLock::new(),
            remarks,
        })
    }
}

impl Method for Embedding {
    fn name(&self) -> &'static str {
        NAME
    }

    fn settings_key(&self, shape: &LibraryShape) -> u64 {
        let sources: Vec<_> = self.scene.sources().collect();
        let shape = shape.key().to_le_bytes();
        seed::stable_hash(&[NAME.as_bytes(), format!("{sources:?}").as_bytes(), &shape])
    }

    fn prepare(
        &self,
        entry: &Entry,
        trial: &Trial,
        _: &LibraryShape,
    ) -> Result<Prepared, RecogniseError> {
        Ok(Prepared::Frames(Arc::new(self.frames(entry, trial)?)))
    }

    fn fit(
        &self,
        library: Vec<Prepared>,
        _: &Arc<LibraryShape>,
    ) -> Result<Arc<dyn Model>, RecogniseError> {
        let library = library.iter().map(|trial| trial.frames(NAME).cloned());
        Ok(Arc::new(self.train(library.collect::<Result<_, _>>()?)?))
    }
}

impl Model for EmbeddingModel {
    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<Prepared, RecogniseError> {
        let frames = FrameFeatures::new(&entry.key, trial, &self.scene)?;
        Ok(Prepared::Frames(Arc::new(frames)))
    }

    fn rank(&self, query: &Prepared) -> Result<Ranking, RecogniseError> {
        let query = query.frames(NAME)?;
        let vectors = self.embed(query)?;
        let posterior = self.posterior_of(query, &vectors);
        let (candidates, sources) = match &posterior {
            Some(posterior) => (self.candidates(posterior, &vectors), posterior.sources.clone()),
            None => {
                let models = || vectors.iter().map(|source| source.model);
                let weights: Vec<f64> = models().map(|model| model.spec.weight).collect();
                let scores = self.log_distances(&vectors);
                let medians = medians(weights.len(), &scores);
                let keys = self.library.iter().map(|trial| &trial.key);
                let ids = models().map(|model| model.spec.id.clone()).collect();
                (candidates(&weights, &scores, &medians, keys), ids)
            }
        };
        // There is a candidate: every surface has a trial, and some trial has a shared source.
        let mut ranking = rank(candidates, 1, sources).expect("at least one candidate");
        ranking.confidence = posterior.as_ref().map(|p| p.log_posterior[p.best()].exp());
        ranking.p_value = posterior.and_then(|posterior| posterior.p_value);
        Ok(ranking)
    }

    fn explain(&self, query: &Prepared) -> Result<Option<Evidence>, RecogniseError> {
        let sources = self.by_source(query.frames(NAME)?)?;
        Ok(Some(Evidence { surfaces: self.surfaces.clone(), sources }))
    }

    fn follow(self: Arc<Self>, options: &FollowOptions) -> Option<Box<dyn Follow>> {
        let trained = self.sources.values().any(|source| source.discriminant.is_some());
        trained.then(|| Box::new(Follower::new(&self, options)) as Box<dyn Follow>)
    }

    fn rejection(&self, rate: f64) -> Result<Rejection, RejectionError> {
        Rejection::new(self.conformity.trials(), rate)
    }

    fn remarks(&self) -> &[String] {
        &self.remarks
    }
}

fn remarks(sources: &BTreeMap<SourceId, SourceModel>) -> Vec<String> {
    let of_source = |(id, model): (&SourceId, &SourceModel)| {
        if model.discriminant.is_none() {
            Some(format!(
                "{id}: too little to train a discriminant with; {}",
                if sources.values().all(|m| m.discriminant.is_none()) {
                    "the nearest trial wins"
                } else {
                    "it is left out of the comparison"
                }
            ))
        } else if !model.temperature.calibrated {
            Some(format!("{id}: too few trials a surface to calibrate probabilities"))
        } else {
            None
        }
    };
    sources.iter().filter_map(of_source).collect()
}
