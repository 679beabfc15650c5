//! Why a scene cannot be used.

/// Why a description of sources cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// not TOML, an unknown key, a missing one, a wrong type
    #[error("{0}")]
    Toml(#[from] toml::de::Error),
    /// a format of the future
    #[error("line {line}: format = {found}, but this program reads format 1; update surfaced")]
    Format {
        /// line, counted from 1
        line: usize,
        /// what the file says
        found: u32,
    },
    /// a source that cannot be
    #[error("line {line}: source `{source_name}`: {problem}")]
    Source {
        /// line of the source's table, counted from 1
        line: usize,
        /// its name
        source_name: String,
        /// what is wrong, and what was expected
        problem: String,
    },
    /// a name that cannot name a file
    #[error("`{0}` cannot name a source; use letters, digits, `_` and `-`")]
    SourceName(String),
    /// a source that the scene does not have
    #[error("no source is called `{name}`; there are: {known}")]
    UnknownSource {
        /// what was named
        name: String,
        /// what there is
        known: String,
    },
}
