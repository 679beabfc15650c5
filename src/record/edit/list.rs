//! The trials of a library, as edits know them.

use std::path::Path;

use serde::Serialize;

use super::folders::{REMOVED, name_of, trials};
use crate::library::{About, Entry, LibraryError};
use crate::scene::{Scene, SourceId};
use crate::trial::TrialKey;

/// A trial as it is listed.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ListedTrial {
    /// What edits call it: `SURFACE/TRIAL`; where it has no folder of its own, which edits need, its
    /// surface and number.
    pub trial: String,
    /// Its label, user and number.
    #[serde(flatten)]
    pub key: TrialKey,
    /// When it was recorded, as its `trial.toml` says.
    pub started_at: Option<String>,
    /// Its sources.
    pub sources: Vec<SourceId>,
    /// Duration of the longest, in seconds.
    pub seconds: f64,
}

/// The trials of a library that can be read, sorted.
///
/// # Errors
/// If they cannot be read.
pub fn list(library: &Path, scene: &Scene) -> Result<Vec<ListedTrial>, LibraryError> {
    Ok(listed(library, &trials(library, scene)?))
}

/// The trials that were removed from a library and can come back, likewise.
///
/// # Errors
/// If they cannot be read.
pub fn list_removed(library: &Path, scene: &Scene) -> Result<Vec<ListedTrial>, LibraryError> {
    let bin = library.join(REMOVED);
    Ok(listed(&bin, &trials(&bin, scene)?))
}

fn listed(root: &Path, entries: &[Entry]) -> Vec<ListedTrial> {
    let one = |entry: &Entry| {
        let folder = entry.folder();
        // What cannot be read of it is left out here, and found by `surfaced check`.
        let seconds = entry.outlines().unwrap_or_default();
        let seconds = seconds.values().map(|of| of.frames as f64 / of.rate_hz);
        let started_at = |folder| About::read(folder).ok()?.started_at;
        ListedTrial {
            trial: name_of(root, entry),
            key: entry.key.clone(),
            started_at: folder.and_then(started_at),
            sources: entry.sources.clone(),
            seconds: seconds.fold(0.0, f64::max),
        }
    };
    entries.iter().map(one).collect()
}
