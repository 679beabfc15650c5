//! The sources of a trial that a scene describes, checked against it.

use std::collections::BTreeMap;

use rayon::prelude::*;

use crate::scene::{Domain, Scene, SourceId, SourceSpec};
use crate::trial::{Signal, Trial, TrialKey};

/// A source of a trial is not what the scene says.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    #[error("{source_name}: {found} channel(s) in {trial}, but the scene says {expected}")]
    Channels { source_name: SourceId, found: usize, expected: usize, trial: String },
    #[error("{source_name}: {trial} holds {found}, but the scene says {expected}")]
    Kind { source_name: SourceId, trial: String, found: &'static str, expected: &'static str },
}

/// Applies `make`, in parallel, to each source of a trial that the scene describes.
///
/// # Errors
/// If a source has another kind or another number of channels than the scene says.
pub(crate) fn of_known_sources<T: Send>(
    key: &TrialKey,
    trial: &Trial,
    scene: &Scene,
    make: impl Fn(&SourceSpec, &Signal) -> T + Sync,
) -> Result<BTreeMap<SourceId, T>, SourceError> {
    let known: Vec<(&SourceSpec, &Signal)> = (trial.signals.iter())
        .filter_map(|(id, signal)| Some((scene.get(id.as_str())?, signal)))
        .collect();
    let make = |(spec, signal): (&SourceSpec, &Signal)| {
        check_signal(spec, signal, key)?;
        Ok((spec.id.clone(), make(spec, signal)))
    };
    known.into_par_iter().map(make).collect()
}

fn check_signal(spec: &SourceSpec, signal: &Signal, key: &TrialKey) -> Result<(), SourceError> {
    // A live scan has no name.
    let trial = if key.surface.is_empty() { "the scan".into() } else { key.to_string() };
    let kind = |found, expected| SourceError::Kind {
        source_name: spec.id.clone(),
        trial: trial.clone(),
        found,
        expected,
    };
    match (signal, spec.domain == Domain::Image) {
        (Signal::Image(_), false) => Err(kind("an image", "a series")),
        (Signal::Series(_), true) => Err(kind("a series", "an image")),
        (Signal::Series(series), false) if series.channels() != spec.channels => {
            Err(SourceError::Channels {
                source_name: spec.id.clone(),
                found: series.channels(),
                expected: spec.channels,
                trial,
            })
        }
        _ => Ok(()),
    }
}
