//! Checks that trials can be compared with their scene and with each other.

use std::collections::BTreeSet;

use super::error::RecogniseError;
use crate::scene::{Domain, SourceId, SourceSpec};
use crate::trial::{Signal, TrialKey};

/// Checks that a signal is an image or a series, and has as many channels, as `spec` says.
///
/// # Errors
/// If it does not match.
pub fn check_signal(
    spec: &SourceSpec,
    signal: &Signal,
    key: &TrialKey,
) -> Result<(), RecogniseError> {
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

/// Checks that a library has at least two surfaces.
///
/// # Errors
/// If its trials are of fewer than two surfaces.
pub fn check_surfaces<'a>(
    library: impl Iterator<Item = &'a TrialKey> + Clone,
) -> Result<(), RecogniseError> {
    let surfaces = library.clone().map(|key| &key.surface).collect::<BTreeSet<_>>().len();
    if surfaces < 2 {
        return Err(RecogniseError::TooFewSurfaces { surfaces, trials: library.count() });
    }
    Ok(())
}

/// The error of a query that shares no source with a library.
pub fn nothing_in_common<'a>(
    query: impl Iterator<Item = &'a SourceId>,
    library: impl Iterator<Item = &'a SourceId>,
) -> RecogniseError {
    RecogniseError::NothingInCommon { query: names(query), library: names(library) }
}

fn names<'a>(ids: impl Iterator<Item = &'a SourceId>) -> String {
    let ids: BTreeSet<_> = ids.map(SourceId::as_str).collect();
    if ids.is_empty() { "none".into() } else { ids.into_iter().collect::<Vec<_>>().join(", ") }
}
