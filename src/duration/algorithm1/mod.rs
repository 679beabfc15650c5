//! The paper's Algorithm 1 and its two rules, for replication.
//!
//! For a lag t, R times, draw a start t₁ and pair the samples of all Q trials at t₁ with those at
//! t₁ + t; T* is the first t at which the upper bound CB+ of HSIC lies below the mean threshold κ.
//! [`Search`] computes the curve and finds T*; `batch` makes eight of its tests at a time, on
//! `lanes`.
//!
//! # What it is worth
//! A test of Q pairs sees little: at Q = 10 `mean-ci` stops at 0.4 of a process's correlation time τ,
//! a sixth of the lag at which the autocorrelation has fallen to 0.1, and `quantile`, nearer to it
//! because of its scatter, stops too early in every run all the same. `quantile` compares two
//! estimates of one quantile: on noise it stops at the first sample in half of the runs. With more
//! trials both answer longer times. `tools/charts/duration-study.md` has the tables.
//!
//! # Threshold
//! By permutations, as in the paper, or from a Pearson III (shifted gamma) distribution with the
//! exact mean, variance and skewness of the permutation distribution, see [`crate::kernel`]. Against
//! 20,000 permutations it is off by 1 % in the median and 7 % at most at Q = 10, 1.5 % at most from
//! Q = 20 on (`cargo test --release --test it duration -- --nocapture`).

use crate::kernel::{PERMUTATIONS, Threshold};

mod batch;
mod lanes;
mod search;

pub use search::{Search, t_star};

/// The upper bound CB+ of HSIC.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Rule {
    /// The (1 − α) quantile of the R values of HSIC: Algorithm 1 as printed.
    Quantile,
    /// The upper end of the two-sided (1 − α) Student-t interval of their mean: the authors'
    /// program, and its Fig. 7.
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

/// Parameters of Algorithm 1. The defaults are the paper's, with the authors' program's rule.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Algorithm1Settings {
    /// The upper bound CB+.
    pub rule: Rule,
    /// R: how often a start t₁ is drawn for each lag.
    pub draws: usize,
    /// t₁,max: the latest start, in samples. Made smaller where a trial is too short for it.
    pub latest_start: usize,
    /// Significance level α.
    pub alpha: f64,
    /// The way to find κ.
    pub threshold: Threshold,
    /// Largest lag t that is looked at, in samples.
    pub largest_lag: usize,
    /// Look at every lag from 1 upwards instead of a coarse grid that is refined.
    pub exhaustive: bool,
    /// Look beyond the first lag found, and take it back where dependence returns: a periodic
    /// signal never becomes independent. Algorithm 1 as printed does not look.
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
    /// Mean of HSIC_b.
    pub hsic_mean: f64,
    /// Lower end of the two-sided (1 − α) interval of the mean.
    pub hsic_low: f64,
    /// Upper end: CB+ of [`Rule::MeanCi`].
    pub hsic_high: f64,
    /// (1 − α) quantile of HSIC_b: CB+ of [`Rule::Quantile`].
    pub hsic_quantile: f64,
    /// Mean threshold κ.
    pub kappa: f64,
}

impl CurvePoint {
    /// CB+.
    pub(crate) fn bound(&self, rule: Rule) -> f64 {
        match rule {
            Rule::Quantile => self.hsic_quantile,
            Rule::MeanCi => self.hsic_high,
        }
    }

    /// Whether samples this far apart can be taken for independent.
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
        /// the lag
        lag: usize,
    },
    /// Dependence at every lag looked at.
    NotInRange {
        /// the largest lag looked at
        largest_lag: usize,
    },
    /// A lag was found, but dependence comes back beyond it, as in a periodic signal: within the
    /// range there is no T*.
    Returns {
        /// where Algorithm 1 as printed stops
        first: usize,
        /// a larger lag at which the lower bound of the mean exceeds κ again
        again_at: usize,
    },
}

/// T* of one surface and source, with the curve that it was read from.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Estimate {
    /// The result of the search.
    #[serde(flatten)]
    pub outcome: SearchOutcome,
    /// The upper bound CB+.
    pub rule: Rule,
    /// Q, the number of trials: say it wherever T* is said.
    pub trials: usize,
    /// The t₁,max that was used, in samples.
    pub latest_start: usize,
    /// Samples a second.
    pub rate_hz: f64,
    /// The lags that were looked at, upwards.
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
