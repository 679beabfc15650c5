//! When answers about left-out library trials would have been settled, and how many are right by when.

use std::collections::BTreeSet;

use rayon::prelude::*;

use super::joint::Excerpt;
use super::left_out::{Followed, LeftOut, evenly};
use super::model::EmbeddingModel;
use crate::recognise::decide::scan_time::{
    LeftOutAccuracy, LeftOutScan, LibraryCounts, looked_after,
};
use crate::recognise::decide::settle::{Look, Settling, Stops};
use crate::recognise::follow::{FollowOptions, LOOK_S};

impl EmbeddingModel {
    /// The stop rule, found but once.
    pub(super) fn settling(&self, options: &FollowOptions) -> Settling {
        let (found_for, followed) = self.followed_first_by(options);
        if found_for == options {
            followed.settling.clone()
        } else {
            self.follow_left_out(options).settling
        }
    }

    /// How many left-out trials are named right by when, which no option changes.
    pub(super) fn accuracy_by_time(&self) -> LeftOutAccuracy {
        self.followed_first_by(&FollowOptions::default()).1.accuracy.clone()
    }

    /// What was found first, or now by these options.
    fn followed_first_by(&self, options: &FollowOptions) -> &(FollowOptions, Followed) {
        self.followed.get_or_init(|| (options.clone(), self.follow_left_out(options)))
    }

    /// Looks at library trials as [`crate::recognise::Follow`] would, with models trained without
    /// them.
    fn follow_left_out(&self, options: &FollowOptions) -> Followed {
        let trials = evenly(self.library.len());
        let (stops, scans): (Vec<Stops>, Vec<LeftOutScan>) =
            trials.into_par_iter().filter_map(|i| self.follow_one(i, options)).unzip();
        Followed {
            settling: Settling::choose(&stops, options.loss),
            accuracy: LeftOutAccuracy::new(&scans, self.counts()),
        }
    }

    fn follow_one(&self, trial: usize, options: &FollowOptions) -> Option<(Stops, LeftOutScan)> {
        let LeftOut { without, .. } = &self.left_out;
        let trained = LeftOut::trained(without, &self.labels, &self.training, trial)?;
        let drag_s = self.joint.drag_s(&self.library[trial])?;
        let steps = (drag_s / LOOK_S + 1e-9).floor() as usize;
        let excerpts: Vec<Excerpt> =
            (1..=steps).map(|step| Excerpt::beginning(step as f64 * LOOK_S)).collect();
        let (vectors, present) = self.joint.embed(&self.library[trial], &excerpts);
        let posterior = |vector: &[f32], scan_s: f64| {
            self.posterior_of(trained.distances(vector.into()), &present, scan_s)
        };
        let at = |step: usize| posterior(&vectors[step - 1], step as f64 * LOOK_S);
        let look = |step: usize| {
            let posterior = at(step);
            let fits = posterior.p_value.is_none_or(|p_value| {
                options.rejection.as_ref().is_none_or(|rejection| !rejection.rejects(p_value))
            });
            let label = posterior.best();
            let probability = posterior.log_posterior[label].exp();
            Look { scan_s: step as f64 * LOOK_S, label, probability, fits }
        };
        let truth = self.labels.class[trial];
        let whole = trained.distances(self.training.whole(trial));
        let whole = self.posterior_of(whole, &present, drag_s).best();
        let scan = LeftOutScan {
            group: self.labels.group[trial],
            scan_s: drag_s,
            right: looked_after(drag_s).map(|step| at(step).best() == truth).collect(),
            right_whole: whole == truth,
        };
        Some((Stops::new((1..=steps).map(look), truth, whole, drag_s), scan))
    }

    /// What the library holds.
    fn counts(&self) -> LibraryCounts {
        let mut trials = vec![0; self.labels.classes];
        self.labels.class.iter().for_each(|&class| trials[class] += 1);
        let people: BTreeSet<&str> = self.library.iter().map(|t| t.key.user.as_str()).collect();
        LibraryCounts {
            people: people.len(),
            across_people: self.labels.across_users,
            surfaces: self.labels.surfaces.iter().cloned().zip(trials).collect(),
        }
    }
}
