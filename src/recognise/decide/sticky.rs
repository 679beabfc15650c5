//! A sticky hidden Markov model, filtered forward: smooths a sequence of answers about a thing that
//! stays as it is for a while.
//!
//! In each step the state stays with one probability, and else changes to any other state alike
//! (L. R. Rabiner, *A tutorial on hidden Markov models*, Proc. IEEE 77, 1989, Eqs. 19 and 20, with
//! scaling).

/// The probability of each state, given all that was observed so far.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct StickyFilter {
    belief: Vec<f64>,
    /// The second eigenvalue of the transitions: the share of a deviation from equal probabilities that a
    /// step keeps.
    keep: f64,
}

impl StickyFilter {
    /// All `states` (at least 2) are equally probable; a state stays with the probability `stay`.
    pub(crate) fn new(states: usize, stay: f64) -> Self {
        let keep = stay - (1.0 - stay) / (states - 1) as f64;
        Self { belief: vec![1.0 / states as f64; states], keep }
    }

    pub(crate) fn belief(&self) -> &[f64] {
        &self.belief
    }

    /// Index of the most probable state; the first index in a tie.
    pub(crate) fn best(&self) -> usize {
        (0..self.belief.len())
            .rev()
            .max_by(|&a, &b| self.belief[a].total_cmp(&self.belief[b]))
            .unwrap_or(0)
    }

    /// Lets `steps` steps pass without an observation.
    pub(crate) fn pass(&mut self, steps: u32) {
        let (alike, keep) = (1.0 / self.belief.len() as f64, self.keep.powi(steps as i32));
        self.belief.iter_mut().for_each(|p| *p = alike + keep * (*p - alike));
    }

    /// Takes an observation with this ln likelihood in each state, of which one at least is finite. An
    /// observation that repeats earlier ones in part counts with a `weight` below 1, as the exponent of its
    /// likelihood.
    pub(crate) fn observe(&mut self, log_likelihood: &[f64], weight: f64) {
        let best = log_likelihood.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        for (p, log) in self.belief.iter_mut().zip(log_likelihood) {
            *p *= (weight * (log - best)).exp();
        }
        let sum: f64 = self.belief.iter().sum();
        self.belief.iter_mut().for_each(|p| *p /= sum);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The oracle: the last state's probabilities, by a sum over all paths through all states.
    fn by_all_paths(states: usize, stay: f64, seen: &[(Vec<f64>, f64)]) -> Vec<f64> {
        let mut of_last = vec![0.0; states];
        for path in 0..states.pow(seen.len() as u32) {
            let state = |at: usize| path / states.pow(at as u32) % states;
            let mut p = 1.0 / states as f64;
            for (at, (likelihood, weight)) in seen.iter().enumerate() {
                if at > 0 {
                    let changes = (1.0 - stay) / (states - 1) as f64;
                    p *= if state(at) == state(at - 1) { stay } else { changes };
                }
                p *= likelihood[state(at)].powf(*weight);
            }
            of_last[state(seen.len() - 1)] += p;
        }
        let sum: f64 = of_last.iter().sum();
        of_last.iter().map(|p| p / sum).collect()
    }

    proptest! {
        #[test]
        fn the_filter_is_the_sum_over_all_paths(
            states in 2_usize..5,
            stay in 0.05..0.999,
            draws in prop::collection::vec((prop::collection::vec(1e-3..1.0, 5), 0.05..1.0), 1..6),
        ) {
            let mut filter = StickyFilter::new(states, stay);
            let seen: Vec<(Vec<f64>, f64)> =
                draws.into_iter().map(|(likelihood, weight)| (likelihood[..states].to_vec(), weight)).collect();
            for (at, (likelihood, weight)) in seen.iter().enumerate() {
                filter.pass(u32::from(at > 0));
                let logs: Vec<f64> = likelihood.iter().map(|x| x.ln()).collect();
                filter.observe(&logs, *weight);
            }
            for (found, expected) in filter.belief().iter().zip(by_all_paths(states, stay, &seen)) {
                prop_assert!((found - expected).abs() < 1e-9, "{found} {expected}");
            }
        }
    }

    #[test]
    fn steps_without_an_observation_pass_at_once_and_end_in_ignorance() {
        let mut at_once = StickyFilter::new(3, 0.9);
        at_once.observe(&[0.0, -9.0, f64::NEG_INFINITY], 1.0);
        let mut one_by_one = at_once.clone();
        at_once.pass(7);
        (0..7).for_each(|_| one_by_one.pass(1));
        for (a, b) in at_once.belief().iter().zip(one_by_one.belief()) {
            assert!((a - b).abs() < 1e-12);
        }
        assert_eq!(at_once.best(), 0);
        at_once.pass(1_000);
        assert!(at_once.belief().iter().all(|p| (p - 1.0 / 3.0).abs() < 1e-9));
    }
}
