//! Turns a file laid over the defaults into the objects that the program works with.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::ops::Range;
use std::path::Path;
use std::time::Duration;

use toml::Spanned;

use super::file::{
    CameraBlock, DEFAULTS, DetectionBlock, FlashName, MicrophoneBlock, SensorKindName, StationFile,
    StylusBlock, is_default, merged,
};
use super::{
    CameraConfig, ConfigError, FlashConfig, MicrophoneConfig, StationConfig, StylusConfig,
};
use crate::device::camera::{FlashControl, Turn};
use crate::device::microphone::Pick;
use crate::device::serial::Wanted;
use crate::scan::detect::{DetectorConfig, SensorKind};
use crate::scan::{CutFrom, Detection};
use crate::scene::config::{line_of, scene};
use crate::scene::{Phase, Scene, SourceId};

/// Name of the microphone's stream, from which several sources are cut.
const SOUND: &str = "sound";

/// A mistake in a value, and its place in the file.
struct Mistake {
    at: Range<usize>,
    problem: String,
}

fn mistake<T, S>(at: &Spanned<S>, problem: impl Into<String>) -> Result<T, Mistake> {
    Err(Mistake { at: at.span(), problem: problem.into() })
}

pub(super) fn resolve(text: &str, path: &Path) -> Result<StationConfig, ConfigError> {
    let toml = |error| ConfigError::Toml { path: path.to_path_buf(), error: Box::new(error) };
    let mut file: StationFile = merged(text, DEFAULTS).map_err(toml)?;
    let defaults = Scene::lmt108();
    let described = scene(String::new(), std::mem::take(&mut file.sources), text, Some(&defaults))
        .map_err(|error| ConfigError::Scene { path: path.to_path_buf(), error: Box::new(error) })?;
    station(file, defaults.with(described), path).map_err(|Mistake { at, problem }| {
        let line = line_of(text, at.start);
        ConfigError::Value { path: path.to_path_buf(), line, problem }
    })
}

fn station(file: StationFile, scene: Scene, path: &Path) -> Result<StationConfig, Mistake> {
    if *file.format.get_ref() != 1 {
        return mistake(&file.format, "this program reads format = 1; update surfaced");
    }
    let Ok(serve) = file.serve.get_ref().parse::<SocketAddr>() else {
        let problem = format!(
            "serve = \"{}\"; expected for example \"127.0.0.1:8080\"",
            file.serve.get_ref()
        );
        return mistake(&file.serve, problem);
    };
    let sound = file.microphone.sources.clone();
    let stylus = stylus(file.stylus, &scene)?;
    let microphone = microphone(file.microphone)?;
    let camera = camera(file.camera, &scene)?;
    let cuts = StreamCuts { scene: &scene, cuts: Vec::new() }
        .stylus(stylus.as_ref())
        .microphone(microphone.as_ref(), &sound)?
        .camera(camera.as_ref())
        .checked(&file.format)?;
    let detection = detection(&file.detection, stylus.as_ref(), cuts, &scene)?;
    let by_t_star = file
        .enroll
        .t_star
        .iter()
        .map(|name| known(name.get_ref(), name, &scene))
        .collect::<Result<_, _>>()?;
    let library = file.library.map(|library| match path.parent() {
        Some(folder) => folder.join(library),
        None => library,
    });
    let trials = positive("trials", &file.enroll.trials)?;
    Ok(StationConfig {
        library,
        serve,
        scene,
        stylus,
        microphone,
        camera,
        detection,
        by_t_star,
        trials,
        keep_mb: file.history.keep_mb,
        http: output("http", file.outputs.http.as_ref())?,
        mqtt: output("mqtt", file.outputs.mqtt.as_ref())?,
    })
}

/// An address of `[outputs]`.
fn output<A: std::str::FromStr<Err = String>>(
    key: &str,
    value: Option<&Spanned<String>>,
) -> Result<Option<A>, Mistake> {
    let Some(value) = value else { return Ok(None) };
    match value.get_ref().parse() {
        Ok(address) => Ok(Some(address)),
        Err(problem) => mistake(value, format!("{key}: {problem}")),
    }
}

/// A finite number above 0.
fn positive<T>(key: &str, value: &Spanned<T>) -> Result<T, Mistake>
where
    T: Copy + Default + PartialOrd + std::fmt::Display + std::ops::Mul<Output = T>,
{
    let number = *value.get_ref();
    // Infinity times 0 is not a number.
    let finite = number * T::default() == T::default();
    match number > T::default() && finite {
        true => Ok(number),
        false => mistake(value, format!("{key} = {number}; expected more than 0")),
    }
}

/// The source of the scene called `name`; `at` is where that name stands in the file.
fn known<S>(name: &str, at: &Spanned<S>, scene: &Scene) -> Result<SourceId, Mistake> {
    if let Some(spec) = scene.get(name) {
        return Ok(spec.id.clone());
    }
    let known: Vec<_> = scene.sources().map(|spec| spec.id.as_str()).collect();
    let problem = format!(
        "no source is called `{name}`; there are {}; describe others in [sources.{name}]",
        known.join(", ")
    );
    mistake(at, problem)
}

fn stylus(block: StylusBlock, scene: &Scene) -> Result<Option<StylusConfig>, Mistake> {
    let StylusBlock { present, port: name, rate_hz, sources, values } = block;
    let port = match name.get_ref().parse() {
        Ok(port) => port,
        Err(problem) => return mistake(&name, format!("port: {problem}")),
    };
    let rate_hz = positive("rate_hz", &rate_hz)?;
    let stray = values.iter().find(|(name, v)| !is_default(v) && !sources.contains_key(*name));
    if let Some((name, value)) = stray {
        return mistake(value, format!("`{name}` is no source of [stylus.sources]"));
    }
    let mut streams = Vec::new();
    for (name, channels) in sources {
        let id = known(&name, &channels, scene)?;
        let (expected, found) =
            (scene.get(&name).map_or(0, |spec| spec.channels), channels.get_ref().len());
        if found != expected {
            let problem = format!("{name}: channels: {found}, but the source has {expected}");
            return mistake(&channels, problem);
        }
        let value = values.get(&name).map(|value| *value.get_ref()).unwrap_or_default();
        streams.push(Wanted { id, channels: channels.into_inner(), value });
    }
    Ok(present.then_some(StylusConfig { port, rate_hz, streams }))
}

fn microphone(block: MicrophoneBlock) -> Result<Option<MicrophoneConfig>, Mistake> {
    let MicrophoneBlock { present, device, channel, .. } = block;
    let pick = match channel {
        None => Pick::Mean,
        Some(channel) => match channel.get_ref().checked_sub(1) {
            Some(index) => Pick::One(index),
            None => return mistake(&channel, "channel = 0; channels are counted from 1"),
        },
    };
    // The name has letters only.
    let stream = SourceId::new(SOUND).expect("letters name a source");
    Ok(present.then_some(MicrophoneConfig { device, pick, stream }))
}

fn camera(block: CameraBlock, scene: &Scene) -> Result<Option<CameraConfig>, Mistake> {
    let Some(turn) = Turn::from_degrees(*block.turn.get_ref()) else {
        let problem = format!("turn = {}; expected 0, 90, 180 or 270", block.turn.get_ref());
        return mistake(&block.turn, problem);
    };
    let every_ms = positive("every_ms", &block.every_ms)?;
    let torch = FlashControl::TORCH;
    let control = FlashControl {
        id: block.flash_control.unwrap_or(torch.id),
        on: block.flash_on.unwrap_or(torch.on),
        off: block.flash_off.unwrap_or(torch.off),
    };
    let flash = match block.flash {
        FlashName::None => None,
        FlashName::Stylus | FlashName::Camera => Some(FlashConfig {
            source: known(block.flash_source.get_ref(), &block.flash_source, scene)?,
            control: (block.flash == FlashName::Camera).then_some(control),
            settle: Duration::from_millis(*block.flash_settle_ms.get_ref()),
        }),
    };
    let camera = CameraConfig {
        device: block.device,
        turn,
        every: Duration::from_millis(every_ms),
        source: known(block.source.get_ref(), &block.source, scene)?,
        flash,
    };
    Ok(block.present.then_some(camera))
}

/// Collects the sources that are cut from each stream.
struct StreamCuts<'a> {
    scene: &'a Scene,
    cuts: Vec<CutFrom>,
}

impl StreamCuts<'_> {
    fn add(&mut self, source: &SourceId, stream: &SourceId) {
        let spec = self.scene.get(source.as_str());
        let (phase, channels) = spec.map_or((Phase::Drag, 1), |spec| (spec.phase, spec.channels));
        let (source, stream) = (source.clone(), stream.clone());
        self.cuts.push(CutFrom { source, stream, phase, channels });
    }

    fn stylus(mut self, stylus: Option<&StylusConfig>) -> Self {
        for stream in stylus.into_iter().flat_map(|stylus| &stylus.streams) {
            self.add(&stream.id, &stream.id);
        }
        self
    }

    fn microphone(
        mut self,
        microphone: Option<&MicrophoneConfig>,
        sources: &[Spanned<String>],
    ) -> Result<Self, Mistake> {
        if let Some(microphone) = microphone {
            for name in sources {
                let source = known(name.get_ref(), name, self.scene)?;
                self.add(&source, &microphone.stream);
            }
        }
        Ok(self)
    }

    fn camera(mut self, camera: Option<&CameraConfig>) -> Self {
        if let Some(camera) = camera {
            self.add(&camera.source, &camera.source);
            camera.flash.iter().for_each(|flash| self.add(&flash.source, &flash.source));
        }
        self
    }

    /// The cuts, if each source occurs once; an error points at the line of `file`.
    fn checked<S>(self, file: &Spanned<S>) -> Result<Vec<CutFrom>, Mistake> {
        let mut seen = BTreeSet::new();
        match self.cuts.iter().find(|cut| !seen.insert(cut.source.clone())) {
            Some(twice) => mistake(file, format!("two devices make the source {}", twice.source)),
            None => Ok(self.cuts),
        }
    }
}

fn detection(
    block: &DetectionBlock,
    stylus: Option<&StylusConfig>,
    cuts: Vec<CutFrom>,
    scene: &Scene,
) -> Result<Detection, Mistake> {
    // The stylus decides about contact where there is one, so its group comes first.
    let (mut of_stylus, mut others) = (Vec::new(), Vec::<(SourceId, SensorKind)>::new());
    for (name, kind) in &block.listen {
        let Some(cut) = cuts.iter().find(|cut| cut.source.as_str() == name) else {
            // A source of a device that this station does not have.
            known(name, kind, scene)?;
            continue;
        };
        if cut.phase == Phase::Still {
            return mistake(kind, format!("{name} is a picture, which shows no contact"));
        }
        let kind = match kind.get_ref() {
            SensorKindName::Force => SensorKind::Force,
            SensorKindName::Vibration => SensorKind::Vibration,
        };
        let in_stylus = stylus.is_some_and(|s| s.streams.iter().any(|w| w.id == cut.stream));
        let group = if in_stylus { &mut of_stylus } else { &mut others };
        if !group.iter().any(|(stream, _)| *stream == cut.stream) {
            group.push((cut.stream.clone(), kind));
        }
    }
    let groups = [of_stylus, others].into_iter().filter(|group| !group.is_empty()).collect();
    let detector = DetectorConfig {
        onset: positive("onset", &block.onset)?,
        quiet: positive("quiet", &block.quiet)?,
        tap_hold_s: positive("tap_hold_s", &block.tap_hold_s)?,
        longest_tap_s: positive("longest_tap_s", &block.longest_tap_s)?,
        longest_pause_s: positive("longest_pause_s", &block.longest_pause_s)?,
        drag_hold_s: positive("drag_hold_s", &block.drag_hold_s)?,
        longest_drag_s: positive("longest_drag_s", &block.longest_drag_s)?,
    };
    if detector.quiet > detector.onset {
        let at = if is_default(&block.quiet) { &block.onset } else { &block.quiet };
        let problem =
            format!("quiet = {}; expected at most onset = {}", detector.quiet, detector.onset);
        return mistake(at, problem);
    }
    Ok(Detection { detector, groups, cuts })
}
