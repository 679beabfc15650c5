//! The answer of a station to a scan.

use std::fmt;
use std::sync::Arc;
use std::time::SystemTime;

use serde::{Deserialize, Serialize};

use super::recogniser::{Recogniser, Remark};
use crate::recognise::RankedSurface;
use crate::record::{unix_ms, utc};
use crate::scan::Scan;
use crate::scene::SourceId;
use crate::trial::Flaw;

/// A scan that has ended, and its name: one line of JSON.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Answer {
    /// The permanent id of the answer: when it was given (UTC), and the number of its scan.
    pub id: String,
    /// The address of its page, relative to the address of the server.
    pub link: String,
    /// When it was given, in milliseconds since 1970.
    pub unix_ms: u64,
    /// Number of the scan in its session, counted from 1.
    pub scan: u32,
    /// Whether the name stands.
    pub state: AnswerState,
    /// Reasons why the name does not stand, a line each; empty for [`AnswerState::Named`].
    pub reasons: Vec<String>,
    /// The surface; `None` if the scan fits none, or could not be compared.
    pub surface: Option<String>,
    /// The true surface, where a recording says so; likewise `user` and `trial`.
    pub truth: Option<String>,
    /// The person who dragged.
    pub user: Option<String>,
    /// Number of the trial.
    pub trial: Option<u32>,
    /// Made by a generator, not measured.
    pub synthetic: bool,
    /// All surfaces of the library, the most similar first.
    pub ranked: Vec<RankedSurface>,
    /// ln of the ratio of the second score to the first.
    pub margin: f64,
    /// Probability of the first surface, by a method that gives one.
    pub confidence: Option<f64>,
    /// Share of left-out library trials that fit their surface no better than this scan fits the
    /// first one (a conformal p-value), where the library is large enough.
    pub fit: Option<f64>,
    /// Probability that the surface is none of the library's, where scans can be found unknown; it is
    /// one half at the threshold below which they are called so.
    #[serde(skip)]
    pub unknown: Option<f64>,
    /// From the end of the scan to its answer, in milliseconds.
    pub latency_ms: f64,
    /// How long the scan lasted, in seconds.
    pub scan_s: f64,
    /// The scan time after which the answer was settled, in seconds; `None` if it never was, or
    /// the scan was not followed.
    pub settled_s: Option<f64>,
    /// Frames (and pictures) lost within the scan.
    pub lost_samples: u64,
    /// The sources that were compared.
    pub sources: Vec<SourceId>,
    /// Reasons why the scan should not be trusted, a line each.
    pub spoiled: Vec<String>,
    /// The reasons in `spoiled`, and the damage of its sources.
    pub damage: Vec<Damage>,
    /// How long the drag should have lasted, in seconds, where that is known.
    pub needed_s: Option<f64>,
    /// Imperfections of the scan.
    pub remarks: Vec<Remark>,
}

/// Whether the name of an answer stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AnswerState {
    /// The name stands.
    Named,
    /// The name is the nearest surface of the library; unknown surfaces are not detected.
    Nearest,
    /// The name is the nearest surface, and there are reasons for doubt.
    Unsure,
    /// The scan fits no surface of the library.
    Unknown,
    /// The scan could not be compared: too little data, no library, or the method failed.
    Unnamed,
}

impl AnswerState {
    /// The name as text, the same everywhere.
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

/// A channel that rests for at least this share of a scan is dead.
const DEAD: f64 = 0.9;

/// Damage of a scan: its signals are not those of the surface alone.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Damage {
    /// The source; `None` for damage of the whole scan.
    pub source: Option<SourceId>,
    /// The damage, and what to do.
    pub text: String,
}

impl Damage {
    /// The damage of a source by the flaws of its channels: a dead channel, or else the one clipped
    /// most. A channel (`moves` counts from 0) that never changes in the library may rest.
    pub(super) fn of_source(
        source: &SourceId,
        flaws: &[Flaw],
        moves: impl Fn(usize) -> bool,
    ) -> Option<Self> {
        // Whether the channel is dead (not clipped), and for what share of the scan.
        let weight = |flaw: &Flaw| match flaw {
            Flaw::Constant { .. } => (true, 1.0),
            Flaw::Stuck { share, .. } | Flaw::Saturated { value: 0.0, share, .. } => (true, *share),
            Flaw::Saturated { share, .. } => (false, *share),
        };
        let found = flaws.iter().filter(|flaw| !weight(flaw).0 || moves(flaw.channel() - 1));
        let order = |a: &&Flaw, b: &&Flaw| {
            let ((a, of_a), (b, of_b)) = (weight(a), weight(b));
            a.cmp(&b).then(of_a.total_cmp(&of_b))
        };
        let text = match weight(found.max_by(order)?) {
            (true, DEAD..) => "dead, check the cable".into(),
            (true, share) => {
                format!("dead for {:.0} % of the scan, check the cable", 100.0 * share)
            }
            (false, share) => format!(
                "clipped in {:.0} % of its samples, lower the gain or press less",
                100.0 * share
            ),
        };
        Some(Self { source: Some(source.clone()), text })
    }
}

/// A scan with its answer and the recogniser that named it.
pub struct AnsweredScan {
    /// The scan.
    pub scan: Box<Scan>,
    /// Its answer.
    pub answer: Arc<Answer>,
    /// The recogniser that named it; `None` for [`AnswerState::Unnamed`].
    pub by: Option<Arc<Recogniser>>,
}

/// A scan that has no name, and why.
#[derive(Clone, Debug)]
pub struct Unnamed {
    /// Its answer, of the state [`AnswerState::Unnamed`].
    pub answer: Arc<Answer>,
    /// The scan and the reason, for messages.
    pub text: String,
    /// Whether it holds too little: it is silent, or shorter than a frame.
    pub too_little: bool,
}

impl fmt::Debug for AnsweredScan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("AnsweredScan").field(&self.answer.id).finish()
    }
}

impl Answer {
    /// An answer without a name, from the scan alone, `latency_ms` after its end.
    pub(crate) fn of(scan: &Scan, latency_ms: f64) -> Self {
        let (id, unix_ms) = stamp(SystemTime::now(), scan.number);
        let truth = scan.truth.as_ref();
        Self {
            link: format!("/#scan={id}"),
            id,
            unix_ms,
            scan: scan.number,
            state: AnswerState::Unnamed,
            reasons: Vec::new(),
            surface: None,
            truth: truth.and_then(|key| key.label().map(String::from)),
            user: truth.map(|key| key.user.clone()),
            trial: truth.map(|key| key.number),
            synthetic: scan.synthetic,
            ranked: Vec::new(),
            margin: 0.0,
            confidence: None,
            fit: None,
            unknown: None,
            latency_ms,
            scan_s: scan.scan_s,
            settled_s: None,
            lost_samples: scan.lost_samples,
            sources: Vec::new(),
            spoiled: scan.spoiled.clone(),
            damage: (scan.spoiled.iter())
                .map(|why| Damage { source: None, text: why.clone() })
                .collect(),
            needed_s: None,
            remarks: Vec::new(),
        }
    }

    /// By how many seconds the drag was too short, if it was by a tenth that can be said.
    pub(crate) fn more_s(&self) -> Option<f64> {
        self.needed_s.map(|needed_s| needed_s - self.scan_s).filter(|more_s| *more_s >= 0.05)
    }
}

/// The permanent id of an answer, such as `20260921-143000.123-7`, and its time in milliseconds
/// since 1970.
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
    fn damage_says_what_to_do_about_the_worst_channel() {
        let source = SourceId::new("ir").unwrap();
        let of = |flaws: &[Flaw]| Damage::of_source(&source, flaws, |channel| channel != 2);
        let text = |flaws: &[Flaw]| of(flaws).unwrap().text;
        let dead = |channel| Flaw::Constant { channel, value: 0.0 };
        let clipped = |channel, share| Flaw::Saturated { channel, value: 1.0, share };
        assert_eq!(text(&[dead(1), clipped(2, 0.1)]), "dead, check the cable");
        let loose = Flaw::Saturated { channel: 1, value: 0.0, share: 0.6 };
        assert_eq!(text(&[loose]), "dead for 60 % of the scan, check the cable");
        let texts = text(&[clipped(1, 0.1), clipped(2, 0.47)]);
        assert_eq!(texts, "clipped in 47 % of its samples, lower the gain or press less");
        assert_eq!(of(&[dead(3)]), None, "it rests in the library, too");
    }

    #[test]
    fn an_answer_is_named_by_its_moment_and_scan() {
        let moment = UNIX_EPOCH + std::time::Duration::from_millis(1_790_001_000_123);
        let stamped = ("20260921-143000.123-07".to_string(), 1_790_001_000_123);
        assert_eq!(stamp(moment, 7), stamped);
    }
}
