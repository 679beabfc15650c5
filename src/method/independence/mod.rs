//! T*, the minimum time between independent samples. It does not say how long a scan must last to be
//! named correctly; cross-validation does, see [`crate::recognise::ScanTime`].
//!
//! ```text
//! library ─► report ─► trials ─► pooled      the default: size of the dependence, from all pairs
//!              │              └► algorithm1  the paper's tests of Q pairs, with two rules
//!              └► figure    dependence against lag
//! scan    ─► online ─► pooled
//! ```
//!
//! [`report()`] computes T* for the surfaces and sources of a library. [`OnlineDuration`] computes T*
//! for the stream of a live scan. [`Trials`] checks the recordings.
//!
//! # What T* means
//! Two samples T* apart depend on each other no more than two samples of a Gaussian process with a
//! correlation of 0.1, so the second adds information about the surface. T* exists for any source
//! that is a series in time, also if methods compare the spectrum of the source. T* of a spectrum
//! is not a distance between its bins: it says how far apart two parts of a drag must be to be
//! independent, and so how many such parts a drag holds. Images and taps have no T*.
//!
//! There may be no T*: "never" if the signal repeats itself or drifts through a whole trial, "too
//! little data" if the trials are too few or too short for a signal this slow, and "not within the
//! range" if T* would exceed a sixth of a trial. Lasting differences between trials (loudness,
//! pressure) do not count as dependence in time; `lasting_share` is their share of the variance.
//!
//! # Accuracy of the two estimators
//! On processes with a known T*, the median of `pooled` is within a tenth of T* if there are at least
//! 500 correlation times of data, and its upper bound is hardly ever below 0.85 of T*. The paper's
//! Algorithm 1 gives a sixth of T* at Q = 10, in every run; its rules are kept for replication. On
//! sounds, T* from five trials of a surface and T* from five other trials agree within a factor of 1.5
//! in 14 of 20 cases. If dependence falls slowly, a small error moves the crossing of the threshold
//! far. `tools/charts/duration-study` measures both, and keeps the tables beside it.

mod algorithm1;
mod figure;
mod online;
mod pooled;
mod report;
#[cfg(test)]
#[path = "../../../tests/common/simulate.rs"]
pub(crate) mod simulate;
mod trials;

pub use algorithm1::{Algorithm1Settings, CurvePoint, Estimate, Rule, Search, SearchOutcome};
#[doc(hidden)]
pub use figure::{AccuracyCurve, figure};
#[doc(hidden)]
pub use online::of_recording;
pub use online::{OnlineDuration, OnlineError};
#[doc(hidden)]
pub use pooled::{CORRELATION, VALUES, at_needed_rate};
pub use pooled::{PooledAnswer, PooledDependence, PooledEstimate};
pub use report::{
    ByRule, DurationReport, Estimator, PooledRow, PooledSettings, Question, ReportError,
    SceneDuration, SourceDuration, report,
};
#[doc(hidden)]
pub use report::{SAMPLES, scan_s};
pub use trials::{DurationError, Trials};
