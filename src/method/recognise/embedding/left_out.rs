//! Leaves library trials out, group by group. Finds how far from all surfaces a known trial can lie,
//! and which trials are named right.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use ndarray::ArrayView1;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::ensemble::{Answer, Ensemble};
use super::joint::{JointEmbedder, Present};
use super::labels::Labels;
use super::temperature::Temperature;
use super::training::Training;
use crate::features::copies::SHARE;
use crate::features::frames::{FOLLOWED, LOOK_S, TrialFrames};
use crate::recognise::decide::conformal::{Calibration, Conformity};

/// Each left-out trial is also examined after these shares of the median length of a drag.
const BEGINNINGS: [f64; 6] = [0.04, 0.08, 0.15, 0.25, 0.4, 0.65];

/// A scan counts as whole if it is longer than this share of the library's trials.
const SHORTER: f64 = 0.05;

/// Ensembles for one set of sources: trained on all trials, and without each group.
#[derive(Serialize, Deserialize)]
pub(super) struct Trained {
    pub all: Ensemble,
    /// Trained without each group; `None` if too few trials are left.
    pub without: Vec<Option<Ensemble>>,
    /// How left-out trials as long as the library's are answered.
    pub whole: Measured,
}

/// How left-out trials are answered by some sources.
#[derive(Default, Serialize, Deserialize)]
pub(super) struct Measured {
    /// How far they lie from all surfaces.
    pub conformity: Conformity,
    /// The factor by which an ensemble is less certain than its members.
    pub temperature: Temperature,
}

impl Trained {
    /// Trains, and measures whole trials that have these sources; in a library of one person excerpts,
    /// which replace scans by somebody else. `drag_s` is the median length of a drag in seconds.
    /// Excerpts also stand for shorter scans unless the library `begins`, so that beginnings do.
    pub(super) fn new(
        joint: &JointEmbedder,
        training: &Training,
        labels: &Labels,
        present: &Present,
        (drag_s, begins): (f64, bool),
    ) -> Self {
        let (all, without) = training.ensembles(joint, present);
        let mut trained = Self { all, without, whole: Measured::default() };
        let has_all = has_all(training, present);
        let trials = || (0..has_all.len()).filter(|&i| has_all[i]);
        let across_people = labels.left_out.across_people();
        let mut by_length = Vec::new();
        if !across_people || !begins {
            let of_each = trials().map(|i| training.excerpts(i).count()).max().unwrap_or(1);
            let excerpts = trials().flat_map(|i| training.excerpts(i).map(move |x| (i, x)));
            let answers = trained.to_trials(labels, &excerpts.collect::<Vec<_>>());
            by_length.push(calibration(labels, SHARE * drag_s, of_each, &answers));
        }
        // Conformity needs all whole trials or none, the temperature no more than these.
        // Ordered by digest, the first are any.
        let is_sampled = |trial: &usize| *trial < FOLLOWED;
        let wholes = trials().filter(|i| across_people || is_sampled(i));
        let wholes: Vec<_> = wholes.map(|i| (i, training.whole(i))).collect();
        let mut wholes = trained.to_trials(labels, &wholes);
        if across_people {
            by_length.push(calibration(labels, drag_s, 1, &wholes));
        }
        wholes.retain(|(trial, _)| is_sampled(trial));
        let held_out = [(drag_s, trained.to_known(labels, wholes))];
        let temperature = Temperature::fit(&held_out, Temperature::default());
        trained.whole = Measured { conformity: Conformity::new(by_length), temperature };
        trained
    }

    /// Measures beginnings too: of lengths `looks`, in steps of [`LOOK_S`]. `begun` has the index of each
    /// trial, and its standardised vector at each of `looks`.
    fn measured(
        &self,
        training: &Training,
        labels: &Labels,
        present: &Present,
        drag_s: f64,
        looks: &[usize],
        begun: &[(usize, Vec<Vec<f32>>)],
    ) -> Measured {
        let has_all = has_all(training, present);
        let at_look = |(at, look): (usize, &usize)| {
            let kept = begun.iter().filter(|(trial, _)| has_all[*trial]);
            let vectors = kept.map(|(trial, vectors)| (*trial, ArrayView1::from(&vectors[at])));
            let answers = self.to_trials(labels, &vectors.collect::<Vec<_>>());
            (*look as f64 * LOOK_S, answers)
        };
        let begun: Vec<_> = looks.iter().enumerate().map(at_look).collect();
        let across_people = labels.left_out.across_people();
        let longest_s = if across_people { f64::INFINITY } else { SHARE * drag_s - 1e-9 };
        let by_length = (begun.iter())
            .filter(|(scan_s, _)| *scan_s < longest_s)
            .map(|(scan_s, answers)| calibration(labels, *scan_s, 1, answers));
        let conformity = self.whole.conformity.after(by_length);
        let known = |(scan_s, answers)| (scan_s, self.to_known(labels, answers));
        let held_out: Vec<_> = begun.into_iter().map(known).collect();
        let temperature = Temperature::fit(&held_out, self.whole.temperature.clone());
        Measured { conformity, temperature }
    }

    /// The answers to vectors of library trials by the ensembles without their groups, each with its
    /// trial.
    fn to_trials(
        &self,
        labels: &Labels,
        vectors: &[(usize, ArrayView1<'_, f32>)],
    ) -> Vec<(usize, Answer)> {
        let of_left_out = self.of_left_out(labels, vectors).into_iter();
        of_left_out.map(|(at, answer)| (vectors[at].0, answer)).collect()
    }

    /// The answers to trials whose class an ensemble without their group knows, each with the class.
    fn to_known(&self, labels: &Labels, answers: Vec<(usize, Answer)>) -> Vec<(Answer, usize)> {
        let known = answers.into_iter().filter(|(trial, _)| self.can_name(labels, *trial));
        known.map(|(trial, answer)| (answer, labels.class[trial])).collect()
    }

    /// The answers to vectors of library trials by the ensembles without their groups. Each vector comes
    /// with its trial, each answer with the index of its vector. An ensemble may not know the class of
    /// a trial; if there is no ensemble, there is no answer.
    pub(super) fn of_left_out(
        &self,
        labels: &Labels,
        vectors: &[(usize, ArrayView1<'_, f32>)],
    ) -> Vec<(usize, Answer)> {
        let of_group = |(group, without): (usize, &Option<Ensemble>)| {
            let own = (0..vectors.len()).filter(|&at| labels.group[vectors[at].0] == group);
            let own: Vec<usize> = own.collect();
            let views: Vec<ArrayView1<'_, f32>> = own.iter().map(|&at| vectors[at].1).collect();
            let without = without.as_ref().filter(|_| !own.is_empty());
            let answers = without.map(|without| without.answers(&views));
            own.into_iter().zip(answers.unwrap_or_default()).collect::<Vec<_>>()
        };
        self.without.iter().enumerate().flat_map(of_group).collect()
    }

    /// Whether the ensemble without the group of a library trial knows the trial's class.
    pub(super) fn can_name(&self, labels: &Labels, trial: usize) -> bool {
        let without = self.without[labels.group[trial]].as_ref();
        without.is_some_and(|without| without.knows(labels.class[trial]))
    }

    /// The p-value of a vector of a scan of `scan_s` seconds, by one of the measurements of these
    /// ensembles.
    pub(super) fn p_value(
        &self,
        vector: ArrayView1<'_, f32>,
        (scan_s, measured): (f64, &Measured),
    ) -> Option<f64> {
        let of_group = |without: &Option<Ensemble>| {
            without.as_ref().map_or(f64::INFINITY, |w| w.answers(&[vector])[0].strangeness())
        };
        let scores: Vec<f64> = self.without.par_iter().map(of_group).collect();
        measured.conformity.p_value(scan_s, |group| scores[group])
    }
}

/// Whether each library trial has all sources that are `present`.
fn has_all(training: &Training, present: &Present) -> Vec<bool> {
    let has = |of_trial: &Present| present.iter().zip(of_trial).all(|(want, has)| has | !want);
    training.present.iter().map(has).collect()
}

fn calibration(
    labels: &Labels,
    scan_s: f64,
    of_each: usize,
    answers: &[(usize, Answer)],
) -> Calibration {
    let scans = answers.iter();
    let scans = scans.map(|(trial, answer)| (labels.group[*trial], answer.strangeness()));
    Calibration::new(scan_s, of_each, scans)
}

#[derive(Serialize, Deserialize)]
pub(super) struct LeftOut {
    /// Number of trials that a model without their group can name. Those that share samples count once.
    pub held_out: usize,
    /// Median length of the drag, in seconds, of the trials that have all sources; 0 if there are none.
    pub drag_s: f64,
    /// Scans of at least this many seconds count as whole. All trials except a share [`SHORTER`] reach it.
    whole_from_s: f64,
    /// Ensembles for each set of sources that occurs in the library.
    pub trained: BTreeMap<Present, Arc<Trained>>,
}

impl LeftOut {
    pub(super) fn new(
        joint: &JointEmbedder,
        training: &Training,
        labels: &Labels,
        library: &[Arc<TrialFrames>],
    ) -> Self {
        let is_full = |i: &usize| training.present[*i].iter().all(|has| *has);
        let mut lengths: Vec<f64> =
            (0..library.len()).filter(is_full).filter_map(|i| joint.drag_s(&library[i])).collect();
        lengths.sort_by(f64::total_cmp);
        let quantile = |share: f64| {
            lengths.get((share * lengths.len() as f64) as usize).copied().unwrap_or(0.0)
        };
        let (drag_s, whole_from_s) = (quantile(0.5), quantile(SHORTER));
        let begins = !looks(drag_s).is_empty();
        let mut trained: BTreeMap<Present, Arc<Trained>> = BTreeMap::new();
        let all = vec![true; joint.stretches.len()];
        for present in training.present.iter().chain([&all]) {
            let train = || Trained::new(joint, training, labels, present, (drag_s, begins));
            trained.entry(present.clone()).or_insert_with(|| Arc::new(train()));
        }
        let is_known = |i: &usize| trained[&training.present[*i]].can_name(labels, *i);
        let known = (0..library.len()).filter(is_known);
        let held_out = known.map(|i| labels.together[i]).collect::<BTreeSet<_>>().len();
        Self { held_out, drag_s, whole_from_s, trained }
    }

    /// Measures beginnings of left-out trials, for each set of sources that occurs in the library.
    pub(super) fn begun(
        &self,
        joint: &JointEmbedder,
        training: &Training,
        labels: &Labels,
        library: &[Arc<TrialFrames>],
    ) -> BTreeMap<Present, Measured> {
        let looks = looks(self.drag_s);
        let last_s = looks.last().map_or(f64::INFINITY, |last| *last as f64 * LOOK_S);
        let is_known = |i: &usize| self.trained[&training.present[*i]].can_name(labels, *i);
        let begin = |i: usize| {
            let is_judged = library[i].is_followed && joint.drag_s(&library[i])? >= last_s;
            is_judged.then(|| (i, joint.beginnings(&library[i], training.whole(i), &looks)))
        };
        let trials = (0..library.len()).into_par_iter().filter(is_known);
        let begun: Vec<_> = trials.filter_map(begin).collect();
        let measured = |(present, trained): (&Present, &Arc<Trained>)| {
            let measured = trained.measured(training, labels, present, self.drag_s, &looks, &begun);
            (present.clone(), measured)
        };
        self.trained.iter().map(measured).collect()
    }

    /// The length that a finished scan with a drag of `drag_s` counts as; infinite without a drag. A
    /// scan about as long as the library's trials counts as whole, not as a beginning.
    pub(super) fn ended_s(&self, drag_s: Option<f64>) -> f64 {
        let drag_s = drag_s.unwrap_or(f64::INFINITY);
        if drag_s >= self.whole_from_s { drag_s.max(self.drag_s) } else { drag_s }
    }
}

/// The lengths of the beginnings of trials with a drag of `drag_s` seconds, in steps of [`LOOK_S`].
fn looks(drag_s: f64) -> Vec<usize> {
    let step = |share: f64| (share * drag_s / LOOK_S).round().max(1.0) as usize;
    let mut looks = BEGINNINGS.map(step).to_vec();
    looks.retain(|look| (*look as f64) * LOOK_S < drag_s);
    looks.dedup();
    looks
}
