//! How well a method names surfaces: protocols, folds, accuracies.
//!
//! [`Evaluation`] is the engine of all that is here: it prepares a method's libraries once and names
//! the queries of each fold. [`SettledOutcome`], [`UnknownOutcome`] and [`EnrolmentOutcome`] measure
//! what else there is to know of a run; `chart`, `plan`, `stress` and `paper` are studies of many
//! runs, and belong to the program.

pub(crate) mod chart;
mod check;
mod enrolled;
mod error;
mod evaluation;
mod fold;
mod loudness;
mod outcome;
#[doc(hidden)]
pub mod paper;
#[doc(hidden)]
pub mod plan;
mod settled;
mod share;
#[doc(hidden)]
pub mod stress;
mod unknown;

#[doc(hidden)]
pub use crate::recognise::wilson_interval;
pub(crate) use check::{CheckReport, TrialCheck, TrialVerdict, check};
pub use enrolled::EnrolmentOutcome;
pub(crate) use enrolled::enrol;
pub use error::EvaluateError;
pub(crate) use evaluation::first_seconds;
pub use evaluation::{
    EvaluatedTrials, Evaluation, LeftOutSources, Measured, ProgressFn, Query, Run,
};
pub use fold::{Fold, Protocol, folds};
pub(crate) use loudness::Loudness;
pub use outcome::{Confusion, FoldAccuracy, Outcome, Prediction};
pub(crate) use outcome::{interval_over_users, is_over_users};
pub use settled::SettledOutcome;
pub use share::Share;
pub use unknown::UnknownOutcome;
