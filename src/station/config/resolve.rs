//! Turns a file laid over the defaults into the objects that the program works with.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::Duration;

use toml::Spanned;

use super::file::{
    CameraBlock, DEFAULTS, DetectionBlock, FlashName, MicrophoneBlock, OutputsBlock,
    SensorKindName, StationFile, StylusBlock, is_default, merged,
};
use super::output_address::{is_segment, machine_name};
use super::{
    CameraConfig, ConfigError, FlashConfig, LinesConfig, MicrophoneConfig, MqttAddress,
    OutputsConfig, StationConfig, StylusConfig, TlsFiles, lines,
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
pub(super) struct Mistake {
    at: Range<usize>,
    problem: String,
}

pub(super) fn mistake<T, S>(at: &Spanned<S>, problem: impl Into<String>) -> Result<T, Mistake> {
    Err(Mistake { at: at.span(), problem: problem.into() })
}

pub(super) fn resolve(text: &str, path: &Path) -> Result<StationConfig, ConfigError> {
    let toml = |error| ConfigError::Toml { path: path.to_path_buf(), error: Box::new(error) };
    let mut file: StationFile = merged(text, DEFAULTS).map_err(toml)?;
    lines::describe(&mut file);
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
    let lines = file.lines.iter().map(|block| lines::lines(block, &scene));
    let lines = lines.collect::<Result<Vec<_>, _>>()?;
    let microphone = microphone(file.microphone)?;
    let camera = camera(file.camera, &scene)?;
    let cuts = StreamCuts { scene: &scene, cuts: Vec::new() }
        .stylus(stylus.as_ref())
        .lines(&lines)
        .microphone(microphone.as_ref(), &sound)?
        .camera(camera.as_ref())
        .checked(&file.format)?;
    let detection = detection(&file.detection, (stylus.as_ref(), &lines), cuts, &scene)?;
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
        lines,
        microphone,
        camera,
        detection,
        by_t_star,
        trials,
        keep_mb: file.history.keep_mb,
        outputs: outputs(file.outputs, path)?,
    })
}

/// The outputs; files of certificates are found from the configuration's own folder.
fn outputs(block: OutputsBlock, path: &Path) -> Result<OutputsConfig, Mistake> {
    let OutputsBlock { http, mqtt, station, ca, certificate, key } = block;
    let name = match &station {
        Some(name) if is_segment(name.get_ref()) => name.get_ref().clone(),
        Some(name) => {
            let problem = "station: use 1 to 64 letters, digits, `-` and `_`, such as \"press-3\"";
            return mistake(name, problem);
        }
        None => machine_name(),
    };
    let file =
        |path_in: &Spanned<PathBuf>| path.parent().unwrap_or(Path::new("")).join(path_in.get_ref());
    let mut address: Option<MqttAddress> = output("mqtt", mqtt.as_ref())?;
    let client = match (&certificate, &key) {
        (Some(certificate), Some(key)) => Some((file(certificate), file(key))),
        (None, None) => None,
        (Some(alone), None) | (None, Some(alone)) => {
            return mistake(alone, "`certificate` and `key` belong together; give both");
        }
    };
    match (address.as_mut().and_then(|address| address.tls.as_mut()), ca.as_ref().or(key.as_ref()))
    {
        (Some(tls), _) => *tls = TlsFiles { ca: ca.as_ref().map(file), client },
        (None, Some(stray)) => {
            return mistake(
                stray,
                "certificates are for a broker with TLS; begin `mqtt` with mqtts://",
            );
        }
        (None, None) => {}
    }
    Ok(OutputsConfig { station: name, http: output("http", http.as_ref())?, mqtt: address })
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
pub(super) fn positive<T>(key: &str, value: &Spanned<T>) -> Result<T, Mistake>
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

/// The source of the scene called `name`, which stands at `at`.
pub(super) fn known<S>(name: &str, at: &Spanned<S>, scene: &Scene) -> Result<SourceId, Mistake> {
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
    if !present {
        return Ok(None);
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
    Ok(Some(StylusConfig { port, rate_hz, streams }))
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

    fn lines(mut self, lines: &[LinesConfig]) -> Self {
        for stream in lines.iter().flat_map(|lines| &lines.streams) {
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
    (stylus, lines): (Option<&StylusConfig>, &[LinesConfig]),
    cuts: Vec<CutFrom>,
    scene: &Scene,
) -> Result<Detection, Mistake> {
    // The stylus leads where there is one, so its group comes first; then lines, each by themselves.
    let (mut of_stylus, mut others) = (Vec::new(), Vec::<(SourceId, SensorKind)>::new());
    let mut of_lines = vec![Vec::new(); lines.len()];
    let in_lines = |id: &SourceId| lines.iter().position(|l| l.streams.iter().any(|s| s.id == *id));
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
        let group = match in_lines(&cut.stream) {
            Some(number) => &mut of_lines[number],
            None if in_stylus => &mut of_stylus,
            None => &mut others,
        };
        if !group.iter().any(|(stream, _)| *stream == cut.stream) {
            group.push((cut.stream.clone(), kind));
        }
    }
    // Whatever moves shows contact, where nothing is said of a sensor.
    for (group, lines) in of_lines.iter_mut().zip(lines).filter(|(group, _)| group.is_empty()) {
        group.extend(lines.streams.iter().map(|s| (s.id.clone(), SensorKind::Vibration)));
    }
    let groups = [vec![of_stylus], of_lines, vec![others]].into_iter().flatten();
    let groups = groups.filter(|group| !group.is_empty()).collect();
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
