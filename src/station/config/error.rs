//! Why a configuration cannot be used.

use std::path::PathBuf;

use crate::scene::SceneError;

/// Why a configuration cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// the file cannot be read
    #[error("{}: {error}", path.display())]
    Io {
        /// which file
        path: PathBuf,
        /// what the system said
        error: std::io::Error,
    },
    /// not TOML, an unknown key, a wrong type
    #[error("{}: {error}", path.display())]
    Toml {
        /// which file
        path: PathBuf,
        /// what, and where
        error: Box<toml::de::Error>,
    },
    /// a description of a source that cannot be
    #[error("{}: {error}", path.display())]
    Scene {
        /// which file
        path: PathBuf,
        /// what, and where
        error: Box<SceneError>,
    },
    /// a value that cannot be
    #[error("{}, line {line}: {problem}", path.display())]
    Value {
        /// which file
        path: PathBuf,
        /// line, counted from 1
        line: usize,
        /// what is wrong, and what was expected
        problem: String,
    },
}
