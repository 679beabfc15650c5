//! When an answer is settled: a stopping rule, calibrated on left-out library trials.
//!
//! An answer is settled once its label has stayed the same for a time called the hold (at least 0.3
//! s of new samples, since old ones add no evidence) and its probability is at least 1 − ε. Each
//! hold and ε of a fixed list make a rule. The rule chosen stops earliest among those whose loss on
//! left-out library trials is within the stated loss, by an upper 90 % bound. A trial is lost if it
//! is named right by its whole length and wrong where the rule stops; gains do not make up for
//! losses.
//!
//! # On real sounds
//! 20 surfaces × 10 trials of LMT108's dragging sounds, one person, one session each, leave one
//! trial out; whole scans last 4.80 s, and 99.5 % are named right. `surfaced eval
//! LMT_108_SurfaceMaterials_Database --protocol leave-one-trial-out --sources mi2 --method embedding
//! --settle` prints
//!
//! | stated loss | named right when settled (95 % interval) | lost | scan time, mean | median |
//! |---|---|---|---|---|
//! | 1 % | 99.5 % (97.2 to 99.9) | 1 of 200 | 0.86 s | 0.70 s |
//!
//! Following a scan with ten looks a second takes 0.2 % of a core (processor time over scan time).

use super::interval::jeffreys_quantile;

/// Holds that are tried: how long the label must stay the same, in seconds of scan time.
const HOLDS_S: [f64; 5] = [0.3, 0.6, 1.0, 1.5, 2.0];

/// Values of ε that are tried, from the earliest to stop to the latest.
const EPSILONS: [f64; 10] = [0.5, 0.3, 0.2, 0.1, 0.05, 0.03, 0.02, 0.01, 0.003, 0.001];

/// Confidence of the upper bound of the loss.
const CONFIDENCE: f64 = 0.9;

/// A stopping rule: how long one label must hold, and how probable it must be.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct SettleRule {
    /// How long the label must have been the same, in seconds of new scan time.
    pub hold_s: f64,
    /// The least probability of the label, 1 − ε.
    pub probability: f64,
}

/// All rules that are tried.
pub fn rules() -> Vec<SettleRule> {
    let of_hold = |hold_s| EPSILONS.map(|e| SettleRule { hold_s, probability: 1.0 - e });
    HOLDS_S.into_iter().flat_map(of_hold).collect()
}

/// The guess at one moment of a scan: its most probable surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Look {
    /// Scan time in seconds.
    pub scan_s: f64,
    /// Index of the label.
    pub label: usize,
    /// Its probability.
    pub probability: f64,
    /// Whether the scan fits the label well enough not to be called unknown.
    pub fits: bool,
}

/// Applies a stopping rule to the successive guesses (looks) at a scan.
#[derive(Clone, Debug)]
pub struct Watch {
    rule: SettleRule,
    since: Option<(usize, f64)>,
    settled: Option<(usize, f64)>,
}

impl Watch {
    /// Starts before the first look.
    pub fn new(rule: SettleRule) -> Self {
        Self { rule, since: None, settled: None }
    }

    /// Takes the next guess. Returns the label and scan time at which the answer was settled, if it
    /// is; later guesses change nothing.
    pub fn see(&mut self, look: Look) -> Option<(usize, f64)> {
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

/// Where each rule stops on one trial: at the end of the trial, if not before.
#[derive(Clone, Debug, PartialEq)]
pub struct Stops {
    /// The trial's true label.
    pub truth: usize,
    /// The label of the whole trial.
    pub whole: usize,
    /// Label and scan time of each rule of [`rules`].
    pub of_rule: Vec<(usize, f64)>,
}

impl Stops {
    /// Applies all rules to the successive guesses at a trial, until every rule has stopped.
    pub fn new(looks: impl Iterator<Item = Look>, truth: usize, whole: usize, scan_s: f64) -> Self {
        let mut watches: Vec<Watch> = rules().into_iter().map(Watch::new).collect();
        for look in looks {
            let settled = watches.iter_mut().filter_map(|watch| watch.see(look)).count();
            if settled == watches.len() {
                break;
            }
        }
        let stop = |watch: Watch| watch.settled.unwrap_or((whole, scan_s));
        Self { truth, whole, of_rule: watches.into_iter().map(stop).collect() }
    }
}

/// A stopping rule, and how it did on left-out library trials.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Settling {
    /// The rule; `None` if no rule keeps the stated loss: then only the end of a scan settles it.
    pub rule: Option<SettleRule>,
    /// The loss that is allowed: a share of all trials.
    pub stated_loss: f64,
    /// Number of left-out trials.
    pub trials: usize,
    /// How many of these are named right by their whole length and wrong where the rule stopped.
    pub lost: usize,
    /// Upper 90 % bound of the loss.
    pub loss_high: f64,
    /// Whether that bound is within the stated loss. False where the trials are too few to show it
    /// even without any loss; then the rule is one that lost none.
    pub shown: bool,
    /// Mean scan time at which the rule stopped, in seconds.
    pub scan_s: f64,
}

impl Settling {
    /// The rule of least mean scan time that keeps `stated_loss` on `trials`.
    pub(crate) fn choose(trials: &[Stops], stated_loss: f64) -> Self {
        let n = trials.len();
        let bound = |lost| if n == 0 { 1.0 } else { jeffreys_quantile(lost, n, CONFIDENCE) };
        let can_show = bound(0) <= stated_loss;
        let mean_s = |rule: usize| {
            trials.iter().map(|stops| stops.of_rule[rule].1).sum::<f64>() / n.max(1) as f64
        };
        let lost = |rule: usize| {
            let lost = |s: &&Stops| s.whole == s.truth && s.of_rule[rule].0 != s.truth;
            trials.iter().filter(lost).count()
        };
        let all = rules();
        let kept = (0..all.len()).filter(|_| n > 0).filter_map(|rule| {
            let lost = lost(rule);
            let keeps = if can_show { bound(lost) <= stated_loss } else { lost == 0 };
            keeps.then(|| (mean_s(rule), rule, lost))
        });
        // The first in a tie.
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

    /// A trial whose looks say `early` with probability 0.8 until 1 s, then the truth, certainly.
    fn stops(early: usize, truth: usize) -> Stops {
        let look = |i: usize| Look {
            scan_s: 0.1 * i as f64,
            label: if i <= 10 { early } else { truth },
            probability: if i <= 10 { 0.8 } else { 1.0 },
            fits: true,
        };
        Stops::new((1..=40).map(look), truth, truth, 4.0)
    }

    #[test]
    fn the_earliest_rule_within_the_stated_loss_is_chosen() {
        let always_right: Vec<Stops> = (0..200).map(|_| stops(1, 1)).collect();
        let chosen = Settling::choose(&always_right, 0.01);
        assert_eq!(chosen.rule.unwrap(), rules()[0]);
        assert!(chosen.shown && chosen.lost == 0 && (chosen.scan_s - 0.4).abs() < 1e-9);
        let often_wrong: Vec<Stops> = (0..200).map(|i| stops(i % 2, 1)).collect();
        let chosen = Settling::choose(&often_wrong, 0.01);
        assert!(chosen.rule.unwrap().probability > 0.8, "{chosen:?}");
        assert_eq!(chosen.lost, 0);
        assert_eq!(Settling::choose(&often_wrong, 0.9).rule.unwrap(), rules()[0]);
    }

    #[test]
    fn too_few_trials_to_show_a_loss_are_said_to_be() {
        let few: Vec<Stops> = (0..20).map(|_| stops(1, 1)).collect();
        let chosen = Settling::choose(&few, 0.01);
        assert!(chosen.rule.is_some() && !chosen.shown && chosen.loss_high > 0.01);
        let mut one_lost = few;
        one_lost.push(stops(0, 1));
        assert!(Settling::choose(&one_lost, 0.01).rule.unwrap().probability > 0.8);
        assert_eq!(Settling::choose(&[], 0.01).rule, None);
    }

    #[test]
    fn looks_are_not_taken_once_every_rule_has_stopped() {
        let mut taken = 0;
        let sure = (1..=40).map(|i| {
            taken += 1;
            Look { scan_s: 0.1 * f64::from(i), label: 0, probability: 1.0, fits: true }
        });
        Stops::new(sure, 0, 0, 4.0);
        assert_eq!(taken, 21, "2 s after the first look");
    }
}
