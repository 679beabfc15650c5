//! Why trials cannot be compared, and the checks for this.

use std::collections::{BTreeMap, BTreeSet};

use rayon::prelude::*;

use crate::library::LibraryError;
use crate::scene::{Domain, Scene, SourceId, SourceSpec};
use crate::trial::{Doubt, Signal, Trial, TrialKey};

/// Why a trial cannot be named.
#[derive(Debug, thiserror::Error)]
pub enum RecogniseError {
    #[error(transparent)]
    Library(#[from] LibraryError),
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
    #[error("{source_name}: {found} channel(s) in {trial}, but the scene says {expected}")]
    Channels { source_name: SourceId, found: usize, expected: usize, trial: String },
    #[error("{source_name}: {trial} holds {found}, but the scene says {expected}")]
    Kind { source_name: SourceId, trial: String, found: &'static str, expected: &'static str },
}

/// `None` for a query that says too little to be named.
pub(crate) fn if_enough<T>(named: Result<T, RecogniseError>) -> Result<Option<T>, RecogniseError> {
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

/// Applies `make`, in parallel, to each source of a trial that the scene describes.
///
/// # Errors
/// If a source has another kind or another number of channels than the scene says.
pub(super) fn of_known_sources<T: Send>(
    key: &TrialKey,
    trial: &Trial,
    scene: &Scene,
    make: impl Fn(&SourceSpec, &Signal) -> T + Sync,
) -> Result<BTreeMap<SourceId, T>, RecogniseError> {
    let known: Vec<(&SourceSpec, &Signal)> = (trial.signals.iter())
        .filter_map(|(id, signal)| Some((scene.get(id.as_str())?, signal)))
        .collect();
    let make = |(spec, signal): (&SourceSpec, &Signal)| {
        check_signal(spec, signal, key)?;
        Ok((spec.id.clone(), make(spec, signal)))
    };
    known.into_par_iter().map(make).collect()
}

fn check_signal(spec: &SourceSpec, signal: &Signal, key: &TrialKey) -> Result<(), RecogniseError> {
    let kind = |found, expected| RecogniseError::Kind {
        source_name: spec.id.clone(),
        trial: key.to_string(),
        found,
        expected,
    };
    match (signal, spec.domain == Domain::Image) {
        (Signal::Image(_), false) => Err(kind("an image", "a series")),
        (Signal::Series(_), true) => Err(kind("a series", "an image")),
        (Signal::Series(series), false) if series.channels() != spec.channels => {
            Err(RecogniseError::Channels {
                source_name: spec.id.clone(),
                found: series.channels(),
                expected: spec.channels,
                trial: key.to_string(),
            })
        }
        _ => Ok(()),
    }
}

/// Fails if a library has trials of fewer than two surfaces.
pub(super) fn check_surfaces<'a>(
    library: impl Iterator<Item = &'a TrialKey> + Clone,
) -> Result<(), RecogniseError> {
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
