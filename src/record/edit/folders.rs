//! Where trials lie that are edited, and where those that were removed.

use std::path::Path;

use crate::library::{Entry, LibraryError, recording};
use crate::scene::Scene;

/// The folder of what was removed.
pub(super) const REMOVED: &str = ".removed";

/// What a trial is called in edits: its folder within the library, `SURFACE/TRIAL`.
pub fn trial_name(library: &Path, folder: &Path) -> String {
    let within = folder.strip_prefix(library).unwrap_or(folder);
    let parts = within.components().map(|part| part.as_os_str().to_string_lossy().into_owned());
    parts.collect::<Vec<_>>().join("/")
}

/// The same of any trial; its surface and number, where it has no folder of its own.
pub(super) fn name_of(library: &Path, entry: &Entry) -> String {
    let loose = || format!("{}/{}", entry.key.surface, entry.key.number);
    entry.folder().map_or_else(loose, |folder| trial_name(library, folder))
}

/// The trials that can be read; none, where there is no such folder or it holds none.
pub(super) fn trials(folder: &Path, scene: &Scene) -> Result<Vec<Entry>, LibraryError> {
    if !folder.exists() {
        return Ok(Vec::new());
    }
    match recording::open_usable(folder, scene) {
        Ok(opened) => Ok(opened.library.entries),
        Err(LibraryError::NothingFound { .. }) => Ok(Vec::new()),
        Err(error) => Err(error),
    }
}
