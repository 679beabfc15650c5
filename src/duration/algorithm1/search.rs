//! Algorithm 1: the smallest lag at which samples of a source can be taken for independent.

use rand::Rng;
use rand::seq::SliceRandom;
use statrs::distribution::{ContinuousCDF, StudentsT};

use super::batch::Batch;
use super::{Algorithm1Settings, CurvePoint, Estimate, Rule, SearchOutcome};
use crate::duration::trials::{DurationError, Trials};
use crate::kernel::{Threshold, quantile_index};
use crate::seed;

/// Computes curves of HSIC against the lag for one set of trials.
pub struct Search<'a> {
    trials: &'a Trials,
    settings: Algorithm1Settings,
    largest_lag: usize,
    starts: usize,
    student: f64,
    batch: Batch,
    curve: std::collections::BTreeMap<usize, CurvePoint>,
}

impl<'a> Search<'a> {
    /// A search over `trials`.
    ///
    /// # Errors
    /// If the settings are not possible, or the trials too short for the largest lag.
    pub fn new(trials: &'a Trials, settings: Algorithm1Settings) -> Result<Self, DurationError> {
        let fail = |text: String| Err(DurationError::Settings(text));
        let Algorithm1Settings { draws, alpha, threshold, largest_lag, latest_start, .. } =
            settings;
        if !(alpha > 0.0 && alpha < 0.5) {
            return fail(format!("α = {alpha}; expected a number between 0 and 0.5"));
        }
        if draws < 10 {
            return fail(format!("R = {draws} draws; expected at least 10"));
        }
        if largest_lag == 0 || latest_start == 0 {
            return fail("the largest lag and the latest start are at least 1 sample".into());
        }
        if let Threshold::Permutations(count) = threshold
            && (count as f64) < 1.0 / alpha
        {
            return fail(format!("{count} permutations cannot resolve α = {alpha}"));
        }
        let frames = trials.frames();
        let largest_lag = largest_lag.min(frames / 2);
        let starts = latest_start.min(frames - largest_lag);
        let freedom = (draws - 1) as f64;
        // Location 0, scale 1 and at least 9 degrees of freedom are a distribution.
        let student = StudentsT::new(0.0, 1.0, freedom).expect("a Student-t distribution");
        let student = student.inverse_cdf(1.0 - alpha / 2.0);
        let batch = Batch::new(trials.count(), trials.channels(), alpha, threshold);
        let curve = std::collections::BTreeMap::new();
        Ok(Self { trials, settings, largest_lag, starts, student, batch, curve })
    }

    /// The point of the curve at one lag: R draws of t₁, HSIC and κ of each.
    ///
    /// Draws are keyed by the lag, so the order in which lags are looked at changes nothing.
    pub fn at(&mut self, lag: usize) -> CurvePoint {
        if let Some(&point) = self.curve.get(&lag) {
            return point;
        }
        let Algorithm1Settings { draws, alpha, threshold, seed, .. } = self.settings;
        let mut rng = seed::rng(seed, &[b"duration", &lag.to_le_bytes()]);
        let mut order: Vec<usize> = (0..self.trials.count()).collect();
        let mut hsic = Vec::with_capacity(draws + Batch::TESTS);
        let mut kappa = 0.0;
        while hsic.len() < draws {
            for test in 0..Batch::TESTS {
                let t1 = below(&mut rng, self.starts);
                // Another order of the trials for each test: see the batch. Moments need none.
                if matches!(threshold, Threshold::Permutations(_)) {
                    order.shuffle(&mut rng);
                }
                for (slot, &trial) in order.iter().enumerate() {
                    self.batch.set(0, test, slot, self.trials.sample(trial, t1));
                    self.batch.set(1, test, slot, self.trials.sample(trial, t1 + lag));
                }
            }
            let tests = self.batch.run(&mut rng);
            let wanted = (draws - hsic.len()).min(Batch::TESTS);
            hsic.extend_from_slice(&tests.hsic[..wanted]);
            kappa += tests.kappa[..wanted].iter().sum::<f64>();
        }
        let count = draws as f64;
        let mean = hsic.iter().sum::<f64>() / count;
        let variance = hsic.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (count - 1.0);
        let half = self.student * (variance / count).sqrt();
        hsic.sort_unstable_by(f64::total_cmp);
        let point = CurvePoint {
            lag,
            hsic_mean: mean,
            hsic_low: mean - half,
            hsic_high: mean + half,
            hsic_quantile: hsic[quantile_index(draws, alpha)],
            kappa: kappa / count,
        };
        self.curve.insert(lag, point);
        point
    }

    /// Finds T* by one of the rules; lags already looked at are not computed again.
    ///
    /// The coarse grid has lags an eighth apart. Every lag between two of its points is looked at
    /// when the upper one is independent, or when either comes so near to it that chance could
    /// make a lag between them independent: within 5 standard errors (5/√R) and 5 %.
    pub fn find(&mut self, rule: Rule) -> Estimate {
        let first = match self.settings.exhaustive {
            true => self.upwards(rule, 1, self.largest_lag),
            false => self.coarse(rule),
        };
        let outcome = match first {
            None => SearchOutcome::NotInRange { largest_lag: self.largest_lag },
            Some(lag) if self.settings.look_beyond => match self.dependent_beyond(lag) {
                Some(again_at) => SearchOutcome::Returns { first: lag, again_at },
                None => SearchOutcome::Found { lag },
            },
            Some(lag) => SearchOutcome::Found { lag },
        };
        Estimate {
            outcome,
            rule,
            trials: self.trials.count(),
            latest_start: self.starts,
            rate_hz: self.trials.rate_hz(),
            curve: self.curve.values().copied().collect(),
        }
    }

    fn upwards(&mut self, rule: Rule, from: usize, to: usize) -> Option<usize> {
        (from..=to).find(|&lag| self.at(lag).independent(rule))
    }

    fn coarse(&mut self, rule: Rule) -> Option<usize> {
        let near = 1.05 + 5.0 / (self.settings.draws as f64).sqrt();
        let (mut below, mut below_near) = (0, true);
        loop {
            let lag = next_coarse(below).min(self.largest_lag);
            let point = self.at(lag);
            let point_near = point.bound(rule) < point.kappa * near;
            if (below_near || point_near)
                && let Some(found) = self.upwards(rule, below + 1, lag)
            {
                return Some(found);
            }
            if lag == self.largest_lag {
                return None;
            }
            (below, below_near) = (lag, point_near);
        }
    }

    /// A lag beyond `lag` at which samples are clearly dependent.
    fn dependent_beyond(&mut self, lag: usize) -> Option<usize> {
        let room = self.trials.frames() - self.starts;
        let end = self.largest_lag.max((4 * lag).min(room));
        let mut beyond = next_coarse(lag);
        while beyond <= end {
            let point = self.at(beyond);
            if point.hsic_low > point.kappa {
                return Some(beyond);
            }
            beyond = next_coarse(beyond);
        }
        None
    }
}

fn next_coarse(lag: usize) -> usize {
    lag + (lag / 8).max(1)
}

/// A whole number in 0..n, uniform to within n/2³² (Lemire's multiplication).
fn below(rng: &mut impl Rng, n: usize) -> usize {
    ((u64::from(rng.next_u32()) * n as u64) >> 32) as usize
}

/// T* of one surface and source by Algorithm 1.
///
/// # Errors
/// If the settings are not possible.
pub fn t_star(trials: &Trials, settings: Algorithm1Settings) -> Result<Estimate, DurationError> {
    Ok(Search::new(trials, settings)?.find(settings.rule))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::duration::simulate;

    fn trials(
        count: usize,
        seed: u64,
        make: impl Fn(&mut rand_chacha::ChaCha8Rng) -> Vec<f32>,
    ) -> Trials {
        let mut rng = seed::rng(seed, &[b"search"]);
        Trials::new(simulate::trials(count, 1e4, || make(&mut rng)).unwrap()).unwrap()
    }

    fn gamma(draws: usize) -> Algorithm1Settings {
        Algorithm1Settings { draws, threshold: Threshold::Gamma, ..Algorithm1Settings::default() }
    }

    #[test]
    fn coarse_to_fine_finds_what_the_plain_search_finds() {
        for (seed, tau) in [(1, 0.0), (2, 5.0), (3, 20.0), (4, 60.0), (5, 60.0), (6, 150.0)] {
            let trials = trials(10, seed, |rng| simulate::ar1(24_000, tau, rng));
            for (rule, look_beyond) in [(Rule::Quantile, false), (Rule::MeanCi, true)] {
                let [coarse, plain] = [false, true].map(|exhaustive| {
                    let settings = Algorithm1Settings { exhaustive, look_beyond, ..gamma(100) };
                    Search::new(&trials, settings).unwrap().find(rule).outcome
                });
                assert_eq!(coarse, plain, "τ = {tau}, {rule}");
            }
        }
    }

    #[test]
    fn by_mean_ci_noise_is_independent_at_the_first_lag() {
        let at_once = (0..40)
            .filter(|&seed| {
                let trials = trials(10, seed, |rng| simulate::ar1(3000, 0.0, rng));
                let settings = Algorithm1Settings { latest_start: 2000, ..gamma(100) };
                t_star(&trials, settings).unwrap().t_star() == Some(1)
            })
            .count();
        assert!(at_once >= 36, "{at_once} of 40");
    }

    #[test]
    fn a_sine_has_no_t_star() {
        for (seed, period) in [(1, 40.0), (2, 210.0), (3, 900.0)] {
            for rule in [Rule::Quantile, Rule::MeanCi] {
                let trials = trials(10, seed, |rng| simulate::sine(30_000, period, rng));
                let estimate = Search::new(&trials, gamma(200)).unwrap().find(rule);
                assert_eq!(estimate.t_star(), None, "period {period}, {rule}");
            }
        }
    }

    #[test]
    fn more_trials_see_weaker_dependence() {
        let at = |count| {
            let trials = trials(count, 9, |rng| simulate::ar1(22_000, 20.0, rng));
            let settings = Algorithm1Settings { latest_start: 20_000, ..gamma(200) };
            t_star(&trials, settings).unwrap().t_star().unwrap()
        };
        let (few, many) = (at(10), at(40));
        assert!((4..20).contains(&few) && (15..60).contains(&many), "{few} {many}");
    }

    #[test]
    fn the_latest_start_shrinks_to_what_the_trials_allow() {
        let trials = trials(10, 3, |rng| simulate::ar1(5000, 3.0, rng));
        let estimate = t_star(&trials, gamma(50)).unwrap();
        assert_eq!(estimate.latest_start, 4000);
    }

    #[test]
    fn impossible_settings_are_refused() {
        let trials = trials(10, 3, |rng| simulate::ar1(5000, 3.0, rng));
        for settings in [
            Algorithm1Settings { alpha: 0.0, ..gamma(50) },
            Algorithm1Settings { draws: 3, ..gamma(50) },
            Algorithm1Settings { largest_lag: 0, ..gamma(50) },
            Algorithm1Settings { threshold: Threshold::Permutations(5), ..gamma(50) },
        ] {
            assert!(matches!(t_star(&trials, settings), Err(DurationError::Settings(_))));
        }
    }
}
