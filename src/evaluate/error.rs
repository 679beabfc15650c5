//! Why an evaluation cannot be done.

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
