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
use crate::features::frames::{LOOK_S, TrialFrames};
use crate::recognise::decide::conformal::{Calibration, Conformity};

/// Each left-out trial is also examined after these shares of the median length of a drag.
const BEGINNINGS: [f64; 6] = [0.04, 0.08, 0.15, 0.25, 0.4, 0.65];

/// A scan counts as whole if it is longer than this share of the library's trials.
const SHORTER: f64 = 0.05;

/// Most trials with beginnings to examine; more would not change any stated digit.
const MOST_BEGUN: usize = 400;

/// Ensembles for one set of sources: trained on all trials, and without each group.
#[derive(Serialize, Deserialize)]
pub(super) struct Trained {
    pub all: Ensemble,
    /// Trained without each group; `None` if too few trials are left.
    pub without: Vec<Option<Ensemble>>,
    /// How far left-out trials lie from all surfaces by these sources.
    pub conformity: Conformity,
    /// How much less certain than its members an ensemble is.
    pub temperature: Temperature,
}

/// Beginnings of left-out trials.
#[derive(Default)]
struct Begun {
    /// Lengths of the beginnings, in steps of [`LOOK_S`].
    looks: Vec<usize>,
    /// Index of each trial, and its standardised vector at each of `looks`.
    trials: Vec<(usize, Vec<Vec<f32>>)>,
}

impl Trained {
    fn new(joint: &JointEmbedder, training: &Training, present: &Present) -> Self {
        let (all, without) = training.ensembles(joint, present);
        Self {
            all,
            without,
            conformity: Conformity::default(),
            temperature: Temperature::default(),
        }
    }

    /// Trains, and measures conformity and temperature with the library trials that have these sources.
    /// `drag_s` is the median length of their drag in seconds.
    pub(super) fn measured(
        joint: &JointEmbedder,
        training: &Training,
        labels: &Labels,
        present: &Present,
        drag_s: f64,
    ) -> Self {
        let mut trained = Self::new(joint, training, present);
        trained.measure(training, labels, present, (drag_s, &Begun::default()));
        trained
    }

    /// Measures conformity and temperature. In a library of one person, excerpts replace scans by
    /// somebody else.
    fn measure(
        &mut self,
        training: &Training,
        labels: &Labels,
        present: &Present,
        (drag_s, begun): (f64, &Begun),
    ) {
        let full: Vec<bool> = (training.present.iter())
            .map(|of_trial| present.iter().zip(of_trial).all(|(want, has)| has | !want))
            .collect();
        let trials = || (0..full.len()).filter(|&i| full[i]);
        // Answers to vectors, each with its trial.
        let answers = |vectors: Vec<(usize, ArrayView1<'_, f32>)>| -> Vec<(usize, Answer)> {
            let of_left_out = self.of_left_out(labels, &vectors).into_iter();
            of_left_out.map(|(at, answer)| (vectors[at].0, answer)).collect()
        };
        let calibration = |scan_s: f64, of_each: usize, answers: &[(usize, Answer)]| {
            let scans = answers.iter();
            let scans = scans.map(|(trial, answer)| (labels.group[*trial], answer.strangeness()));
            Calibration::new(scan_s, of_each, scans)
        };
        let beginning = |(at, look): (usize, &usize)| {
            let kept = begun.trials.iter().filter(|(trial, _)| full[*trial]);
            let vectors = kept.map(|(trial, vectors)| (*trial, ArrayView1::from(&vectors[at])));
            (*look as f64 * LOOK_S, answers(vectors.collect()))
        };
        let begun: Vec<(f64, Vec<(usize, Answer)>)> =
            begun.looks.iter().enumerate().map(beginning).collect();
        let (across_people, excerpt_s) = (labels.left_out.across_people(), SHARE * drag_s);
        let longest_s = if across_people { f64::INFINITY } else { excerpt_s - 1e-9 };
        let mut by_length: Vec<Calibration> = (begun.iter())
            .filter(|(scan_s, _)| *scan_s < longest_s)
            .map(|(scan_s, answers)| calibration(*scan_s, 1, answers))
            .collect();
        if begun.is_empty() || !across_people {
            let of_each = trials().map(|i| training.excerpts(i).count()).max().unwrap_or(1);
            let excerpts = trials().flat_map(|i| training.excerpts(i).map(move |x| (i, x)));
            by_length.push(calibration(excerpt_s, of_each, &answers(excerpts.collect())));
        }
        // Conformity needs all whole trials or none, the temperature no more than these.
        let sample = evenly(full.len());
        let is_sampled = |trial: &usize| sample.binary_search(trial).is_ok();
        let wholes = trials().filter(|i| across_people || is_sampled(i));
        let mut wholes = answers(wholes.map(|i| (i, training.whole(i))).collect());
        if across_people {
            by_length.push(calibration(drag_s, 1, &wholes));
        }
        wholes.retain(|(trial, _)| is_sampled(trial));
        let known = |(scan_s, answers): (f64, Vec<(usize, Answer)>)| {
            let known = answers.into_iter().filter(|(trial, _)| self.can_name(labels, *trial));
            (scan_s, known.map(|(trial, answer)| (answer, labels.class[trial])).collect())
        };
        let held_out: Vec<_> = begun.into_iter().chain([(drag_s, wholes)]).map(known).collect();
        let temperature = Temperature::fit(&held_out);
        let conformity = Conformity::new(by_length);
        (self.conformity, self.temperature) = (conformity, temperature);
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

    pub(super) fn p_value(&self, vector: ArrayView1<'_, f32>, scan_s: f64) -> Option<f64> {
        let of_group = |without: &Option<Ensemble>| {
            without.as_ref().map_or(f64::INFINITY, |w| w.answers(&[vector])[0].strangeness())
        };
        let scores: Vec<f64> = self.without.par_iter().map(of_group).collect();
        self.conformity.p_value(scan_s, |group| scores[group])
    }
}

#[derive(Serialize, Deserialize)]
pub(super) struct LeftOut {
    /// Number of trials that a model without their group can name. Those that share samples count once.
    pub held_out: usize,
    /// Median length of the drag, in seconds, of the trials that have all sources; 0 if there are none.
    pub drag_s: f64,
    /// Scans of at least this many seconds count as whole. In a library of several people, all trials
    /// except a share [`SHORTER`] reach it. In a library of one person, half of the trials do, since
    /// whole scans are compared with excerpts there.
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
        let mut trained: BTreeMap<Present, Trained> = BTreeMap::new();
        let all = vec![true; joint.stretches.len()];
        for present in training.present.iter().chain([&all]) {
            let train = || Trained::new(joint, training, present);
            trained.entry(present.clone()).or_insert_with(train);
        }
        let is_known = |i: usize| trained[&training.present[i]].can_name(labels, i);
        let is_full = |i: &usize| training.present[*i].iter().all(|has| *has);
        let mut lengths: Vec<f64> =
            (0..library.len()).filter(is_full).filter_map(|i| joint.drag_s(&library[i])).collect();
        lengths.sort_by(f64::total_cmp);
        let quantile = |share: f64| {
            lengths.get((share * lengths.len() as f64) as usize).copied().unwrap_or(0.0)
        };
        let drag_s = quantile(0.5);
        let whole_from_s = if labels.left_out.across_people() { quantile(SHORTER) } else { drag_s };
        let mut looks: Vec<usize> = BEGINNINGS
            .map(|share| (share * drag_s / LOOK_S).round().max(1.0) as usize)
            .into_iter()
            .filter(|look| *look as f64 * LOOK_S < drag_s)
            .collect();
        looks.dedup();
        let last_s = looks.last().map_or(f64::INFINITY, |last| *last as f64 * LOOK_S);
        let begun = |i: usize| {
            let long_enough = joint.drag_s(&library[i])? >= last_s;
            let begin = || joint.beginnings(&library[i], training.whole(i), &looks);
            long_enough.then(|| (i, begin()))
        };
        let trials = evenly(library.len()).into_par_iter().filter(|&i| is_known(i));
        let trials = trials.filter_map(begun).collect();
        let begun = Begun { looks, trials };
        let known = (0..library.len()).filter(|&i| is_known(i));
        let held_out = known.map(|i| labels.together[i]).collect::<BTreeSet<_>>().len();
        trained.iter_mut().for_each(|(present, trained)| {
            trained.measure(training, labels, present, (drag_s, &begun));
        });
        Self {
            held_out,
            drag_s,
            whole_from_s,
            trained: trained.into_iter().map(|(has, trained)| (has, Arc::new(trained))).collect(),
        }
    }

    /// The length that a finished scan with a drag of `drag_s` counts as; infinite without a drag. A
    /// scan about as long as the library's trials counts as whole, not as a beginning.
    pub(super) fn ended_s(&self, drag_s: Option<f64>) -> f64 {
        let drag_s = drag_s.unwrap_or(f64::INFINITY);
        if drag_s >= self.whole_from_s { drag_s.max(self.drag_s) } else { drag_s }
    }
}

/// Indices of at most [`MOST_BEGUN`] trials, evenly spread.
pub(super) fn evenly(trials: usize) -> Vec<usize> {
    let used = trials.min(MOST_BEGUN);
    (0..used).map(|i| i * trials / used).collect()
}
