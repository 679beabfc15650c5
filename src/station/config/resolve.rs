//! From what a file and the defaults say to what the program works with.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use toml::Spanned;

use super::file::{
    CameraBlock, DetectionBlock, FeelName, FlashName, MicrophoneBlock, Said, StationFile,
    StylusBlock,
};
use super::{
    CameraConfig, ConfigError, DEFAULTS, FlashConfig, MicrophoneConfig, StationConfig, StylusConfig,
};
use crate::device::camera::{FlashControl, Turn};
use crate::device::microphone::Pick;
use crate::device::serial::Wanted;
use crate::scan::detect::{Feel, Limits};
use crate::scan::{CutFrom, Detection};
use crate::scene::config::{line_of, scene};
use crate::scene::{Phase, Scene, SourceId};

/// Name of the microphone's stream, from which several sources are cut.
const SOUND: &str = "sound";

/// Names of sources, with their places in the file.
type Names = Vec<Spanned<String>>;

/// A file beside the defaults, and how its mistakes are told.
struct Source<'a> {
    path: &'a Path,
    text: &'a str,
    scene: Scene,
}

/// What was said, or else the default, which the embedded file holds.
fn or<T: Clone>(said: &Option<T>, default: &Option<T>) -> T {
    // A test parses the embedded file, and with it every key that is asked for.
    said.clone().or_else(|| default.clone()).expect("the defaults are complete")
}

/// The value alone.
fn plain<T: Clone>(said: &Said<T>, default: &Said<T>) -> T {
    or(said, default).into_inner()
}

pub(super) fn resolve(text: &str, path: &Path) -> Result<StationConfig, ConfigError> {
    let toml = |error| ConfigError::Toml { path: path.to_path_buf(), error: Box::new(error) };
    let mut file: StationFile = toml::from_str(text).map_err(toml)?;
    let defaults: StationFile = toml::from_str(DEFAULTS).map_err(toml)?;
    let described = scene(String::new(), std::mem::take(&mut file.sources), text)
        .map_err(|error| ConfigError::Scene { path: path.to_path_buf(), error: Box::new(error) })?;
    let source = Source { path, text, scene: Scene::lmt108().with(described) };
    if *file.format.get_ref() != 1 {
        let problem = "this program reads format = 1; update surfaced";
        return source.fail(&file.format, problem);
    }
    let serve = or(&file.serve, &defaults.serve);
    let Ok(address) = serve.get_ref().parse::<SocketAddr>() else {
        let problem =
            format!("serve = \"{}\"; expected for example \"127.0.0.1:8108\"", serve.get_ref());
        return source.fail(&serve, problem);
    };
    let stylus = source.stylus(&file.stylus, &defaults.stylus)?;
    let microphone = source.microphone(&file.microphone, &defaults.microphone)?;
    let camera = source.camera(&file.camera, &defaults.camera)?;
    let cuts = source.cuts(&stylus, &microphone, &camera, &file)?;
    let detection =
        source.detection(&file.detection, &defaults.detection, stylus.as_ref(), cuts)?;
    let mut by_t_star = Vec::new();
    for id in or(&file.enroll.t_star, &defaults.enroll.t_star) {
        by_t_star.push(source.id(&id)?);
    }
    let below = |library: &std::path::PathBuf| match path.parent() {
        Some(folder) => folder.join(library),
        None => library.clone(),
    };
    Ok(StationConfig {
        library: file.library.as_ref().map(below),
        serve: address,
        scene: source.scene.clone(),
        stylus,
        microphone: microphone.map(|(microphone, _)| microphone),
        camera,
        detection,
        by_t_star,
        trials: source.positive("trials", &file.enroll.trials, &defaults.enroll.trials)?,
    })
}

/// A number that may be asked to be positive.
trait Positive: Clone + std::fmt::Display {
    fn is_positive(&self) -> bool;
}

impl Positive for u32 {
    fn is_positive(&self) -> bool {
        *self > 0
    }
}

impl Positive for u64 {
    fn is_positive(&self) -> bool {
        *self > 0
    }
}

impl Positive for f64 {
    fn is_positive(&self) -> bool {
        self.is_finite() && *self > 0.0
    }
}

impl Source<'_> {
    fn fail<T, S>(&self, at: &Spanned<S>, problem: impl Into<String>) -> Result<T, ConfigError> {
        let line = line_of(self.text, at.span().start);
        Err(ConfigError::Value { path: self.path.to_path_buf(), line, problem: problem.into() })
    }

    fn positive<T: Positive>(
        &self,
        key: &str,
        said: &Said<T>,
        default: &Said<T>,
    ) -> Result<T, ConfigError> {
        let value = or(said, default);
        match value.get_ref().is_positive() {
            true => Ok(value.into_inner()),
            false => {
                self.fail(&value, format!("{key} = {}; expected more than 0", value.get_ref()))
            }
        }
    }

    /// A source of the scene.
    fn id(&self, name: &Spanned<String>) -> Result<SourceId, ConfigError> {
        self.known(name.get_ref(), name)
    }

    fn known<S>(&self, name: &str, at: &Spanned<S>) -> Result<SourceId, ConfigError> {
        if let Some(spec) = self.scene.get(name) {
            return Ok(spec.id.clone());
        }
        let known: Vec<_> = self.scene.sources().map(|spec| spec.id.as_str()).collect();
        let problem = format!(
            "no source is called `{name}`; there are {}; describe others in [sources.{name}]",
            known.join(", ")
        );
        self.fail(at, problem)
    }

    fn stylus(
        &self,
        said: &StylusBlock,
        default: &StylusBlock,
    ) -> Result<Option<StylusConfig>, ConfigError> {
        let port = or(&said.port, &default.port);
        let selector = match port.get_ref().parse() {
            Ok(selector) => selector,
            Err(problem) => return self.fail(&port, format!("port: {problem}")),
        };
        let rate_hz = self.positive("rate_hz", &said.rate_hz, &default.rate_hz)?;
        let values = or(&said.values, &default.values);
        let sources = or(&said.sources, &default.sources);
        for (name, value) in said.values.iter().flatten() {
            if !sources.contains_key(name) {
                return self.fail(value, format!("`{name}` is no source of [stylus.sources]"));
            }
        }
        let mut streams = Vec::new();
        for (name, channels) in &sources {
            let id = self.known(name, channels)?;
            let (expected, found) =
                (self.scene.get(name).map_or(0, |spec| spec.channels), channels.get_ref().len());
            if found != expected {
                let problem = format!("{name}: {found} channel(s), but the source has {expected}");
                return self.fail(channels, problem);
            }
            let value = values.get(name).map(|value| *value.get_ref()).unwrap_or_default();
            streams.push(Wanted { id, channels: channels.get_ref().clone(), value });
        }
        let stylus = StylusConfig { port: selector, rate_hz, streams };
        Ok(or(&said.present, &default.present).then_some(stylus))
    }

    /// The microphone, and the sources that are cut from its stream.
    fn microphone(
        &self,
        said: &MicrophoneBlock,
        default: &MicrophoneBlock,
    ) -> Result<Option<(MicrophoneConfig, Names)>, ConfigError> {
        let pick = match &said.channel {
            None => Pick::Mean,
            Some(channel) => match channel.get_ref().checked_sub(1) {
                Some(index) => Pick::One(index),
                None => return self.fail(channel, "channel = 0; channels are counted from 1"),
            },
        };
        // Letters alone.
        let stream = SourceId::new(SOUND).expect("letters name a source");
        let device = or(&said.device, &default.device);
        let sources = or(&said.sources, &default.sources);
        let microphone = MicrophoneConfig { device, pick, stream };
        Ok(or(&said.present, &default.present).then_some((microphone, sources)))
    }

    fn camera(
        &self,
        said: &CameraBlock,
        default: &CameraBlock,
    ) -> Result<Option<CameraConfig>, ConfigError> {
        let degrees = or(&said.turn, &default.turn);
        let Some(turn) = Turn::from_degrees(*degrees.get_ref()) else {
            let problem = format!("turn = {}; expected 0, 90, 180 or 270", degrees.get_ref());
            return self.fail(&degrees, problem);
        };
        let every_ms = self.positive("every_ms", &said.every_ms, &default.every_ms)?;
        let torch = FlashControl::TORCH;
        let control = FlashControl {
            id: said.flash_control.unwrap_or(torch.id),
            on: said.flash_on.unwrap_or(torch.on),
            off: said.flash_off.unwrap_or(torch.off),
        };
        let name = or(&said.flash, &default.flash);
        let flash = match name {
            FlashName::None => None,
            FlashName::Stylus | FlashName::Camera => Some(FlashConfig {
                source: self.id(&or(&said.flash_source, &default.flash_source))?,
                control: (name == FlashName::Camera).then_some(control),
                settle: Duration::from_millis(plain(
                    &said.flash_settle_ms,
                    &default.flash_settle_ms,
                )),
            }),
        };
        let camera = CameraConfig {
            device: or(&said.device, &default.device),
            turn,
            every: Duration::from_millis(every_ms),
            source: self.id(&or(&said.source, &default.source))?,
            flash,
        };
        Ok(or(&said.present, &default.present).then_some(camera))
    }

    /// What is cut from which stream.
    fn cuts(
        &self,
        stylus: &Option<StylusConfig>,
        microphone: &Option<(MicrophoneConfig, Vec<Spanned<String>>)>,
        camera: &Option<CameraConfig>,
        file: &StationFile,
    ) -> Result<Vec<CutFrom>, ConfigError> {
        let mut cuts: Vec<CutFrom> = Vec::new();
        let mut add = |source: &SourceId, stream: &SourceId| {
            let spec = self.scene.get(source.as_str());
            let (phase, channels) = spec.map_or((Phase::Drag, 1), |s| (s.phase, s.channels));
            cuts.push(CutFrom { source: source.clone(), stream: stream.clone(), phase, channels });
        };
        for stream in stylus.iter().flat_map(|stylus| &stylus.streams) {
            add(&stream.id, &stream.id);
        }
        if let Some((microphone, sources)) = microphone {
            for name in sources {
                add(&self.id(name)?, &microphone.stream);
            }
        }
        if let Some(camera) = camera {
            add(&camera.source, &camera.source);
            camera.flash.iter().for_each(|flash| add(&flash.source, &flash.source));
        }
        let mut seen = BTreeSet::new();
        match cuts.iter().find(|cut| !seen.insert(cut.source.clone())) {
            Some(twice) => {
                self.fail(&file.format, format!("two devices make the source {}", twice.source))
            }
            None => Ok(cuts),
        }
    }

    fn detection(
        &self,
        said: &DetectionBlock,
        default: &DetectionBlock,
        stylus: Option<&StylusConfig>,
        cuts: Vec<CutFrom>,
    ) -> Result<Detection, ConfigError> {
        // The stylus leads where there is one, so its group comes first.
        let (mut of_stylus, mut others) = (Vec::new(), Vec::<(SourceId, Feel)>::new());
        for (name, feel) in &or(&said.listen, &default.listen) {
            let Some(cut) = cuts.iter().find(|cut| cut.source.as_str() == name) else {
                // Of a device that this station has not.
                self.known(name, feel)?;
                continue;
            };
            if cut.phase == Phase::Still {
                return self.fail(feel, format!("{name} is a picture, which nobody listens to"));
            }
            let feel = match feel.get_ref() {
                FeelName::Force => Feel::Force,
                FeelName::Vibration => Feel::Vibration,
            };
            let in_stylus = stylus.is_some_and(|s| s.streams.iter().any(|w| w.id == cut.stream));
            let group = if in_stylus { &mut of_stylus } else { &mut others };
            if !group.iter().any(|(stream, _)| *stream == cut.stream) {
                group.push((cut.stream.clone(), feel));
            }
        }
        let groups: Vec<_> =
            [of_stylus, others].into_iter().filter(|group| !group.is_empty()).collect();
        let limits = Limits {
            onset: self.positive("onset", &said.onset, &default.onset)?,
            quiet: self.positive("quiet", &said.quiet, &default.quiet)?,
            tap_hold_s: self.positive("tap_hold_s", &said.tap_hold_s, &default.tap_hold_s)?,
            longest_tap_s: self.positive(
                "longest_tap_s",
                &said.longest_tap_s,
                &default.longest_tap_s,
            )?,
            longest_pause_s: self.positive(
                "longest_pause_s",
                &said.longest_pause_s,
                &default.longest_pause_s,
            )?,
            drag_hold_s: self.positive("drag_hold_s", &said.drag_hold_s, &default.drag_hold_s)?,
            longest_drag_s: self.positive(
                "longest_drag_s",
                &said.longest_drag_s,
                &default.longest_drag_s,
            )?,
        };
        if limits.quiet > limits.onset {
            let problem =
                format!("quiet = {}; expected at most onset = {}", limits.quiet, limits.onset);
            return self.fail(&or(&said.quiet, &default.quiet), problem);
        }
        Ok(Detection { limits, groups, cuts })
    }
}
