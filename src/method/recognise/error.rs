//! Why trials cannot be compared, and the checks for this.

use std::collections::BTreeSet;

use crate::features::sources::SourceError;
use crate::library::LibraryError;
use crate::scene::SourceId;
use crate::trial::{Doubt, TrialKey};

/// Why a trial cannot be named.
#[derive(Debug, thiserror::Error)]
pub enum RecogniseError {
    #[error(transparent)]
    Library(#[from] LibraryError),
    #[error(transparent)]
    Source(#[from] SourceError),
    #[error(
        "the library holds {trials} trial(s) of {surfaces} surface(s); naming needs trials of at \
         least two surfaces: enrol more, or open another library. The folder that holds a trial names its \
         surface"
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
    #[error("{}", Doubt::TooLittle.text())]
    TooLittle,
}

/// A result that fails, unless said otherwise, because trials cannot be named.
pub(crate) type Result<T, E = RecogniseError> = std::result::Result<T, E>;

/// `None` for a query that says too little to be named.
pub(crate) fn if_enough<T>(named: Result<T>) -> Result<Option<T>> {
    match named {
        Err(RecogniseError::TooLittle) => Ok(None),
        named => named.map(Some),
    }
}

impl From<RecogniseError> for Doubt {
    /// Why a scan has no name.
    fn from(error: RecogniseError) -> Self {
        match error {
            RecogniseError::TooLittle => Self::TooLittle,
            other => Self::NotNamed { why: other.to_string() },
        }
    }
}

/// Fails if a library has trials of fewer than two surfaces.
pub(super) fn check_surfaces<'a>(
    library: impl Iterator<Item = &'a TrialKey> + Clone,
) -> Result<()> {
    let surfaces = library.clone().map(|key| &key.surface).collect::<BTreeSet<_>>().len();
    if surfaces < 2 {
        return Err(RecogniseError::TooFewSurfaces { surfaces, trials: library.count() });
    }
    Ok(())
}

/// The error for a query that shares no source with a library.
pub(super) fn nothing_in_common<'a>(
    query: impl Iterator<Item = &'a SourceId>,
    library: impl Iterator<Item = &'a SourceId>,
) -> RecogniseError {
    RecogniseError::NothingInCommon { query: names(query), library: names(library) }
}

fn names<'a>(ids: impl Iterator<Item = &'a SourceId>) -> String {
    let ids: BTreeSet<_> = ids.map(SourceId::as_str).collect();
    if ids.is_empty() { "none".into() } else { ids.into_iter().collect::<Vec<_>>().join(", ") }
}
