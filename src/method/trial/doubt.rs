//! Doubts: what is known against a scan, as data. A doubt becomes a sentence where a person reads it,
//! and nowhere else.
//!
//! As JSON, a doubt is an object of its `kind` (a stable code), its numbers, and its `text` without
//! the source:
//!
//! ```json
//! {"kind": "clipped", "source": "ac", "channel": 1, "value": 2.0, "share": 0.12,
//!  "text": "channel 1 is clipped in 12.0 % of its samples; lower the gain, or press less"}
//! ```

use std::fmt;

use serde::{Serialize, Serializer};

use crate::scene::SourceId;

/// A doubt about a scan. Channels are counted from 1, shares go from 0 to 1, times are in seconds.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(remote = "Self", tag = "kind", rename_all = "snake_case")]
pub enum Doubt {
    /// A channel has one value for the last `share` of the samples, and moves in the library.
    Stuck { source: SourceId, channel: usize, value: f32, share: f64 },
    /// A channel is at 0 for `share` of the samples, as by a loose cable.
    AtZero { source: SourceId, channel: usize, share: f64 },
    /// A channel rests at a limit of its range for `share` of the samples.
    Clipped { source: SourceId, channel: usize, value: f32, share: f64 },
    /// All pixels of a picture are equal.
    OneColour { source: SourceId },

    /// A gap in the data that is too long to be bridged.
    Gap { source: SourceId, gap_s: f64, bridged_s: f64 },
    /// The first or last part of a source did not arrive, or all of it.
    Missing { source: SourceId, missing_s: f64, expected_s: f64 },
    /// A picture did not arrive.
    PictureLost { source: SourceId },
    /// The samples of a source are not a signal, for example because one is NaN.
    Unusable { source: SourceId, why: String },
    /// No source has any data.
    NoData,
    /// The data stopped before the scan was over.
    EndedEarly,
    /// The scan begins or ends in a gap of the data.
    Cut,
    /// A source comes at another rate than the scan states, so its frequencies are wrong.
    WrongRate { source: SourceId, seen_hz: f64, rate_hz: f64 },
    /// Samples and pictures were lost, in gaps that were bridged.
    LostSamples { samples: u64 },

    /// The drag is shorter than needed. `settled`: its answer was settled before its end.
    TooShort { scan_s: f64, needed_s: f64, settled: bool },
    /// A source is too short to hold `samples` independent samples; `needed_s` is `None` if no two
    /// samples are known to be independent.
    FewIndependent { source: SourceId, held_s: f64, needed_s: Option<f64>, samples: usize },
    /// The library has a source that the scan lacks.
    SourceMissing { source: SourceId },
    /// A source of scan and library that was not compared.
    NotCompared { source: SourceId },
    /// Nothing says whether the surface is unknown: the scan is too short or lacks sources.
    Untested { without: Vec<SourceId> },
    /// The first surface is less probable than all others together.
    Improbable { surface: String, probability: f64 },
    /// The scan fits none of the library's surfaces: its p-value is at the threshold or below.
    FitsNone { surfaces: usize, p_value: f64, threshold: f64 },
    /// The library, or the method, cannot tell unknown surfaces.
    UnknownNotDetected,
    /// A scan that was to be a trial of one surface resembles another of the library.
    NearSurface { surface: String },

    /// A channel has another level in scans of the reference surface than at first.
    LevelDrift { source: SourceId, channel: usize, surface: String, moved_db: f64, limit_db: f64 },
    /// A channel has another level at rest than at first.
    NoiseDrift { source: SourceId, channel: usize, surface: String, moved_db: f64, limit_db: f64 },
    /// Scans of the reference surface fit its trials less well than at first. `moved` is in p-values or, for
    /// methods without them, in natural logarithms of the score.
    FitDrift { surface: String, moved: f64, limit: f64 },

    /// The scan is silent, or shorter than a frame.
    TooLittle,
    /// The scan could not be named.
    NotNamed { why: String },
    /// The scan could not be written to disk.
    NotWritten { why: String },
}

impl Doubt {
    /// The source that the doubt is about; `None` for the whole scan.
    pub fn source(&self) -> Option<&SourceId> {
        match self {
            Self::Stuck { source, .. }
            | Self::AtZero { source, .. }
            | Self::Clipped { source, .. }
            | Self::OneColour { source }
            | Self::Gap { source, .. }
            | Self::Missing { source, .. }
            | Self::PictureLost { source }
            | Self::Unusable { source, .. }
            | Self::WrongRate { source, .. }
            | Self::FewIndependent { source, .. }
            | Self::SourceMissing { source }
            | Self::LevelDrift { source, .. }
            | Self::NoiseDrift { source, .. }
            | Self::NotCompared { source } => Some(source),
            _ => None,
        }
    }

    pub fn is_sensor_fault(&self) -> bool {
        use Doubt::*;
        matches!(self, Stuck { .. } | AtZero { .. } | Clipped { .. } | OneColour { .. })
    }

    /// Whether it is a remark that tends to come with each scan: a fault of a sensor, or a short drag.
    pub fn is_remark(&self) -> bool {
        self.is_sensor_fault() || matches!(self, Self::TooShort { .. })
    }

    /// Whether data are missing or wrong, so that the whole scan should not be trusted.
    pub fn spoils(&self) -> bool {
        use Doubt::*;
        let of_source = matches!(self, Gap { .. } | Missing { .. } | PictureLost { .. });
        of_source || matches!(self, Unusable { .. } | WrongRate { .. } | NoData | EndedEarly | Cut)
    }

    /// How bad a fault of a sensor is: whether the sensor is dead (not clipped), and the share of time.
    pub fn severity(&self) -> (bool, f64) {
        match self {
            Self::Stuck { share, .. } | Self::AtZero { share, .. } => (true, *share),
            Self::Clipped { share, .. } => (false, *share),
            _ => (true, 1.0),
        }
    }

    /// The doubt in words, without its source.
    pub fn text(&self) -> String {
        let percent = |share: &f64| format!("{:.0} %", 100.0 * share);
        let ms = |seconds: &f64| format!("{:.1} ms", 1e3 * seconds);
        let louder = |moved_db: &f64| if *moved_db < 0.0 { "quieter" } else { "louder" };
        match self {
            Self::Stuck { channel, value, share, .. } => {
                let part = || format!(" for the last {} of the scan", percent(share));
                let since = (*share < 1.0).then(part).unwrap_or_default();
                format!("channel {channel} is stuck at {value}{since}; check its cable")
            }
            Self::AtZero { channel, share, .. } => {
                let share = percent(share);
                format!("channel {channel} is at 0 for {share} of the scan; check its cable")
            }
            Self::Clipped { channel, share, .. } => format!(
                "channel {channel} is clipped in {:.1} % of its samples; lower the gain, or press less",
                100.0 * share
            ),
            Self::OneColour { .. } => "the picture is of one colour; uncover the lens".into(),
            Self::Gap { gap_s, bridged_s, .. } => format!(
                "a gap of {}, longer than the {:.0} ms that can be bridged",
                ms(gap_s),
                1e3 * bridged_s
            ),
            Self::Missing { missing_s, expected_s, .. } if missing_s >= expected_s => {
                format!("none of its {} arrived", ms(expected_s))
            }
            Self::Missing { missing_s, .. } => format!("{} of it are missing", ms(missing_s)),
            Self::PictureLost { .. } => "the picture was lost".into(),
            Self::Unusable { why, .. } => format!("left out: {why}"),
            Self::NoData => "no source of the scene has any data in this scan".into(),
            Self::EndedEarly => "its data stopped before it was over".into(),
            Self::Cut => "a gap in its data hides a part of it".into(),
            Self::WrongRate { seen_hz, rate_hz, .. } => format!(
                "its rate is {seen_hz} Hz, but {rate_hz} Hz are expected; set rate_hz in its [[lines]] of \
                 the configuration"
            ),
            Self::LostSamples { samples } => format!("{samples} samples were lost in it"),
            Self::TooShort { scan_s, needed_s, .. } => {
                // A scan that is too short by less than a tenth must not look long enough.
                let digits = if needed_s - scan_s < 0.1 { 2 } else { 1 };
                format!("lifted after {scan_s:.digits$} s; {needed_s:.digits$} s needed")
            }
            Self::FewIndependent { held_s, needed_s, samples, .. } => {
                let take = match needed_s {
                    Some(needed_s) => {
                        format!("{samples} independent samples take {needed_s:.1} s here")
                    }
                    None => "no two samples in it are known to be independent".into(),
                };
                format!("{held_s:.1} s is too short: {take}; drag longer, or move faster")
            }
            Self::SourceMissing { .. } => "not in this scan".into(),
            Self::NotCompared { .. } => "not compared".into(),
            Self::Untested { without } if without.is_empty() => {
                "too short to tell whether it is an unknown surface".into()
            }
            Self::Untested { without } => format!(
                "without {}, which the library has, it cannot be told whether it is an unknown surface",
                without.iter().map(SourceId::as_str).collect::<Vec<_>>().join(", ")
            ),
            Self::Improbable { surface, probability } => {
                format!("{surface} is the most probable surface, by {}", percent(probability))
            }
            Self::FitsNone { surfaces, p_value, threshold } => format!(
                "matches none of your {surfaces} surfaces (p = {}; unknown at {} or below)",
                digits(*p_value),
                digits(*threshold)
            ),
            Self::UnknownNotDetected => "unknown surfaces are not detected".into(),
            Self::NearSurface { surface } => {
                format!("this looks like {surface}, which the library has")
            }
            Self::LevelDrift { channel, surface, moved_db, limit_db, .. } => format!(
                "channel {channel} is {} on {surface} than at first ({moved_db:+.1} dB; up to \
                 {limit_db:.1} dB is no drift); check gain, cable, tip and mounting",
                louder(moved_db)
            ),
            Self::NoiseDrift { channel, moved_db, limit_db, .. } => format!(
                "channel {channel} is {} at rest than at first ({moved_db:+.1} dB; up to \
                 {limit_db:.1} dB is no drift); check gain, cable and earthing",
                louder(moved_db)
            ),
            Self::FitDrift { surface, moved, limit } => format!(
                "scans of {surface} fit its trials less well than at first ({moved:+.2}; up to \
                 {limit:.2} is no drift); see whether the part is worn, then check the sensors"
            ),
            Self::TooLittle => {
                "too little to name: every source is silent, or shorter than a frame; \
                                drag for longer, and check the cables"
                    .into()
            }
            Self::NotNamed { why } | Self::NotWritten { why } => why.clone(),
        }
    }
}

/// A p-value in the digits that people read.
fn digits(p: f64) -> String {
    if p >= 0.1 { format!("{p:.2}") } else { format!("{p:.3}") }
}

impl fmt::Display for Doubt {
    /// Writes the doubt in words, after the name of its source.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.source() {
            Some(source) => write!(f, "{source}: {}", self.text()),
            None => f.write_str(&self.text()),
        }
    }
}

impl Serialize for Doubt {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        #[derive(Serialize)]
        struct Written<'a> {
            // The derived form, without the text.
            #[serde(flatten, serialize_with = "Doubt::serialize")]
            doubt: &'a Doubt,
            text: String,
        }

        Written { doubt: self, text: self.text() }.serialize(to)
    }
}

/// The doubts in words, one line each.
pub fn lines<'a>(doubts: impl IntoIterator<Item = &'a Doubt>) -> Vec<String> {
    doubts.into_iter().map(ToString::to_string).collect()
}
