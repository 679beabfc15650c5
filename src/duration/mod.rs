//! T*, the minimum time between independent samples. How long a scan must last to be named
//! correctly is another question; cross-validation answers it: [`crate::recognise::ScanTime`].
//!
//! ```text
//! library ─► report ─► trials ─► pooled      the default: size of the dependence, from all pairs
//!              │              └► algorithm1  the paper's tests of Q pairs, with two rules
//!              ├► need      from T* to seconds of dragging
//!              └► figure    dependence against lag
//! stream  ─► online ─► pooled
//! ```
//!
//! [`report()`] computes T* for the surfaces and sources of a library, [`OnlineDuration`] for the
//! stream of a live scan; [`Trials`] checks the recordings. `need` turns T* into seconds to drag.
//!
//! # What T* means
//! Two samples T* apart depend on each other no more than those of a Gaussian process with a
//! correlation of 0.1: the second is new evidence about the surface. This holds for any source that
//! is a series in time, whether methods compare it as a series or by its spectrum. For a spectrum,
//! T* is no distance between bins: it says how far apart two parts of one drag must be for the
//! second to add evidence, and so how many such parts a drag holds. Images and taps have no T*.
//!
//! There may be no T*: "never" if the signal repeats itself or drifts through a whole trial, "too
//! little data" if the trials are too few or too short for a signal this slow, and "not within the
//! range" if T* would exceed a sixth of a trial. Lasting differences between trials (level,
//! loudness, hand) are no dependence in time; `lasting_share` is their share of the variance.
//!
//! # Accuracy of the two estimators
//! On processes with a known T*, the median of `pooled` is within a tenth of T* once there are 500
//! correlation times of data, and its upper bound is hardly ever below 0.85 of the truth. The
//! paper's Algorithm 1 gives a sixth of the truth at Q = 10, in every run; its rules are kept for
//! replication. On sounds, T* from five trials of a surface and from the five others agree within a
//! factor of 1.5 in 14 of 20 cases: where dependence falls slowly, a small error moves the crossing
//! of the threshold far. `tools/charts/duration-study` measures both, on processes and on
//! recordings, and keeps the tables beside it.

mod algorithm1;
mod figure;
mod need;
mod online;
mod pooled;
mod report;
#[cfg(test)]
#[path = "../../tests/common/simulate.rs"]
pub(crate) mod simulate;
mod trials;

pub use algorithm1::{Algorithm1Settings, CurvePoint, Estimate, Rule, Search, SearchOutcome};
pub(crate) use figure::{AccuracyCurve, figure};
pub(crate) use need::{SAMPLES, ScanNeed};
pub use online::{OnlineDuration, OnlineError, OnlineEstimate, OnlineSettings};
#[doc(hidden)]
pub use pooled::{CORRELATION, VALUES, at_needed_rate};
pub use pooled::{PooledAnswer, PooledDependence, PooledEstimate};
pub use report::{
    ByRule, DurationReport, Estimator, PooledRow, PooledSettings, Question, ReportError,
    SceneDuration, SourceDuration, report,
};
pub use trials::{DurationError, Trials};
