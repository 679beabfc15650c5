//! The configuration file of a station, as it is written, merged with the defaults; and checks of its
//! values, with a message for each mistake.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::PathBuf;

use serde::Deserialize;
use serde::de::DeserializeOwned;
use toml::Spanned;
use toml::de::{DeTable, DeValue, Deserializer, Error};

use crate::device::lines::Column;
use crate::device::serial::Value;
use crate::scan::detect::SensorKind;
use crate::scene::config::SourceBlock;
use crate::scene::{Scene, SourceId};
use crate::station::AnswerState;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct StationFile {
    pub format: Spanned<u32>,
    pub library: Option<PathBuf>,
    pub serve: Spanned<String>,
    pub stylus: StylusBlock,
    pub microphone: MicrophoneBlock,
    pub camera: CameraBlock,
    pub scan: ScanBlock,
    pub detection: DetectionBlock,
    #[serde(default)]
    pub lines: Vec<LinesBlock>,
    pub enroll: EnrollBlock,
    pub page: PageBlock,
    pub history: HistoryBlock,
    #[serde(default)]
    pub outputs: OutputsBlock,
    #[serde(default)]
    pub alert: Vec<AlertBlock>,
    #[serde(default)]
    pub sources: BTreeMap<String, Spanned<SourceBlock>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct StylusBlock {
    pub present: bool,
    pub port: Spanned<String>,
    pub rate_hz: Spanned<u32>,
    pub sources: BTreeMap<String, Spanned<Vec<String>>>,
    pub values: BTreeMap<String, Spanned<Value>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct LinesBlock {
    pub port: Spanned<String>,
    pub rate_hz: Option<Spanned<f64>>,
    pub counter: Option<Spanned<Column>>,
    pub time_us: Option<Spanned<Column>>,
    pub decimal: Option<Spanned<String>>,
    #[serde(default)]
    pub sources: BTreeMap<String, Spanned<Vec<Column>>>,
    #[serde(default)]
    pub scale: BTreeMap<String, Spanned<f64>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct MicrophoneBlock {
    pub present: bool,
    pub device: String,
    pub channel: Option<Spanned<usize>>,
    pub sources: Vec<Spanned<String>>,
}

#[derive(Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum FlashName {
    Stylus,
    Camera,
    None,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CameraBlock {
    pub present: bool,
    pub device: String,
    pub turn: Spanned<u32>,
    pub every_ms: Spanned<u64>,
    pub source: Spanned<String>,
    pub flash: FlashName,
    pub flash_source: Spanned<String>,
    pub flash_settle_ms: Spanned<u64>,
}

#[derive(Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum ScanMode {
    Drag,
    Continuous,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ScanBlock {
    pub mode: ScanMode,
    pub hop_s: Spanned<f64>,
    pub expected_stay_s: Spanned<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct DetectionBlock {
    pub listen: BTreeMap<String, Spanned<SensorKind>>,
    pub onset: Spanned<f64>,
    pub quiet: Spanned<f64>,
    pub tap_hold_s: Spanned<f64>,
    pub longest_tap_s: Spanned<f64>,
    pub longest_pause_s: Spanned<f64>,
    pub drag_hold_s: Spanned<f64>,
    pub longest_drag_s: Spanned<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct EnrollBlock {
    pub t_star: Vec<Spanned<String>>,
    pub trials: Spanned<u32>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct PageBlock {
    pub stale_after_s: Spanned<f64>,
    pub public_address: Option<Spanned<String>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct HistoryBlock {
    pub keep_mb: u32,
}

#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct OutputsBlock {
    pub http: Option<Spanned<String>>,
    pub header_file: Option<Spanned<PathBuf>>,
    pub mqtt: Option<Spanned<String>>,
    pub password_file: Option<Spanned<PathBuf>>,
    pub station: Option<Spanned<String>>,
    pub ca: Option<Spanned<PathBuf>>,
    pub certificate: Option<Spanned<PathBuf>>,
    pub key: Option<Spanned<PathBuf>>,
}

/// The only value of `on`.
#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Drifts {
    Drift,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct AlertBlock {
    pub name: Spanned<String>,
    pub state: Option<Spanned<AnswerState>>,
    pub surface: Option<Spanned<String>>,
    pub on: Option<Spanned<Drifts>>,
    pub scans: Option<Spanned<usize>>,
    pub of: Option<Spanned<usize>>,
    pub cooldown_s: Option<Spanned<f64>>,
    pub http: Option<Spanned<String>>,
    pub header_file: Option<Spanned<PathBuf>>,
    pub modbus: Option<Spanned<String>>,
    pub hold_s: Option<Spanned<f64>>,
}

/// A link to `configs`, so that the package holds the file; Git without links writes a path instead.
pub(super) const DEFAULTS: &str = include_str!("stylus.toml");
const _: () = assert!(DEFAULTS.len() > 99, "stylus.toml is a link: check out with core.symlinks");

/// The span of default values, since they have no place in the file.
const NOWHERE: Range<usize> = 0..0;

/// Parses `text`, and fills in missing keys from `defaults`. Tables at the top level (such as
/// `[stylus]`) are merged key by key; any other value replaces its default as a whole. `format` has
/// no default. Spans refer to `text`.
///
/// # Errors
/// If `text` is not TOML, or does not have the form of `T`.
pub(super) fn merged<T: DeserializeOwned>(text: &str, defaults: &str) -> Result<T, Error> {
    let mut all = DeTable::parse(defaults)?.into_inner();
    all.remove("format");
    all = without_spans(all);
    let file = DeTable::parse(text)?;
    let span = file.span();
    for (name, mut value) in file.into_inner() {
        let default = all.remove_entry(&name).map(|(_, default)| default.into_inner());
        if let (DeValue::Table(own), Some(DeValue::Table(mut table))) = (value.get_mut(), default) {
            for (key, value) in std::mem::take(own) {
                table.remove(&key);
                table.insert(key, value);
            }
            *own = table;
        }
        all.insert(name, value);
    }
    T::deserialize(Deserializer::from(Spanned::new(span, all))).map_err(|mut error| {
        error.set_input(Some(text));
        error
    })
}

pub(super) fn is_default<T>(value: &Spanned<T>) -> bool {
    value.span() == NOWHERE
}

fn without_spans(table: DeTable<'_>) -> DeTable<'_> {
    let entries = table.into_iter();
    entries.map(|(key, value)| (Spanned::new(NOWHERE, key.into_inner()), nowhere(value))).collect()
}

fn nowhere(value: Spanned<DeValue<'_>>) -> Spanned<DeValue<'_>> {
    let value = match value.into_inner() {
        DeValue::Table(table) => DeValue::Table(without_spans(table)),
        DeValue::Array(array) => DeValue::Array(array.into_iter().map(nowhere).collect()),
        plain => plain,
    };
    Spanned::new(NOWHERE, value)
}

pub(super) struct Mistake {
    pub at: Range<usize>,
    pub problem: String,
}

pub(super) fn mistake<T, S>(at: &Spanned<S>, problem: impl Into<String>) -> Result<T, Mistake> {
    Err(Mistake { at: at.span(), problem: problem.into() })
}

pub(super) fn parsed<T: std::str::FromStr<Err = String>>(
    key: &str,
    value: &Spanned<String>,
) -> Result<T, Mistake> {
    value.get_ref().parse().or_else(|problem| mistake(value, format!("{key}: {problem}")))
}

/// Checks that a value is finite and above 0.
pub(super) fn positive<T>(key: &str, value: &Spanned<T>) -> Result<T, Mistake>
where
    T: Copy + Default + PartialOrd + std::fmt::Display + std::ops::Mul<Output = T>,
{
    let number = *value.get_ref();
    // Infinity times 0 is NaN, and so not equal to 0.
    let finite = number * T::default() == T::default();
    match number > T::default() && finite {
        true => Ok(number),
        false => mistake(value, format!("{key} = {number}; expected more than 0")),
    }
}

/// The source of the scene called `name`. A mistake is reported at the place `at`.
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

/// The source called `name`, if it has one channel for each of `parts`; messages call these `what`.
pub(super) fn source_of<T>(
    name: &str,
    what: &str,
    parts: &Spanned<Vec<T>>,
    scene: &Scene,
) -> Result<SourceId, Mistake> {
    let id = known(name, parts, scene)?;
    let expected = scene.get(name).map_or(0, |spec| spec.channels);
    let found = parts.get_ref().len();
    if found != expected {
        let problem = format!("{name}: {what}: {found}, but the source has {expected}");
        return mistake(parts, problem);
    }
    Ok(id)
}

/// Refuses settings for sources that `sources` lacks, except default settings.
pub(super) fn no_stray<T, S>(
    settings: &BTreeMap<String, Spanned<T>>,
    sources: &BTreeMap<String, S>,
    table: &str,
) -> Result<(), Mistake> {
    let mut own = settings.iter().filter(|(_, value)| !is_default(*value));
    match own.find(|(name, _)| !sources.contains_key(*name)) {
        Some((name, value)) => mistake(value, format!("`{name}` is no source of {table}")),
        None => Ok(()),
    }
}
