//! A configuration file of a station, laid over the defaults, as it stands there.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::Deserialize;
use toml::Spanned;

use crate::device::serial::Value;
use crate::scene::config::SourceBlock;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct StationFile {
    pub format: Spanned<u32>,
    pub library: Option<PathBuf>,
    pub serve: Spanned<String>,
    pub stylus: StylusBlock,
    pub microphone: MicrophoneBlock,
    pub camera: CameraBlock,
    pub detection: DetectionBlock,
    pub enroll: EnrollBlock,
    pub history: HistoryBlock,
    #[serde(default)]
    pub outputs: OutputsBlock,
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
    pub flash_control: Option<u32>,
    pub flash_on: Option<i64>,
    pub flash_off: Option<i64>,
    pub flash_settle_ms: Spanned<u64>,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum SensorKindName {
    Force,
    Vibration,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct DetectionBlock {
    pub listen: BTreeMap<String, Spanned<SensorKindName>>,
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
pub(super) struct HistoryBlock {
    pub keep_mb: u32,
}

#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct OutputsBlock {
    pub http: Option<Spanned<String>>,
    pub mqtt: Option<Spanned<String>>,
}
