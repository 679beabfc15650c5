//! The trained model of the method `embedding`: turns a query into an answer.

use std::any::Any;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::ops::Range;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use ndarray::{ArrayView1, s};
use rayon::prelude::*;

use super::NAME;
use super::ensemble::Answer;
use super::joint::{JointEmbedder, Present, SourceEmbedder, Stretch};
use super::labels::{Labels, together};
use super::left_out::{LeftOut, Measured, Trained};
use super::training::Training;
use crate::features::frames::{LOOK_S, TrialFrames};
use crate::library::Entry;
use crate::library::shape::LibraryShape;
use crate::recognise::decide::conformal::{Rejection, RejectionError};
use crate::recognise::decide::scan_time::{Goal, LeftOutAccuracy, LibraryCounts, ScanTime};
use crate::recognise::decide::settle::{
    FollowOptions, FollowedTrial, LeftOutLook, Settling, looks_in,
};
use crate::recognise::error::{RecogniseError, Result};
use crate::recognise::method::{Evidence, Model, SourceEvidence};
use crate::recognise::prepared::Prepared;
use crate::recognise::rank::{Candidate, Ranking, rank};
use crate::scene::{Scene, SourceId};
use crate::trial::{Trial, TrialKey};

pub struct EmbeddingModel {
    pub(super) scene: Scene,
    pub(in crate::recognise) shape: Arc<LibraryShape>,
    /// The keys of the library's trials, in the order of their samples' digests.
    pub(super) keys: Vec<TrialKey>,
    pub(super) labels: Labels,
    pub(super) joint: JointEmbedder,
    pub(super) training: Training,
    pub(super) left_out: LeftOut,
    /// Ensembles for sets of sources that a query has had, but no library trial has.
    pub(super) trained: Mutex<HashMap<Present, Arc<Trained>>>,
    /// The library's trials, kept until `followed` is computed from them.
    pub(super) unfollowed: Mutex<Option<Vec<Arc<TrialFrames>>>>,
    /// How beginnings of left-out trials are answered by the sources of each trial.
    pub(super) begun: OnceLock<BTreeMap<Present, Measured>>,
    /// The left-out trials, each named at every look of its growing drag.
    pub(super) followed: OnceLock<Vec<FollowedTrial>>,
    /// The stopping rule for the first options asked for; later scans mostly have the same options.
    pub(super) settling: OnceLock<(FollowOptions, Settling)>,
}

/// The probability of each surface for a query, and the p-value.
pub(super) struct Posterior {
    /// ln of the ensemble's probability of each surface.
    pub log_posterior: Vec<f64>,
    /// Probability of each surface, limited to what left-out library trials can show.
    pub probabilities: Vec<f64>,
    /// The p-value, see [`Ranking::p_value`].
    pub p_value: Option<f64>,
}

impl Posterior {
    /// Index of the most probable surface; the first index in a tie.
    pub(super) fn best(&self) -> usize {
        let of = |class: usize| self.log_posterior[class];
        (0..self.log_posterior.len()).rev().max_by(|&a, &b| of(a).total_cmp(&of(b))).unwrap_or(0)
    }
}

impl EmbeddingModel {
    /// Trains on a library that is sorted by key. `seed` determines the copies of its trials.
    pub(super) fn train(
        scene: &Scene,
        shape: &Arc<LibraryShape>,
        mut library: Vec<Arc<TrialFrames>>,
        seed: u64,
    ) -> Result<Self> {
        let keys: Vec<&TrialKey> = library.iter().map(|trial| &trial.key).collect();
        let labels = Labels::new(&keys, together(&library));
        let mut joint = JointEmbedder::new(scene, &library);
        for trial in &library {
            joint.check(trial)?;
        }
        let training = Training::new(&mut joint, &mut library, &labels, seed);
        let left_out = LeftOut::new(&joint, &training, &labels, &library);
        Ok(Self {
            scene: scene.clone(),
            shape: shape.clone(),
            keys: library.iter().map(|trial| trial.key.clone()).collect(),
            labels,
            joint,
            training,
            left_out,
            trained: Mutex::default(),
            unfollowed: Mutex::new(Some(library)),
            begun: OnceLock::new(),
            followed: OnceLock::new(),
            settling: OnceLock::new(),
        })
    }

    fn embed(&self, query: &TrialFrames) -> Result<(Vec<f32>, Present)> {
        self.joint.check(query)?;
        if !self.joint.says_something(query) {
            return Err(RecogniseError::TooLittle);
        }
        Ok(self.joint.embed(query))
    }

    /// The discriminants for a set of sources. They are trained when first needed, and kept.
    fn trained(&self, present: &Present) -> Arc<Trained> {
        if let Some(known) = self.left_out.trained.get(present) {
            return known.clone();
        }
        let lock = || self.trained.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = lock().get(present) {
            return known.clone();
        }
        let (joint, training, labels) = (&self.joint, &self.training, &self.labels);
        let trained = Trained::new(joint, training, labels, present, (self.left_out.drag_s, false));
        let trained = Arc::new(trained);
        lock().insert(present.clone(), trained.clone());
        trained
    }

    /// The measurements that judge answers to scans of `scan_s` seconds by these sources.
    fn measured<'a>(
        &'a self,
        trained: &'a Trained,
        present: &Present,
        scan_s: f64,
    ) -> &'a Measured {
        match scan_s < self.left_out.drag_s {
            true => self.begun().get(present).unwrap_or(&trained.whole),
            false => &trained.whole,
        }
    }

    /// How beginnings of left-out trials are answered. Computed once, since whole scans do not need it.
    pub(super) fn begun(&self) -> &BTreeMap<Present, Measured> {
        if let Some(known) = self.begun.get() {
            return known;
        }
        // Two threads may compute it. One that waits for the other might run the other's work.
        let library = self.unfollowed.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let measure = |library: Vec<Arc<TrialFrames>>| {
            self.left_out.begun(&self.joint, &self.training, &self.labels, &library)
        };
        let measured = library.map(measure).unwrap_or_default();
        self.begun.get_or_init(|| measured)
    }

    /// Makes a posterior from the answer of an ensemble, its temperature, and a p-value.
    fn posterior_of(&self, answer: &Answer, tau: f64, p_value: Option<f64>) -> Posterior {
        let log_posterior = answer.log_probabilities(tau);
        let probabilities = log_posterior.iter().map(|log_p| log_p.exp()).collect();
        let probabilities = held_back(probabilities, self.left_out.held_out);
        Posterior { log_posterior, probabilities, p_value }
    }

    pub(super) fn posterior(&self, vector: &[f32], present: &Present, scan_s: f64) -> Posterior {
        let trained = self.trained(present);
        let vector = ArrayView1::from(vector);
        let measured = self.measured(&trained, present, scan_s);
        let p_value = trained.p_value(vector, (scan_s, measured));
        // One vector has one answer.
        let answer = &trained.all.answers(&[vector])[0];
        self.posterior_of(answer, measured.temperature.at(scan_s), p_value)
    }

    pub(super) fn ranking(&self, vector: &[f32], present: &Present, scan_s: f64) -> Ranking {
        let posterior = self.posterior(vector, present, scan_s);
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
        let sources = self.joint.there(present).map(|stretch| stretch.spec.id.clone()).collect();
        // There is a candidate, since a library has at least two surfaces.
        let mut ranking = rank(candidates, 1, sources).expect("at least two candidates");
        ranking.confidence = (self.left_out.held_out > 0).then(|| posterior.probabilities[best]);
        ranking.p_value = posterior.p_value;
        ranking
    }

    /// The trial of a class that is nearest to a standardised vector.
    fn nearest(&self, vector: &[f32], present: &Present, class: usize) -> TrialKey {
        let columns = self.joint.columns(present);
        let distance = |trial: usize| -> f64 {
            let whole = self.training.whole(trial);
            columns.iter().map(|&c| f64::from(whole[c] - vector[c]).powi(2)).sum()
        };
        let members = (0..self.keys.len()).filter(|&i| self.labels.class[i] == class);
        let nearest = members.min_by(|&a, &b| distance(a).total_cmp(&distance(b)));
        // Every class has a trial, since the classes come from the trials.
        self.keys[nearest.unwrap_or(0)].clone()
    }

    /// The share of each source in half the distance to each surface, as a mean over members. The sum
    /// over sources is the mean of their −ln posterior, up to a constant that is the same for all
    /// surfaces.
    fn evidence(&self, vector: &[f32], present: &Present) -> Evidence {
        let columns: Vec<_> = self.joint.there(present).map(|s| s.columns.clone()).collect();
        let trained = &self.trained(present).all;
        let (weights, offsets) = trained.weights((self.labels.classes, self.joint.dims()));
        // u·m_c. The distance to class c is |u|² + |m_c|² − 2·u·m_c.
        let inner = |class: usize, vector: ArrayView1<'_, f32>, columns: &Range<usize>| {
            let columns = s![columns.clone()];
            f64::from(weights.row(class).slice(columns).dot(&vector.slice(columns)))
        };
        let mut terms = vec![vec![f64::INFINITY; self.labels.classes]; columns.len()];
        for class in (0..self.labels.classes).filter(|&class| trained.knows(class)) {
            let mean = self.training.class_mean(&self.labels, class);
            let offset = offsets[class] / columns.len() as f64;
            for (of_source, columns) in terms.iter_mut().zip(&columns) {
                let of_mean = inner(class, mean.view(), columns) - offset;
                let of_query = inner(class, ArrayView1::from(vector), columns) - offset;
                of_source[class] = 0.5 * of_mean - of_query;
            }
        }
        let of_source = |(stretch, terms): (&Stretch, Vec<f64>)| SourceEvidence {
            source: stretch.spec.id.clone(),
            terms,
        };
        let sources = self.joint.there(present).zip(terms).map(of_source).collect();
        Evidence { surfaces: self.labels.surfaces.clone(), sources }
    }

    pub(super) fn settling(&self, options: &FollowOptions) -> Settling {
        let choose = || Settling::choose(self.followed(), options);
        let (found_for, settling) = self.settling.get_or_init(|| (options.clone(), choose()));
        if found_for == options { settling.clone() } else { choose() }
    }

    /// The left-out trials, each named at every look of its growing drag. Computed once.
    pub(super) fn followed(&self) -> &[FollowedTrial] {
        // Needs the library too.
        self.begun();
        self.followed.get_or_init(|| {
            let library = self.unfollowed.lock().unwrap_or_else(PoisonError::into_inner).take();
            let follow = |library: Vec<Arc<TrialFrames>>| {
                let trials = library.par_iter().enumerate().filter(|(_, trial)| trial.is_followed);
                trials.filter_map(|(i, trial)| self.follow_one(trial, i)).collect()
            };
            library.map_or_else(Vec::new, follow)
        })
    }

    /// Follows a library trial like a follower, but with a model trained without the trial.
    fn follow_one(&self, frames: &TrialFrames, trial: usize) -> Option<FollowedTrial> {
        let present = &self.training.present[trial];
        let trained = self.left_out.trained.get(present)?;
        let trained = trained.can_name(&self.labels, trial).then_some(trained)?;
        let drag_s = self.joint.drag_s(frames)?;
        let whole = self.training.whole(trial);
        let looks: Vec<usize> = (1..=looks_in(drag_s)).collect();
        let beginnings = self.joint.beginnings(frames, whole, &looks);
        let views = beginnings.iter().map(ArrayView1::from).chain([whole]);
        let vectors: Vec<_> = views.map(|view| (trial, view)).collect();
        let mut answers = trained.of_left_out(&self.labels, &vectors);
        let (_, whole) = answers.pop()?;
        let measured = |scan_s: f64| self.measured(trained, present, scan_s);
        let posterior = |answer: &Answer, scan_s: f64| {
            // Only the model without this trial measures it, so this value is used for every group.
            let p_value = measured(scan_s).conformity.p_value(scan_s, |_| answer.strangeness());
            self.posterior_of(answer, measured(scan_s).temperature.at(scan_s), p_value)
        };
        let look = |(at, answer): (usize, Answer)| {
            let named = posterior(&answer, looks[at] as f64 * LOOK_S);
            let class = named.best();
            let probability = named.log_posterior[class].exp();
            LeftOutLook { class, probability, p_value: named.p_value }
        };
        Some(FollowedTrial {
            group: self.labels.group[trial],
            truth: self.labels.class[trial],
            whole: posterior(&whole, drag_s).best(),
            drag_s,
            looks: answers.into_iter().map(look).collect(),
        })
    }
}

impl Model for EmbeddingModel {
    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<Prepared> {
        let frames = TrialFrames::new(&entry.key, trial, &self.scene, &self.shape, None)?;
        Ok(Prepared::Frames(Arc::new(frames)))
    }

    fn rank(&self, query: &Prepared) -> Result<Ranking> {
        let query = query.frames(NAME)?;
        let (vector, present) = self.embed(query)?;
        Ok(self.ranking(&vector, &present, self.left_out.ended_s(self.joint.drag_s(query))))
    }

    fn explain(&self, query: &Prepared) -> Result<Option<Evidence>> {
        let query = query.frames(NAME)?;
        let (vector, present) = self.embed(query)?;
        Ok(Some(self.evidence(&vector, &present)))
    }

    fn as_any(self: Arc<Self>) -> Option<Arc<dyn Any + Send + Sync>> {
        Some(self)
    }
}

impl dyn Model {
    /// The model as that of the method `embedding`, which can do more; `None` for other methods.
    pub fn embedding(self: Arc<Self>) -> Option<Arc<EmbeddingModel>> {
        self.as_any()?.downcast().ok()
    }

    /// How long scans must last to reach `accuracy`. If `accuracy` is `None`, they may lose at most
    /// one percentage point against whole scans. All commands use this number. `None` if the method
    /// cannot follow scans.
    pub fn scan_time(self: Arc<Self>, accuracy: Option<f64>) -> Option<ScanTime> {
        Some(self.embedding()?.left_out_accuracy().scan_time(Goal::wanted(accuracy)))
    }
}

impl EmbeddingModel {
    /// The share of time, from 0 to 1, that each channel of a source usually rests at one value in a
    /// trial of the library; a query's channel that rests as long is not dead. Empty for pictures and
    /// for sources that the library lacks.
    pub fn rests(&self, source: &SourceId) -> &[f32] {
        match self.joint.stretch(source).map(|stretch| &stretch.embedder) {
            Some(SourceEmbedder::Series(embedder)) => &embedder.rests,
            _ => &[],
        }
    }

    /// Trains for scans that have these sources, if no library trial has exactly these, so that the first
    /// such scan does not wait for it.
    pub fn ready_for(&self, sources: &BTreeSet<SourceId>) {
        let has = |stretch: &Stretch| sources.contains(&stretch.spec.id);
        let present: Present = self.joint.stretches.iter().map(has).collect();
        if present.contains(&true) {
            self.trained(&present);
        }
    }

    /// Measures beginnings of left-out trials if scans with a drag of `drag_s` seconds are judged by them, so
    /// that the first such scan does not wait for it.
    pub fn ready_for_length(&self, drag_s: Option<f64>) {
        if self.left_out.ended_s(drag_s) < self.left_out.drag_s {
            self.begun();
        }
    }

    /// A query that can be named several times, each time by some of its sources.
    ///
    /// # Errors
    /// The errors of [`Model::rank`].
    pub fn by_sources(self: Arc<Self>, query: &Prepared) -> Result<QueryVector> {
        let (vector, present) = self.embed(query.frames(NAME)?)?;
        Ok(QueryVector { model: self, vector, present })
    }

    /// How many left-out library trials are named right at each scan time. The first call takes a
    /// while, unless scans were followed before.
    pub fn left_out_accuracy(&self) -> LeftOutAccuracy {
        let mut trials = vec![0; self.labels.classes];
        self.labels.class.iter().for_each(|&class| trials[class] += 1);
        let people: BTreeSet<&str> = self.keys.iter().map(|key| key.user.as_str()).collect();
        let counts = LibraryCounts {
            people: people.len(),
            left_out: self.labels.left_out,
            surfaces: self.labels.surfaces.iter().cloned().zip(trials).collect(),
        };
        LeftOutAccuracy::new(self.followed(), counts)
    }

    /// How many trials of each surface were left out, and how many of these were named right by a model
    /// without them. Surfaces of which none could be left out do not occur. Of a large library, only
    /// some trials are. The first call takes a while, unless scans were followed before.
    pub fn left_out_of_each(&self) -> BTreeMap<String, (usize, usize)> {
        let mut found = BTreeMap::new();
        for trial in self.followed() {
            let surface = self.labels.surfaces[trial.truth].clone();
            let (trials, right) = found.entry(surface).or_default();
            (*trials, *right) = (*trials + 1, *right + usize::from(trial.whole == trial.truth));
        }
        found
    }

    /// The p-value at or below which a query is called unknown, for a stated false rejection rate. If
    /// `rate` is `None`, the rate is 1 %, or the lowest rate that the library's trials can show.
    ///
    /// # Errors
    /// If the library has too few trials.
    pub fn rejection(&self, rate: Option<f64>) -> Result<Rejection, RejectionError> {
        let all = vec![true; self.joint.stretches.len()];
        let trials = self.trained(&all).whole.conformity.trials();
        let left_out = self.labels.left_out;
        match rate {
            None => Rejection::usual(trials, left_out),
            Some(rate) => Rejection::new(trials, left_out, rate),
        }
    }
}

/// A query as a vector, to be named by any of its sources.
pub struct QueryVector {
    model: Arc<EmbeddingModel>,
    vector: Vec<f32>,
    present: Present,
}

impl QueryVector {
    /// The surface most like the query by `sources` alone; `None` if the query and the library have
    /// none of these sources in common.
    pub fn surface(&self, sources: &[&SourceId]) -> Option<&str> {
        let stretches = self.model.joint.stretches.iter().zip(&self.present);
        let chosen: Present =
            stretches.map(|(s, has)| *has && sources.contains(&&s.spec.id)).collect();
        if !chosen.contains(&true) {
            return None;
        }
        let posterior = self.model.posterior(&self.vector, &chosen, f64::INFINITY);
        Some(&self.model.labels.surfaces[posterior.best()])
    }
}

/// Probabilities, mixed with equal shares so that none is above (m + ½)/(m + 1). With m = `held_out`
/// left-out trials no more can be shown, even if all are named right.
fn held_back(mut probabilities: Vec<f64>, held_out: usize) -> Vec<f64> {
    let classes = probabilities.len() as f64;
    let doubt = 0.5 / (held_out as f64 + 1.0);
    let shared = (doubt / (1.0 - 1.0 / classes)).min(1.0);
    probabilities.iter_mut().for_each(|p| *p = (1.0 - shared) * *p + shared / classes);
    probabilities
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_probability_is_beyond_what_the_left_out_trials_can_show() {
        for (trials, classes) in [(0, 2), (7, 3), (200, 20)] {
            let mut sure = vec![0.0; classes];
            sure[0] = 1.0;
            let held = held_back(sure, trials);
            let most = (trials as f64 + 0.5) / (trials as f64 + 1.0);
            assert!(
                (held[0] - most).abs() < 1e-12 && (held.iter().sum::<f64>() - 1.0).abs() < 1e-12
            );
        }
        let even = held_back(vec![0.5; 2], 3);
        assert!((even[0] - 0.5).abs() < 1e-12);
    }
}
