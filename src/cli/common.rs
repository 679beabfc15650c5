//! Parts shared by commands: their results, the opening of data, and the parsing of values.

use std::path::Path;

use super::{bad_files, show};
use crate::library::Library;
use crate::record::edit::LibraryLock;
use crate::scene::{Scene, SourceId};

/// Why a command did not do all of its work.
#[derive(Debug)]
pub(super) enum Failure {
    /// Exit code 1.
    Failed(String),
    /// Exit code 2.
    Usage(String),
    /// Exit code 3: done, but something in use was lost or damaged.
    Damaged(String),
}

impl Failure {
    /// The reason.
    pub fn text(self) -> String {
        let (Self::Failed(text) | Self::Usage(text) | Self::Damaged(text)) = self;
        text
    }
}

/// An error during work is a failure with exit code 1.
impl<E: std::error::Error> From<E> for Failure {
    fn from(error: E) -> Self {
        Self::Failed(error.to_string())
    }
}

/// The result of a command.
pub(super) type Done = Result<(), Failure>;

/// The sources that a comparison uses.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct SourceArgs {
    /// Sources to compare, with commas between them (default: all that the data have)
    #[arg(long, value_delimiter = ',', value_name = "ID,…", value_parser = SourceId::new)]
    pub(super) sources: Vec<SourceId>,
}

impl SourceArgs {
    /// The scene with only the sources that were named.
    pub(super) fn narrow(&self, scene: Scene) -> Result<Scene, Failure> {
        if self.sources.is_empty() {
            return Ok(scene);
        }
        scene.only(&self.sources).map_err(|error| Failure::Usage(error.to_string()))
    }
}

/// Locks out edits of a library (at `path`, or that of the trial at `path`) until the command ends.
pub(super) fn hold(path: &Path) {
    let path = path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
    // A trial lies two folders below its library.
    for folder in path.ancestors().take(3).filter(|folder| folder.is_dir()) {
        std::mem::forget(LibraryLock::for_reading(folder));
    }
}

/// Opens recordings of any form, locks out edits of them, and says on stderr which are found.
pub(super) fn open(path: &Path) -> Result<Library, Failure> {
    hold(path);
    open_held(path)
}

/// The same, where the caller locks out edits.
pub(super) fn open_held(path: &Path) -> Result<Library, Failure> {
    let library = bad_files::open(path, &Scene::lmt108())?;
    show::library(&library);
    Ok(library)
}

/// Longest drag in seconds: an hour.
const LONGEST_S: f64 = 3600.0;

/// Parses a positive number of seconds.
pub fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(x) if x > 0.0 && x <= LONGEST_S => Ok(x),
        _ => Err(format!("expected a positive number of seconds, at most {LONGEST_S}")),
    }
}

/// Parses a fraction.
pub fn share(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(x) if x > 0.0 && x < 1.0 => Ok(x),
        _ => Err("expected a fraction above 0 and below 1, such as 0.01".into()),
    }
}
