//! How well a method names surfaces: protocols, folds, accuracies.

mod chart;
mod chart_figure;
mod fold;
mod loudness;
mod outcome;
pub mod paper;
pub mod plan;
mod run;
mod settled;
pub mod stress;
mod unknown;

pub use chart::{Chart, Point, pareto};
pub use chart_figure::figure;
pub use fold::{Fold, Protocol, folds};
pub use loudness::Loudness;
pub use outcome::{Confusion, FoldAccuracy, Outcome, Prediction, wilson_interval};
pub use run::{
    Progress, first_seconds, prepare_folds, run, run_features, run_prepared, run_variants,
};
pub use settled::{SettledOutcome, follow, run_settled};
pub use unknown::{UnknownOutcome, run_unknown};

use crate::recognise::{RecogniseError, RejectionError};
use crate::scene::SceneError;

/// Why an evaluation cannot be done.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// the data do not hold what the protocol needs
    #[error("the protocol {protocol} needs {needs}; the data hold {found}")]
    Protocol {
        /// its name
        protocol: &'static str,
        /// what it needs
        needs: &'static str,
        /// what was found
        found: String,
    },
    /// a trial cannot be compared
    #[error(transparent)]
    Recognise(#[from] RecogniseError),
    /// a source that the data do not describe
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// unknown surfaces cannot be told
    #[error(transparent)]
    Rejection(#[from] RejectionError),
    /// a method that says nothing before the end of a scan
    #[error("the method {method} cannot follow a scan while it goes on; use --method embedding")]
    Follow {
        /// the method
        method: &'static str,
    },
}
