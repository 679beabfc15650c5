//! The report of `surfaced eval`, as text and JSON.

use crate::cli::{say, show};
use crate::evaluate::{
    EnrolmentOutcome, Outcome, Prediction, Protocol, SettledOutcome, UnknownOutcome,
};
use crate::trial::TrialKey;

/// The JSON document: the outcome, and what it was measured on.
#[derive(serde::Serialize)]
pub struct EvalReport {
    #[serde(flatten)]
    pub outcome: Outcome,
    #[serde(serialize_with = "name")]
    pub protocol: Protocol,
    pub data: String,
    pub synthetic: bool,
    pub query_seconds: Option<f64>,
    /// Only with `--settle`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub settled: Option<SettledOutcome>,
    /// Only with `--leave-surfaces-out`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unknown: Option<UnknownOutcome>,
    /// Only with `--enrolled`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub enrolled: Option<EnrolmentOutcome>,
    pub predictions: Vec<EvalAnswer>,
    /// Sources that were left out and the reason, a line each.
    pub warnings: Vec<String>,
}

// serde demands this signature.
#[allow(clippy::trivially_copy_pass_by_ref)]
fn name<S: serde::Serializer>(protocol: &Protocol, to: S) -> Result<S::Ok, S::Error> {
    to.serialize_str(protocol.name())
}

/// One query and its answer.
#[derive(serde::Serialize)]
pub struct EvalAnswer {
    truth: String,
    user: String,
    trial: u32,
    answer: String,
    margin: f64,
}

impl From<Prediction> for EvalAnswer {
    fn from(p: Prediction) -> Self {
        let TrialKey { surface: truth, user, number: trial } = p.key;
        Self { truth, user, trial, answer: p.surface, margin: p.margin }
    }
}

impl EvalReport {
    /// Prints the report as text.
    pub fn print(&self) {
        let o = &self.outcome;
        let percent = show::percent;
        let sources: Vec<_> = o.sources.iter().map(|id| id.as_str()).collect();
        let mark = if self.synthetic { ", on synthetic data" } else { "" };
        result!();
        result!(
            "accuracy   {} ({} of {} queries; 95 % interval {})",
            percent(o.share.value()),
            o.share.right,
            o.queries,
            show::interval(o.share)
        );
        result!(
            "           {} · {} · {}{mark}",
            self.protocol.name(),
            o.method,
            sources.join(", ")
        );
        if self.protocol.folds_are_users() {
            result!(
                "           mean over {}: {} ± {}",
                show::counted(o.folds.len(), "user"),
                percent(o.accuracy_mean),
                percent(o.accuracy_std)
            );
        }
        self.enrolled.iter().for_each(print_enrolled);
        result!(
            "           {} against {}",
            show::counted(o.classes, "surface"),
            show::counted(o.library_trials, "library trial")
        );
        if !o.never_queried.is_empty() {
            result!("           never queried: {}", o.never_queried.join(", "));
        }
        if say::is_verbose() {
            result!("precision  {}", percent(o.precision_mean));
            result!(
                "query      {:.1} ms from raw samples to the answer (median), {:.1} ms (p99)",
                o.query_ms_p50,
                o.query_ms_p99
            );
        }
        for (truth, answer, count) in o.confusion.worst(5) {
            result!("           {count} × {truth} taken for {answer}");
        }
        self.settled.iter().for_each(print_settled);
        self.unknown.iter().for_each(print_unknown);
    }
}

fn print_enrolled(e: &EnrolmentOutcome) {
    result!(
        "enrolled   {} of each surface by the user: {:+.1} points; without, {} of the same queries \
         ({})",
        show::counted(e.trials, "trial"),
        100.0 * e.gain,
        show::percent(e.without.value()),
        show::interval(e.without)
    );
}

fn print_settled(s: &SettledOutcome) {
    let percent = show::percent;
    result!(
        "settled    {} (95 % interval {}) against {} by whole scans: {} lost, {} gained",
        percent(s.share.value()),
        show::interval(s.share),
        percent(s.accuracy_whole),
        s.lost,
        s.gained
    );
    result!(
        "           after {:.2} s on average ({:.2} s in the median) of {:.2} s; {} of {} scans settled \
         before they ended",
        s.scan_s_mean,
        s.scan_s_p50,
        s.whole_s_mean,
        s.settled,
        s.queries
    );
    let shown = s.rules.iter().filter(|rule| rule.shown).count();
    result!(
        "           stated loss {} at most, shown (at 90 %) by the libraries of {shown} of {} folds",
        percent(s.stated_loss),
        s.rules.len()
    );
    if let Some(share) = s.core_share {
        result!("           following takes {} of one core", percent(share));
    }
}

fn print_unknown(u: &UnknownOutcome) {
    let percent = show::percent;
    result!(
        "unknown    {} of {} queries of left-out surfaces caught (95 % interval {})",
        percent(u.unknown.value()),
        u.unknown.of,
        show::interval(u.unknown)
    );
    result!(
        "           {} of {} queries of known ones rejected ({}); stated {} ({} to {}, by {} \
         left-out trials)",
        percent(u.known.value()),
        u.known.of,
        show::interval(u.known),
        percent(u.stated.rate),
        percent(u.stated.rate_low),
        percent(u.stated.rate_high),
        u.stated.trials
    );
    result!(
        "           in {} of {} folds the share rejected lies in the interval stated there",
        u.folds_as_stated,
        u.folds
    );
}
