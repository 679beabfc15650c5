//! Decides how certain an answer is: its state, and the reasons for doubt.

use super::answer::{AnswerState, Damage, Remark};
use crate::recognise::{Ranking, Rejection};
use crate::scan::Scan;
use crate::scene::SourceId;

/// Below this probability, the first surface is less likely than all others together.
const EVEN: f64 = 0.5;

/// The share of the needed drag that a scan must reach to raise no doubt. Between this share and the
/// whole, the test has fewer samples than needed, so it is weaker but not wrong.
const LONG_ENOUGH: f64 = 0.5;

#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    pub ranking: Ranking,
    /// The p-value at or below which the scan is unknown; `None` if unknown surfaces are not detected.
    pub rejection: Option<Rejection>,
    /// Sources that were not compared, and the reasons, a line each.
    pub left_out: Vec<String>,
    /// Sources of the library that the scan does not have.
    pub lacking: Vec<SourceId>,
    /// How long the drag should last, in seconds; `None` if that is not known.
    pub needed_s: Option<f64>,
    pub remarks: Vec<Remark>,
    pub damage: Vec<Damage>,
}

impl Verdict {
    pub fn is_unknown(&self) -> bool {
        let test = self.ranking.p_value.zip(self.rejection.as_ref());
        test.is_some_and(|(p, rejection)| rejection.rejects(p))
    }
}

/// The state of a scan in progress whose first surface has this probability; `None` as long as it
/// cannot be told whether the surface is unknown.
pub(super) fn so_far(
    p_value: Option<f64>,
    rejection: Option<&Rejection>,
    probability: f64,
) -> Option<AnswerState> {
    match (p_value, rejection) {
        (None, Some(_)) => None,
        (Some(p), Some(rejection)) if rejection.rejects(p) => Some(AnswerState::Unknown),
        _ if probability < EVEN => Some(AnswerState::Unsure),
        (_, Some(_)) => Some(AnswerState::Named),
        (_, None) => Some(AnswerState::Nearest),
    }
}

/// The state of an answer and the reasons for this state, a line each.
pub(super) fn judge(
    verdict: &Verdict,
    scan: &Scan,
    settled_s: Option<f64>,
) -> (AnswerState, Vec<String>) {
    let Verdict { ranking, rejection, .. } = verdict;
    if let (Some(p), Some(rejection)) = (ranking.p_value, rejection)
        && rejection.rejects(p)
    {
        let (of, p, rate) = (ranking.ranked.len(), digits(p), digits(rejection.rate));
        let reason =
            format!("matches none of your {of} surfaces (p = {p}; unknown at {rate} or below)");
        return (AnswerState::Unknown, vec![reason]);
    }
    let doubts = doubts(verdict, scan, settled_s);
    if !doubts.is_empty() {
        return (AnswerState::Unsure, doubts);
    }
    if rejection.is_none() {
        let reason = "unknown surfaces are not detected";
        return (AnswerState::Nearest, vec![reason.into()]);
    }
    (AnswerState::Named, Vec::new())
}

/// The probability that a scan is of an unknown surface; `None` without a p-value or a threshold.
///
/// The Bayes factor for a known surface is at least −e·p·ln p for a p-value p below 1/e, and 1
/// above (Sellke, Bayarri and Berger, The American Statistician 55, 2001). The prior odds are
/// chosen to make the probability one half at the threshold.
pub(super) fn unknown_share(verdict: &Verdict) -> Option<f64> {
    let evidence = |p: f64| match p {
        0.0 => 0.0,
        p if p < (-1.0f64).exp() => -std::f64::consts::E * p * p.ln(),
        _ => 1.0,
    };
    let (p, threshold) = (verdict.ranking.p_value?, verdict.rejection.as_ref()?.rate);
    Some(evidence(threshold) / (evidence(threshold) + evidence(p)))
}

fn doubts(verdict: &Verdict, scan: &Scan, settled_s: Option<f64>) -> Vec<String> {
    let Verdict { ranking, rejection, needed_s, left_out, lacking, .. } = verdict;
    let mut doubts = scan.spoiled.clone();
    doubts.extend_from_slice(left_out);
    match needed_s.filter(|needed_s| scan.scan_s < LONG_ENOUGH * needed_s) {
        // A settled answer does not need a longer scan, so only others are doubted.
        Some(needed_s) if settled_s.is_none() => {
            doubts.push(format!("too short: {:.1} s of {needed_s:.1} s", scan.scan_s));
        }
        _ if rejection.is_some() && ranking.p_value.is_none() && !lacking.is_empty() => {
            let names: Vec<&str> = lacking.iter().map(|id| id.as_str()).collect();
            doubts.push(format!(
                "without {}, which the library has, it cannot be told whether it is an unknown surface",
                names.join(", ")
            ));
        }
        _ if rejection.is_some() && ranking.p_value.is_none() => {
            doubts.push("too short to tell whether it is an unknown surface".into());
        }
        _ => {}
    }
    if let Some(confidence) = ranking.confidence.filter(|confidence| *confidence < EVEN) {
        let (percent, surface) = (100.0 * confidence, ranking.surface());
        doubts.push(format!("{surface} is the most probable surface, by {percent:.0} %"));
    }
    doubts
}

fn digits(p: f64) -> String {
    if p >= 0.1 { format!("{p:.2}") } else { format!("{p:.3}") }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::recognise::{RankedSurface, Ranking, Rejection};
    use crate::trial::TrialKey;

    fn verdict(p_value: Option<f64>, threshold: bool) -> Verdict {
        let ranked = ["oak", "ash"].map(|s| RankedSurface { surface: s.into(), score: 1.0 });
        let ranking = Ranking {
            ranked: ranked.into(),
            margin: 1.0,
            sources: Vec::new(),
            nearest: TrialKey::new("oak", "expert", 1),
            confidence: Some(0.9),
            p_value,
        };
        let rejection = threshold.then(|| Rejection::usual(99, true).unwrap());
        let (left_out, lacking, remarks) = (Vec::new(), Vec::new(), Vec::new());
        let (needed_s, damage) = (Some(0.9), Vec::new());
        Verdict { ranking, rejection, left_out, lacking, needed_s, remarks, damage }
    }

    fn scan(scan_s: f64) -> Scan {
        Scan { scan_s, ..Scan::of_signals(1, BTreeMap::new()) }
    }

    fn judged(verdict: &Verdict, scan_s: f64, settled_s: Option<f64>) -> (AnswerState, String) {
        let (state, reasons) = judge(verdict, &scan(scan_s), settled_s);
        (state, reasons.join("\n"))
    }

    #[test]
    fn a_guess_follows_the_rule_of_answers_from_its_first_p_value() {
        use AnswerState::{Named, Nearest, Unknown, Unsure};
        let rejection = Rejection::usual(99, true).unwrap();
        let of = |p| so_far(p, Some(&rejection), 0.97);
        assert_eq!([of(None), of(Some(0.004)), of(Some(0.4))], [None, Some(Unknown), Some(Named)]);
        assert_eq!(so_far(Some(0.4), Some(&rejection), 0.4), Some(Unsure));
        assert_eq!(so_far(None, None, 0.97), Some(Nearest));
    }

    #[test]
    fn each_state_has_its_reason() {
        use AnswerState::{Named, Nearest, Unknown, Unsure};
        let known = verdict(Some(0.4), true);
        assert_eq!(judged(&known, 1.0, None), (Named, String::new()));
        let (state, reason) = judged(&verdict(Some(0.004), true), 1.0, None);
        assert_eq!(state, Unknown);
        assert!(reason.starts_with("matches none of your 2 surfaces (p = 0.004"), "{reason}");
        assert_eq!(judged(&known, 0.2, None), (Unsure, "too short: 0.2 s of 0.9 s".into()));
        assert_eq!(judged(&known, 0.2, Some(0.1)).0, Named, "it was settled");
        assert_eq!(judged(&known, 0.6, None).0, Named, "it is long enough");
        assert_eq!(judged(&verdict(None, false), 1.0, None).0, Nearest);
        assert_eq!(judged(&verdict(None, true), 1.0, None).0, Unsure);
        let lacking = vec![crate::scene::SourceId::new("ir").unwrap()];
        let (state, reason) = judged(&Verdict { lacking, ..verdict(None, true) }, 1.0, None);
        assert!(state == Unsure && reason.starts_with("without ir"), "{reason}");
        let silent = Verdict { left_out: vec!["mi2 is left out".into()], ..known.clone() };
        assert_eq!(judged(&silent, 1.0, None), (Unsure, "mi2 is left out".into()));
        let mut close = known;
        close.ranking.confidence = Some(0.4);
        assert_eq!(judged(&close, 1.0, None).0, Unsure);
    }

    #[test]
    fn a_scan_is_as_likely_unknown_as_not_at_the_threshold_and_less_likely_the_better_it_fits() {
        let share = |p| unknown_share(&verdict(Some(p), true)).unwrap();
        let rate = verdict(None, true).rejection.unwrap().rate;
        assert!((share(rate) - 0.5).abs() < 1e-12);
        let shares = [0.0, rate / 2.0, rate, 0.2, 0.36, 0.9].map(share);
        assert!(shares.is_sorted_by(|a, b| a >= b), "{shares:?}");
        assert_eq!((shares[0], share(0.5)), (1.0, shares[5]));
        assert_eq!(unknown_share(&verdict(None, true)), None);
        assert_eq!(unknown_share(&verdict(Some(0.5), false)), None);
    }
}
