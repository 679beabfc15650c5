//! Converts trials to MCAP (<https://mcap.dev/spec>), which the field's tools open, and back.
//!
//! A file holds everything twice. Its messages are for tools to draw; compressed, they take about
//! as much room as the recording. Its attachments are the recording's own files, byte for byte,
//! from which an import restores it exactly.

mod attached;
mod export;
mod import;
mod messages;

pub use export::export;
pub use import::import;

use std::path::Path;

use crate::dataset;
use crate::library::{Library, LibraryError, recording};
use crate::scene::Scene;

/// Opens a recording to be exported: a library of any layout, or a single trial of a library in the
/// recording format.
///
/// # Errors
/// If it is neither, or cannot be read.
pub fn open(recording: &Path, scene: &Scene) -> Result<Library, LibraryError> {
    match attached::is_trial(recording)? {
        true => recording::open_trial(recording, scene),
        false => dataset::open(recording, scene),
    }
}
