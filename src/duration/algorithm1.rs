//! The paper's Algorithm 1 and its two rules, for replication.
//!
//! For a lag t, R times, draw a start t₁ and pair the samples of all Q trials at t₁ with those at
//! t₁ + t; T* is the first t at which the upper bound CB+ of HSIC lies below the mean threshold κ.
//! [`Search`] computes the curve and finds T*; the R tests at one lag run in parallel.
//!
//! # Accuracy
//! A test of Q pairs has little power: at Q = 10 `mean-ci` stops at 0.4 of a process's correlation
//! time τ, a sixth of the lag at which the autocorrelation has fallen to 0.1. `quantile` scatters
//! more and comes closer to that lag, but also stops too early in every run. As `quantile` compares
//! two estimates of one quantile, it stops on noise at the first sample in only half of the runs.
//! With more trials both give longer times. `tools/charts/duration-study.md` has the tables.
//!
//! # Threshold
//! κ comes from permutations, as in the paper, or from a Pearson III (shifted gamma) distribution
//! with the exact mean, variance and skewness of the permutation distribution, see
//! [`crate::kernel`]. Compared with 20,000 permutations, the latter is off by 1 % in the median and
//! 7 % at most at Q = 10, and by 1.5 % at most from Q = 20 on (`cargo test --release --test it
//! duration -- --nocapture`).

use ndarray::Array2;
use rand::Rng;
use rayon::prelude::*;
use statrs::distribution::{ContinuousCDF, StudentsT};

use super::trials::{DurationError, Trials};
use crate::kernel::{PERMUTATIONS, Threshold, quantile, test_independence};
use crate::seed;

/// The rule for the upper bound CB+ of HSIC.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Rule {
    /// The (1 − α) quantile of the R values of HSIC: Algorithm 1 as printed.
    Quantile,
    /// The upper end of the two-sided (1 − α) Student-t interval of the mean of the R values: the
    /// authors' program, and the paper's Fig. 7.
    MeanCi,
}

impl std::fmt::Display for Rule {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Self::Quantile => "quantile",
            Self::MeanCi => "mean-ci",
        })
    }
}

/// Settings of Algorithm 1. The defaults are the paper's, with the rule of the authors' program.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Algorithm1Settings {
    /// The rule for the upper bound CB+.
    pub rule: Rule,
    /// R: how often a start t₁ is drawn for each lag.
    pub draws: usize,
    /// t₁,max: the latest start, in samples. Reduced if a trial is too short for it.
    pub latest_start: usize,
    /// Significance level α.
    pub alpha: f64,
    /// How κ is found.
    pub threshold: Threshold,
    /// Largest lag t to test, in samples.
    pub largest_lag: usize,
    /// Test every lag from 1 upwards, instead of a coarse grid that is refined.
    pub exhaustive: bool,
    /// After the first independent lag, test longer ones too, and reject the first if dependence
    /// returns: a periodic signal never becomes independent. Algorithm 1 as printed omits this.
    pub look_beyond: bool,
    /// Seed of every draw.
    pub seed: u64,
}

impl Default for Algorithm1Settings {
    fn default() -> Self {
        Self {
            rule: Rule::MeanCi,
            draws: 500,
            latest_start: 20_000,
            alpha: 0.05,
            threshold: Threshold::Permutations(PERMUTATIONS),
            largest_lag: 1000,
            exhaustive: false,
            look_beyond: true,
            seed: 1,
        }
    }
}

/// The result at one lag, over all R draws.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct CurvePoint {
    /// Lag t in samples.
    pub lag: usize,
    /// Mean of HSIC_b over the draws.
    pub hsic_mean: f64,
    /// Lower end of the two-sided (1 − α) interval of the mean.
    pub hsic_low: f64,
    /// Upper end of the same interval: CB+ of [`Rule::MeanCi`].
    pub hsic_high: f64,
    /// (1 − α) quantile of HSIC_b: CB+ of [`Rule::Quantile`].
    pub hsic_quantile: f64,
    /// Mean of the threshold κ over the draws.
    pub kappa: f64,
}

impl CurvePoint {
    /// The upper bound CB+ of HSIC by a rule.
    pub(crate) fn bound(&self, rule: Rule) -> f64 {
        match rule {
            Rule::Quantile => self.hsic_quantile,
            Rule::MeanCi => self.hsic_high,
        }
    }

    /// Whether samples this far apart count as independent.
    pub(crate) fn independent(&self, rule: Rule) -> bool {
        self.bound(rule) < self.kappa
    }
}

/// The result of the search.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(tag = "outcome", rename_all = "kebab-case")]
pub enum SearchOutcome {
    /// T* in samples.
    Found {
        /// T*, the smallest independent lag
        lag: usize,
    },
    /// Samples depend on each other at every lag tested.
    NotInRange {
        /// the largest lag tested
        largest_lag: usize,
    },
    /// No T* within the range: a lag was found, but beyond it dependence returns.
    Returns {
        /// where Algorithm 1 as printed stops
        first: usize,
        /// a larger lag at which the lower bound of the mean exceeds κ again
        again_at: usize,
    },
}

/// T* of one surface and source, with the curve from which it was read.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Estimate {
    /// The result of the search.
    #[serde(flatten)]
    pub outcome: SearchOutcome,
    /// The rule for the upper bound CB+.
    pub rule: Rule,
    /// Q, the number of trials, on which T* depends: show both together.
    pub trials: usize,
    /// The t₁,max that was used, in samples.
    pub latest_start: usize,
    /// Samples a second.
    pub rate_hz: f64,
    /// The results at the lags tested, the smallest lag first.
    pub curve: Vec<CurvePoint>,
}

impl Estimate {
    /// T* in samples, if there is one within the range.
    pub fn t_star(&self) -> Option<usize> {
        match self.outcome {
            SearchOutcome::Found { lag } => Some(lag),
            SearchOutcome::NotInRange { .. } | SearchOutcome::Returns { .. } => None,
        }
    }

    /// T* in seconds.
    pub fn t_star_s(&self) -> Option<f64> {
        self.t_star().map(|lag| lag as f64 / self.rate_hz)
    }
}

/// Computes curves of HSIC against the lag for one set of trials.
pub struct Search<'a> {
    trials: &'a Trials,
    settings: Algorithm1Settings,
    largest_lag: usize,
    starts: usize,
    student: f64,
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
        // Location 0, scale 1 and at least 9 degrees of freedom are valid parameters.
        let student = StudentsT::new(0.0, 1.0, freedom).expect("a Student-t distribution");
        let student = student.inverse_cdf(1.0 - alpha / 2.0);
        let curve = std::collections::BTreeMap::new();
        Ok(Self { trials, settings, largest_lag, starts, student, curve })
    }

    /// The result at one lag, from HSIC and κ of R draws of t₁.
    ///
    /// Draws are keyed by the lag, so the order in which lags are tested changes nothing.
    pub fn at(&mut self, lag: usize) -> CurvePoint {
        if let Some(&point) = self.curve.get(&lag) {
            return point;
        }
        let Algorithm1Settings { draws, alpha, seed, .. } = self.settings;
        let mut rng = seed::rng(seed, &[b"duration", &lag.to_le_bytes()]);
        let starts: Vec<usize> = (0..draws).map(|_| below(&mut rng, self.starts)).collect();
        let test = |(draw, start)| self.test(lag, draw, start);
        let (hsic, kappa): (Vec<f64>, Vec<f64>) =
            starts.into_par_iter().enumerate().map(test).unzip();
        let count = draws as f64;
        let mean = hsic.iter().sum::<f64>() / count;
        let variance = hsic.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (count - 1.0);
        let half = self.student * (variance / count).sqrt();
        let point = CurvePoint {
            lag,
            hsic_mean: mean,
            hsic_low: mean - half,
            hsic_high: mean + half,
            hsic_quantile: quantile(hsic, alpha),
            kappa: kappa.iter().sum::<f64>() / count,
        };
        self.curve.insert(lag, point);
        point
    }

    /// HSIC and κ of the samples of all trials at `start`, paired with the samples `lag` later.
    fn test(&self, lag: usize, draw: usize, start: usize) -> (f64, f64) {
        let Algorithm1Settings { alpha, threshold, seed, .. } = self.settings;
        let shape = (self.trials.count(), self.trials.channels());
        let at = |frame: usize| {
            Array2::from_shape_fn(shape, |(trial, c)| {
                f64::from(self.trials.sample(trial, frame)[c])
            })
        };
        let key: [&[u8]; 3] = [b"permutations", &lag.to_le_bytes(), &draw.to_le_bytes()];
        let rng = &mut seed::rng(seed, &key);
        match test_independence(at(start).view(), at(start + lag).view(), alpha, threshold, rng) {
            Ok(found) => (found.hsic, found.kappa),
            // Settings and trials were checked, so one side is constant and depends on nothing.
            Err(_) => (0.0, 0.0),
        }
    }

    /// Finds T* by one of the rules; lags already tested are not computed again.
    ///
    /// The coarse grid has steps of an eighth of the lag. All lags between two grid points are
    /// tested if CB+ at one of the two is below κ·(1.05 + 5/√R): within 5 % and 5 standard errors
    /// of κ, chance could make a lag between them independent.
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

    /// The first grid lag beyond `lag` at which samples are clearly dependent.
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

/// A random integer in 0..n by Lemire's multiplication; its bias is at most n/2³².
fn below(rng: &mut impl Rng, n: usize) -> usize {
    ((u64::from(rng.next_u32()) * n as u64) >> 32) as usize
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

    fn t_star(trials: &Trials, settings: Algorithm1Settings) -> Result<Estimate, DurationError> {
        Ok(Search::new(trials, settings)?.find(settings.rule))
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
