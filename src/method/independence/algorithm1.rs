//! The paper's Algorithm 1 and its two rules, for replication.
//!
//! For each lag t, a start t₁ is drawn R times, and the samples of all Q trials at t₁ are paired with
//! those at t₁ + t. T* is the first t with an upper bound CB+ of HSIC below the mean threshold κ.
//! [`Search`] computes the curve and finds T*; the R tests at one lag run in parallel.
//!
//! # Accuracy
//! A test of Q pairs has little power: at Q = 10, `mean-ci` stops at a sixth of the lag at which
//! the autocorrelation has fallen to 0.1. `quantile` varies more and stops closer to that lag, but
//! also too early in every run. On noise, `quantile` finds T* = 1 in only half of the runs, since
//! it compares two estimates of one quantile. With more trials both rules give longer times.
//!
//! # Threshold
//! κ comes from permutations, as in the paper, or from a Pearson III (shifted gamma) distribution with
//! the exact mean, variance and skewness of the permutation distribution, see [`crate::kernel`].
//! Compared with 20,000 permutations, Pearson III is off by 1 % in the median and at most 7 % at Q =
//! 10, and by at most 1.5 % from Q = 20 on (`cargo test --release --test it duration -- --nocapture`).

use std::collections::BTreeMap;

use ndarray::Array2;
use rand::Rng;
use rayon::prelude::*;
use statrs::distribution::{ContinuousCDF, StudentsT};

use super::trials::{DurationError, Trials};
use crate::kernel::{PERMUTATIONS, Threshold, check_level, quantile, test_independence};
use crate::seed;

/// How the upper bound CB+ of HSIC is computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Rule {
    /// The (1 − α) quantile of the R values of HSIC, as in the printed Algorithm 1.
    Quantile,
    /// The upper end of the two-sided (1 − α) Student-t interval of the mean of the R values, as in
    /// the authors' program and the paper's Fig. 7.
    MeanCi,
}

impl std::fmt::Display for Rule {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        serde::Serialize::serialize(self, f)
    }
}

/// Settings of Algorithm 1. The defaults are the paper's, with the rule of the authors' program.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Algorithm1Settings {
    pub rule: Rule,
    /// R: how many starts t₁ are drawn for each lag.
    pub draws: usize,
    /// t₁,max: the latest start, in samples. It is reduced if a trial is too short.
    pub latest_start: usize,
    pub alpha: f64,
    pub threshold: Threshold,
    /// Largest lag t to test, in samples.
    pub largest_lag: usize,
    /// Whether to test every lag from 1 upwards, instead of a coarse grid that is then refined.
    pub exhaustive: bool,
    /// Whether to test lags beyond the first independent lag, and reject that lag if dependence
    /// returns, as in a periodic signal. The printed Algorithm 1 does not do this.
    pub look_beyond: bool,
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

/// HSIC and κ at one lag, over all R draws of the start t₁.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct CurvePoint {
    pub lag: usize,
    pub hsic_mean: f64,
    /// Lower end of the two-sided (1 − α) interval of `hsic_mean`.
    pub hsic_low: f64,
    /// Upper end of the two-sided (1 − α) interval of `hsic_mean`: CB+ by [`Rule::MeanCi`].
    pub hsic_high: f64,
    /// (1 − α) quantile of HSIC_b: CB+ by [`Rule::Quantile`].
    pub hsic_quantile: f64,
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

    pub(crate) fn independent(&self, rule: Rule) -> bool {
        self.bound(rule) < self.kappa
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SearchOutcome {
    /// T* in samples: the smallest lag at which samples are independent.
    Found { lag: usize },
    /// Samples depend on each other at every lag tested.
    NotInRange { largest_lag: usize },
    /// There is no T* within the range: the lag `first`, at which the printed Algorithm 1 stops, is
    /// independent, but at a larger one the lower bound of mean HSIC exceeds κ again. In samples.
    Returns { first: usize, again_at: usize },
}

/// T* of one surface and source, and the curve of HSIC from which T* was read.
#[derive(Clone, Debug, PartialEq)]
pub struct Estimate {
    pub outcome: SearchOutcome,
    /// t₁,max, the latest start from which pairs of samples were drawn, in samples.
    pub latest_start: usize,
    pub rate_hz: f64,
    /// The results at the lags tested, in ascending order of lag.
    pub curve: Vec<CurvePoint>,
}

impl Estimate {
    /// T* in samples; `None` if no T* lies within the range of lags.
    pub fn t_star(&self) -> Option<usize> {
        let SearchOutcome::Found { lag } = self.outcome else { return None };
        Some(lag)
    }
}

/// Computes curves of HSIC against the lag for one set of trials.
pub struct Search<'a> {
    trials: &'a Trials,
    settings: Algorithm1Settings,
    largest_lag: usize,
    starts: usize,
    student: f64,
    curve: BTreeMap<usize, CurvePoint>,
}

impl<'a> Search<'a> {
    /// A search over `trials`, with no lag tested yet.
    ///
    /// # Errors
    /// If the settings are not possible. Too large a largest lag is reduced to half a trial.
    pub fn new(trials: &'a Trials, settings: Algorithm1Settings) -> Result<Self, DurationError> {
        let fail = |text: String| Err(DurationError::Settings(text));
        let Algorithm1Settings { draws, alpha, threshold, largest_lag, latest_start, .. } =
            settings;
        check_level(alpha, threshold)?;
        if draws < 10 {
            return fail(format!("R = {draws} draws; expected at least 10"));
        }
        if largest_lag == 0 || latest_start == 0 {
            return fail("the largest lag and the latest start are at least 1 sample".into());
        }
        let frames = trials.frames;
        let largest_lag = largest_lag.min(frames / 2);
        let starts = latest_start.min(frames - largest_lag);
        let freedom = (draws - 1) as f64;
        // Location 0, scale 1 and at least 9 degrees of freedom are valid parameters.
        let student = StudentsT::new(0.0, 1.0, freedom).expect("a Student-t distribution");
        let student = student.inverse_cdf(1.0 - alpha / 2.0);
        Ok(Self { trials, settings, largest_lag, starts, student, curve: BTreeMap::new() })
    }

    /// The result at one lag, from HSIC and κ of R draws of t₁.
    ///
    /// Draws are seeded by the lag, so the order in which lags are tested changes nothing.
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
        let of = |(trial, c), frame| f64::from(self.trials.sample(trial, frame)[c]);
        let at = |frame: usize| Array2::from_shape_fn(shape, |place| of(place, frame));
        let key: [&[u8]; 3] = [b"permutations", &lag.to_le_bytes(), &draw.to_le_bytes()];
        let rng = &mut seed::rng(seed, &key);
        match test_independence(at(start).view(), at(start + lag).view(), alpha, threshold, rng) {
            Ok(found) => (found.hsic, found.kappa),
            // After all checks, the only error left is a constant side, which depends on nothing.
            Err(_) => (0.0, 0.0),
        }
    }

    /// Finds T* by `rule`; lags already tested are not computed again. T* depends on the number of
    /// trials, so show both together.
    ///
    /// Tests a coarse grid of lags (unless `exhaustive`), in steps of an eighth of the lag. Then
    /// tests all lags between two grid lags if CB+ at one of them is below κ·(1.05 + 5/√R): that
    /// close to κ (5 % and 5 standard errors), a lag in between could be independent by chance.
    pub fn find(&mut self, rule: Rule) -> Estimate {
        let first = match self.settings.exhaustive {
            true => self.upwards(rule, 1, self.largest_lag),
            false => self.coarse(rule),
        };
        let beyond = first.filter(|_| self.settings.look_beyond);
        let outcome = match (first, beyond.and_then(|lag| self.dependent_beyond(lag))) {
            (None, _) => SearchOutcome::NotInRange { largest_lag: self.largest_lag },
            (Some(first), Some(again_at)) => SearchOutcome::Returns { first, again_at },
            (Some(lag), None) => SearchOutcome::Found { lag },
        };
        let (latest_start, rate_hz) = (self.starts, self.trials.rate_hz());
        Estimate { outcome, latest_start, rate_hz, curve: self.curve.values().copied().collect() }
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

    /// The first grid lag beyond `lag` at which samples are clearly dependent, if there is one.
    fn dependent_beyond(&mut self, lag: usize) -> Option<usize> {
        let room = self.trials.frames - self.starts;
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
