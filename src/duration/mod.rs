//! T*, the minimum time between independent samples. How long a scan must last to be named right is
//! another question, which left-out trials answer: [`crate::recognise::ScanTime`].
//!
//! ```text
//! library ─► report ─► trials ─► pooled      the size of the dependence, all pairs: the default
//!              │              └► algorithm1  the paper's tests of Q pairs, two rules
//!              ├► need      from T* to seconds of dragging
//!              └► figure    dependence against lag
//! stream  ─► online ─► pooled
//! ```
//!
//! [`report()`] computes T* for the surfaces and sources of a library, [`OnlineDuration`] for the
//! stream of a live scan; [`Trials`] checks the recordings. `need` turns T* into the seconds to
//! drag, and `figure` draws it.
//!
//! # What T* means
//! Two samples T* apart depend on each other no more than those of a Gaussian process with a
//! correlation of 0.1 do: they are fresh evidence about the surface. This holds for any source that
//! is a series in time, whatever it is compared by. Where that is the spectrum, T* is no distance of
//! bins: it says how far apart two pieces of one drag must lie for the second to say what the first
//! did not, and how many such pieces a drag holds. Images, and taps, which are over before they
//! repeat themselves, have no T*.
//!
//! A source may have none. "Never" is a signal that repeats itself or drifts through a whole trial,
//! "too little data" one whose trials are too short or too few against its slowness, and "not within
//! the range" one whose T* would be longer than a sixth of a trial. What differs between trials for
//! good (their level, their loudness, the hand) is no dependence in time: `lasting_share` is how
//! much of the variance that is.
//!
//! # What the two estimators are worth
//! On processes whose answer is known, `pooled` is within a tenth of it in the median from 500
//! correlation times of data on, and its upper bound is below 0.85 of the truth in hardly any run.
//! The paper's Algorithm 1 answers a sixth of it at Q = 10, in every run. Its rules stay for
//! replication. On sounds, five trials of a surface and the five others agree within a factor of 1.5
//! in 14 of 20 cases, as far as five trials can: a dependence that falls slowly crosses the threshold
//! at a lag that a small error moves far. `tools/charts/duration-study` measures both, on processes
//! and on recordings, and keeps the tables beside it.

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
