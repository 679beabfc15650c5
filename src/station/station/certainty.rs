//! Decides how certain an answer is: its state, and the doubts that follow from the whole answer.

use super::account::{decides, reasons};
use super::answer::{Answer, AnswerState};
use crate::recognise::{LOOK_S, Rejection};
use crate::scan::Scan;
use crate::trial::Doubt;

/// Below this probability, the first surface is less likely than all others together.
pub(super) const EVEN: f64 = 0.5;

/// The state of a scan in progress whose first surface has this probability; `None` as long as it
/// is open whether the surface is unknown.
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

/// Sets the state of an answer, and adds the doubts that follow from it as a whole: whether the scan
/// is long enough, fits a surface, and which surface is probable. Everything else in `answer` is known,
/// and its doubts name the sources that are missing.
pub(super) fn judge(answer: &mut Answer, rejection: Option<&Rejection>) {
    let Answer { scan_s, ranked, p_value, .. } = &*answer;
    let mut found = Vec::new();
    let short = answer
        .needed_s
        .and_then(|needed_s| too_short(*scan_s, needed_s, answer.settled_s.is_some()));
    let is_far_too_short = short.as_ref().is_some_and(|short| decides(short, &[]));
    found.extend(short);
    match (*p_value, rejection) {
        (_, None) => found.push(Doubt::UnknownNotDetected),
        (Some(p_value), Some(rejection)) if rejection.rejects(p_value) => {
            let (surfaces, threshold) = (ranked.len(), rejection.rate);
            found.push(Doubt::FitsNone { surfaces, p_value, threshold });
        }
        (None, Some(_)) if !is_far_too_short => {
            let lacking = answer.doubts.iter().filter_map(|doubt| match doubt {
                Doubt::SourceMissing { source } => Some(source.clone()),
                _ => None,
            });
            found.push(Doubt::Untested { without: lacking.collect() });
        }
        _ => {}
    }
    if let Some(probability) = answer.confidence.filter(|confidence| *confidence < EVEN) {
        let surface = ranked[0].surface.clone();
        found.push(Doubt::Improbable { surface, probability });
    }
    answer.doubts.extend(found);
    answer.state = match reasons(&answer.doubts)[..] {
        [] => AnswerState::Named,
        [Doubt::FitsNone { .. }] => AnswerState::Unknown,
        [Doubt::NotNamed { .. } | Doubt::TooLittle] => AnswerState::Unnamed,
        [Doubt::UnknownNotDetected] => AnswerState::Nearest,
        _ => AnswerState::Unsure,
    };
    match answer.state {
        AnswerState::Unknown => answer.confidence = None,
        _ => answer.surface = Some(answer.ranked[0].surface.clone()),
    }
}

/// A doubt if a drag is shorter than needed by half a look or more.
pub(super) fn too_short(scan_s: f64, needed_s: f64, settled: bool) -> Option<Doubt> {
    let is_short = scan_s < needed_s - 0.5 * LOOK_S;
    is_short.then_some(Doubt::TooShort { scan_s, needed_s, settled })
}

/// The doubts about the data of a scan that was taken whole or with losses.
pub(super) fn lost_in(scan: &Scan) -> Vec<Doubt> {
    let mut doubts = scan.spoiled.clone();
    if scan.lost_samples > 0 && doubts.is_empty() {
        doubts.push(Doubt::LostSamples { samples: scan.lost_samples });
    }
    doubts
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

#[cfg(test)]
mod tests {
    use super::AnswerState::{Named, Nearest, Unknown, Unsure};
    use super::*;
    use crate::recognise::RankedSurface;
    use crate::scene::SourceId;
    use crate::trial::lines;

    fn rejection() -> Rejection {
        Rejection::usual(99, crate::recognise::LeftOutBy::People).unwrap()
    }

    fn answer(p_value: Option<f64>, scan_s: f64) -> Answer {
        let ranked = ["oak", "ash"].map(|s| RankedSurface { surface: s.into(), score: 1.0 }).into();
        let (confidence, needed_s) = (Some(0.9), Some(0.9));
        Answer { ranked, p_value, scan_s, confidence, needed_s, ..Answer::default() }
    }

    fn judged_by(answer: &Answer, rejection: Option<&Rejection>) -> (AnswerState, String) {
        let mut answer = answer.clone();
        judge(&mut answer, rejection);
        (answer.state, lines(answer.reasons()).join("\n"))
    }

    fn judged(answer: &Answer) -> (AnswerState, String) {
        judged_by(answer, Some(&rejection()))
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
        assert_eq!(judged(&short), (Unsure, "lifted after 0.2 s; 0.9 s needed".into()));
        let settled = Answer { settled_s: Some(0.1), ..short };
        assert_eq!(judged(&settled).0, Named, "it was settled");
        assert_eq!(judged(&answer(Some(0.4), 0.6)).0, Named, "it is long enough");
        let untested = answer(None, 1.0);
        assert_eq!(judged_by(&untested, None).0, Nearest);
        assert_eq!(judged(&untested).0, Unsure);
        let id = |name: &str| SourceId::new(name).unwrap();
        let lacks = vec![Doubt::SourceMissing { source: id("ir") }];
        let (state, reason) = judged(&Answer { doubts: lacks.clone(), ..untested });
        assert!(state == Unsure && reason.starts_with("without ir"), "{reason}");
        assert_eq!(judged(&Answer { doubts: lacks, ..known.clone() }).0, Named, "others suffice");
        assert_eq!(judged(&Answer { confidence: Some(0.4), ..known.clone() }).0, Unsure);
        let fault = Doubt::Stuck { source: id("mi2"), channel: 1, value: 0.0, share: 1.0 };
        let compared = Answer { doubts: vec![fault.clone()], ..known.clone() };
        assert_eq!(judged(&compared).0, Named, "by the other sources");
        let left_out = vec![fault, Doubt::NotCompared { source: id("mi2") }];
        let (state, reason) = judged(&Answer { doubts: left_out, ..known });
        assert_eq!(state, Unsure);
        assert_eq!(reason, "mi2: channel 1 is stuck at 0; check its cable\nmi2: not compared");
    }

    #[test]
    fn every_answer_that_was_lifted_early_says_so_and_no_surface_means_no_certainty() {
        for (p_value, scan_s) in [(0.4, 0.2), (0.4, 0.6), (0.004, 0.2)] {
            let mut answer = answer(Some(p_value), scan_s);
            judge(&mut answer, Some(&rejection()));
            let short = Doubt::TooShort { scan_s, needed_s: 0.9, settled: false };
            assert!(answer.doubts.contains(&short), "{:?}", answer.doubts);
            let is_known = p_value == 0.4;
            assert_eq!(
                (answer.surface.is_some(), answer.confidence.is_some()),
                (is_known, is_known)
            );
            assert_eq!(answer.p_value, Some(p_value));
        }
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
