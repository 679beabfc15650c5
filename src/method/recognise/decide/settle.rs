//! Decides when an answer is settled, by a stopping rule calibrated on left-out library trials.
//!
//! A rule has two limits: an answer is settled once its label has stayed the same for the hold time
//! (at least 0.3 s of new samples, since old samples add no evidence) and its probability is at least
//! 1 − ε. All combinations of a fixed list of holds and a fixed list of ε are tried on left-out
//! library trials. A trial is lost if it is named right by its whole length but wrong where the rule
//! stops; gains do not offset losses. A rule is allowed if the upper 90 % bound of its loss is within
//! the stated loss. The allowed rule with the smallest mean scan time is chosen.
//!
//! `src/method/evaluate/README.md` shows results on real sounds. Following a scan with ten looks a second
//! takes 0.2 % of a core (processor time over scan time).

use super::conformal::Rejection;
use super::interval::jeffreys_quantile;
use crate::features::frames::LOOK_S;

/// Hold times to try: how long the label must stay the same, in seconds of scan time.
const HOLDS_S: [f64; 5] = [0.3, 0.6, 1.0, 1.5, 2.0];

/// Values of ε to try. A rule with a smaller ε stops later.
const EPSILONS: [f64; 10] = [0.5, 0.3, 0.2, 0.1, 0.05, 0.03, 0.02, 0.01, 0.003, 0.001];

const CONFIDENCE: f64 = 0.9;

#[derive(Clone, Debug, PartialEq)]
pub struct FollowOptions {
    /// Accepted loss of accuracy, as a fraction of all scans, when a scan is answered once its guess
    /// is settled instead of at its end.
    pub loss: f64,
    /// Threshold at which a scan is called unknown. An unknown scan is never settled.
    pub rejection: Option<Rejection>,
}

impl Default for FollowOptions {
    fn default() -> Self {
        Self { loss: 0.01, rejection: None }
    }
}

/// A stopping rule: how long a label must stay the same, and how probable it must be.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct SettleRule {
    /// How long the label must stay the same, in seconds of new scan time.
    pub hold_s: f64,
    /// Least probability of the label, 1 − ε.
    pub probability: f64,
}

pub(crate) fn rules() -> Vec<SettleRule> {
    let of_hold = |hold_s| EPSILONS.map(|e| SettleRule { hold_s, probability: 1.0 - e });
    HOLDS_S.into_iter().flat_map(of_hold).collect()
}

/// The guess at one moment of a scan: its most probable surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Look {
    pub scan_s: f64,
    pub label: usize,
    pub probability: f64,
    /// Whether the scan is enough like the labelled surface not to be called unknown.
    pub fits: bool,
}

/// Applies a stopping rule to the successive guesses (looks) of one scan.
#[derive(Clone, Debug)]
pub(crate) struct Watch {
    rule: SettleRule,
    since: Option<(usize, f64)>,
    settled: Option<(usize, f64)>,
}

impl Watch {
    /// Makes a watch that has seen no look yet.
    pub(crate) fn new(rule: SettleRule) -> Self {
        Self { rule, since: None, settled: None }
    }

    /// Takes the next guess. Returns the label and scan time at which the answer was settled, or
    /// `None` if it is not settled yet. Guesses after that change nothing.
    pub(crate) fn see(&mut self, look: Look) -> Option<(usize, f64)> {
        let (label, since_s) = self
            .since
            .filter(|(label, _)| *label == look.label)
            .unwrap_or((look.label, look.scan_s));
        self.since = Some((label, since_s));
        let held = look.scan_s - since_s >= self.rule.hold_s - 1e-9;
        if held && look.fits && look.probability >= self.rule.probability {
            self.settled.get_or_insert((label, look.scan_s));
        }
        self.settled
    }
}

/// A left-out library trial, and how a model trained without it names it at each look as its drag
/// grows. The names do not depend on [`FollowOptions`].
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub(crate) struct FollowedTrial {
    /// Index of the group of trials that were left out together with this trial.
    pub group: usize,
    pub truth: usize,
    /// Index of the surface that the whole trial is named.
    pub whole: usize,
    pub drag_s: f64,
    /// The guess at each look: one after each [`LOOK_S`] of the drag.
    pub looks: Vec<LeftOutLook>,
}

#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub(crate) struct LeftOutLook {
    pub class: usize,
    pub probability: f64,
    pub p_value: Option<f64>,
}

/// Number of looks (one after each [`LOOK_S`]) in a drag of `drag_s` seconds.
pub(crate) fn looks_in(drag_s: f64) -> usize {
    (drag_s / LOOK_S + 1e-9).floor() as usize
}

impl FollowedTrial {
    /// Label and scan time at which each rule of [`rules`] stops; the end of the trial for a rule that
    /// does not stop before.
    fn stops(&self, options: &FollowOptions) -> Vec<(usize, f64)> {
        let fits = |p_value| options.rejection.as_ref().is_none_or(|r| !r.rejects(p_value));
        let look = |(i, look): (usize, &LeftOutLook)| Look {
            scan_s: (i + 1) as f64 * LOOK_S,
            label: look.class,
            probability: look.probability,
            fits: look.p_value.is_none_or(fits),
        };
        stops(self.looks.iter().enumerate().map(look), (self.whole, self.drag_s))
    }

    pub(crate) fn is_sound(&self, classes: usize) -> bool {
        let labels = self.looks.iter().map(|look| look.class).chain([self.truth, self.whole]);
        self.looks.len() == looks_in(self.drag_s) && labels.max() < Some(classes)
    }
}

/// Label and scan time at which each rule of [`rules`] stops; `end` for a rule that never does.
fn stops(looks: impl Iterator<Item = Look>, end: (usize, f64)) -> Vec<(usize, f64)> {
    let mut watches: Vec<Watch> = rules().into_iter().map(Watch::new).collect();
    for look in looks {
        let settled = watches.iter_mut().filter_map(|watch| watch.see(look)).count();
        if settled == watches.len() {
            break;
        }
    }
    watches.into_iter().map(|watch| watch.settled.unwrap_or(end)).collect()
}

/// A stopping rule, and its results on left-out library trials.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Settling {
    /// The rule; `None` if no rule keeps the stated loss, so that a scan settles only at its end.
    pub rule: Option<SettleRule>,
    /// The loss that is allowed: a share of all trials.
    pub stated_loss: f64,
    pub trials: usize,
    /// How many of these trials are named right by their whole length and wrong where the rule stops.
    pub lost: usize,
    /// Upper 90 % bound of the share of lost trials.
    pub loss_high: f64,
    /// Whether `loss_high` can be within the stated loss. False if there are too few trials to show
    /// the stated loss even if none is lost; then `rule` is one that lost none.
    pub shown: bool,
    /// Mean scan time at which the rule stops, in seconds.
    pub scan_s: f64,
}

impl Settling {
    /// Chooses the rule with the least mean scan time among those that keep the stated loss.
    pub(crate) fn choose(trials: &[FollowedTrial], options: &FollowOptions) -> Self {
        let n = trials.len();
        let stated_loss = options.loss;
        let bound = |lost| if n == 0 { 1.0 } else { jeffreys_quantile(lost, n, CONFIDENCE) };
        let can_show = bound(0) <= stated_loss;
        let stops: Vec<_> = trials.iter().map(|trial| trial.stops(options)).collect();
        let mean_s =
            |rule: usize| stops.iter().map(|stops| stops[rule].1).sum::<f64>() / n.max(1) as f64;
        let lost = |rule: usize| {
            let named = trials.iter().zip(&stops).filter(|(trial, _)| trial.whole == trial.truth);
            named.filter(|(trial, stops)| stops[rule].0 != trial.truth).count()
        };
        let all = rules();
        let kept = (0..all.len()).filter(|_| n > 0).filter_map(|rule| {
            let lost = lost(rule);
            let keeps = if can_show { bound(lost) <= stated_loss } else { lost == 0 };
            keeps.then(|| (mean_s(rule), rule, lost))
        });
        // In a tie, `min_by` takes the first rule.
        let best = kept.min_by(|a, b| a.0.total_cmp(&b.0));
        let lost = best.map_or(0, |best| best.2);
        Self {
            rule: best.map(|best| all[best.1]),
            stated_loss,
            trials: n,
            lost,
            loss_high: bound(lost),
            shown: can_show,
            scan_s: best.map_or(0.0, |best| best.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn looks(labels: &[usize], probability: f64) -> Vec<Look> {
        let look = |(i, &label): (usize, &usize)| Look {
            scan_s: 0.1 * (i + 1) as f64,
            label,
            probability,
            fits: true,
        };
        labels.iter().enumerate().map(look).collect()
    }

    #[test]
    fn a_label_must_hold_for_new_scan_time_and_be_probable() {
        let rule = SettleRule { hold_s: 0.3, probability: 0.9 };
        let settled = |looks: &[Look]| {
            let mut watch = Watch::new(rule);
            looks.iter().filter_map(|&look| watch.see(look)).last()
        };
        let (label, at) = settled(&looks(&[1, 2, 2, 2, 2, 1, 1], 0.95)).unwrap();
        assert!(label == 2 && (at - 0.5).abs() < 1e-9, "{at}");
        assert_eq!(settled(&looks(&[1, 2, 2, 2, 1, 1, 1], 0.95)), None);
        assert_eq!(settled(&looks(&[2; 9], 0.89)), None);
        let unfit: Vec<Look> =
            looks(&[2; 9], 0.95).into_iter().map(|look| Look { fits: false, ..look }).collect();
        assert_eq!(settled(&unfit), None);
    }

    /// A trial with the label `early` at probability 0.8 until 1 s, and then the truth at 1.0.
    fn followed(early: usize, truth: usize) -> FollowedTrial {
        let look = |i: usize| LeftOutLook {
            class: if i <= 10 { early } else { truth },
            probability: if i <= 10 { 0.8 } else { 1.0 },
            p_value: None,
        };
        let looks = (1..=40).map(look).collect();
        FollowedTrial { group: 0, truth, whole: truth, drag_s: 4.0, looks }
    }

    fn choose(trials: &[FollowedTrial], loss: f64) -> Settling {
        Settling::choose(trials, &FollowOptions { loss, rejection: None })
    }

    #[test]
    fn the_earliest_rule_within_the_stated_loss_is_chosen() {
        let always_right: Vec<_> = (0..200).map(|_| followed(1, 1)).collect();
        let chosen = choose(&always_right, 0.01);
        assert_eq!(chosen.rule.unwrap(), rules()[0]);
        assert!(chosen.shown && chosen.lost == 0 && (chosen.scan_s - 0.4).abs() < 1e-9);
        let often_wrong: Vec<_> = (0..200).map(|i| followed(i % 2, 1)).collect();
        let chosen = choose(&often_wrong, 0.01);
        assert!(chosen.rule.unwrap().probability > 0.8, "{chosen:?}");
        assert_eq!(chosen.lost, 0);
        assert_eq!(choose(&often_wrong, 0.9).rule.unwrap(), rules()[0]);
    }

    #[test]
    fn too_few_trials_to_show_a_loss_are_said_to_be() {
        let few: Vec<_> = (0..20).map(|_| followed(1, 1)).collect();
        let chosen = choose(&few, 0.01);
        assert!(chosen.rule.is_some() && !chosen.shown && chosen.loss_high > 0.01);
        let mut one_lost = few;
        one_lost.push(followed(0, 1));
        assert!(choose(&one_lost, 0.01).rule.unwrap().probability > 0.8);
        assert_eq!(choose(&[], 0.01).rule, None);
    }

    #[test]
    fn looks_are_not_taken_once_every_rule_has_stopped() {
        let mut taken = 0;
        let sure = (1..=40).map(|i| {
            taken += 1;
            Look { scan_s: 0.1 * f64::from(i), label: 0, probability: 1.0, fits: true }
        });
        stops(sure, (0, 4.0));
        assert_eq!(taken, 21, "2 s after the first look");
    }
}
