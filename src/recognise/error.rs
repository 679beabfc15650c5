//! Why trials cannot be compared.

use crate::library::LibraryError;
use crate::scene::SourceId;

/// Why a trial cannot be named.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The messages say it.
pub enum RecogniseError {
    #[error(transparent)]
    Library(#[from] LibraryError),
    #[error(
        "the library holds {trials} trial(s) of {surfaces} surface(s); naming needs trials of at \
         least two surfaces: enrol more, or open another library"
    )]
    TooFewSurfaces { surfaces: usize, trials: usize },
    #[error("no source in common: the query has {query}; the library has {library}")]
    NothingInCommon { query: String, library: String },
    #[error(
        "{source_name}: {query_hz} Hz in the query, but {library_hz} Hz in {trial}; one source has \
         one rate: resample one of them"
    )]
    Rates { source_name: SourceId, query_hz: f64, library_hz: f64, trial: String },
    #[error(
        "{0} needs recordings; on feature tables use naive-bayes, svm, knn, mahalanobis, adaboost \
         or random-forest"
    )]
    NeedsRecordings(&'static str),
    #[error("{trial} was prepared for {by}, and cannot be compared by {method}")]
    PreparedByAnother { method: &'static str, by: &'static str, trial: String },
    #[error(
        "too little to name: every source is silent, or shorter than a frame; drag for longer, and \
         check the cables"
    )]
    TooLittle,
    #[error("{source_name}: {found} channel(s) in {trial}, but the scene says {expected}")]
    Channels { source_name: SourceId, found: usize, expected: usize, trial: String },
    #[error("{source_name}: {trial} holds {found}, but the scene says {expected}")]
    Kind { source_name: SourceId, trial: String, found: &'static str, expected: &'static str },
}
