//! The configuration of a station, in two steps: a file merged with the defaults, then the objects
//! that the program works with.

mod file;
mod lines;
mod output_address;
mod resolve;

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use http::Uri;

use crate::device::camera::Turn;
pub use crate::device::lines::LinesConfig;
use crate::device::microphone::Pick;
pub use crate::device::serial::StylusConfig;
use crate::scan::Detection;
use crate::scene::{Scene, SourceId};
use crate::station::Continuous;

use file::DEFAULTS;

#[doc(hidden)]
pub use lines::fitting;
pub use output_address::{
    AlertCause, AlertConfig, CoilAddress, HttpAddress, MqttAddress, OutputsConfig, Password,
    TlsFiles,
};
#[doc(hidden)]
pub use output_address::{STRAY_PASSWORD_FILE, is_segment, machine_name, percent_decoded};

/// A mistake in a configuration. The text names the file, the line if known, and what was expected.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct ConfigError(String);

#[derive(Clone, Debug, PartialEq)]
pub struct StationConfig {
    pub library: Option<PathBuf>,
    /// The address of the page. The command line may override it.
    pub serve: SocketAddr,
    pub scene: Scene,
    pub stylus: Option<StylusConfig>,
    pub lines: Vec<LinesConfig>,
    pub microphone: Option<MicrophoneConfig>,
    pub camera: Option<CameraConfig>,
    /// Whether surfaces are named without begin and end; the command line may say so, too.
    pub is_continuous: bool,
    pub sliding: Continuous,
    pub detection: Detection,
    /// A good trial must hold enough independent samples of each of these sources, judged by T*.
    pub by_t_star: Vec<SourceId>,
    pub trials: u32,
    /// Age from which the page no longer shows an answer as the present one, in seconds.
    pub stale_after_s: f64,
    /// Address of the page for a browser, if a proxy is in front of it.
    pub public_address: Option<Uri>,
    /// Disk space for past scans, in millions of bytes; with 0, no scans are kept.
    pub keep_mb: u32,
    pub outputs: OutputsConfig,
}

#[derive(Clone, Debug, PartialEq)]
pub struct MicrophoneConfig {
    pub device: String,
    pub pick: Pick,
    pub stream: SourceId,
}

#[derive(Clone, Debug, PartialEq)]
pub struct CameraConfig {
    pub device: String,
    pub turn: Turn,
    pub every: Duration,
    pub source: SourceId,
    pub flash: Option<FlashConfig>,
}

#[derive(Clone, Debug, PartialEq)]
pub struct FlashConfig {
    pub source: SourceId,
    /// Whether the camera switches its own light; otherwise the stylus switches the light.
    pub by_camera: bool,
    /// Time from switching the light until pictures show the change.
    pub settle: Duration,
}

#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum DevicePart {
    Stylus,
    Lines(usize),
    Microphone,
    Camera,
    Flash,
}

impl StationConfig {
    pub fn embedded() -> Self {
        // A test parses the embedded file, so this cannot fail.
        Self::parse(DEFAULTS, Path::new("configs/stylus.toml")).expect("the defaults parse")
    }

    /// Reads a file, and uses the defaults for missing keys.
    ///
    /// # Errors
    /// If the file cannot be read, is not TOML, has an unknown key, or has an impossible value;
    /// the error states the line if it is known.
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path)
            .map_err(|error| ConfigError(format!("{}: {error}", path.display())))?;
        Self::parse(&text, path)
    }

    /// How surfaces are named without begin and end, if they are.
    pub fn continuous(&self) -> Option<Continuous> {
        self.is_continuous.then_some(self.sliding)
    }

    /// Reduces this station to the devices and cuts that scans of `sources` need. Scans are
    /// detected by a device that shows contact. If no kept device does, one is added (the stylus
    /// first, then lines, then the microphone).
    pub fn only(mut self, sources: &[SourceId]) -> Self {
        self.detection.cuts.retain(|cut| sources.contains(&cut.source));
        let cuts = &self.detection.cuts;
        let mut parts: BTreeSet<DevicePart> =
            cuts.iter().filter_map(|cut| self.part_of(&cut.stream)).collect();
        if parts.contains(&DevicePart::Flash) {
            parts.insert(DevicePart::Camera);
            // If the camera cannot switch the light, the stylus does, so the stylus is kept, too.
            let flash = self.camera.as_ref().and_then(|camera| camera.flash.as_ref());
            if flash.is_some_and(|flash| !flash.by_camera) && self.stylus.is_some() {
                parts.insert(DevicePart::Stylus);
            }
        }
        let groups = self.detection.groups.iter().flatten();
        let contact: BTreeSet<DevicePart> =
            groups.filter_map(|(stream, _)| self.part_of(stream)).collect();
        if parts.is_disjoint(&contact) {
            // The first part in the order stylus, lines, microphone is added.
            parts.extend(contact.first());
        }
        let mut groups = std::mem::take(&mut self.detection.groups);
        let kept = |stream: &SourceId| self.part_of(stream).is_some_and(|p| parts.contains(&p));
        groups.retain(|group| group.iter().all(|(stream, _)| kept(stream)));
        self.detection.groups = groups;
        self.stylus = self.stylus.filter(|_| parts.contains(&DevicePart::Stylus));
        let mut number = 0..;
        self.lines.retain(|_| number.next().is_some_and(|n| parts.contains(&DevicePart::Lines(n))));
        self.microphone = self.microphone.filter(|_| parts.contains(&DevicePart::Microphone));
        self.camera = self.camera.filter(|_| parts.contains(&DevicePart::Camera));
        if let Some(camera) = &mut self.camera {
            camera.flash = camera.flash.take().filter(|_| parts.contains(&DevicePart::Flash));
        }
        self.by_t_star.retain(|source| sources.contains(source));
        self
    }

    fn part_of(&self, stream: &SourceId) -> Option<DevicePart> {
        let stylus = self.stylus.iter().flat_map(|of| &of.streams).any(|of| of.id == *stream);
        let lines = self.lines.iter().position(|of| of.streams.iter().any(|s| s.id == *stream));
        let sound = self.microphone.iter().any(|of| of.stream == *stream);
        let camera = self.camera.iter().any(|of| of.source == *stream);
        let flash = self.camera.iter().flat_map(|of| &of.flash).any(|of| of.source == *stream);
        match lines {
            Some(number) => Some(DevicePart::Lines(number)),
            None if stylus => Some(DevicePart::Stylus),
            None if sound => Some(DevicePart::Microphone),
            None if camera => Some(DevicePart::Camera),
            None => flash.then_some(DevicePart::Flash),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::serial::Value;
    use crate::scan::detect::SensorKind;
    use crate::scene::Phase;

    #[test]
    fn the_embedded_file_describes_a_whole_station() {
        let config = StationConfig::embedded();
        let stylus = config.stylus.unwrap();
        let of_stylus: Vec<_> =
            stylus.streams.iter().map(|s| (s.id.as_str(), s.channels.len(), s.value)).collect();
        let full = |id, channels| (id, channels, Value::FullScale);
        let expected = [full("ac", 3), full("fr", 2), full("ir", 1), ("me", 1, Value::Unit)];
        assert_eq!((stylus.rate_hz, &of_stylus[..]), (10_000, &expected[..]));
        let sources: Vec<_> = config.detection.cuts.iter().map(|cut| cut.source.as_str()).collect();
        assert_eq!(sources, ["ac", "fr", "ir", "me", "mi1", "mi2", "ca1", "ca2"]);
        let tap = config.detection.cuts.iter().find(|cut| cut.source.as_str() == "mi1").unwrap();
        assert_eq!((tap.stream.as_str(), tap.phase), ("sound", Phase::Tap));
        let groups: Vec<Vec<_>> = (config.detection.groups.iter())
            .map(|group| group.iter().map(|(id, feel)| (id.as_str(), *feel)).collect())
            .collect();
        let stylus = vec![("ac", SensorKind::Vibration), ("fr", SensorKind::Force)];
        assert_eq!(groups, [stylus, vec![("sound", SensorKind::Vibration)]]);
    }
}
