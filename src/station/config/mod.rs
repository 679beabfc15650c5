//! The configuration of a station, in two steps: a file laid over the defaults, and the objects
//! that the program works with.

mod file;
mod lines;
mod only;
mod output_address;
mod resolve;

use file::DEFAULTS;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::device::camera::{FlashControl, Turn};
use crate::device::lines::{Count, LinesAddress, LinesStream};
use crate::device::microphone::Pick;
use crate::device::serial::{Selector, Wanted};
use crate::scan::Detection;
use crate::scene::{Scene, SceneError, SourceId};

pub(crate) use lines::fitting;
pub use output_address::{HttpAddress, MqttAddress, OutputsConfig, TlsFiles};
pub(crate) use output_address::{is_segment, machine_name};

impl StationConfig {
    /// The defaults.
    pub fn embedded() -> Self {
        // A test parses the embedded file.
        Self::parse(DEFAULTS, Path::new("configs/stylus.toml")).expect("the defaults parse")
    }

    /// Reads a file, and takes the defaults where it says nothing.
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

/// Errors of a configuration.
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
    /// an impossible description of a source
    #[error("{}: {error}", path.display())]
    Scene {
        /// which file
        path: PathBuf,
        /// what, and where
        error: Box<SceneError>,
    },
    /// an impossible value
    #[error("{}, line {line}: {problem}", path.display())]
    Value {
        /// which file
        path: PathBuf,
        /// line, counted from 1
        line: usize,
        /// the mistake, and the expected value
        problem: String,
    },
}

/// A station, as its configuration describes it.
#[derive(Clone, Debug, PartialEq)]
pub struct StationConfig {
    /// The library, if one is named.
    pub library: Option<PathBuf>,
    /// The address of the page, unless the command line names another one.
    pub serve: SocketAddr,
    /// The sources.
    pub scene: Scene,
    /// The stylus, if the station has one.
    pub stylus: Option<StylusConfig>,
    /// Sensors that print lines of numbers.
    pub lines: Vec<LinesConfig>,
    /// The microphone, if there is to be one.
    pub microphone: Option<MicrophoneConfig>,
    /// The camera, if the station has one.
    pub camera: Option<CameraConfig>,
    /// How scans are detected, and which sources are cut from which streams.
    pub detection: Detection,
    /// Sources of which a good trial must hold enough independent samples, by T*.
    pub by_t_star: Vec<SourceId>,
    /// Number of trials that `enroll` records of a surface.
    pub trials: u32,
    /// Space for past scans beside the library, in millions of bytes; 0 keeps none.
    pub keep_mb: u32,
    /// The programs that answers go to.
    pub outputs: OutputsConfig,
}

/// The stylus.
#[derive(Clone, Debug, PartialEq)]
pub struct StylusConfig {
    /// Its port.
    pub port: Selector,
    /// Its rate in Hz.
    pub rate_hz: u32,
    /// Its streams, which are sources.
    pub streams: Vec<Wanted>,
}

/// A sensor that prints lines of numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct LinesConfig {
    /// The place that its lines come from.
    pub address: LinesAddress,
    /// Its rate in Hz; measured where it is not given.
    pub rate_hz: Option<f64>,
    /// The column that counts, if there is one.
    pub count: Option<Count>,
    /// Its streams, which are sources.
    pub streams: Vec<LinesStream>,
}

/// The microphone, one stream.
#[derive(Clone, Debug, PartialEq)]
pub struct MicrophoneConfig {
    /// Its name.
    pub device: String,
    /// The channel to use.
    pub pick: Pick,
    /// The stream.
    pub stream: SourceId,
}

/// The camera, one stream or two.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraConfig {
    /// Its name.
    pub device: String,
    /// How it is turned.
    pub turn: Turn,
    /// Time between two pictures.
    pub every: Duration,
    /// The source of its pictures.
    pub source: SourceId,
    /// Pictures with flash, if there are any.
    pub flash: Option<FlashConfig>,
}

/// Pictures with flash.
#[derive(Clone, Debug, PartialEq)]
pub struct FlashConfig {
    /// The source of these pictures.
    pub source: SourceId,
    /// The camera's control that switches the light; without it, the stylus does.
    pub control: Option<FlashControl>,
    /// Time until pictures show a change of the light.
    pub settle: Duration,
}
