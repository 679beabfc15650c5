//! Measures how well a method names surfaces: protocols, folds, accuracies.
//!
//! All measurements use [`Evaluation`], which prepares a method's libraries once and names the
//! queries of each fold. [`SettledOutcome`] measures early answers, [`UnknownOutcome`] the
//! detection of unknown surfaces, and [`EnrolmentOutcome`] the gain from enrolling. `chart`,
//! `plan` and `stress` each combine many runs for a command.

mod answers;
#[doc(hidden)]
pub mod chart;
mod check;
#[doc(hidden)]
pub mod control_chart;
mod enrolled;
mod evaluation;
mod fold;
mod leak;
mod outcome;
mod paired;
#[doc(hidden)]
pub mod plan;
mod still;
#[doc(hidden)]
pub mod stress;

#[doc(hidden)]
pub use self::{
    check::{Audited, CheckReport, Finding, TrialCheck, TrialVerdict, check},
    enrolled::enrol,
    evaluation::{first_seconds, in_libraries, within},
    fold::{Split, TEST, TRAIN},
    leak::Leaks,
    outcome::percentile,
    paired::{Named, Paired, better_plain, paired},
    still::{Still, still},
};
pub use answers::{SettledOutcome, UnknownOutcome};
pub use enrolled::EnrolmentOutcome;
pub use evaluation::{
    EvaluatedTrials, Evaluation, LeftOutSources, Measured, ProgressFn, Query, Run,
};
pub use fold::{Fold, Protocol, folds};
pub use outcome::{
    Confusion, FoldAccuracy, Interval, Outcome, Over, Prediction, Share, SurfaceAccuracy,
};

use crate::recognise::{RecogniseError, RejectionError};
use crate::scene::SceneError;

#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// trials that cannot be split as the protocol wants
    #[error("{0}")]
    Trials(String),
    #[error(transparent)]
    Recognise(#[from] RecogniseError),
    #[error(transparent)]
    Scene(#[from] SceneError),
    #[error(transparent)]
    Rejection(#[from] RejectionError),
    #[error("the method {method} cannot follow a scan in progress")]
    Follow { method: &'static str },
}
