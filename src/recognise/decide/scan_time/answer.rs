//! The answer to how long a scan must last, or why that is not known.

use crate::recognise::follow::FollowOptions;

/// How accurately scans are to be named.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Goal {
    /// This share of scans named right.
    Accuracy(f64),
    /// The accuracy of whole scans, less this share.
    Loss(f64),
}

impl Goal {
    /// The given accuracy; without one, at most one percentage point lost against whole scans.
    pub fn wanted(accuracy: Option<f64>) -> Self {
        accuracy.map_or(Self::Loss(FollowOptions::default().loss), Self::Accuracy)
    }

    /// The share that the trials must be able to show if all of them are named right.
    pub(super) fn to_show(self) -> f64 {
        match self {
            Self::Accuracy(share) => share,
            Self::Loss(loss) => 1.0 - loss,
        }
    }
}

/// The share of left-out trials that are named right by a scan time.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct AccuracyAt {
    /// Scan time in seconds.
    pub scan_s: f64,
    /// The share.
    pub accuracy: f64,
    /// Lower end of its 95 % interval.
    pub accuracy_low: f64,
    /// Upper end.
    pub accuracy_high: f64,
}

/// Why no scan time is shown.
#[derive(Clone, Debug, PartialEq)]
pub enum Shortfall {
    /// No trial can be left out.
    NothingLeftOut {
        /// the surfaces with too few trials, and how many each lacks
        lacking: Vec<(String, usize)>,
    },
    /// Too few trials to show the share even if all were right; scans should last as long.
    TooFewTrials {
        /// the share to be shown
        share: f64,
        /// about how many trials to record
        more: usize,
    },
    /// Not even whole trials reach the target.
    NotReached,
    /// The trials cannot be compared with each other: why.
    NoModel(String),
}

/// How long a scan must last, or why that cannot be said.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
#[serde(into = "ScanTimeDocument")]
pub struct ScanTime {
    /// The share that is to be named right.
    pub target: f64,
    /// How long to drag, and the share that is named right by then.
    pub enough: Option<AccuracyAt>,
    /// The share that is named right by the whole length of the trials.
    pub whole: Option<AccuracyAt>,
    /// Number of left-out trials that the answer rests on.
    pub trials: usize,
    /// People in the library.
    pub people: usize,
    /// Whether the accuracy holds for other people: each person was left out in turn.
    pub across_people: bool,
    /// Why `enough` is `None` or the whole length, if it is.
    pub shortfall: Option<Shortfall>,
}

/// The JSON form of [`ScanTime`].
#[derive(serde::Serialize)]
struct ScanTimeDocument {
    /// The share that is to be named right.
    target: f64,
    /// How long to drag, in seconds; null, or the whole length, where `reason` says why.
    scan_s: Option<f64>,
    /// The share that is named right by then, and its 95 % interval.
    accuracy: Option<f64>,
    accuracy_low: Option<f64>,
    accuracy_high: Option<f64>,
    /// Median length of the library's trials, and the share named right by their whole length.
    whole_s: Option<f64>,
    accuracy_whole: Option<f64>,
    /// Number of left-out trials that the answer rests on.
    trials: usize,
    /// People in the library, and whether each was left out in turn.
    people: usize,
    across_people: bool,
    reason: Option<String>,
    /// About how many trials to record, if too few are the reason.
    more_trials: Option<usize>,
}

impl From<ScanTime> for ScanTimeDocument {
    fn from(answer: ScanTime) -> Self {
        let (at, whole) = (answer.enough, answer.whole);
        Self {
            target: answer.target,
            scan_s: answer.scan_s(),
            accuracy: at.map(|at| at.accuracy),
            accuracy_low: at.map(|at| at.accuracy_low),
            accuracy_high: at.map(|at| at.accuracy_high),
            whole_s: whole.map(|whole| whole.scan_s),
            accuracy_whole: whole.map(|whole| whole.accuracy),
            trials: answer.trials,
            people: answer.people,
            across_people: answer.across_people,
            reason: answer.reason(),
            more_trials: answer.more_trials(),
        }
    }
}

impl ScanTime {
    /// How long to drag, in seconds, where that is known.
    pub fn scan_s(&self) -> Option<f64> {
        self.enough.map(|at| at.scan_s)
    }

    /// The answer in one line.
    pub fn line(&self) -> String {
        let (at, why) = match (self.enough, self.reason()) {
            (None, why) => {
                return format!("how long to drag is not known: {}", why.unwrap_or_default());
            }
            (Some(at), why) => (at, why),
        };
        if let Some(why) = why {
            return format!("drag for {:.1} s, as long as your trials: {why}", at.scan_s);
        }
        format!(
            "drag for at least {:.1} s: {} of left-out scans ({} to {}) are named right by then, \
             and {} at full length ({})",
            at.scan_s,
            percent(at.accuracy),
            number(at.accuracy_low),
            number(at.accuracy_high),
            self.whole_percent(),
            self.for_whom()
        )
    }

    fn whole_percent(&self) -> String {
        self.whole.map_or_else(String::new, |whole| percent(whole.accuracy))
    }

    /// Why no scan time is shown.
    pub fn reason(&self) -> Option<String> {
        self.shortfall.as_ref().map(|shortfall| self.why(shortfall))
    }

    /// How many trials to record, if too few are the reason.
    pub fn more_trials(&self) -> Option<usize> {
        match self.shortfall.as_ref()? {
            Shortfall::NothingLeftOut { lacking } => Some(lacking.iter().map(|(_, n)| n).sum()),
            Shortfall::TooFewTrials { more, .. } => Some(*more),
            Shortfall::NotReached | Shortfall::NoModel(_) => None,
        }
    }

    fn for_whom(&self) -> &'static str {
        match (self.people, self.across_people) {
            (_, true) => "for other people, too: each was left out in turn",
            (0 | 1, _) => "for this person",
            _ => "for the people in the library",
        }
    }

    fn why(&self, shortfall: &Shortfall) -> String {
        match shortfall {
            Shortfall::NothingLeftOut { lacking } => {
                let lacking: Vec<String> =
                    lacking.iter().map(|(surface, n)| format!("{n} more of {surface}")).collect();
                match lacking.is_empty() {
                    true => "no trial with a drag can be left out".into(),
                    false => format!(
                        "it is found by leaving trials out, which takes two of each surface: \
                         record {}",
                        lacking.join(", ")
                    ),
                }
            }
            Shortfall::TooFewTrials { share, more } => format!(
                "{} are too few to show {} for a shorter scan; record {more} more",
                self.trials,
                percent(*share)
            ),
            Shortfall::NoModel(why) => why.clone(),
            Shortfall::NotReached => format!(
                "no scan time reaches {}; at full length {} of left-out scans are named right ({}): \
                 add a source, or record more trials",
                percent(self.target),
                self.whole_percent(),
                self.for_whom()
            ),
        }
    }
}

fn number(share: f64) -> String {
    format!("{:.1}", 100.0 * share)
}

fn percent(share: f64) -> String {
    format!("{} %", number(share))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn answer() -> ScanTime {
        let at = |scan_s, accuracy, accuracy_low, accuracy_high| AccuracyAt {
            scan_s,
            accuracy,
            accuracy_low,
            accuracy_high,
        };
        ScanTime {
            target: 0.985,
            enough: Some(at(0.9, 0.99, 0.972, 0.997)),
            whole: Some(at(4.8, 0.995, 0.97, 0.999)),
            trials: 200,
            people: 1,
            across_people: false,
            shortfall: None,
        }
    }

    #[test]
    fn one_line_says_how_long_how_surely_and_for_whom() {
        assert_eq!(
            answer().line(),
            "drag for at least 0.9 s: 99.0 % of left-out scans (97.2 to 99.7) are named right by \
             then, and 99.5 % at full length (for this person)"
        );
        let others = ScanTime { people: 4, across_people: true, ..answer() };
        assert!(others.line().ends_with("(for other people, too: each was left out in turn)"));
    }

    #[test]
    fn without_a_scan_time_the_line_says_why_and_what_to_record() {
        let none = |shortfall| ScanTime { enough: None, shortfall: Some(shortfall), ..answer() };
        let shortfall = Some(Shortfall::TooFewTrials { share: 0.99, more: 6 });
        let few = ScanTime { enough: answer().whole, shortfall, trials: 17, ..answer() };
        assert_eq!(
            few.line(),
            "drag for 4.8 s, as long as your trials: 17 are too few to show 99.0 % for a shorter \
             scan; record 6 more"
        );
        assert_eq!(few.more_trials(), Some(6));
        let lacking = vec![("ash".into(), 1), ("oak".into(), 2)];
        let nothing = none(Shortfall::NothingLeftOut { lacking });
        assert!(nothing.line().ends_with("record 1 more of ash, 2 more of oak"));
        let poor = none(Shortfall::NotReached);
        assert!(poor.line().contains("no scan time reaches 98.5 %; at full length 99.5 %"));
        let json = serde_json::to_value(&poor).unwrap();
        assert!(json["scan_s"].is_null() && json["reason"].is_string() && json["trials"] == 200);
    }
}
