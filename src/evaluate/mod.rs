//! How well a method names surfaces: protocols, folds, accuracies.
//!
//! [`Evaluation`] is the engine of all that is here: it prepares a method's libraries once and names
//! the queries of each fold. [`SettledOutcome`], [`UnknownOutcome`] and [`EnrolmentOutcome`] measure
//! what else there is to know of a run; [`chart`], [`plan`], [`stress`] and [`paper`] are studies of
//! many runs.

pub mod chart;
mod check;
mod enrolled;
mod error;
mod evaluation;
mod fold;
mod loudness;
mod outcome;
pub mod paper;
pub mod plan;
mod settled;
pub mod stress;
mod unknown;

pub use check::{CheckReport, SurfaceCheck, TrialCheck, TrialVerdict, check};
pub use enrolled::{EnrolmentOutcome, enrol};
pub use error::EvaluateError;
pub use evaluation::{Evaluation, LeftOut, Measured, Progress, Query, Run, Trials, first_seconds};
pub use fold::{Fold, Protocol, folds};
pub use loudness::Loudness;
pub use outcome::{
    Confusion, FoldAccuracy, Outcome, Prediction, interval_over_users, is_over_users,
    wilson_interval,
};
pub use settled::{SettledOutcome, follow};
pub use unknown::UnknownOutcome;
