//! What a configuration file of a station says, as it stands there.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::Deserialize;
use toml::Spanned;

use crate::device::serial::Value;
use crate::scene::config::SourceBlock;

/// A value that was said, and where.
pub(super) type Said<T> = Option<Spanned<T>>;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct StationFile {
    pub format: Spanned<u32>,
    pub library: Option<PathBuf>,
    pub serve: Said<String>,
    #[serde(default)]
    pub stylus: StylusBlock,
    #[serde(default)]
    pub microphone: MicrophoneBlock,
    #[serde(default)]
    pub camera: CameraBlock,
    #[serde(default)]
    pub detection: DetectionBlock,
    #[serde(default)]
    pub enroll: EnrollBlock,
    #[serde(default)]
    pub sources: BTreeMap<String, Spanned<SourceBlock>>,
}

#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct StylusBlock {
    pub present: Option<bool>,
    pub port: Said<String>,
    pub rate_hz: Said<u32>,
    pub sources: Option<BTreeMap<String, Spanned<Vec<String>>>>,
    pub values: Option<BTreeMap<String, Spanned<Value>>>,
}

#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct MicrophoneBlock {
    pub present: Option<bool>,
    pub device: Option<String>,
    pub channel: Said<usize>,
    pub sources: Option<Vec<Spanned<String>>>,
}

#[derive(Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum FlashName {
    Stylus,
    Camera,
    None,
}

#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct CameraBlock {
    pub present: Option<bool>,
    pub device: Option<String>,
    pub turn: Said<u32>,
    pub every_ms: Said<u64>,
    pub source: Said<String>,
    pub flash: Option<FlashName>,
    pub flash_source: Said<String>,
    pub flash_control: Option<u32>,
    pub flash_on: Option<i64>,
    pub flash_off: Option<i64>,
    pub flash_settle_ms: Said<u64>,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum SensorKindName {
    Force,
    Vibration,
}

#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct DetectionBlock {
    pub listen: Option<BTreeMap<String, Spanned<SensorKindName>>>,
    pub onset: Said<f64>,
    pub quiet: Said<f64>,
    pub tap_hold_s: Said<f64>,
    pub longest_tap_s: Said<f64>,
    pub longest_pause_s: Said<f64>,
    pub drag_hold_s: Said<f64>,
    pub longest_drag_s: Said<f64>,
}

#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct EnrollBlock {
    pub t_star: Option<Vec<Spanned<String>>>,
    pub trials: Said<u32>,
}
