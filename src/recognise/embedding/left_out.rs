//! Leaves library trials out, group by group, and finds how sure a model may be, how far from all
//! surfaces a known trial can lie, when an answer is settled, and which are right by each time.

use std::collections::BTreeMap;
use std::sync::Arc;

use ndarray::ArrayView1;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::calibrated_probability::{HeldOut, Temperature};
use super::copies::{EXCERPTS, SHARE};
use super::discriminant::Discriminant;
use super::frames::TrialFrames;
use super::joint::{JointEmbedder, Present};
use super::labels::Labels;
use super::training::Training;
use crate::recognise::decide::conformal::{Calibration, Conformity, nonconformity};
use crate::recognise::decide::scan_time::{LeftOutScan, looked_after};
use crate::recognise::decide::settle::{Look, Stops};
use crate::recognise::follow::{FollowOptions, LOOK_S};

/// Lengths of the beginnings of left-out trials that are examined, as shares of the median drag.
const BEGINNINGS: [f64; 6] = [0.04, 0.08, 0.15, 0.25, 0.4, 0.65];

/// Share of the library's trials that are shorter than what counts as a whole scan.
const SHORTER: f64 = 0.05;

/// Most trials whose beginnings are examined: more would change no digit that is stated.
const MOST_BEGUN: usize = 400;

/// Discriminants for one set of sources: from all trials, and from those outside each group.
#[derive(Serialize, Deserialize)]
pub(super) struct Trained {
    /// Trained on all trials; plain distances to the class means if that is not possible.
    pub all: Discriminant,
    /// Trained without each group; `None` where too few trials are left.
    pub without: Vec<Option<Discriminant>>,
    /// How far left-out trials lie from all surfaces by these sources.
    pub conformity: Conformity,
}

/// Beginnings of left-out trials: length in seconds; trials, each with its standardised vector.
type Begun = (f64, Vec<(usize, Vec<f32>)>);

impl Trained {
    /// Trains without measuring conformity.
    fn new(joint: &JointEmbedder, training: &Training, present: &Present) -> Self {
        let (all, without) = training.discriminants(joint, present);
        Self { all, without, conformity: Conformity::default() }
    }

    /// Trains, and measures the conformity of the library trials that have these sources; `drag_s`
    /// is the median length of their drag.
    pub fn measured(
        joint: &JointEmbedder,
        training: &Training,
        labels: &Labels,
        present: &Present,
        drag_s: f64,
    ) -> Self {
        let mut trained = Self::new(joint, training, present);
        trained.measure(training, labels, present, (drag_s, &[]));
        trained
    }

    /// Measures conformity. In a library of one person, excerpts stand for scans by somebody else.
    fn measure(
        &mut self,
        training: &Training,
        labels: &Labels,
        present: &Present,
        (drag_s, begun): (f64, &[Begun]),
    ) {
        let full: Vec<usize> = (0..labels.class.len())
            .filter(|&i| present.iter().zip(&training.present[i]).all(|(want, has)| has | !want))
            .collect();
        let strange = |trial: usize, vector: ArrayView1<'_, f32>| {
            let group = labels.group[trial];
            let without = self.without[group].as_ref()?;
            Some((group, nonconformity(&without.distances(vector))))
        };
        let excerpt_s = SHARE * drag_s;
        let longest_s = if labels.across_users { f64::INFINITY } else { excerpt_s - 1e-9 };
        let shorter = begun.iter().filter(|(scan_s, _)| *scan_s < longest_s);
        let mut by_length: Vec<Calibration> = shorter
            .map(|(scan_s, vectors)| {
                let kept = vectors.iter().filter(|(trial, _)| full.contains(trial));
                let scans = kept.filter_map(|(trial, vector)| strange(*trial, vector.into()));
                Calibration::new(*scan_s, 1, scans)
            })
            .collect();
        let excerpts = |of_each: usize| {
            let all = full
                .iter()
                .flat_map(|&i| training.excerpts(i).into_iter().map(move |vector| (i, vector)));
            let scans = all.filter_map(|(i, vector)| strange(i, vector[..].into()));
            Calibration::new(excerpt_s, of_each, scans)
        };
        if labels.across_users {
            if begun.is_empty() {
                by_length.push(excerpts(EXCERPTS));
            }
            let wholes = full.iter().filter_map(|&i| strange(i, training.whole(i)));
            by_length.push(Calibration::new(drag_s, 1, wholes));
        } else {
            by_length.push(excerpts(EXCERPTS));
        }
        self.conformity = Conformity::new(by_length);
    }

    /// The p-value of a scan of `scan_s` seconds.
    pub fn p_value(&self, vector: ArrayView1<'_, f32>, scan_s: f64) -> Option<f64> {
        let of_group = |without: &Option<Discriminant>| {
            without.as_ref().map_or(f64::INFINITY, |w| nonconformity(&w.distances(vector)))
        };
        let scores: Vec<f64> = self.without.iter().map(of_group).collect();
        self.conformity.p_value(scan_s, |group| scores[group])
    }
}

/// What was found by leaving trials out.
#[derive(Serialize, Deserialize)]
pub(super) struct LeftOut {
    /// Temperature τ of probabilities, as a function of the length of a scan.
    pub temperature: Temperature,
    /// Distances of whole left-out trials, with their classes.
    pub held_out: Vec<HeldOut>,
    /// Median length of the drag of trials that have all sources, in seconds; 0 if none has.
    pub drag_s: f64,
    /// Scans of this length and above count as whole. All but [`SHORTER`] of these trials are as
    /// long; half of them in a library of one person, where whole scans are compared with excerpts.
    whole_from_s: f64,
    /// Discriminants for each set of sources that library trials have.
    pub trained: BTreeMap<Present, Arc<Trained>>,
}

impl LeftOut {
    /// Leaves the trials of a library out with their groups.
    pub fn new(
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
        let without = |i: usize| {
            let without = trained[&training.present[i]].without[labels.group[i]].as_ref();
            without.filter(|without| without.knows(labels.class[i]))
        };
        let is_full = |i: &usize| training.present[*i].iter().all(|has| *has);
        let mut lengths: Vec<f64> =
            (0..library.len()).filter(is_full).filter_map(|i| joint.drag_s(&library[i])).collect();
        lengths.sort_by(f64::total_cmp);
        let quantile = |share: f64| {
            lengths.get((share * lengths.len() as f64) as usize).copied().unwrap_or(0.0)
        };
        let drag_s = quantile(0.5);
        let whole_from_s = if labels.across_users { quantile(SHORTER) } else { drag_s };
        let mut looks: Vec<usize> = BEGINNINGS
            .map(|share| (share * drag_s / LOOK_S).round().max(1.0) as usize)
            .into_iter()
            .filter(|look| *look as f64 * LOOK_S < drag_s)
            .collect();
        looks.dedup();
        let last_s = looks.last().map_or(f64::INFINITY, |last| *last as f64 * LOOK_S);
        let begun = |i: usize| {
            without(i)?;
            let long_enough = joint.drag_s(&library[i])? >= last_s;
            let begin = || joint.beginnings(&library[i], training.whole(i), &looks);
            long_enough.then(|| (i, begin()))
        };
        let vectors: Vec<(usize, Vec<Vec<f32>>)> =
            evenly(library.len()).into_par_iter().filter_map(begun).collect();
        let of_look = |(at, look): (usize, &usize)| -> Begun {
            let of_look = |(i, vectors): &(usize, Vec<Vec<f32>>)| (*i, vectors[at].clone());
            (*look as f64 * LOOK_S, vectors.iter().map(of_look).collect())
        };
        let begun: Vec<Begun> = looks.iter().enumerate().map(of_look).collect();
        let held_out = |i: usize, vector: ArrayView1<'_, f32>| -> Option<HeldOut> {
            Some((without(i)?.distances(vector), labels.class[i]))
        };
        let whole: Vec<HeldOut> = (0..library.len())
            .into_par_iter()
            .filter_map(|i| held_out(i, training.whole(i)))
            .collect();
        let mut by_length: Vec<(f64, Vec<HeldOut>)> = (begun.iter())
            .map(|(scan_s, vectors)| {
                let of_trial = |(i, vector): &(usize, Vec<f32>)| held_out(*i, vector.into());
                (*scan_s, vectors.iter().filter_map(of_trial).collect())
            })
            .collect();
        by_length.push((drag_s, whole.clone()));
        trained.iter_mut().for_each(|(present, trained)| {
            trained.measure(training, labels, present, (drag_s, &begun));
        });
        Self {
            temperature: Temperature::fit(&by_length),
            held_out: whole,
            drag_s,
            whole_from_s,
            trained: trained.into_iter().map(|(has, trained)| (has, Arc::new(trained))).collect(),
        }
    }

    /// The length that a finished scan of `scan_s` seconds counts as. A scan about as long as the
    /// library's trials counts as whole, not as the beginning of a longer one.
    pub fn ended_s(&self, scan_s: f64) -> f64 {
        if scan_s >= self.whole_from_s { scan_s.max(self.drag_s) } else { scan_s }
    }

    /// The discriminant trained without a trial's group, if it knows the trial's class.
    pub fn without(
        &self,
        labels: &Labels,
        present: &Present,
        trial: usize,
    ) -> Option<&Discriminant> {
        let without = self.trained.get(present)?.without.get(labels.group[trial])?.as_ref();
        without.filter(|without| without.knows(labels.class[trial]))
    }
}

/// Indices of at most [`MOST_BEGUN`] trials, evenly spread.
pub(super) fn evenly(trials: usize) -> Vec<usize> {
    let used = trials.min(MOST_BEGUN);
    (0..used).map(|i| i * trials / used).collect()
}

/// A left-out trial, named at each look while its drag grows by a model trained without it. This
/// does not depend on [`FollowOptions`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct FollowedTrial {
    /// The group that it was left out with.
    pub group: usize,
    /// Index of its true surface.
    pub truth: usize,
    /// Index of the surface that it is named by its whole length.
    pub whole: usize,
    /// Length of its drag in seconds.
    pub drag_s: f64,
    /// The guess after each [`LOOK_S`] of the drag.
    pub looks: Vec<LeftOutLook>,
}

/// The guess at one look at a left-out trial.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct LeftOutLook {
    pub class: usize,
    pub probability: f64,
    pub p_value: Option<f64>,
}

impl FollowedTrial {
    /// Where each stopping rule would have stopped.
    pub fn stops(&self, options: &FollowOptions) -> Stops {
        let fits = |p_value| options.rejection.as_ref().is_none_or(|r| !r.rejects(p_value));
        let look = |(i, look): (usize, &LeftOutLook)| Look {
            scan_s: (i + 1) as f64 * LOOK_S,
            label: look.class,
            probability: look.probability,
            fits: look.p_value.is_none_or(fits),
        };
        Stops::new(self.looks.iter().enumerate().map(look), self.truth, self.whole, self.drag_s)
    }

    /// Whether it is named correctly after each time of [`looked_after`].
    pub fn scan(&self) -> LeftOutScan {
        let right = |step: usize| self.looks[step - 1].class == self.truth;
        LeftOutScan {
            group: self.group,
            scan_s: self.drag_s,
            right: looked_after(self.drag_s).map(right).collect(),
            judged: (looked_after(self.drag_s))
                .map(|step| self.looks[step - 1].p_value.is_some())
                .collect(),
            right_whole: self.whole == self.truth,
        }
    }

    /// Whether a stored trial is possible with this number of classes.
    pub fn is_sound(&self, classes: usize) -> bool {
        let labels = self.looks.iter().map(|look| look.class).chain([self.truth, self.whole]);
        self.looks.len() == looks_in(self.drag_s) && labels.max() < Some(classes)
    }
}

/// Number of looks (one each [`LOOK_S`]) at a drag.
pub(super) fn looks_in(drag_s: f64) -> usize {
    (drag_s / LOOK_S + 1e-9).floor() as usize
}
