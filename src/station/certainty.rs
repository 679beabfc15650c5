//! Decides how certain an answer is: its state, and the reasons for doubt.

use super::answer::{Answer, AnswerState};
use crate::recognise::Rejection;

/// Below this probability, the first surface is less likely than all others together.
const EVEN: f64 = 0.5;

/// The share of the needed drag that a scan must reach to raise no doubt. Between this share and the
/// whole, the test has fewer samples than needed, so it is weaker but not wrong.
const LONG_ENOUGH: f64 = 0.5;

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

/// The state of an answer, and the reasons for this state, a line each. Everything else in `answer` is
/// known. `left_out` says which sources were not compared, and why; `lacking` are the sources of the
/// library that the scan does not have.
pub(super) fn judge(
    answer: &Answer,
    rejection: Option<&Rejection>,
    left_out: Vec<String>,
    lacking: &[&str],
) -> (AnswerState, Vec<String>) {
    if let (Some(p), Some(rejection)) = (answer.fit, rejection)
        && rejection.rejects(p)
    {
        let (of, p, rate) = (answer.ranked.len(), digits(p), digits(rejection.rate));
        let reason =
            format!("matches none of your {of} surfaces (p = {p}; unknown at {rate} or below)");
        return (AnswerState::Unknown, vec![reason]);
    }
    let mut doubts = answer.spoiled.clone();
    doubts.extend(left_out);
    let scan_s = answer.scan_s;
    match answer.needed_s.filter(|needed_s| scan_s < LONG_ENOUGH * needed_s) {
        // A settled answer does not need a longer scan, so only others are doubted.
        Some(needed_s) if answer.settled_s.is_none() => {
            doubts.push(format!("too short: {scan_s:.1} s of {needed_s:.1} s"));
        }
        _ if rejection.is_none() || answer.fit.is_some() => {}
        _ if lacking.is_empty() => {
            doubts.push("too short to tell whether it is an unknown surface".into());
        }
        _ => doubts.push(format!(
            "without {}, which the library has, it cannot be told whether it is an unknown surface",
            lacking.join(", ")
        )),
    }
    if let Some(confidence) = answer.confidence.filter(|confidence| *confidence < EVEN) {
        let (percent, surface) = (100.0 * confidence, &answer.ranked[0].surface);
        doubts.push(format!("{surface} is the most probable surface, by {percent:.0} %"));
    }
    if !doubts.is_empty() {
        return (AnswerState::Unsure, doubts);
    }
    if rejection.is_none() {
        return (AnswerState::Nearest, vec!["unknown surfaces are not detected".into()]);
    }
    (AnswerState::Named, Vec::new())
}

/// The probability that a scan is of an unknown surface; `None` without a p-value or a threshold.
///
/// The Bayes factor for a known surface is at least −e·p·ln p for a p-value p below 1/e, and 1
/// above (Sellke, Bayarri and Berger, The American Statistician 55, 2001). The prior odds are
/// chosen to make the probability one half at the threshold.
pub(super) fn unknown_share(p_value: Option<f64>, rejection: Option<&Rejection>) -> Option<f64> {
    let evidence = |p: f64| match p {
        0.0 => 0.0,
        p if p < (-1.0f64).exp() => -std::f64::consts::E * p * p.ln(),
        _ => 1.0,
    };
    let (p, threshold) = (p_value?, rejection?.rate);
    Some(evidence(threshold) / (evidence(threshold) + evidence(p)))
}

fn digits(p: f64) -> String {
    if p >= 0.1 { format!("{p:.2}") } else { format!("{p:.3}") }
}

#[cfg(test)]
mod tests {
    use super::AnswerState::{Named, Nearest, Unknown, Unsure};
    use super::*;
    use crate::recognise::RankedSurface;

    fn rejection() -> Rejection {
        Rejection::usual(99, true).unwrap()
    }

    fn answer(fit: Option<f64>, scan_s: f64) -> Answer {
        let ranked = ["oak", "ash"].map(|s| RankedSurface { surface: s.into(), score: 1.0 }).into();
        let (confidence, needed_s) = (Some(0.9), Some(0.9));
        Answer { ranked, fit, scan_s, confidence, needed_s, ..Answer::default() }
    }

    fn judged(answer: &Answer) -> (AnswerState, String) {
        let (state, reasons) = judge(answer, Some(&rejection()), Vec::new(), &[]);
        (state, reasons.join("\n"))
    }

    #[test]
    fn a_guess_follows_the_rule_of_answers_from_its_first_p_value() {
        let rejection = rejection();
        let of = |p| so_far(p, Some(&rejection), 0.97);
        assert_eq!([of(None), of(Some(0.004)), of(Some(0.4))], [None, Some(Unknown), Some(Named)]);
        assert_eq!(so_far(Some(0.4), Some(&rejection), 0.4), Some(Unsure));
        assert_eq!(so_far(None, None, 0.97), Some(Nearest));
    }

    #[test]
    fn each_state_has_its_reason() {
        let known = answer(Some(0.4), 1.0);
        assert_eq!(judged(&known), (Named, String::new()));
        let (state, reason) = judged(&answer(Some(0.004), 1.0));
        assert_eq!(state, Unknown);
        assert!(reason.starts_with("matches none of your 2 surfaces (p = 0.004"), "{reason}");
        let short = answer(Some(0.4), 0.2);
        assert_eq!(judged(&short), (Unsure, "too short: 0.2 s of 0.9 s".into()));
        let settled = Answer { settled_s: Some(0.1), ..short };
        assert_eq!(judged(&settled).0, Named, "it was settled");
        assert_eq!(judged(&answer(Some(0.4), 0.6)).0, Named, "it is long enough");
        let untested = answer(None, 1.0);
        assert_eq!(judge(&untested, None, Vec::new(), &[]).0, Nearest);
        assert_eq!(judged(&untested).0, Unsure);
        let (state, reasons) = judge(&untested, Some(&rejection()), Vec::new(), &["ir"]);
        assert!(state == Unsure && reasons[0].starts_with("without ir"), "{reasons:?}");
        let left_out = vec!["mi2 is left out".to_string()];
        let silent = judge(&known, Some(&rejection()), left_out.clone(), &[]);
        assert_eq!(silent, (Unsure, left_out));
        assert_eq!(judged(&Answer { confidence: Some(0.4), ..known }).0, Unsure);
    }

    #[test]
    fn a_scan_is_as_likely_unknown_as_not_at_the_threshold_and_less_likely_the_better_it_fits() {
        let rejection = rejection();
        let share = |p| unknown_share(Some(p), Some(&rejection)).unwrap();
        let rate = rejection.rate;
        assert!((share(rate) - 0.5).abs() < 1e-12);
        let shares = [0.0, rate / 2.0, rate, 0.2, 0.36, 0.9].map(share);
        assert!(shares.is_sorted_by(|a, b| a >= b), "{shares:?}");
        assert_eq!((shares[0], share(0.5)), (1.0, shares[5]));
        assert_eq!(unknown_share(None, Some(&rejection)), None);
        assert_eq!(unknown_share(Some(0.5), None), None);
    }
}
