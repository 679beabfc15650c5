//! The answer of a station to a scan.

use std::time::SystemTime;

use serde::ser::SerializeMap;
use serde::{Deserialize, Serialize, Serializer};

use super::account::{self, reasons};
use crate::recognise::RankedSurface;
use crate::scan::Scan;
use crate::scene::SourceId;
use crate::trial::{Doubt, Signal, channel_levels_db, lines, unix_ms, utc};

/// The answer to a scan that has ended; as JSON, it takes one line.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Answer {
    /// The permanent id of the answer, made of the time of the answer (UTC) and the number of its scan.
    pub id: String,
    /// The address of the answer's page, relative to the address of the server.
    pub link: String,
    /// When the answer was given, in milliseconds since 1970 (UTC).
    pub unix_ms: u64,
    /// Number of the scan in its session, counted from 1.
    pub scan: u32,
    pub state: AnswerState,
    /// The surface named; `None` if the scan fits no surface or could not be compared.
    pub surface: Option<String>,
    /// The true surface, if a recording states it; `user`, `session` and `trial` also come from the
    /// recording.
    pub truth: Option<String>,
    pub user: Option<String>,
    pub session: Option<String>,
    pub trial: Option<u32>,
    /// Whether the scan was generated, not measured.
    pub synthetic: bool,
    /// All surfaces of the library, the most similar first.
    pub ranked: Vec<RankedSurface>,
    /// Natural logarithm of the second score divided by the first.
    pub margin: f64,
    /// Probability of the named surface, if it is one of the library's. `None` if no surface is named,
    /// or the method gives no probabilities. This is the one number for how sure an answer is.
    pub confidence: Option<f64>,
    /// Share of left-out library trials that fit their own surface no better than this scan fits
    /// the first surface (a conformal p-value); `None` if the library is too small. In JSON, it is also
    /// called `fit`.
    #[serde(flatten, serialize_with = "by_both_names")]
    pub p_value: Option<f64>,
    /// A scale of the p-value: one half at the threshold for unknown surfaces, 1 far below it. `None`
    /// if unknown surfaces are not detected.
    #[serde(skip)]
    pub unknown: Option<f64>,
    /// Time from the end of the scan to its answer, in milliseconds.
    pub latency_ms: f64,
    pub scan_s: f64,
    /// When the surface was found, in seconds since the begin of the scan, if surfaces are named without
    /// begin and end: a scan then has an answer for each stretch of one surface, `scan_s` long. `None` for
    /// an answer to a whole scan; JSON then lacks it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub begin_s: Option<f64>,
    /// Seconds of scan until the answer was settled (see [`super::Guess`]); `None` if it never was.
    pub settled_s: Option<f64>,
    /// Number of frames and pictures lost during the scan.
    pub lost_samples: u64,
    pub sources: Vec<SourceId>,
    /// The level of each channel, if the library has a reference surface; empty otherwise, and JSON then
    /// lacks it.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub levels: Vec<ChannelLevel>,
    /// How long the drag should last, in seconds; `None` if that is not known.
    pub needed_s: Option<f64>,
    /// Doubts about the scan and its answer. In JSON, lists of lines stand beside `doubts`:
    /// `reasons` for a state other than [`AnswerState::Named`], `spoiled`, `damage` and `remarks`.
    #[serde(flatten, serialize_with = "account::of_answer")]
    pub doubts: Vec<Doubt>,
}

/// How strong a channel of a scan is. Levels are root mean squares without the mean, in dB relative to
/// 1, rounded to 0.01 dB.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ChannelLevel {
    pub source: SourceId,
    /// Counted from 1.
    pub channel: usize,
    pub level_db: f64,
    /// The level at rest, just before the scan; `None` if the station did not see it at rest.
    pub noise_db: Option<f64>,
}

/// The levels of all channels of a scan's series.
pub(super) fn levels(scan: &Scan) -> Vec<ChannelLevel> {
    let mut all = Vec::new();
    for (id, signal) in &scan.trial.signals {
        let Signal::Series(series) = signal else { continue };
        let noise = scan.rest.get(id);
        let levels = channel_levels_db(series.samples(), series.channels()).into_iter();
        all.extend(levels.enumerate().map(|(at, level_db)| ChannelLevel {
            source: id.clone(),
            channel: at + 1,
            level_db,
            noise_db: noise.and_then(|noise| noise.get(at).copied()),
        }));
    }
    all
}

fn by_both_names<S: Serializer>(p_value: &Option<f64>, to: S) -> Result<S::Ok, S::Error> {
    let mut map = to.serialize_map(None)?;
    map.serialize_entry("fit", p_value)?;
    map.serialize_entry("p_value", p_value)?;
    map.end()
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AnswerState {
    Named,
    /// The answer names the nearest surface of the library, since unknown surfaces are not detected.
    Nearest,
    /// The answer names the nearest surface, but there are reasons for doubt.
    Unsure,
    /// The scan fits no surface of the library.
    Unknown,
    /// The scan could not be compared, for example since it is too short or there is no library.
    #[default]
    Unnamed,
}

impl std::fmt::Display for AnswerState {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // Writes the state's name in JSON.
        self.serialize(f)
    }
}

impl Answer {
    /// Makes an answer without a name; `latency_ms` is the time since the end of the scan.
    pub fn of(scan: &Scan, latency_ms: f64) -> Self {
        let (id, unix_ms) = stamp(SystemTime::now(), scan.number);
        let truth = scan.truth.as_ref();
        Self {
            link: format!("/#scan={id}"),
            id,
            unix_ms,
            scan: scan.number,
            truth: truth.and_then(|key| key.label().map(String::from)),
            user: truth.map(|key| key.user.clone()),
            session: truth.and_then(|key| key.session.clone()),
            trial: truth.map(|key| key.number),
            synthetic: scan.synthetic,
            latency_ms,
            scan_s: scan.scan_s,
            lost_samples: scan.lost_samples,
            doubts: scan.spoiled.clone(),
            ..Self::default()
        }
    }

    pub fn not_named(&self) -> String {
        format!("scan {} was not named: {}", self.scan, lines(self.reasons()).join("; "))
    }

    /// The doubts that are the reasons for the answer's state.
    pub fn reasons(&self) -> Vec<&Doubt> {
        reasons(&self.doubts)
    }

    /// Why the scan should not be trusted.
    pub fn spoiled(&self) -> impl Iterator<Item = &Doubt> {
        self.doubts.iter().filter(|doubt| doubt.spoils())
    }

    /// How many seconds the drag was too short; `None` if it was long enough.
    pub fn more_s(&self) -> Option<f64> {
        self.doubts.iter().find_map(|doubt| match doubt {
            Doubt::TooShort { scan_s, needed_s, .. } => Some(needed_s - scan_s),
            _ => None,
        })
    }
}

/// The id of an answer, such as `20260921-143000.123-07`, and its time in milliseconds since 1970.
fn stamp(now: SystemTime, scan: u32) -> (String, u64) {
    let unix_ms = unix_ms(now);
    let date = utc(now).replace(['-', ':', 'Z'], "").replace('T', "-");
    (format!("{date}.{:03}-{scan:02}", unix_ms % 1000), unix_ms)
}

#[cfg(test)]
mod tests {
    use std::time::UNIX_EPOCH;

    use super::*;

    #[test]
    fn an_answer_is_named_by_its_moment_and_scan() {
        let moment = UNIX_EPOCH + std::time::Duration::from_millis(1_790_001_000_123);
        let stamped = ("20260921-143000.123-07".to_string(), 1_790_001_000_123);
        assert_eq!(stamp(moment, 7), stamped);
    }
}
