//! Finds how long a scan must last: the earliest time such that left-out library trials are named as
//! accurately as wanted at this and all later times.
//!
//! Trials are left out one at a time; if the library has several people, all trials of one person are
//! left out together. Each left-out trial is named after each of a list of scan times.
//! [`LeftOutAccuracy`] holds the share named right at each time, and [`LeftOutAccuracy::scan_time`]
//! derives the answer. `surfaced duration`, `plan`, `replay`, `run` and the countdowns all use this
//! answer. The scan time is never shorter than the first time at which enough trials can be tested for
//! an unknown surface, since the answer to a shorter scan is not complete. If there are too few trials
//! to show the wanted accuracy, the scan time is the whole length of the trials; where chance may explain
//! the names of whole trials, there is none.
//!
//! The stated accuracy would be too high if the same trials chose the time and measured the accuracy.
//! It is therefore cross-fitted: the accuracy of each group of trials is measured at a time that all
//! other groups chose. If the result misses the goal, all these times move later, one step at a time.
//! With several people, a group is a person, and the interval is over people, not trials.

mod answer;

pub use answer::{AccuracyAt, Goal, ScanTime, Shortfall};

use super::LeftOutBy;
use super::interval::{can_show, chance, wilson, wilson_of_groups};
use super::settle::{FollowedTrial, looks_in};
use crate::features::frames::LOOK_S;

/// Largest ratio of successive scan times. The first times are one look (0.1 s) apart.
const RATIO: f64 = 1.15;

/// The looks (steps of 0.1 s, counted from 1) at which a trial of `scan_s` seconds is named.
pub(crate) fn looked_after(scan_s: f64) -> impl Iterator<Item = usize> {
    let last = looks_in(scan_s);
    let next = |&look: &usize| Some((look + 1).max((look as f64 * RATIO) as usize));
    std::iter::successors(Some(1), next).take_while(move |look| *look <= last)
}

#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct LibraryCounts {
    pub people: usize,
    pub left_out: LeftOutBy,
    /// Each surface with its number of trials.
    pub surfaces: Vec<(String, usize)>,
}

/// Trials that were left out together: their number, and how many of them are named right at each scan
/// time. The last scan time is the whole length of the trials.
#[derive(Clone, Debug, PartialEq)]
struct LeftOutGroup {
    trials: usize,
    right: Vec<usize>,
}

/// How many left-out trials are named right after each scan time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LeftOutAccuracy {
    /// Scan times in seconds, ascending. The last is the median length of the trials, and stands for
    /// their whole length.
    times: Vec<f64>,
    /// For each time, how many trials have a full answer: a name, and a test for an unknown surface.
    measured: Vec<usize>,
    groups: Vec<LeftOutGroup>,
    library: LibraryCounts,
}

impl LeftOutAccuracy {
    /// Counts the trials named right at each time. A trial shorter than the time counts as a whole.
    pub(crate) fn new(trials: &[FollowedTrial], library: LibraryCounts) -> Self {
        let mut lengths: Vec<f64> = trials.iter().map(|trial| trial.drag_s).collect();
        lengths.sort_by(f64::total_cmp);
        let Some(&whole_s) = lengths.get(lengths.len() / 2) else {
            return Self { library, ..Self::default() };
        };
        let shorter = |look: &usize| (*look as f64 * LOOK_S) < whole_s - 1e-9;
        let steps: Vec<usize> = looked_after(whole_s).filter(shorter).collect();
        let times: Vec<f64> =
            steps.iter().map(|&look| look as f64 * LOOK_S).chain([whole_s]).collect();
        // If no trial can be tested for an unknown surface, no scan time needs to wait for the test.
        let judged = |trial: &FollowedTrial, step: usize| trial.looks[step - 1].p_value.is_some();
        let judges = trials.iter().any(|t| looked_after(t.drag_s).any(|step| judged(t, step)));
        let look = |trial: &FollowedTrial, at: usize| trial.looks.get(steps.get(at)? - 1).copied();
        let is_measured = |trial: &FollowedTrial, at: usize| {
            !judges || look(trial, at).is_none_or(|look| look.p_value.is_some())
        };
        let is_right = |trial: &FollowedTrial, at: usize| {
            look(trial, at).map_or(trial.whole, |look| look.class) == trial.truth
        };
        let measured = |at| trials.iter().filter(|trial| is_measured(trial, at)).count();
        let count = trials.iter().map(|trial| trial.group + 1).max().unwrap_or(0);
        let of_group = |group: usize| {
            let own = || trials.iter().filter(|trial| trial.group == group);
            let right = |at| own().filter(|trial| is_right(trial, at)).count();
            LeftOutGroup { trials: own().count(), right: (0..times.len()).map(right).collect() }
        };
        Self {
            measured: (0..times.len()).map(measured).collect(),
            groups: (0..count).map(of_group).filter(|group| group.trials > 0).collect(),
            times,
            library,
        }
    }

    pub fn trials(&self) -> usize {
        self.groups.iter().map(|group| group.trials).sum()
    }

    /// Accuracy by each time; the last is that by the whole length.
    pub fn points(&self) -> Vec<AccuracyAt> {
        (0..self.times.len()).map(|at| self.point(self.times[at], |_| at)).collect()
    }

    /// Accuracy if group g is measured at the scan time with index `at(g)`.
    fn point(&self, scan_s: f64, at: impl Fn(usize) -> usize) -> AccuracyAt {
        let counts: Vec<(usize, usize)> = (self.groups.iter().enumerate())
            .map(|(g, group)| (group.right[at(g)], group.trials))
            .collect();
        let share = counts.iter().map(|count| count.0).sum::<usize>() as f64 / self.trials() as f64;
        let (accuracy_low, accuracy_high) = match self.library.left_out {
            LeftOutBy::People | LeftOutBy::Sessions => wilson_of_groups(&counts),
            LeftOutBy::Trials => wilson(share, self.trials() as f64),
        };
        AccuracyAt { scan_s, accuracy: share, accuracy_low, accuracy_high }
    }

    /// Index of the earliest time such that, then and at all later times, all groups except `without`
    /// reach the goal and enough trials have a full answer; `None` if even whole trials miss the goal.
    fn earliest(&self, goal: Goal, without: Option<usize>) -> Option<usize> {
        let kept = || self.groups.iter().enumerate().filter(|(g, _)| Some(*g) != without);
        let trials: usize = kept().map(|(_, group)| group.trials).sum();
        let right = |at: usize| kept().map(|(_, group)| group.right[at]).sum::<usize>();
        let last = self.times.len() - 1;
        let share = |at: usize| right(at) as f64 / f64::max(trials as f64, 1.0);
        let (target, to_show) = (goal.target(share(last)), goal.target(1.0));
        let is_measured = |at: usize| at == last || can_show(self.measured[at], to_show);
        let enough = |at: &usize| share(*at) >= target - 1e-9 && is_measured(*at);
        (0..self.times.len()).rev().take_while(enough).last()
    }

    /// How long a scan must last to reach a goal.
    pub fn scan_time(&self, goal: Goal) -> ScanTime {
        let whole = self.points().last().copied();
        let trials = self.trials();
        let target = goal.target(whole.map_or(1.0, |whole| whole.accuracy));
        // All trials named right must be able to show it.
        let share = goal.target(1.0);
        let chance = chance(self.library.surfaces.iter().map(|(_, trials)| *trials));
        let at_chance = |accuracy| wilson(accuracy, trials as f64).0 <= chance;
        let (enough, shortfall) = match (trials > 0).then(|| self.earliest(goal, None)) {
            None => (None, Some(Shortfall::NothingLeftOut { lacking: self.lacking() })),
            Some(None) => (None, Some(Shortfall::NotReached)),
            // Whatever chance names at full length, it names as well at once. This is over trials: whether
            // names say anything at all, a few people show, too.
            Some(Some(_)) if whole.is_none_or(|whole| at_chance(whole.accuracy)) => {
                (None, Some(Shortfall::AtChance { chance }))
            }
            Some(Some(_)) if !can_show(trials, share) => {
                let needed = (trials..).find(|&n| can_show(n, share)).unwrap_or(trials);
                (whole, Some(Shortfall::TooFewTrials { share, more: needed - trials }))
            }
            Some(Some(at)) => (Some(self.cross_fitted(goal, at, target)), None),
        };
        let LibraryCounts { people, left_out, .. } = self.library;
        ScanTime { target, enough, whole, trials, people, left_out, shortfall }
    }

    /// The earliest time, from index `at` on, with a cross-fitted accuracy that reaches the target; if
    /// there is none, the whole length.
    fn cross_fitted(&self, goal: Goal, at: usize, target: f64) -> AccuracyAt {
        let last = self.times.len() - 1;
        let without = |g: usize| self.earliest(goal, Some(g)).unwrap_or(last);
        let chosen: Vec<usize> = (0..self.groups.len()).map(without).collect();
        let later =
            |by: usize| self.point(self.times[(at + by).min(last)], |g| (chosen[g] + by).min(last));
        let reaches = |point: &AccuracyAt| point.accuracy >= target - 1e-9;
        (0..last).map(later).find(reaches).unwrap_or_else(|| later(last))
    }

    /// Surfaces with too few trials to leave one out, and the number of trials that each lacks.
    fn lacking(&self) -> Vec<(String, usize)> {
        let lacks = |(surface, trials): &(String, usize)| {
            (surface.clone(), 2_usize.saturating_sub(*trials))
        };
        self.library.surfaces.iter().map(lacks).filter(|(_, lacks)| *lacks > 0).collect()
    }
}

impl ScanTime {
    /// The answer if the trials cannot be compared with each other, because of `why`.
    pub fn without_model(goal: Goal, why: String) -> Self {
        let shortfall = Some(Shortfall::NoModel(why));
        Self { shortfall, ..LeftOutAccuracy::default().scan_time(goal) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recognise::decide::settle::LeftOutLook;

    /// A trial that is named right at each look where `right` is true, and is tested for an unknown
    /// surface from the look `judged_from` on.
    fn trial(
        group: usize,
        drag_s: f64,
        right: impl Fn(usize) -> bool,
        judged_from: usize,
        right_whole: bool,
    ) -> FollowedTrial {
        let look = |look: usize| LeftOutLook {
            class: usize::from(!right(look)),
            probability: 1.0,
            p_value: (look >= judged_from).then_some(0.5),
        };
        let looks = (1..=looks_in(drag_s)).map(look).collect();
        FollowedTrial { group, truth: 0, whole: usize::from(!right_whole), drag_s, looks }
    }

    /// `trials` trials of 2 s in ten groups; trial i is named right from `right_from(i)` s on.
    fn accuracy(trials: usize, right_from: impl Fn(usize) -> f64) -> LeftOutAccuracy {
        let scan = |i: usize| {
            let right = |look: usize| look as f64 * LOOK_S >= right_from(i) - 1e-9;
            trial(i % 10, 2.0, right, 1, right_from(i) <= 2.0)
        };
        let scans: Vec<FollowedTrial> = (0..trials).map(scan).collect();
        let surfaces = vec![("ash".into(), trials / 2), ("oak".into(), trials / 2)];
        LeftOutAccuracy::new(
            &scans,
            LibraryCounts { people: 1, left_out: LeftOutBy::Trials, surfaces },
        )
    }

    #[test]
    fn looks_are_a_step_apart_at_first_and_then_a_share_of_the_time() {
        let all: Vec<usize> = looked_after(4.8).collect();
        assert_eq!(all[..10], [1, 2, 3, 4, 5, 6, 7, 8, 9, 10]);
        assert!(all.windows(2).all(|w| w[0] < w[1] && w[1] as f64 <= 1.15 * w[0] as f64 + 1.0));
        assert_eq!(looked_after(0.05).count(), 0);
        assert_eq!(looked_after(0.3).count(), 3);
    }

    #[test]
    fn the_scan_time_is_the_earliest_from_which_on_the_goal_is_kept() {
        let mostly = accuracy(200, |i| if i % 51 == 0 { 1.0 } else { 0.5 });
        let found = |goal| mostly.scan_time(goal).enough.unwrap();
        assert!((found(Goal::Accuracy(0.95)).scan_s - 0.5).abs() < 1e-9);
        let all = found(Goal::Loss(0.01));
        assert!((all.scan_s - 1.0).abs() < 1e-9 && all.accuracy == 1.0 && all.accuracy_low < 1.0);
        // Right at 0.5 s, but wrong again at 0.8 s: the scan must last longer than 0.8 s.
        let mut relapse = mostly;
        relapse.groups.iter_mut().for_each(|group| group.right[7] = 0);
        let found = relapse.scan_time(Goal::Accuracy(0.95)).enough.unwrap();
        assert!((found.scan_s - 0.9).abs() < 1e-9, "{found:?}");
    }

    #[test]
    fn the_stated_accuracy_is_of_trials_that_did_not_choose_the_time() {
        // Only one group needs longer; the other groups choose a time at which it is still wrong.
        let late = accuracy(200, |i| if i % 10 == 3 { 1.5 } else { 0.5 });
        let lenient = late.scan_time(Goal::Accuracy(0.9)).enough.unwrap();
        assert!((lenient.scan_s - 0.5).abs() < 1e-9 && lenient.accuracy == 0.9, "{lenient:?}");
        // At these times a tenth is lost, so all times move later until this group is right too.
        let found = late.scan_time(Goal::Loss(0.01)).enough.unwrap();
        assert!(found.scan_s == 2.0 && found.accuracy == 1.0, "{found:?}");
    }

    #[test]
    fn a_scan_is_never_shorter_than_one_that_can_be_told_from_an_unknown_surface() {
        let scans: Vec<_> = (0..200).map(|i| trial(i % 10, 2.0, |_| true, 7, true)).collect();
        let found = LeftOutAccuracy::new(&scans, LibraryCounts::default());
        let found = found.scan_time(Goal::Loss(0.01)).enough.unwrap();
        assert!((found.scan_s - 0.7).abs() < 1e-9, "{found:?}");
    }

    #[test]
    fn a_goal_that_whole_trials_miss_has_no_scan_time() {
        let poor = accuracy(200, |i| if i % 5 == 0 { 9.0 } else { 0.5 });
        let answer = poor.scan_time(Goal::Accuracy(0.9));
        assert_eq!((answer.enough, answer.shortfall.clone()), (None, Some(Shortfall::NotReached)));
        assert_eq!(answer.scan_s(), None);
        assert!((poor.scan_time(Goal::Loss(0.01)).enough.unwrap().accuracy - 0.8).abs() < 1e-9);
        let few = accuracy(10, |i| if i < 4 { 9.0 } else { 0.1 }).scan_time(Goal::Loss(0.01));
        assert_eq!(few.shortfall, Some(Shortfall::AtChance { chance: 0.5 }), "few as they are");
        // Every second of two surfaces' trials is named right, from the first look on.
        let chance = accuracy(200, |i| if i / 10 % 2 == 0 { 9.0 } else { 0.1 });
        let answer = chance.scan_time(Goal::Loss(0.01));
        assert_eq!(answer.shortfall, Some(Shortfall::AtChance { chance: 0.5 }));
        assert!(
            answer.line().contains("50.0 % of 200 left-out scans (43.1 to 56.9) are named right")
        );
    }

    #[test]
    fn too_few_trials_ask_for_the_whole_length_and_say_how_many_more() {
        let few = accuracy(10, |_| 0.1).scan_time(Goal::Loss(0.01));
        let Some(Shortfall::TooFewTrials { more, .. }) = few.shortfall else { panic!("{few:?}") };
        assert!(can_show(10 + more, 0.99) && !can_show(9 + more, 0.99));
        assert_eq!(few.scan_s(), Some(2.0), "the whole length until then");
        let poor = accuracy(10, |i| if i == 3 { 9.0 } else { 0.1 }).scan_time(Goal::Accuracy(0.99));
        assert_eq!((poor.scan_s(), poor.shortfall), (None, Some(Shortfall::NotReached)));
        let surfaces = vec![("ash".to_string(), 1), ("oak".to_string(), 2)];
        let counts = LibraryCounts { people: 1, left_out: LeftOutBy::Trials, surfaces };
        let none = LeftOutAccuracy::new(&[], counts).scan_time(Goal::Loss(0.01));
        let lacking = vec![("ash".to_string(), 1)];
        assert_eq!(none.shortfall, Some(Shortfall::NothingLeftOut { lacking }));
    }

    #[test]
    fn short_trials_count_by_their_whole_length() {
        let scan = |scan_s: f64, right: bool| trial(0, scan_s, |_| !right, 1, right);
        let scans = [scan(0.3, true), scan(1.0, false), scan(1.0, false)];
        let points = LeftOutAccuracy::new(&scans, LibraryCounts::default()).points();
        assert!((points[0].accuracy - 2.0 / 3.0).abs() < 1e-9, "{points:?}");
        assert_eq!(points[3].accuracy, 1.0, "the short one is right by now");
        assert!((points.last().unwrap().accuracy - 1.0 / 3.0).abs() < 1e-9);
    }
}
