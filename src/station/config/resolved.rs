//! A configuration as the program works with it.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use super::output_address::{HttpAddress, MqttAddress};
use crate::device::camera::{FlashControl, Turn};
use crate::device::microphone::Pick;
use crate::device::serial::{Selector, Wanted};
use crate::scan::Detection;
use crate::scene::{Scene, SourceId};

/// A station, as its configuration describes it.
#[derive(Clone, Debug, PartialEq)]
pub struct StationConfig {
    /// The library, if one is named.
    pub library: Option<PathBuf>,
    /// Where the page is served, unless the command line names another address.
    pub serve: SocketAddr,
    /// What the sources are.
    pub scene: Scene,
    /// The stylus, if there is to be one.
    pub stylus: Option<StylusConfig>,
    /// The microphone, if there is to be one.
    pub microphone: Option<MicrophoneConfig>,
    /// The camera, if there is to be one.
    pub camera: Option<CameraConfig>,
    /// How scans are found, and what is cut.
    pub detection: Detection,
    /// Sources of which a good trial holds enough independent samples.
    pub by_t_star: Vec<SourceId>,
    /// Trials that `enroll` takes of a surface.
    pub trials: u32,
    /// Space for past scans beside the library, in millions of bytes; 0 keeps none.
    pub keep_mb: u32,
    /// Where answers are posted, if anywhere.
    pub http: Option<HttpAddress>,
    /// Where answers are published by MQTT, if anywhere.
    pub mqtt: Option<MqttAddress>,
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

/// The microphone, one stream.
#[derive(Clone, Debug, PartialEq)]
pub struct MicrophoneConfig {
    /// Its name.
    pub device: String,
    /// Which of its channels.
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
    /// Their source.
    pub source: SourceId,
    /// The camera's control that switches the light; without it, the stylus does.
    pub control: Option<FlashControl>,
    /// Time until pictures show a change.
    pub settle: Duration,
}
