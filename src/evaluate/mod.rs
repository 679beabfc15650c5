//! Measures how well a method names surfaces: protocols, folds, accuracies.
//!
//! [`Evaluation`] is the engine of all that is here: it prepares a method's libraries once and names
//! the queries of each fold. [`SettledOutcome`], [`UnknownOutcome`] and [`EnrolmentOutcome`] measure
//! what else there is to know of a run; `chart`, `plan`, `stress` and `paper` are studies of many
//! runs, and belong to the program.

pub(crate) mod chart;
mod check;
mod enrolled;
mod evaluation;
mod fold;
mod loudness;
mod outcome;
#[doc(hidden)]
pub mod paper;
mod plain;
#[doc(hidden)]
pub mod plan;
mod settled;
mod share;
#[doc(hidden)]
pub mod stress;
mod unknown;

#[doc(hidden)]
pub use crate::recognise::wilson_interval;
pub(crate) use check::{Audited, CheckReport, Finding, TrialCheck, TrialVerdict, check};
pub use enrolled::EnrolmentOutcome;
pub(crate) use enrolled::enrol;
pub(crate) use evaluation::first_seconds;
pub use evaluation::{
    EvaluatedTrials, Evaluation, LeftOutSources, Measured, ProgressFn, Query, Run,
};
pub use fold::{Fold, Protocol, folds};
pub(crate) use loudness::Loudness;
pub use outcome::{Confusion, FoldAccuracy, Outcome, Prediction};
pub(crate) use outcome::{interval_over_users, is_over_users};
pub(crate) use plain::better_plain;
pub use settled::SettledOutcome;
pub use share::Share;
pub use unknown::UnknownOutcome;

use crate::recognise::{RecogniseError, RejectionError};
use crate::scene::SceneError;

/// Why an evaluation cannot be done.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// the data do not hold what the protocol needs
    #[error("the protocol {protocol} needs {needs}; the data hold {found}{fits}")]
    Protocol {
        /// its name
        protocol: &'static str,
        /// what it needs
        needs: &'static str,
        /// what was found
        found: String,
        /// the protocol that fits the data, if one does
        fits: String,
    },
    /// every query was enrolled
    #[error("no user has more than {count} trial(s) of a surface, so none is left to name")]
    AllEnrolled {
        /// trials of each surface that were to be enrolled
        count: usize,
    },
    /// a trial cannot be compared
    #[error(transparent)]
    Recognise(#[from] RecogniseError),
    /// a source that the data do not describe
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// unknown surfaces cannot be recognised
    #[error(transparent)]
    Rejection(#[from] RejectionError),
    /// a method that says nothing before the end of a scan
    #[error("the method {method} cannot follow a scan in progress")]
    Follow {
        /// the method
        method: &'static str,
    },
}
