//! How long a scan must last, or why no scan time is known.

use serde::ser::{Serialize, SerializeStruct, Serializer};

use crate::recognise::decide::LeftOutBy;
use crate::recognise::decide::settle::FollowOptions;

/// The accuracy that a scan time must reach.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Goal {
    /// This share of scans is named right.
    Accuracy(f64),
    /// The accuracy may be lower than the accuracy of whole scans by at most this share.
    Loss(f64),
}

impl Goal {
    /// The given accuracy; if `None`, a loss of at most one percentage point against whole scans.
    pub fn wanted(accuracy: Option<f64>) -> Self {
        accuracy.map_or(Self::Loss(FollowOptions::default().loss), Self::Accuracy)
    }

    /// The accuracy to reach if that of whole scans is `whole`.
    pub(super) fn target(self, whole: f64) -> f64 {
        match self {
            Self::Accuracy(share) => share,
            Self::Loss(loss) => whole - loss,
        }
    }
}

/// The share of left-out trials that are named right after a given scan time.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct AccuracyAt {
    pub scan_s: f64,
    /// Share of trials named right, from 0 to 1.
    pub accuracy: f64,
    /// Lower end of the 95 % interval of `accuracy`.
    pub accuracy_low: f64,
    pub accuracy_high: f64,
}

/// Why no scan time, or only the length of whole trials, can be given.
#[derive(Clone, Debug, PartialEq)]
pub enum Shortfall {
    NothingLeftOut {
        /// the surfaces with too few trials, and how many trials each lacks
        lacking: Vec<(String, usize)>,
    },
    /// There are too few trials to show the share even if all are right; scan for their whole length.
    TooFewTrials {
        /// the share to be shown, from 0 to 1
        share: f64,
        /// about how many trials to record
        more: usize,
    },
    /// Not even whole trials reach the wanted accuracy.
    NotReached,
    /// Whole trials are not shown to be named right more often than by chance.
    AtChance {
        /// the share that is right if the most frequent surface is always named
        chance: f64,
    },
    /// The trials cannot be compared with each other, for this reason.
    NoModel(String),
}

/// How long a scan must last, or why no scan time can be given.
#[derive(Clone, Debug, PartialEq)]
pub struct ScanTime {
    /// The wanted accuracy: the share of scans to be named right.
    pub target: f64,
    /// How long to drag, and the accuracy by then.
    pub enough: Option<AccuracyAt>,
    /// The accuracy after the whole length of the trials.
    pub whole: Option<AccuracyAt>,
    /// Number of left-out trials that the answer is based on.
    pub trials: usize,
    pub people: usize,
    pub left_out: LeftOutBy,
    /// Why `enough` is `None` or the length of whole trials; `None` if `enough` is a shorter time.
    pub shortfall: Option<Shortfall>,
}

impl Serialize for ScanTime {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        let (at, whole) = (self.enough, self.whole);
        let mut document = to.serialize_struct("ScanTime", 13)?;
        document.serialize_field("target", &self.target)?;
        // If it is null or the whole length, `reason` says why.
        document.serialize_field("scan_s", &self.scan_s())?;
        document.serialize_field("accuracy", &at.map(|at| at.accuracy))?;
        document.serialize_field("accuracy_low", &at.map(|at| at.accuracy_low))?;
        document.serialize_field("accuracy_high", &at.map(|at| at.accuracy_high))?;
        // The median length of the library's trials.
        document.serialize_field("whole_s", &whole.map(|whole| whole.scan_s))?;
        document.serialize_field("accuracy_whole", &whole.map(|whole| whole.accuracy))?;
        document.serialize_field("trials", &self.trials)?;
        document.serialize_field("people", &self.people)?;
        document.serialize_field("across_people", &self.left_out.across_people())?;
        document.serialize_field("left_out", self.left_out.name())?;
        document.serialize_field("reason", &self.reason())?;
        document.serialize_field("more_trials", &self.more_trials())?;
        document.end()
    }
}

impl ScanTime {
    /// How long to drag, in seconds; `None` if no scan time is known.
    pub fn scan_s(&self) -> Option<f64> {
        self.enough.map(|at| at.scan_s)
    }

    pub fn line(&self) -> String {
        let why = self.reason();
        let Some(at) = self.enough else {
            return format!("how long to drag is not known: {}", why.unwrap_or_default());
        };
        if let Some(why) = why {
            return format!("drag for {:.1} s, as long as your trials: {why}", at.scan_s);
        }
        let (whole, whom) = (self.whole_percent(), self.left_out.of_whom(self.people));
        format!(
            "drag for at least {:.1} s: {} of {} left-out scans ({}) are named right by then, and {whole} \
             at full length ({whom})",
            at.scan_s,
            percent(at.accuracy),
            self.trials,
            ends(&at)
        )
    }

    fn whole_percent(&self) -> String {
        self.whole.map_or_else(String::new, |whole| percent(whole.accuracy))
    }

    /// Why there is no scan time shorter than whole trials; `None` if there is one.
    pub fn reason(&self) -> Option<String> {
        self.shortfall.as_ref().map(|shortfall| self.why(shortfall))
    }

    /// About how many trials to record, if `reason` is that there are too few.
    fn more_trials(&self) -> Option<usize> {
        match self.shortfall.as_ref()? {
            Shortfall::NothingLeftOut { lacking } => Some(lacking.iter().map(|(_, n)| n).sum()),
            Shortfall::TooFewTrials { more, .. } => Some(*more),
            Shortfall::NotReached | Shortfall::AtChance { .. } | Shortfall::NoModel(_) => None,
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
            Shortfall::AtChance { chance } => format!(
                "at full length {} of {} left-out scans ({}) are named right, which chance may explain: \
                 always naming the most frequent surface gives {}; add a source, or record more trials",
                self.whole_percent(),
                self.trials,
                self.whole.as_ref().map_or_else(String::new, ends),
                percent(*chance)
            ),
            Shortfall::NotReached => format!(
                "no scan time reaches {}; at full length {} of left-out scans are named right ({}): \
                 add a source, or record more trials",
                percent(self.target),
                self.whole_percent(),
                self.left_out.of_whom(self.people)
            ),
        }
    }
}

/// The interval of an accuracy, such as `97.2 to 99.7`.
fn ends(at: &AccuracyAt) -> String {
    format!("{} to {}", number(at.accuracy_low), number(at.accuracy_high))
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
            left_out: LeftOutBy::Trials,
            shortfall: None,
        }
    }

    #[test]
    fn one_line_says_how_long_how_surely_and_for_whom() {
        assert_eq!(
            answer().line(),
            "drag for at least 0.9 s: 99.0 % of 200 left-out scans (97.2 to 99.7) are named right by \
             then, and 99.5 % at full length (for this person, within one session)"
        );
        let others = ScanTime { people: 4, left_out: LeftOutBy::People, ..answer() };
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
