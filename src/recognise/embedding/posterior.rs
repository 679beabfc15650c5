//! From distances to an answer: probabilities, a ranking, what each source says.

use std::sync::Arc;

use ndarray::ArrayView1;

use super::calibrated_probability::{held_back, log_posterior};
use super::joint::{Present, columns};
use super::model::EmbeddingModel;
use crate::recognise::decide::conformal::nonconformity;
use crate::recognise::method::{BySources, Evidence, SourceEvidence};
use crate::recognise::rank::{Candidate, Ranking, rank};
use crate::scene::SourceId;
use crate::trial::TrialKey;

/// How far a query is from each surface, and what that means.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Posterior {
    /// Distance to each in the space of the discriminant.
    pub distances: Vec<f64>,
    /// ln of softmax(−distance/2τ).
    pub log_posterior: Vec<f64>,
    /// Probability of each, held to what the left-out trials of the library can show.
    pub probabilities: Vec<f64>,
    /// The sources that were used.
    pub sources: Vec<SourceId>,
    /// As [`Ranking::p_value`]: known where the query has all sources of the library.
    pub p_value: Option<f64>,
}

impl Posterior {
    /// Index of the most probable surface; the first of equal ones.
    pub fn best(&self) -> usize {
        let mut best = 0;
        for (i, p) in self.log_posterior.iter().enumerate() {
            if *p > self.log_posterior[best] {
                best = i;
            }
        }
        best
    }
}

/// A query as a vector, to be named by any of its sources.
pub(super) struct QueryVector {
    pub model: Arc<EmbeddingModel>,
    /// In the library's deviations.
    pub vector: Vec<f32>,
    pub present: Present,
}

impl BySources for QueryVector {
    fn surface(&self, sources: &[&SourceId]) -> Option<&str> {
        let stretches = self.model.joint.stretches.iter().zip(&self.present);
        let chosen: Present =
            stretches.map(|(s, has)| *has && sources.contains(&&s.spec.id)).collect();
        if !chosen.contains(&true) {
            return None;
        }
        let posterior = self.model.posterior_at(&self.vector, &chosen, f64::INFINITY);
        Some(&self.model.labels.surfaces[posterior.best()])
    }
}

impl EmbeddingModel {
    /// What distances to all surfaces mean for a scan of `scan_s` seconds.
    pub(super) fn posterior_of(
        &self,
        distances: Vec<f64>,
        present: &Present,
        scan_s: f64,
    ) -> Posterior {
        let tau = self.left_out.temperature.at(scan_s);
        let log_posterior = log_posterior(&distances, tau);
        let sources = self.joint.stretches.iter().zip(present).filter(|(_, has)| **has);
        let p_value = || self.left_out.conformity.p_value(scan_s, nonconformity(&distances)?);
        Posterior {
            probabilities: held_back(&log_posterior, self.left_out.held_out.len()),
            sources: sources.map(|(stretch, _)| stretch.spec.id.clone()).collect(),
            p_value: if present.iter().all(|has| *has) { p_value() } else { None },
            log_posterior,
            distances,
        }
    }

    /// The posterior of a vector in the library's deviations.
    pub(super) fn posterior_at(&self, vector: &[f32], present: &Present, scan_s: f64) -> Posterior {
        let distances = self.discriminant(present).distances(vector.into());
        self.posterior_of(distances, present, scan_s)
    }

    /// The ranking of a vector.
    pub(super) fn ranking(&self, vector: &[f32], present: &Present, scan_s: f64) -> Ranking {
        let posterior = self.posterior_at(vector, present, scan_s);
        let best = posterior.best();
        let candidate = |(class, p): (usize, &f64)| {
            let key = if class == best {
                self.nearest(vector, present, class)
            } else {
                TrialKey::new(&self.labels.surfaces[class], "", 0)
            };
            Candidate { key, log_ds: -p }
        };
        let candidates = posterior.log_posterior.iter().enumerate().map(candidate).collect();
        // There is a candidate: a library has two surfaces.
        let mut ranking =
            rank(candidates, 1, posterior.sources.clone()).expect("at least two candidates");
        let calibrated = !self.left_out.held_out.is_empty();
        ranking.confidence = calibrated.then(|| posterior.probabilities[best]);
        ranking.p_value = posterior.p_value;
        ranking
    }

    /// The trial of a class that is nearest to a vector, in the library's deviations.
    fn nearest(&self, vector: &[f32], present: &Present, class: usize) -> TrialKey {
        let columns = columns(&self.joint.stretches, present);
        let distance = |trial: usize| -> f64 {
            let whole = self.training.whole(trial);
            columns.iter().map(|&c| f64::from(whole[c] - vector[c]).powi(2)).sum()
        };
        let members = (0..self.keys.len()).filter(|&i| self.labels.class[i] == class);
        let nearest = members.min_by(|&a, &b| distance(a).total_cmp(&distance(b)));
        // Every class has a trial: classes were made of trials.
        self.keys[nearest.unwrap_or(0)].clone()
    }

    /// What each source says: its share of the distance to each surface, over 2τ, so that the sums
    /// are −ln posterior but for one number that is the same for all surfaces.
    pub(super) fn evidence(&self, vector: &[f32], present: &Present, scan_s: f64) -> Evidence {
        let stretches: Vec<_> = self
            .joint
            .stretches
            .iter()
            .zip(present)
            .filter(|(_, has)| **has)
            .map(|(s, _)| s)
            .collect();
        let columns: Vec<_> = stretches.iter().map(|stretch| stretch.columns.clone()).collect();
        let trained = self.discriminant(present);
        let scale = 1.0 / (2.0 * self.left_out.temperature.at(scan_s));
        let weights = trained.weights();
        let mut terms = vec![vec![f64::INFINITY; self.labels.classes]; stretches.len()];
        for class in (0..self.labels.classes).filter(|&class| trained.knows(class)) {
            let mean = self.training.class_mean(&self.labels, class);
            let of_mean = weights.terms(class, mean.view(), &columns);
            let of_query = weights.terms(class, ArrayView1::from(vector), &columns);
            for (of_source, (m, q)) in terms.iter_mut().zip(of_mean.iter().zip(of_query)) {
                of_source[class] = scale * (m - 2.0 * q);
            }
        }
        let of_source = |(stretch, terms): (&&super::joint::Stretch, Vec<f64>)| SourceEvidence {
            source: stretch.spec.id.clone(),
            trained: true,
            terms,
        };
        let sources = stretches.iter().zip(terms).map(of_source).collect();
        Evidence { surfaces: self.labels.surfaces.clone(), sources }
    }
}
