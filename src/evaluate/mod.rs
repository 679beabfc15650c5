//! How well a method names surfaces: protocols, folds, accuracies.

mod chart;
mod chart_figure;
mod fold;
mod loudness;
mod outcome;
pub mod paper;
mod run;

pub use chart::{Chart, Point, pareto};
pub use chart_figure::figure;
pub use fold::{Fold, Protocol, folds};
pub use loudness::Loudness;
pub use outcome::{Confusion, FoldAccuracy, Outcome, Prediction, wilson_interval};
pub use run::{Progress, prepare, prepare_folds, run, run_prepared, run_variants};

use crate::recognise::RecogniseError;

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
}
