//! The configuration of a station, in two steps: a file laid over the defaults, and what the
//! program works with.

mod error;
mod file;
mod merge;
mod only;
mod output_address;
mod resolve;
mod resolved;

use std::path::Path;

pub use error::ConfigError;
pub use output_address::{HttpAddress, MqttAddress};
pub use resolved::{CameraConfig, FlashConfig, MicrophoneConfig, StationConfig, StylusConfig};

use merge::DEFAULTS;

impl StationConfig {
    /// The defaults.
    pub fn embedded() -> Self {
        // A test parses the embedded file.
        Self::parse(DEFAULTS, Path::new("configs/stylus.toml")).expect("the defaults parse")
    }

    /// What a file says, and the defaults where it says nothing.
    ///
    /// # Errors
    /// With the line, if the file cannot be read, is not TOML, has an unknown key, or a value that
    /// is impossible.
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path)
            .map_err(|error| ConfigError::Io { path: path.to_path_buf(), error })?;
        Self::parse(&text, path)
    }

    /// The same for the text of a file, which lies (or would lie) at `path`.
    ///
    /// # Errors
    /// As [`StationConfig::read`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, ConfigError> {
        resolve::resolve(text, path)
    }
}

#[cfg(test)]
mod tests;
