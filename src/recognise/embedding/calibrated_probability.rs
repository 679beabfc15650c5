//! Turns distances into probabilities, with temperatures fitted on left-out library trials.
//!
//! A posterior is softmax(−d/(2τ)), where d are the distances to the classes. With τ = 1 it would be
//! too sure, the more the shorter the scan, since the frames of a scan are not independent. So τ
//! depends on the length of the scan (Guo et al. 2017, "On calibration of modern neural networks": the
//! τ of highest likelihood on held-out data). τ is at least 1, and probabilities are limited to what
//! the left-out trials can show.

use serde::{Deserialize, Serialize};

const HIGHEST: f64 = 200.0;

const STEPS: usize = 60;

/// Distances of a left-out trial to all classes, and the index of its own class.
pub(crate) type HeldOut = (Vec<f64>, usize);

/// τ as a function of the length of a scan.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Temperature {
    /// (Length of a scan in seconds, τ), in ascending order of length.
    points: Vec<(f64, f64)>,
}

impl Temperature {
    /// Fits τ at each length, so that τ never rises with length. Without left-out trials, τ is 1.
    pub(crate) fn fit(held_out: &[(f64, Vec<HeldOut>)]) -> Self {
        let mut points: Vec<(f64, f64)> = held_out
            .iter()
            .filter(|(_, trials)| !trials.is_empty())
            .map(|(seconds, trials)| (*seconds, best_temperature(trials)))
            .collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut highest = 1.0;
        for (_, tau) in points.iter_mut().rev() {
            highest = f64::max(highest, *tau);
            *tau = highest;
        }
        Self { points }
    }

    /// τ for a scan of `seconds` seconds, interpolated linearly.
    pub(crate) fn at(&self, seconds: f64) -> f64 {
        let after = self.points.partition_point(|(t, _)| *t < seconds);
        match (after.checked_sub(1).map(|i| self.points[i]), self.points.get(after)) {
            (Some((t0, a)), Some(&(t1, b))) => a + (b - a) * (seconds - t0) / (t1 - t0),
            (Some((_, tau)), None) | (None, Some(&(_, tau))) => tau,
            (None, None) => 1.0,
        }
    }
}

/// The τ in [1, 200] with the least log loss.
fn best_temperature(held_out: &[HeldOut]) -> f64 {
    let loss = |tau: f64| -> f64 {
        held_out.iter().map(|(d, class)| -log_posterior(d, tau)[*class].max(-700.0)).sum()
    };
    let tau = |step: usize| HIGHEST.powf(step as f64 / (STEPS - 1) as f64);
    let fits = (0..STEPS).map(|step| (tau(step), loss(tau(step))));
    fits.min_by(|a, b| a.1.total_cmp(&b.1)).map_or(1.0, |best| best.0)
}

/// ln of softmax(−d/(2τ)); −∞ for infinite distances. If all are infinite, all classes are equal.
pub(crate) fn log_posterior(distances: &[f64], tau: f64) -> Vec<f64> {
    let least = distances.iter().copied().fold(f64::INFINITY, f64::min);
    if !least.is_finite() {
        return vec![-(distances.len() as f64).ln(); distances.len()];
    }
    let logits: Vec<f64> = distances.iter().map(|d| (least - d) / (2.0 * tau)).collect();
    let total = logits.iter().map(|x| x.exp()).sum::<f64>().ln();
    logits.iter().map(|x| x - total).collect()
}

/// Posterior probabilities, mixed with equal shares so that none is above (m + ½)/(m + 1). With m =
/// `trials` left-out trials no more can be shown, even if all are named right.
pub(crate) fn held_back(log_posterior: &[f64], trials: usize) -> Vec<f64> {
    let classes = log_posterior.len() as f64;
    let doubt = 0.5 / (trials as f64 + 1.0);
    let shared = (doubt / (1.0 - 1.0 / classes)).min(1.0);
    log_posterior.iter().map(|p| (1.0 - shared) * p.exp() + shared / classes).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_posterior_sums_to_one_whatever_the_distances() {
        for d in [vec![1e12, 0.0, f64::INFINITY], vec![3.0; 3], vec![f64::INFINITY; 2]] {
            let sum: f64 = log_posterior(&d, 2.0).iter().map(|x| x.exp()).sum();
            assert!((sum - 1.0).abs() < 1e-12, "{d:?}");
        }
    }

    #[test]
    fn an_overconfident_distance_gets_a_higher_temperature() {
        // One trial in ten is wrong, by as much as the others are right.
        let trial = |i: usize| (vec![0.0, 40.0], usize::from(i.is_multiple_of(10)));
        let tau = best_temperature(&(0..100).map(trial).collect::<Vec<_>>());
        assert!((20.0 / tau - 9f64.ln()).abs() < 0.2, "{tau}");
    }

    #[test]
    fn temperatures_fall_with_the_length_of_a_scan() {
        let trial = |wrong: usize, i: usize| (vec![0.0, 40.0], usize::from(i < wrong));
        let at = |seconds, wrong| (seconds, (0..100).map(|i| trial(wrong, i)).collect());
        let fitted = Temperature::fit(&[at(1.0, 5), at(0.5, 2), at(2.0, 0)]);
        assert!(fitted.at(0.1) >= fitted.at(0.75) && fitted.at(0.75) >= fitted.at(1.5));
        assert!(fitted.at(9.0) >= 1.0);
        assert_eq!(Temperature::fit(&[]).at(0.45), 1.0);
    }

    #[test]
    fn no_probability_is_beyond_what_the_left_out_trials_can_show() {
        for (trials, classes) in [(0, 2), (7, 3), (200, 20)] {
            let mut sure = vec![-f64::INFINITY; classes];
            sure[0] = 0.0;
            let held = held_back(&sure, trials);
            let most = (trials as f64 + 0.5) / (trials as f64 + 1.0);
            assert!(
                (held[0] - most).abs() < 1e-12 && (held.iter().sum::<f64>() - 1.0).abs() < 1e-12
            );
        }
        let even = held_back(&[0.5f64.ln(); 2], 3);
        assert!((even[0] - 0.5).abs() < 1e-12);
    }
}
