//! Leaves library trials out, group by group. Finds how sure a model may be, how far from all surfaces
//! a known trial can lie, and which trials are named right.

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
use crate::recognise::follow::LOOK_S;

/// Each left-out trial is also examined after these shares of the median length of a drag.
const BEGINNINGS: [f64; 6] = [0.04, 0.08, 0.15, 0.25, 0.4, 0.65];

/// A scan counts as whole if it is longer than this share of the library's trials.
const SHORTER: f64 = 0.05;

/// Most trials with beginnings to examine; more would not change any stated digit.
const MOST_BEGUN: usize = 400;

/// Discriminants for one set of sources: trained on all trials, and without each group.
#[derive(Serialize, Deserialize)]
pub(super) struct Trained {
    /// Trained on all trials. If that is not possible, gives plain distances to the class means.
    pub all: Discriminant,
    /// Trained without each group; `None` if too few trials are left.
    pub without: Vec<Option<Discriminant>>,
    /// How far left-out trials lie from all surfaces by these sources.
    pub conformity: Conformity,
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
        let (all, without) = training.discriminants(joint, present);
        Self { all, without, conformity: Conformity::default() }
    }

    /// Trains, and measures the conformity of the library trials that have these sources. `drag_s` is
    /// the median length of their drag in seconds.
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

    /// Measures conformity. In a library of one person, excerpts replace scans by somebody else.
    fn measure(
        &mut self,
        training: &Training,
        labels: &Labels,
        present: &Present,
        (drag_s, begun): (f64, &Begun),
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
        let mut by_length: Vec<Calibration> = (begun.looks.iter().enumerate())
            .map(|(at, look)| (at, *look as f64 * LOOK_S))
            .filter(|(_, scan_s)| *scan_s < longest_s)
            .map(|(at, scan_s)| {
                let kept = begun.trials.iter().filter(|(trial, _)| full.contains(trial));
                let scans = kept
                    .filter_map(|(trial, vectors)| strange(*trial, ArrayView1::from(&vectors[at])));
                Calibration::new(scan_s, 1, scans)
            })
            .collect();
        if begun.looks.is_empty() || !labels.across_users {
            let excerpts =
                full.iter().flat_map(|&i| training.excerpts(i).map(move |vector| (i, vector)));
            let scans = excerpts.filter_map(|(i, vector)| strange(i, vector));
            by_length.push(Calibration::new(excerpt_s, EXCERPTS, scans));
        }
        if labels.across_users {
            let wholes = full.iter().filter_map(|&i| strange(i, training.whole(i)));
            by_length.push(Calibration::new(drag_s, 1, wholes));
        }
        self.conformity = Conformity::new(by_length);
    }

    pub(super) fn p_value(&self, vector: ArrayView1<'_, f32>, scan_s: f64) -> Option<f64> {
        let of_group = |without: &Option<Discriminant>| {
            without.as_ref().map_or(f64::INFINITY, |w| nonconformity(&w.distances(vector)))
        };
        let scores: Vec<f64> = self.without.par_iter().map(of_group).collect();
        self.conformity.p_value(scan_s, |group| scores[group])
    }
}

#[derive(Serialize, Deserialize)]
pub(super) struct LeftOut {
    /// Temperature τ of probabilities, as a function of the length of a scan.
    pub temperature: Temperature,
    /// Distances of whole left-out trials, with their classes.
    pub held_out: Vec<HeldOut>,
    /// Median length of the drag, in seconds, of the trials that have all sources; 0 if there are none.
    pub drag_s: f64,
    /// Scans of at least this many seconds count as whole. In a library of several people, all trials
    /// except a share [`SHORTER`] reach it. In a library of one person, half of the trials do, since
    /// whole scans are compared with excerpts there.
    whole_from_s: f64,
    /// Discriminants for each set of sources that occurs in the library.
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
        let trials = evenly(library.len()).into_par_iter().filter_map(begun).collect();
        let begun = Begun { looks, trials };
        let held_out = |i: usize, vector: ArrayView1<'_, f32>| -> Option<HeldOut> {
            Some((without(i)?.distances(vector), labels.class[i]))
        };
        let whole: Vec<HeldOut> = (0..library.len())
            .into_par_iter()
            .filter_map(|i| held_out(i, training.whole(i)))
            .collect();
        let of_look = |(at, look): (usize, &usize)| -> (f64, Vec<HeldOut>) {
            let trials = begun.trials.iter();
            let held_out = trials.filter_map(|(i, vectors)| held_out(*i, (&vectors[at]).into()));
            (*look as f64 * LOOK_S, held_out.collect())
        };
        let mut by_length: Vec<_> = begun.looks.iter().enumerate().map(of_look).collect();
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

    /// The length that a finished scan with a drag of `drag_s` counts as; infinite without a drag. A
    /// scan about as long as the library's trials counts as whole, not as a beginning.
    pub(super) fn ended_s(&self, drag_s: Option<f64>) -> f64 {
        let drag_s = drag_s.unwrap_or(f64::INFINITY);
        if drag_s >= self.whole_from_s { drag_s.max(self.drag_s) } else { drag_s }
    }

    /// The discriminant trained without a trial's group; `None` if it does not know the trial's class.
    pub(super) fn without(
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
