//! Trials as MCAP (<https://mcap.dev/spec>), which the field's tools open, and back.
//!
//! A file holds everything twice: as messages, for tools to draw, compressed and so made that they
//! take about as much as the recording; and as attachments, the recording's own files byte for byte,
//! from which it comes back exactly.

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

/// Opens what is to be exported: a library of any form, or a single trial of one in the recording
/// format.
///
/// # Errors
/// If it is neither.
pub fn open(recording: &Path, scene: &Scene) -> Result<Library, LibraryError> {
    match attached::is_trial(recording)? {
        true => recording::open_trial(recording, scene),
        false => dataset::open(recording, scene),
    }
}
