//! How certain answers are: temperatures fitted on left-out library trials.
//!
//! With τ = 1, the probabilities softmax(−d/2τ) of the members are too sure, the more the shorter the
//! scan, since the frames of a scan are not independent, and members err alike. So τ depends on the
//! length of the scan (Guo et al. 2017, "On calibration of modern neural networks": the τ of highest
//! likelihood on held-out data). τ is at least 1.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::ensemble::Answer;

/// Greatest τ, and number of values of τ to try.
const HIGHEST: f64 = 200.0;
const STEPS: usize = 24;

/// Lowest ln of a probability that counts. One wrong answer must not outweigh all others.
const LEAST: f64 = -20.0;

/// τ as a function of the length of a scan.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Temperature {
    /// (Length of a scan in seconds, τ), in ascending order of length.
    points: Vec<(f64, f64)>,
}

impl Temperature {
    /// Fits τ at each length, beside the τ of `other` lengths, so that τ never rises with length.
    /// `held_out` has answers to left-out trials, each with the trial's class. Without them, τ is 1.
    pub(super) fn fit(held_out: &[(f64, Vec<(Answer, usize)>)], other: Self) -> Self {
        let trials = held_out.iter().filter(|(_, trials)| !trials.is_empty());
        let mut points = other.points;
        points.extend(trials.map(|(seconds, trials)| (*seconds, best(trials))));
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut highest = 1.0;
        for (_, tau) in points.iter_mut().rev() {
            highest = f64::max(highest, *tau);
            *tau = highest;
        }
        Self { points }
    }

    /// τ for a scan of `seconds` seconds, interpolated linearly.
    pub(super) fn at(&self, seconds: f64) -> f64 {
        let after = self.points.partition_point(|(t, _)| *t < seconds);
        match (after.checked_sub(1).map(|i| self.points[i]), self.points.get(after)) {
            (Some((t0, a)), Some(&(t1, b))) => a + (b - a) * (seconds - t0) / (t1 - t0),
            (Some((_, tau)), None) | (None, Some(&(_, tau))) => tau,
            (None, None) => 1.0,
        }
    }
}

/// The τ in [1, [`HIGHEST`]] with the least log loss.
fn best(held_out: &[(Answer, usize)]) -> f64 {
    let loss = |tau: f64| -> f64 {
        let of_trial = |(answer, class): &(Answer, usize)| answer.log_probability(*class, tau);
        -held_out.iter().map(|trial| of_trial(trial).max(LEAST)).sum::<f64>()
    };
    let tau = |step: usize| HIGHEST.powf(step as f64 / (STEPS - 1) as f64);
    let fits: Vec<(f64, f64)> =
        (0..STEPS).into_par_iter().map(|step| (tau(step), loss(tau(step)))).collect();
    fits.into_iter().min_by(|a, b| a.1.total_cmp(&b.1)).map_or(1.0, |best| best.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A trial of class 1 if it is among the `wrong`, else of class 0; its answer is always 0.
    fn trial(wrong: usize, i: usize) -> (Answer, usize) {
        (Answer { distances: vec![vec![0.0, 40.0]], features: 1 }, usize::from(i < wrong))
    }

    #[test]
    fn an_overconfident_answer_gets_a_higher_temperature() {
        let tau = best(&(0..100).map(|i| trial(10, i)).collect::<Vec<_>>());
        assert!((20.0 / tau - 9f64.ln()).abs() < 0.4, "{tau}");
    }

    #[test]
    fn temperatures_fall_with_the_length_of_a_scan() {
        let at = |seconds, wrong| (seconds, (0..100).map(|i| trial(wrong, i)).collect());
        let long = Temperature::fit(&[at(1.0, 5), at(2.0, 0)], Temperature::default());
        let fitted = Temperature::fit(&[at(0.5, 2)], long);
        assert!(fitted.at(0.1) >= fitted.at(0.75) && fitted.at(0.75) >= fitted.at(1.5));
        assert!(fitted.at(9.0) >= 1.0);
        assert_eq!(Temperature::fit(&[], Temperature::default()).at(0.45), 1.0);
    }
}
