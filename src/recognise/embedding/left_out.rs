//! What left-out library trials show of a model: how sure it may be, how unlike all surfaces a trial
//! of the library can look, and when an answer is settled.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::calibrated_probability::{HeldOut, Temperature, best_fit};
use super::discriminant::Discriminant;
use super::joint::{JointEmbedder, Present};
use super::labels::Labels;
use super::training::Training;
use crate::recognise::decide::conformal::{Conformity, nonconformity};
use crate::recognise::features::frame_features::FrameFeatures;

/// Lengths of beginnings at which left-out trials are looked at, as shares of the median drag.
const BEGINNINGS: [f64; 6] = [0.04, 0.08, 0.15, 0.25, 0.4, 0.65];

/// Trials whose beginnings are looked at, at most: as many more would change no digit that is
/// stated.
const MOST_BEGUN: usize = 400;

/// Weights of excerpts that are tried beside that of a whole trial, down to next to nothing.
const LIGHTER_EXCERPTS: [f64; 3] = [0.1, 0.01, 0.001];

/// What left-out trials showed.
#[derive(Serialize, Deserialize)]
pub(super) struct LeftOut {
    /// τ by the length of a scan.
    pub temperature: Temperature,
    /// How unlike all surfaces left-out trials look.
    pub conformity: Conformity,
    /// Distances of whole left-out trials, with their classes.
    pub held_out: Vec<HeldOut>,
}

impl LeftOut {
    /// What trials show that are left out with their groups; `without` is of the same library.
    pub fn new(
        joint: &JointEmbedder,
        training: &Training,
        labels: &Labels,
        library: &[Arc<FrameFeatures>],
        without: &WithoutGroups,
    ) -> Self {
        let trained = |i: usize| without.of(labels, training, i);
        let whole = without.whole_trials(labels, training);
        let is_full = |i: &usize| training.present[*i].iter().all(|has| *has);
        let mut lengths: Vec<f64> =
            (0..library.len()).filter(is_full).filter_map(|i| joint.drag_s(&library[i])).collect();
        lengths.sort_by(f64::total_cmp);
        let middle_s = lengths.get(lengths.len() / 2).copied();
        let begun_s: Vec<f64> = middle_s.map_or(Vec::new(), |s| BEGINNINGS.map(|b| b * s).to_vec());
        let begun = |i: usize| {
            let trained = trained(i)?;
            if joint.drag_s(&library[i])? < *begun_s.last()? {
                return None;
            }
            let vectors = joint.beginnings(&library[i], training.whole(i), &begun_s);
            let distances = trained.distances_of_each(&vectors).into_iter();
            Some((i, distances.map(|d| (d, labels.class[i])).collect::<Vec<HeldOut>>()))
        };
        let begun: Vec<(usize, Vec<HeldOut>)> = if begun_s.is_empty() {
            Vec::new()
        } else {
            evenly(library.len()).into_par_iter().filter_map(begun).collect()
        };
        let held_out = |keep: &dyn Fn(&usize) -> bool| -> Vec<(f64, Vec<HeldOut>)> {
            let of_beginning = |(b, &s): (usize, &f64)| {
                let kept = begun.iter().filter(|(i, _)| keep(i));
                (s, kept.map(|(_, of_trial)| of_trial[b].clone()).collect())
            };
            let mut all: Vec<_> = begun_s.iter().enumerate().map(of_beginning).collect();
            let kept = (0..library.len()).filter(|i| keep(i));
            all.push((middle_s.unwrap_or(0.0), kept.filter_map(|i| whole[i].clone()).collect()));
            all
        };
        let strange = |(s, of_length): (f64, Vec<HeldOut>)| {
            (s, of_length.iter().filter_map(|(d, _)| nonconformity(d)).collect())
        };
        Self {
            temperature: Temperature::fit(&held_out(&|_| true)),
            conformity: Conformity::new(held_out(&is_full).into_iter().map(strange).collect()),
            held_out: whole.into_iter().flatten().collect(),
        }
    }
}

/// Discriminants trained without each group of trials, by the sources that these have.
pub(super) struct WithoutGroups(BTreeMap<(usize, Present), Option<Discriminant>>);

impl WithoutGroups {
    /// Leaves each group of trials out in turn. Where groups are people, excerpts get the weight by
    /// which left-out people's trials are named best: that of least log loss.
    pub fn new(joint: &JointEmbedder, training: &mut Training, labels: &Labels) -> Self {
        let mut best = Self::train(joint, training, labels);
        if !labels.across_users {
            return best;
        }
        let (mut least, mut weight) = (best.log_loss(labels, training), training.excerpt_weight());
        for lighter in LIGHTER_EXCERPTS {
            training.weigh_excerpts(lighter);
            let without = Self::train(joint, training, labels);
            let loss = without.log_loss(labels, training);
            if loss < least {
                (least, weight, best) = (loss, lighter, without);
            }
        }
        training.weigh_excerpts(weight);
        best
    }

    /// That of whole trials, by the temperature that fits them best.
    fn log_loss(&self, labels: &Labels, training: &Training) -> f64 {
        let held_out: Vec<HeldOut> =
            self.whole_trials(labels, training).into_iter().flatten().collect();
        best_fit(&held_out).1
    }

    fn train(joint: &JointEmbedder, training: &Training, labels: &Labels) -> Self {
        let parts: BTreeSet<(usize, Present)> =
            (labels.group.iter().copied()).zip(training.present.iter().cloned()).collect();
        let train = |(group, present): (usize, Present)| {
            let trained = training.discriminant(joint, &present, Some(group));
            ((group, present), trained)
        };
        Self(parts.into_par_iter().map(train).collect())
    }

    /// Distances of each whole trial, and its class, where that is known without it.
    fn whole_trials(&self, labels: &Labels, training: &Training) -> Vec<Option<HeldOut>> {
        let whole = |i: usize| {
            let trained = self.of(labels, training, i)?;
            Some((trained.distances(training.whole(i)), labels.class[i]))
        };
        (0..labels.class.len()).into_par_iter().map(whole).collect()
    }

    /// The discriminant that a trial did not train, if its class is known without it.
    pub fn of(&self, labels: &Labels, training: &Training, trial: usize) -> Option<&Discriminant> {
        let part = (labels.group[trial], training.present[trial].clone());
        self.0.get(&part)?.as_ref().filter(|trained| trained.knows(labels.class[trial]))
    }
}

/// At most [`MOST_BEGUN`] of some trials, evenly spread.
pub(super) fn evenly(trials: usize) -> Vec<usize> {
    let used = trials.min(MOST_BEGUN);
    (0..used).map(|i| i * trials / used).collect()
}
