//! The answer of a station to a scan.

use std::time::SystemTime;

use serde::{Deserialize, Serialize};

use crate::recognise::RankedSurface;
use crate::record::{unix_ms, utc};
use crate::scan::Scan;
use crate::scene::SourceId;

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
    /// The reasons for a state other than [`AnswerState::Named`], a line each.
    pub reasons: Vec<String>,
    /// The surface named; `None` if the scan fits no surface or could not be compared.
    pub surface: Option<String>,
    /// The true surface, if a recording states it; `user` and `trial` also come from the recording.
    pub truth: Option<String>,
    pub user: Option<String>,
    pub trial: Option<u32>,
    /// Whether the scan was generated, not measured.
    pub synthetic: bool,
    /// All surfaces of the library, the most similar first.
    pub ranked: Vec<RankedSurface>,
    /// Natural logarithm of the second score divided by the first.
    pub margin: f64,
    /// Probability of the first surface; `None` if the method gives no probabilities.
    pub confidence: Option<f64>,
    /// Share of left-out library trials that fit their own surface no better than this scan fits
    /// the first surface (a conformal p-value); `None` if the library is too small.
    pub fit: Option<f64>,
    /// Probability that the surface is not in the library; one half at the threshold for unknown
    /// surfaces. `None` if unknown surfaces are not detected.
    #[serde(skip)]
    pub unknown: Option<f64>,
    /// Time from the end of the scan to its answer, in milliseconds.
    pub latency_ms: f64,
    pub scan_s: f64,
    /// Seconds of scan until the answer was settled (see [`super::Guess`]); `None` if it never was.
    pub settled_s: Option<f64>,
    /// Number of frames and pictures lost during the scan.
    pub lost_samples: u64,
    pub sources: Vec<SourceId>,
    /// Reasons why the scan should not be trusted, a line each.
    pub spoiled: Vec<String>,
    /// All damage. It has one entry for each reason in `spoiled`, and the damage of single sources.
    pub damage: Vec<Damage>,
    /// How long the drag should last, in seconds; `None` if that is not known.
    pub needed_s: Option<f64>,
    pub remarks: Vec<Remark>,
    /// Whether the scan held too little to be named: it is silent, or shorter than a frame.
    #[serde(skip)]
    pub too_little: bool,
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

impl AnswerState {
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Named => "named",
            Self::Nearest => "nearest",
            Self::Unsure => "unsure",
            Self::Unknown => "unknown",
            Self::Unnamed => "unnamed",
        }
    }
}

/// A fault in the signals of a scan, such as a dead or clipped channel.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Damage {
    /// The source; `None` for damage of the whole scan.
    pub source: Option<SourceId>,
    /// The damage, and the remedy.
    pub text: String,
}

/// A flaw of a scan. Only its text is written as JSON.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(into = "String")]
pub struct Remark {
    /// The source whose signal is flawed; `None` if the drag is shorter than the library's scan time.
    pub source: Option<SourceId>,
    pub text: String,
}

impl From<Remark> for String {
    fn from(remark: Remark) -> Self {
        remark.text
    }
}

impl Answer {
    /// Makes an answer without a name; `latency_ms` is the time since the end of the scan.
    pub(crate) fn of(scan: &Scan, latency_ms: f64) -> Self {
        let (id, unix_ms) = stamp(SystemTime::now(), scan.number);
        let truth = scan.truth.as_ref();
        Self {
            link: format!("/#scan={id}"),
            id,
            unix_ms,
            scan: scan.number,
            truth: truth.and_then(|key| key.label().map(String::from)),
            user: truth.map(|key| key.user.clone()),
            trial: truth.map(|key| key.number),
            synthetic: scan.synthetic,
            latency_ms,
            scan_s: scan.scan_s,
            lost_samples: scan.lost_samples,
            spoiled: scan.spoiled.clone(),
            damage: (scan.spoiled.iter())
                .map(|why| Damage { source: None, text: why.clone() })
                .collect(),
            ..Self::default()
        }
    }

    pub(crate) fn not_named(&self) -> String {
        format!("scan {} was not named: {}", self.scan, self.reasons.join("; "))
    }

    /// How many seconds the drag was too short; `None` below 0.05 s, which would be printed as 0.0.
    pub(crate) fn more_s(&self) -> Option<f64> {
        self.needed_s.map(|needed_s| needed_s - self.scan_s).filter(|more_s| *more_s >= 0.05)
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
