//! A sticky hidden Markov model, filtered forward: smooths the answers of windows that slide over surfaces
//! of which each stays the same for a while.
//!
//! In each step the state stays with one probability, and else changes to any other state alike
//! (L. R. Rabiner, *A tutorial on hidden Markov models*, Proc. IEEE 77, 1989, Eqs. 19 and 20, with
//! scaling). After a change, windows hold some of the state before: of one that ends a steps after the
//! change, W steps long, the share a/W is of the new state. Its likelihood is the mixture of both states' by
//! these shares. So the filter remembers how long ago the state began, and can tell it, as with the run
//! lengths of R. P. Adams and D. J. C. MacKay, *Bayesian online changepoint detection*, 2007
//! (arXiv:0710.3742). The state changes at most once in W steps.

use std::collections::VecDeque;

/// The beginning of a state is remembered for this number of windows.
const REMEMBERED: usize = 4;
/// A change is forgotten if it is less probable than this share of a change from a certain state.
const FORGOTTEN: f64 = 0.01;

/// The probability of each state and of when it began, given all that was observed so far.
#[derive(Clone, Debug, PartialEq)]
pub struct StickyFilter {
    stay: f64,
    /// Steps of a window.
    window: usize,
    /// Changes 1, 2, … steps ago, which the window still shows.
    mixed: VecDeque<Vec<Changed>>,
    /// For states that began 1, 2, … steps before the window did, the probability of each.
    aged: VecDeque<Vec<f64>>,
    /// Probability of each state, begun earlier.
    old: Vec<f64>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Changed {
    from: usize,
    to: usize,
    p: f64,
}

impl StickyFilter {
    /// All `states` (at least 2) are equally probable; a state stays for a step with the probability `stay`. A
    /// window is as long as `window` steps (at least 1).
    pub fn new(states: usize, stay: f64, window: usize) -> Self {
        let (mixed, aged) = (VecDeque::new(), VecDeque::new());
        Self { stay, window, mixed, aged, old: vec![1.0 / states as f64; states] }
    }

    /// Probability of each state now.
    pub fn belief(&self) -> Vec<f64> {
        let mut belief = self.settled();
        self.mixed.iter().flatten().for_each(|changed| belief[changed.to] += changed.p);
        belief
    }

    /// Probability that each state is all that the window shows.
    fn settled(&self) -> Vec<f64> {
        let mut settled = self.old.clone();
        for aged in &self.aged {
            settled.iter_mut().zip(aged).for_each(|(sum, p)| *sum += p);
        }
        settled
    }

    /// How many steps ago a state began if it is the present one: the median. `None` if it began too long
    /// ago to be remembered.
    pub fn age(&self, state: usize) -> Option<usize> {
        let to_it = |changes: &Vec<Changed>| {
            changes.iter().filter(|changed| changed.to == state).map(|changed| changed.p).sum()
        };
        let by_age: Vec<f64> = (self.mixed.iter().map(to_it))
            .chain(self.aged.iter().map(|aged| aged[state]))
            .collect();
        let half = 0.5 * (by_age.iter().sum::<f64>() + self.old[state]);
        let mut sum = 0.0;
        let reaches_half = |p: &f64| {
            sum += p;
            sum >= half
        };
        by_age.iter().position(reaches_half).map(|at| at + 1)
    }

    /// Lets `steps` steps pass without an observation.
    pub fn pass(&mut self, steps: u32) {
        let each = steps.min((REMEMBERED * self.window) as u32);
        (0..each).for_each(|_| self.step());
        if steps > each {
            // The rest at once, by the second eigenvalue of the transitions, as if the state could change in
            // every step.
            let belief = self.belief();
            let alike = belief.iter().sum::<f64>() / belief.len() as f64;
            let keep = (self.stay - self.change()).powf(f64::from(steps - each));
            self.old = belief.iter().map(|p| alike + keep * (p - alike)).collect();
            self.aged.clear();
            self.mixed.clear();
        }
    }

    /// Probability of a change to one certain other state in a step.
    fn change(&self) -> f64 {
        (1.0 - self.stay) / (self.old.len() - 1) as f64
    }

    fn step(&mut self) {
        let states = self.old.len();
        let mut aged = vec![0.0; states];
        if self.mixed.len() == self.window {
            let over = self.mixed.pop_back();
            over.into_iter().flatten().for_each(|changed| aged[changed.to] += changed.p);
        }
        self.aged.push_front(aged);
        if self.aged.len() > (REMEMBERED - 1) * self.window
            && let Some(oldest) = self.aged.pop_back()
        {
            self.old.iter_mut().zip(oldest).for_each(|(sum, p)| *sum += p);
        }
        let (settled, change) = (self.settled(), self.change());
        let pairs = (0..states).flat_map(|from| (0..states).map(move |to| (from, to)));
        let changed = |(from, to)| Changed { from, to, p: settled[from] * change };
        let kept = |changed: &Changed| changed.from != changed.to && changed.p > FORGOTTEN * change;
        self.mixed.push_front(pairs.map(changed).filter(kept).collect());
        self.aged.iter_mut().flatten().chain(&mut self.old).for_each(|p| *p *= self.stay);
    }

    /// Takes the observation of the window that ends now: its ln likelihood in each state, at least one of
    /// which is finite. An observation that repeats earlier ones in part counts with a `weight` below 1,
    /// as the exponent of its likelihood.
    pub fn observe(&mut self, log_likelihood: &[f64], weight: f64) {
        let best = log_likelihood.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let of_one: Vec<f64> = log_likelihood.iter().map(|log| (log - best).exp()).collect();
        let weighted: Vec<f64> = of_one.iter().map(|p| p.powf(weight)).collect();
        for settled in self.aged.iter_mut().chain([&mut self.old]) {
            settled.iter_mut().zip(&weighted).for_each(|(p, likelihood)| *p *= likelihood);
        }
        for (before, changes) in self.mixed.iter_mut().enumerate() {
            let new = (before + 1) as f64 / self.window as f64;
            for Changed { from, to, p } in &mut *changes {
                *p *= ((1.0 - new) * of_one[*from] + new * of_one[*to]).powf(weight);
            }
        }
        let (sum, fewest) = (self.belief().iter().sum::<f64>(), FORGOTTEN * self.change());
        for settled in self.aged.iter_mut().chain([&mut self.old]) {
            settled.iter_mut().for_each(|p| *p /= sum);
        }
        for changes in &mut self.mixed {
            changes.iter_mut().for_each(|changed| changed.p /= sum);
            changes.retain(|changed| changed.p > fewest);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The oracle: the last state's probabilities and when it began, by a sum over all paths through all
    /// states that change at most once in a window. Item n of the second is for n steps ago, its last for no
    /// change.
    fn by_all_paths(
        states: usize,
        stay: f64,
        window: usize,
        seen: &[(Vec<f64>, f64)],
    ) -> (Vec<f64>, Vec<Vec<f64>>) {
        let mut of_last = vec![0.0; states];
        let mut of_age = vec![vec![0.0; seen.len() + 1]; states];
        for path in 0..states.pow(seen.len() as u32 + 1) {
            let state = |at: usize| path / states.pow(at as u32) % states;
            let (mut p, mut age, mut from) = (1.0 / states as f64, None, 0);
            for (at, (likelihood, weight)) in seen.iter().enumerate() {
                let may_change = age.is_none_or(|age| age >= window);
                if state(at + 1) != state(at) {
                    p *= if may_change { (1.0 - stay) / (states - 1) as f64 } else { 0.0 };
                    (age, from) = (Some(1), state(at));
                } else {
                    p *= if may_change { stay } else { 1.0 };
                    age = age.map(|age| age + 1);
                }
                let new = age.map_or(1.0, |age| (age as f64 / window as f64).min(1.0));
                let likelihood = (1.0 - new) * likelihood[from] + new * likelihood[state(at + 1)];
                p *= likelihood.powf(*weight);
            }
            let last = state(seen.len());
            of_last[last] += p;
            of_age[last][age.unwrap_or(seen.len() + 1) - 1] += p;
        }
        let sum: f64 = of_last.iter().sum();
        (of_last.iter().map(|p| p / sum).collect(), of_age)
    }

    proptest! {
        // The difference allowed is that of changes that are forgotten.
        #[test]
        fn the_filter_is_the_sum_over_all_paths(
            states in 2_usize..4,
            stay in 0.3..0.99,
            window in 1_usize..4,
            draws in prop::collection::vec((prop::collection::vec(0.1..1.0, 4), 0.05..1.0), 1..7),
        ) {
            let mut filter = StickyFilter::new(states, stay, window);
            let seen: Vec<(Vec<f64>, f64)> =
                draws.into_iter().map(|(likelihood, weight)| (likelihood[..states].to_vec(), weight)).collect();
            for (likelihood, weight) in &seen {
                filter.pass(1);
                let logs: Vec<f64> = likelihood.iter().map(|x| x.ln()).collect();
                filter.observe(&logs, *weight);
            }
            let (expected, of_age) = by_all_paths(states, stay, window, &seen);
            for (found, expected) in filter.belief().iter().zip(expected) {
                prop_assert!((found - expected).abs() < 0.03, "{found} {expected}");
            }
            for (state, of_age) in of_age.iter().enumerate() {
                let until = |age: usize| of_age[..age].iter().sum::<f64>() / of_age.iter().sum::<f64>();
                match filter.age(state) {
                    Some(age) => {
                        prop_assert!(until(age) > 0.4 && until(age - 1) < 0.6, "{age} {of_age:?}");
                    }
                    None => {
                        let remembered = (REMEMBERED * window).min(seen.len());
                        prop_assert!(until(remembered) < 0.6, "{of_age:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn steps_without_an_observation_pass_at_once_and_end_in_ignorance() {
        let mut at_once = StickyFilter::new(3, 0.9, 2);
        at_once.observe(&[0.0, -9.0, f64::NEG_INFINITY], 1.0);
        let mut one_by_one = at_once.clone();
        at_once.pass(7);
        (0..7).for_each(|_| one_by_one.pass(1));
        assert_eq!(at_once, one_by_one);
        assert!(at_once.belief()[0] > 0.4);
        let kept: f64 = at_once.belief().iter().sum();
        at_once.pass(1_000_000_000);
        let sum: f64 = at_once.belief().iter().sum();
        assert!((sum - kept).abs() < 0.01, "no state is lost on the way: {sum} of {kept}");
        assert!(at_once.belief().iter().all(|p| (p / sum - 1.0 / 3.0).abs() < 1e-9));
    }

    #[test]
    fn a_change_within_windows_is_dated_to_its_step() {
        // 8 steps a window. State 0 for 40 steps, then state 1; of mixed windows, the likelihoods are mixed.
        let mut filter = StickyFilter::new(3, 0.99, 8);
        let (mut found, mut age) = (None, None);
        for step in 1..=60_u32 {
            filter.pass(1);
            let new = f64::from(step.saturating_sub(40).min(8)) / 8.0;
            let likelihood = [1.0 - new, new, 0.0].map(|share| f64::ln(0.9 * share + 0.05));
            filter.observe(&likelihood, 1.0 / 8.0);
            let belief = filter.belief();
            assert!(belief[2] < 0.5);
            if belief[1] > 0.5 && found.is_none() {
                (found, age) = (Some(step), filter.age(1));
            }
        }
        let (found, age) = (found.unwrap(), age.unwrap());
        assert!((45..=56).contains(&found), "{found}");
        assert!((found as i64 - age as i64 - 40).abs() <= 2, "{found} {age}");
        assert_eq!(filter.age(0).is_none(), filter.belief()[0] < 0.5);
    }
}
