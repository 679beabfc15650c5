//! Why scans cannot be kept, read or corrected.

use std::path::{Path, PathBuf};

/// Why scans cannot be kept, read or corrected.
#[derive(Debug, thiserror::Error)]
pub enum HistoryError {
    /// the file system said no
    #[error("{}: {error}", path.display())]
    Io {
        /// the file or folder
        path: PathBuf,
        /// what the file system said
        error: std::io::Error,
    },
    /// another program keeps its scans there
    #[error("{}: another surfaced keeps its scans here", .0.display())]
    InUse(PathBuf),
    /// no such scan
    #[error("there is no scan {0}")]
    NoScan(String),
    /// a scan whose signals have made room for newer ones
    #[error("the signals of scan {0} are no longer kept")]
    NoSignals(String),
    /// the trial of a scan cannot be read or written
    #[error(transparent)]
    Library(#[from] crate::library::LibraryError),
}

impl HistoryError {
    pub(super) fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_path_buf();
        |error| Self::Io { path, error }
    }
}
