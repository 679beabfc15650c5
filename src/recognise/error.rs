//! Why trials cannot be compared.

use crate::library::LibraryError;
use crate::scene::SourceId;

/// Why a trial cannot be named.
#[derive(Debug, thiserror::Error)]
pub enum RecogniseError {
    /// a trial of the library cannot be read
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// nothing to choose between
    #[error(
        "the library holds {trials} trial(s) of {surfaces} surface(s); naming needs trials of at \
         least two surfaces: enrol more, or open another library"
    )]
    TooFewSurfaces {
        /// number of surfaces
        surfaces: usize,
        /// number of trials
        trials: usize,
    },
    /// no source in common
    #[error("no source in common: the query has {query}; the library has {library}")]
    NothingInCommon {
        /// the query's sources
        query: String,
        /// the library's sources
        library: String,
    },
    /// two rates in one source
    #[error(
        "{source_name}: {query_hz} Hz in the query, but {library_hz} Hz in {trial}; one source has \
         one rate: resample one of them"
    )]
    Rates {
        /// the source
        source_name: SourceId,
        /// the query's rate
        query_hz: f64,
        /// the library's rate
        library_hz: f64,
        /// the library's trial
        trial: String,
    },
    /// features alone, by a method that compares recordings
    #[error(
        "{0} needs recordings; on feature tables use naive-bayes, svm, knn, mahalanobis, adaboost \
         or random-forest"
    )]
    NeedsRecordings(&'static str),
    /// a trial that another kind of method prepared
    #[error("{trial} was prepared for {by}, and cannot be compared by {method}")]
    PreparedByAnother {
        /// the method that it was given to
        method: &'static str,
        /// the method that it was prepared for
        by: &'static str,
        /// the trial
        trial: String,
    },
    /// a query that says nothing
    #[error(
        "too little to name: every source is silent, or shorter than a frame; drag for longer, and \
         check the cables"
    )]
    TooLittle,
    /// a number of channels that the scene does not describe
    #[error("{source_name}: {found} channel(s) in {trial}, but the scene says {expected}")]
    Channels {
        /// the source
        source_name: SourceId,
        /// what the trial has
        found: usize,
        /// what the scene says
        expected: usize,
        /// the trial
        trial: String,
    },
    /// a series where an image should be, or an image where a series should be
    #[error("{source_name}: {trial} holds {found}, but the scene says {expected}")]
    Kind {
        /// the source
        source_name: SourceId,
        /// the trial
        trial: String,
        /// what the trial holds
        found: &'static str,
        /// what the scene says
        expected: &'static str,
    },
}
