//! When answers about left-out library trials would have been settled, and how many are right by when.

use std::collections::BTreeSet;
use std::sync::{Arc, PoisonError};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::left_out::{WithoutGroups, evenly};
use super::model::EmbeddingModel;
use crate::recognise::decide::scan_time::{
    LeftOutAccuracy, LeftOutScan, LibraryCounts, looked_after,
};
use crate::recognise::decide::settle::{Look, Settling, Stops};
use crate::recognise::features::FrameFeatures;
use crate::recognise::follow::{FollowOptions, LOOK_S};

/// What it takes to follow left-out trials.
pub(super) struct Unfollowed {
    pub library: Vec<Arc<FrameFeatures>>,
    pub without: WithoutGroups,
}

/// What a left-out trial looks like as its drag grows, by a model trained without it. No option of
/// following changes that.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct FollowedTrial {
    /// Trials of one group were left out together.
    group: usize,
    /// Its class.
    truth: usize,
    /// The class that it is named by its whole length.
    whole: usize,
    /// Length of its drag in seconds.
    drag_s: f64,
    /// After each [`LOOK_S`] of it.
    looks: Vec<LeftOutLook>,
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct LeftOutLook {
    class: usize,
    probability: f64,
    p_value: Option<f64>,
}

impl FollowedTrial {
    /// Where each stop rule would have stopped.
    fn stops(&self, options: &FollowOptions) -> Stops {
        let fits = |p_value| options.rejection.as_ref().is_none_or(|r| !r.rejects(p_value));
        let look = |(i, look): (usize, &LeftOutLook)| Look {
            scan_s: (i + 1) as f64 * LOOK_S,
            label: look.class,
            probability: look.probability,
            fits: look.p_value.is_none_or(fits),
        };
        Stops::new(self.looks.iter().enumerate().map(look), self.truth, self.whole, self.drag_s)
    }

    fn scan(&self) -> LeftOutScan {
        let right = |step: usize| self.looks[step - 1].class == self.truth;
        LeftOutScan {
            group: self.group,
            scan_s: self.drag_s,
            right: looked_after(self.drag_s).map(right).collect(),
            right_whole: self.whole == self.truth,
        }
    }

    /// Whether following a trial can give this, with this number of classes.
    pub fn is_sound(&self, classes: usize) -> bool {
        let labels = self.looks.iter().map(|look| look.class).chain([self.truth, self.whole]);
        self.looks.len() == looks_in(self.drag_s) && labels.max() < Some(classes)
    }
}

/// Number of looks at a drag.
fn looks_in(drag_s: f64) -> usize {
    (drag_s / LOOK_S + 1e-9).floor() as usize
}

impl EmbeddingModel {
    /// The stop rule.
    pub(super) fn settling(&self, options: &FollowOptions) -> Settling {
        let choose = || {
            let stops: Vec<Stops> = self.followed().iter().map(|t| t.stops(options)).collect();
            Settling::choose(&stops, options.loss)
        };
        let (found_for, settling) = self.settling.get_or_init(|| (options.clone(), choose()));
        if found_for == options { settling.clone() } else { choose() }
    }

    /// How many left-out trials are named right by when.
    pub(super) fn accuracy_by_time(&self) -> LeftOutAccuracy {
        let scans: Vec<LeftOutScan> = self.followed().iter().map(FollowedTrial::scan).collect();
        LeftOutAccuracy::new(&scans, self.counts())
    }

    /// What following left-out trials shows, found but once.
    pub(super) fn followed(&self) -> &[FollowedTrial] {
        self.followed.get_or_init(|| {
            let unfollowed = self.unfollowed.lock().unwrap_or_else(PoisonError::into_inner).take();
            let follow = |unfollowed: Unfollowed| {
                let trials = evenly(self.keys.len()).into_par_iter();
                trials.filter_map(|trial| self.follow_one(&unfollowed, trial)).collect()
            };
            unfollowed.map_or_else(Vec::new, follow)
        })
    }

    /// Looks at a library trial as [`crate::recognise::Follow`] would, with a model trained without
    /// it.
    fn follow_one(&self, with: &Unfollowed, trial: usize) -> Option<FollowedTrial> {
        let trained = with.without.of(&self.labels, &self.training, trial)?;
        let drag_s = self.joint.drag_s(&with.library[trial])?;
        let whole = self.training.whole(trial);
        let looks_s: Vec<f64> = (1..=looks_in(drag_s)).map(|step| step as f64 * LOOK_S).collect();
        let vectors = self.joint.beginnings(&with.library[trial], whole, &looks_s);
        let present = &self.training.present[trial];
        let look = |(i, distances): (usize, Vec<f64>)| {
            let posterior = self.posterior_of(distances, present, looks_s[i]);
            let class = posterior.best();
            let probability = posterior.log_posterior[class].exp();
            LeftOutLook { class, probability, p_value: posterior.p_value }
        };
        let looks = trained.distances_of_each(&vectors).into_iter().enumerate().map(look);
        let whole = trained.distances(whole);
        Some(FollowedTrial {
            group: self.labels.group[trial],
            truth: self.labels.class[trial],
            whole: self.posterior_of(whole, present, drag_s).best(),
            drag_s,
            looks: looks.collect(),
        })
    }

    /// What the library holds.
    fn counts(&self) -> LibraryCounts {
        let mut trials = vec![0; self.labels.classes];
        self.labels.class.iter().for_each(|&class| trials[class] += 1);
        let people: BTreeSet<&str> = self.keys.iter().map(|key| key.user.as_str()).collect();
        LibraryCounts {
            people: people.len(),
            across_people: self.labels.across_users,
            surfaces: self.labels.surfaces.iter().cloned().zip(trials).collect(),
        }
    }
}
