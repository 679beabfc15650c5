//! Turns a merged file into the objects that the program works with.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use http::Uri;
use toml::Spanned;

use super::file::{
    AlertBlock, CameraBlock, DEFAULTS, DetectionBlock, FlashName, MicrophoneBlock, Mistake,
    OutputsBlock, ScanBlock, ScanMode, StationFile, StylusBlock, is_default, known, merged,
    mistake, no_stray, parsed, positive, source_of,
};
use super::output_address::{STRAY_PASSWORD_FILE, is_segment, machine_name, without_passwords};
use super::{
    AlertCause, AlertConfig, CameraConfig, CoilAddress, ConfigError, DevicePart, FlashConfig,
    HttpAddress, MicrophoneConfig, MqttAddress, OutputsConfig, StationConfig, StylusConfig,
    TlsFiles, lines,
};
use crate::device::camera::Turn;
use crate::device::microphone::Pick;
use crate::device::serial::Wanted;
use crate::scan::detect::{DetectorConfig, SensorKind};
use crate::scan::{CutFrom, Detection};
use crate::scene::config::{line_of, scene};
use crate::scene::{Phase, Scene, SourceId};
use crate::station::Continuous;

/// Name of the microphone's stream. Several sources are cut from it.
const SOUND: &str = "sound";
/// The most answers that a rule for alerts watches, and its longest time in seconds (a day).
const MOST_WATCHED: usize = 1000;
const MOST_S: f64 = 86_400.0;

impl StationConfig {
    /// Parses the text of a configuration; `path` is where the file is, or would be.
    ///
    /// # Errors
    /// Those of [`StationConfig::read`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, ConfigError> {
        let toml = |mut error: toml::de::Error| {
            error.set_input(Some(&without_passwords(text)));
            ConfigError(format!("{}: {error}", path.display()))
        };
        let mut file: StationFile = merged(text, DEFAULTS).map_err(toml)?;
        lines::describe(&mut file);
        let (sources, defaults) = (std::mem::take(&mut file.sources), Scene::lmt108());
        let described = scene(String::new(), sources, text, &defaults)
            .map_err(|error| ConfigError(format!("{}: {error}", path.display())))?;
        station(file, defaults.with(described), path).map_err(|Mistake { at, problem }| {
            let line = line_of(text, at.start);
            ConfigError(format!("{}, line {line}: {problem}", path.display()))
        })
    }
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
    no_twins(&file)?;
    let sound = file.microphone.sources.clone();
    let stylus = stylus(file.stylus, &scene)?;
    let lines = file.lines.iter().map(|block| lines::lines(block, &scene));
    let lines = lines.collect::<Result<Vec<_>, _>>()?;
    lines::no_shared_port(&file.lines, &lines)?;
    let microphone = microphone(file.microphone)?;
    let camera = camera(file.camera, &scene)?;
    let of_lines = lines.iter().flat_map(|lines| lines.streams.iter().map(|stream| &stream.id));
    let own = stylus.iter().flat_map(|stylus| stylus.streams.iter().map(|stream| &stream.id));
    let mut cuts: Vec<_> = own.chain(of_lines).map(|id| cut(id, id, &scene)).collect();
    if let Some(microphone) = &microphone {
        for name in &sound {
            cuts.push(cut(&known(name.get_ref(), name, &scene)?, &microphone.stream, &scene));
        }
    }
    if let Some(camera) = &camera {
        let sources = [&camera.source].into_iter().chain(camera.flash.as_ref().map(|f| &f.source));
        cuts.extend(sources.map(|id| cut(id, id, &scene)));
    }
    let sliding = sliding(&file.scan)?;
    let detector = detector(&file.detection)?;
    let by_t_star = file.enroll.t_star.iter().map(|name| known(name.get_ref(), name, &scene));
    let by_t_star = by_t_star.collect::<Result<_, _>>()?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let library = file.library.map(|library| folder.join(library));
    let trials = positive("trials", &file.enroll.trials)?;
    let mut config = StationConfig {
        library,
        serve,
        scene,
        stylus,
        lines,
        microphone,
        camera,
        is_continuous: file.scan.mode == ScanMode::Continuous,
        sliding,
        detection: Detection { detector, groups: Vec::new(), cuts },
        by_t_star,
        trials,
        stale_after_s: positive("stale_after_s", &file.page.stale_after_s)?,
        public_address: file.page.public_address.as_ref().map(public_address).transpose()?,
        keep_mb: file.history.keep_mb,
        outputs: outputs(file.outputs, file.alert, folder)?,
    };
    config.detection.groups = groups(&file.detection.listen, &config)?;
    Ok(config)
}

/// Refuses two devices that make the same source. Sensors of lines come last, since only they have no
/// defaults, so that the mistake has a place in the file.
fn no_twins(file: &StationFile) -> Result<(), Mistake> {
    let StationFile { stylus, microphone, camera, lines, .. } = file;
    let of_stylus = stylus.sources.iter().filter(|_| stylus.present);
    let sound = microphone.sources.iter().filter(|_| microphone.present);
    let flash = Some(&camera.flash_source).filter(|_| camera.flash != FlashName::None);
    let pictures = [&camera.source].into_iter().chain(flash).filter(|_| camera.present);
    let named = sound.chain(pictures).map(|name| (name.get_ref(), name.span()));
    let of_stylus = of_stylus.map(|(name, channels)| (name, channels.span()));
    let of_lines = lines.iter().flat_map(|lines| &lines.sources);
    let of_lines = of_lines.map(|(name, columns)| (name, columns.span()));
    let mut all = of_stylus.chain(named).chain(of_lines);
    let mut seen = BTreeSet::new();
    match all.find(|(name, _)| !seen.insert(*name)) {
        Some((name, at)) => {
            let problem = format!("two devices make the source {name}; leave one of them out");
            Err(Mistake { at, problem })
        }
        None => Ok(()),
    }
}

fn public_address(text: &Spanned<String>) -> Result<Uri, Mistake> {
    parsed::<HttpAddress>("public_address", text)?;
    let uri = text.get_ref().parse();
    uri.or_else(|error: http::uri::InvalidUri| mistake(text, format!("public_address: {error}")))
}

/// Resolves the outputs. Paths of certificates, header and password are relative to the configuration's folder.
fn outputs(
    block: OutputsBlock,
    rules: Vec<AlertBlock>,
    folder: &Path,
) -> Result<OutputsConfig, Mistake> {
    let OutputsBlock { http, header_file, mqtt, password_file, station, ca, certificate, key } =
        block;
    let name = match &station {
        Some(name) if is_segment(name.get_ref()) => name.get_ref().clone(),
        Some(name) => {
            let problem = "station: use 1 to 64 letters, digits, `-` and `_`, such as \"press-3\"";
            return mistake(name, problem);
        }
        None => machine_name(),
    };
    let file = |path: &Spanned<PathBuf>| folder.join(path.get_ref());
    let mqtt = mqtt.as_ref().map(|mqtt| parsed::<MqttAddress>("mqtt", mqtt));
    let mut address = mqtt.transpose()?;
    if let Some(path) = &password_file
        && !address.as_mut().is_some_and(|address| address.set_password_file(file(path)))
    {
        return mistake(path, format!("password_file: {STRAY_PASSWORD_FILE}"));
    }
    let client = match (&certificate, &key) {
        (Some(certificate), Some(key)) => Some((file(certificate), file(key))),
        (None, None) => None,
        (Some(alone), None) | (None, Some(alone)) => {
            return mistake(alone, "`certificate` and `key` belong together; give both");
        }
    };
    let mut http = posted(http.as_ref(), header_file.as_ref(), file)?;
    let mut alerts: Vec<AlertConfig> = Vec::new();
    for rule in rules {
        if alerts.iter().any(|alert| alert.name == *rule.name.get_ref()) {
            return mistake(&rule.name, "name: another [[alert]] has it");
        }
        alerts.push(alert(rule, address.is_some(), file)?);
    }
    let files = TlsFiles { ca: ca.as_ref().map(file), client };
    let of_alerts = alerts.iter_mut().filter_map(|alert| alert.http.as_mut());
    let of_http = http.iter_mut().chain(of_alerts).filter_map(|http| http.tls.as_mut());
    let of_mqtt = address.as_mut().and_then(|mqtt| mqtt.tls.as_mut());
    let with_tls: Vec<_> = of_http.chain(of_mqtt).collect();
    if let (true, Some(stray)) = (with_tls.is_empty(), ca.as_ref().or(key.as_ref())) {
        let problem =
            "certificates are for TLS; begin `mqtt` with mqtts:// or `http` with https://";
        return mistake(stray, problem);
    }
    with_tls.into_iter().for_each(|tls| *tls = files.clone());
    Ok(OutputsConfig { station: name, http, mqtt: address, alerts })
}

/// Resolves an address to post to, with the file of its header.
fn posted(
    http: Option<&Spanned<String>>,
    header_file: Option<&Spanned<PathBuf>>,
    file: impl Fn(&Spanned<PathBuf>) -> PathBuf,
) -> Result<Option<HttpAddress>, Mistake> {
    match (http, header_file) {
        (Some(http), path) => {
            let address = parsed::<HttpAddress>("http", http)?;
            Ok(Some(HttpAddress { header_file: path.map(file), ..address }))
        }
        (None, Some(stray)) => mistake(stray, "header_file: it goes with `http`; give both"),
        (None, None) => Ok(None),
    }
}

/// Resolves a rule for alerts, which go to the broker if there is one (`to_broker`).
fn alert(
    block: AlertBlock,
    to_broker: bool,
    file: impl Fn(&Spanned<PathBuf>) -> PathBuf,
) -> Result<AlertConfig, Mistake> {
    let AlertBlock { name, state, surface, on, http, header_file, modbus, .. } = &block;
    if !is_segment(name.get_ref()) {
        return mistake(name, "name: use 1 to 64 letters, digits, `-` and `_`, such as \"reject\"");
    }
    let on = match (state, surface, on) {
        (Some(state), None, None) => AlertCause::State(*state.get_ref()),
        (None, Some(surface), None) => AlertCause::Surface(surface.get_ref().clone()),
        (None, None, Some(_)) => AlertCause::Drift,
        _ => {
            let problem =
                "give one of `state`, such as \"unknown\", `surface`, and `on = \"drift\"`";
            return mistake(name, problem);
        }
    };
    if let (AlertCause::Drift, Some(stray)) = (&on, block.scans.as_ref().or(block.of.as_ref())) {
        let problem = "`scans` and `of` count answers, and a drift is found by many scans anyway; \
                       leave them out";
        return mistake(stray, problem);
    }
    let count = |value: &Option<Spanned<usize>>| value.as_ref().map(|value| *value.get_ref());
    let scans = count(&block.scans).unwrap_or(1);
    let of = count(&block.of).unwrap_or(scans);
    if !(1..=of).contains(&scans) || of > MOST_WATCHED {
        let at = block.scans.as_ref().or(block.of.as_ref()).map_or(name.span(), Spanned::span);
        let problem = format!(
            "scans = {scans}, of = {of}; expected `scans` of at least 1, and `of` from there to \
             {MOST_WATCHED}"
        );
        return Err(Mistake { at, problem });
    }
    let seconds = |key: &str, value: &Option<Spanned<f64>>, usual: f64| match value {
        Some(at) if !(0.0..=MOST_S).contains(at.get_ref()) => {
            mistake(at, format!("{key} = {}; expected 0 to {MOST_S}", at.get_ref()))
        }
        _ => Ok(Duration::from_secs_f64(value.as_ref().map_or(usual, |at| *at.get_ref()))),
    };
    let http = posted(http.as_ref(), header_file.as_ref(), file)?;
    let coil = modbus.as_ref().map(|coil| parsed::<CoilAddress>("modbus", coil)).transpose()?;
    if let (None, Some(stray)) = (&coil, &block.hold_s) {
        return mistake(stray, "hold_s: it goes with `modbus`; give both");
    }
    if http.is_none() && coil.is_none() && !to_broker {
        let problem = "nobody would hear of it; add `http` or `modbus`, or `mqtt` to [outputs]";
        return mistake(name, problem);
    }
    Ok(AlertConfig {
        name: name.get_ref().clone(),
        on,
        scans,
        of,
        cooldown: seconds("cooldown_s", &block.cooldown_s, 60.0)?,
        http,
        coil,
        hold: seconds("hold_s", &block.hold_s, 2.0)?,
    })
}

fn stylus(block: StylusBlock, scene: &Scene) -> Result<Option<StylusConfig>, Mistake> {
    let StylusBlock { present, port, rate_hz, sources, values } = block;
    let port = parsed("port", &port)?;
    let rate_hz = positive("rate_hz", &rate_hz)?;
    no_stray(&values, &sources, "[stylus.sources]")?;
    if !present {
        return Ok(None);
    }
    let mut streams = Vec::new();
    for (name, channels) in sources {
        let id = source_of(&name, "channels", &channels, scene)?;
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
    // The name consists of letters only, so it is a valid id.
    let stream = SourceId::new(SOUND).expect("letters name a source");
    Ok(present.then_some(MicrophoneConfig { device, pick, stream }))
}

fn camera(block: CameraBlock, scene: &Scene) -> Result<Option<CameraConfig>, Mistake> {
    let Some(turn) = Turn::from_degrees(*block.turn.get_ref()) else {
        let problem = format!("turn = {}; expected 0, 90, 180 or 270", block.turn.get_ref());
        return mistake(&block.turn, problem);
    };
    let every_ms = positive("every_ms", &block.every_ms)?;
    let flash = match block.flash {
        FlashName::None => None,
        FlashName::Stylus | FlashName::Camera => Some(FlashConfig {
            source: known(block.flash_source.get_ref(), &block.flash_source, scene)?,
            by_camera: block.flash == FlashName::Camera,
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

fn cut(source: &SourceId, stream: &SourceId, scene: &Scene) -> CutFrom {
    let spec = scene.get(source.as_str());
    let (phase, channels) = spec.map_or((Phase::Drag, 1), |spec| (spec.phase, spec.channels));
    CutFrom { source: source.clone(), stream: stream.clone(), phase, channels }
}

/// The streams that show contact, in groups: stylus, then each sensor of lines, then microphone.
fn groups(
    listen: &BTreeMap<String, Spanned<SensorKind>>,
    config: &StationConfig,
) -> Result<Vec<Vec<(SourceId, SensorKind)>>, Mistake> {
    let mut groups = BTreeMap::<DevicePart, Vec<(SourceId, SensorKind)>>::new();
    for (name, kind) in listen {
        let cut = config.detection.cuts.iter().find(|cut| cut.source.as_str() == name);
        let Some((cut, part)) = cut.and_then(|cut| Some((cut, config.part_of(&cut.stream)?)))
        else {
            // The source belongs to a device that this station does not have, so it cannot show contact.
            known(name, kind, &config.scene)?;
            continue;
        };
        if cut.phase == Phase::Still {
            return mistake(kind, format!("{name} is a picture, which shows no contact"));
        }
        let group = groups.entry(part).or_default();
        if !group.iter().any(|(stream, _)| *stream == cut.stream) {
            group.push((cut.stream.clone(), *kind.get_ref()));
        }
    }
    // If the file names no source of a sensor as a sign of contact, any vibration of the sensor is one.
    for (number, lines) in config.lines.iter().enumerate() {
        let all = lines.streams.iter().map(|stream| (stream.id.clone(), SensorKind::Vibration));
        groups.entry(DevicePart::Lines(number)).or_insert_with(|| all.collect());
    }
    Ok(groups.into_values().collect())
}

fn sliding(block: &ScanBlock) -> Result<Continuous, Mistake> {
    let hop_s = positive("hop_s", &block.hop_s)?;
    let expected_stay_s = positive("expected_stay_s", &block.expected_stay_s)?;
    if expected_stay_s <= hop_s {
        let own = [&block.expected_stay_s, &block.hop_s];
        let at = own.into_iter().find(|value| !is_default(*value)).unwrap_or(&block.hop_s);
        let problem =
            format!("expected_stay_s = {expected_stay_s}; expected more than hop_s = {hop_s}");
        return mistake(at, problem);
    }
    Ok(Continuous { hop_s, expected_stay_s })
}

fn detector(block: &DetectionBlock) -> Result<DetectorConfig, Mistake> {
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
    Ok(detector)
}
