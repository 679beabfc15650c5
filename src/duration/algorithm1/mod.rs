//! The paper's Algorithm 1 and its two rules, for replication.
//!
//! For a lag t, R times, draw a start t₁ and pair the samples of all Q trials at t₁ with those at
//! t₁ + t; T* is the first t at which the upper bound CB+ of HSIC lies below the mean threshold κ.
//! [`Search`] computes the curve and finds T*; `batch` makes eight of its tests at a time, on
//! `distances` and `lanes`.
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

mod batch;
mod distances;
mod estimate;
mod lanes;
mod search;

pub use estimate::{Algorithm1Settings, CurvePoint, Estimate, Rule, SearchOutcome};
pub use search::{Search, t_star};
