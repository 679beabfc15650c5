//! Finds how long a scan must last: the earliest time from which on left-out library trials are
//! named as accurately as wanted.
//!
//! Every trial is left out in turn, together with all others of its person if the library has
//! several people, and is named after each of a list of scan times. [`LeftOutAccuracy`] holds the
//! share named right by each time, from which [`LeftOutAccuracy::scan_time`] reads the answer.
//! `surfaced duration`, `plan`, `replay`, `run` and the countdowns all use this one number. It is
//! never shorter than the first time by which enough trials could be tested for an unknown surface,
//! since a shorter scan has no full answer. If there are too few trials to show the accuracy, it is
//! their whole length.
//!
//! The accuracy would be flattered if the trials that choose the time also stated it. So it is
//! cross-fitted: for each group of trials, all other groups choose the time at which the group is
//! counted. While that misses the goal, all these times move later, one step at a time. With
//! several people, a group is a person, and the interval is over people, not trials.

mod answer;

pub use answer::{AccuracyAt, Goal, ScanTime, Shortfall};

use super::interval::{can_show, wilson, wilson_of_groups};
use crate::recognise::follow::LOOK_S;

/// Largest ratio of successive scan times; the first ones are one look (0.1 s) apart.
const RATIO: f64 = 1.15;

/// The looks (steps of 0.1 s, counted from 1) after which a trial of `scan_s` seconds is named.
pub fn looked_after(scan_s: f64) -> impl Iterator<Item = usize> {
    let last = (scan_s / LOOK_S + 1e-9).floor() as usize;
    let next = |&look: &usize| Some((look + 1).max((look as f64 * RATIO) as usize));
    std::iter::successors(Some(1), next).take_while(move |look| *look <= last)
}

/// A left-out trial.
#[derive(Clone, Debug, PartialEq)]
pub struct LeftOutScan {
    /// The group that it was left out with.
    pub group: usize,
    /// How long its drag lasts, in seconds.
    pub scan_s: f64,
    /// Whether it was named correctly after each time of [`looked_after`].
    pub right: Vec<bool>,
    /// Whether it could be tested for an unknown surface after each time of [`looked_after`].
    pub judged: Vec<bool>,
    /// Whether it was named right by its whole length.
    pub right_whole: bool,
}

/// The people and surfaces of a library: for whom the accuracy holds, and what is lacking.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LibraryCounts {
    pub people: usize,
    /// Whether each person was left out in turn.
    pub across_people: bool,
    /// Its surfaces, with the number of trials of each.
    pub surfaces: Vec<(String, usize)>,
}

/// Trials that were left out together: how many there are, and how many are named right by each
/// time, the last time being their whole length.
#[derive(Clone, Debug, PartialEq)]
struct LeftOutGroup {
    trials: usize,
    right: Vec<usize>,
}

/// How many left-out trials are named right by each scan time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LeftOutAccuracy {
    /// Scan times in seconds, rising; the median length of the trials comes last and stands for
    /// their whole length.
    times: Vec<f64>,
    /// Trials with a full answer by each time: a name, and a test for an unknown surface.
    measured: Vec<usize>,
    groups: Vec<LeftOutGroup>,
    library: LibraryCounts,
}

impl LeftOutAccuracy {
    /// Counts the trials named right by each time; a trial shorter than that, by its whole length.
    pub(crate) fn new(scans: &[LeftOutScan], library: LibraryCounts) -> Self {
        let mut lengths: Vec<f64> = scans.iter().map(|scan| scan.scan_s).collect();
        lengths.sort_by(f64::total_cmp);
        let Some(&whole_s) = lengths.get(lengths.len() / 2) else {
            return Self { library, ..Self::default() };
        };
        let mut times: Vec<f64> = looked_after(whole_s).map(|look| look as f64 * LOOK_S).collect();
        times.retain(|time| *time < whole_s - 1e-9);
        let shorter = times.len();
        times.push(whole_s);
        let count = scans.iter().map(|scan| scan.group + 1).max().unwrap_or(0);
        let mut groups = vec![LeftOutGroup { trials: 0, right: vec![0; times.len()] }; count];
        // If no trial can be tested for an unknown surface, nobody waits for such a test.
        let judges = scans.iter().any(|scan| scan.judged.contains(&true));
        let is_measured = |scan: &LeftOutScan, at: usize| {
            let judged = scan.judged.get(at).filter(|_| judges && at < shorter);
            judged.copied().unwrap_or(true)
        };
        let measured = |at| scans.iter().filter(|scan| is_measured(scan, at)).count();
        let measured = (0..times.len()).map(measured).collect();
        for scan in scans {
            let group = &mut groups[scan.group];
            group.trials += 1;
            let by = |at: usize| scan.right.get(at).filter(|_| at < shorter);
            for (at, right) in group.right.iter_mut().enumerate() {
                *right += usize::from(*by(at).unwrap_or(&scan.right_whole));
            }
        }
        groups.retain(|group| group.trials > 0);
        Self { times, measured, groups, library }
    }

    /// Number of left-out trials.
    pub fn trials(&self) -> usize {
        self.groups.iter().map(|group| group.trials).sum()
    }

    /// Median length of the trials, in seconds.
    pub fn whole_s(&self) -> Option<f64> {
        self.times.last().copied()
    }

    /// Accuracy by each time; the last is that by the whole length.
    pub fn points(&self) -> Vec<AccuracyAt> {
        (0..self.times.len()).map(|at| self.point(self.times[at], |_| at)).collect()
    }

    /// Accuracy where group g is counted at the time with index `at(g)`.
    fn point(&self, scan_s: f64, at: impl Fn(usize) -> usize) -> AccuracyAt {
        let counts: Vec<(usize, usize)> = self
            .groups
            .iter()
            .enumerate()
            .map(|(g, group)| (group.right[at(g)], group.trials))
            .collect();
        let share = counts.iter().map(|count| count.0).sum::<usize>() as f64 / self.trials() as f64;
        let (accuracy_low, accuracy_high) = match self.library.across_people {
            true => wilson_of_groups(&counts),
            false => wilson(share, self.trials() as f64),
        };
        AccuracyAt { scan_s, accuracy: share, accuracy_low, accuracy_high }
    }

    /// Index of the earliest time from which on the groups except `without` reach the goal and
    /// enough trials have a full answer; `None` if even their whole length misses the goal.
    fn earliest(&self, goal: Goal, without: Option<usize>) -> Option<usize> {
        let kept = || self.groups.iter().enumerate().filter(|(g, _)| Some(*g) != without);
        let trials: usize = kept().map(|(_, group)| group.trials).sum();
        let right = |at: usize| kept().map(|(_, group)| group.right[at]).sum::<usize>();
        let last = self.times.len() - 1;
        let share = |at: usize| right(at) as f64 / f64::max(trials as f64, 1.0);
        let target = match goal {
            Goal::Accuracy(target) => target,
            Goal::Loss(loss) => share(last) - loss,
        };
        let is_measured = |at: usize| at == last || can_show(self.measured[at], goal.to_show());
        let enough = |at: &usize| share(*at) >= target - 1e-9 && is_measured(*at);
        (0..self.times.len()).rev().take_while(enough).last()
    }

    /// The answer for a goal.
    pub fn scan_time(&self, goal: Goal) -> ScanTime {
        let whole = self.points().last().copied();
        let trials = self.trials();
        let target = match goal {
            Goal::Accuracy(share) => share,
            Goal::Loss(loss) => whole.map_or(1.0, |whole| whole.accuracy) - loss,
        };
        let mut answer = ScanTime {
            target,
            enough: None,
            whole,
            trials,
            people: self.library.people,
            across_people: self.library.across_people,
            shortfall: None,
        };
        let share = goal.to_show();
        if trials == 0 {
            answer.shortfall = Some(Shortfall::NothingLeftOut { lacking: self.lacking() });
            return answer;
        }
        match self.earliest(goal, None) {
            None => answer.shortfall = Some(Shortfall::NotReached),
            Some(_) if !can_show(trials, share) => {
                let needed = (trials..).find(|&n| can_show(n, share)).unwrap_or(trials);
                answer.shortfall = Some(Shortfall::TooFewTrials { share, more: needed - trials });
                answer.enough = whole;
            }
            Some(at) => answer.enough = Some(self.cross_fitted(goal, at, target)),
        }
        answer
    }

    /// The earliest time, from index `at` on, whose cross-fitted accuracy reaches the target; at
    /// the latest the whole length.
    fn cross_fitted(&self, goal: Goal, at: usize, target: f64) -> AccuracyAt {
        let last = self.times.len() - 1;
        let without = |g: usize| self.earliest(goal, Some(g)).unwrap_or(last);
        let chosen: Vec<usize> = (0..self.groups.len()).map(without).collect();
        let later =
            |by: usize| self.point(self.times[(at + by).min(last)], |g| (chosen[g] + by).min(last));
        let reaches = |point: &AccuracyAt| point.accuracy >= target - 1e-9;
        (0..last).map(later).find(reaches).unwrap_or_else(|| later(last))
    }

    /// Surfaces that have too few trials for one to be left out, with the number that they lack.
    fn lacking(&self) -> Vec<(String, usize)> {
        let lacks = |(surface, trials): &(String, usize)| {
            (surface.clone(), 2_usize.saturating_sub(*trials))
        };
        self.library.surfaces.iter().map(lacks).filter(|(_, lacks)| *lacks > 0).collect()
    }
}

impl ScanTime {
    /// The answer for trials that cannot be compared with each other.
    pub(crate) fn without_model(goal: Goal, why: String) -> Self {
        let shortfall = Some(Shortfall::NoModel(why));
        Self { shortfall, ..LeftOutAccuracy::default().scan_time(goal) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `trials` trials of 2 s in ten groups; trial i is named right from `right_from(i)` s on.
    fn accuracy(trials: usize, right_from: impl Fn(usize) -> f64) -> LeftOutAccuracy {
        let scan = |i: usize| LeftOutScan {
            group: i % 10,
            scan_s: 2.0,
            right: looked_after(2.0)
                .map(|look| look as f64 * LOOK_S >= right_from(i) - 1e-9)
                .collect(),
            judged: vec![true; looked_after(2.0).count()],
            right_whole: right_from(i) <= 2.0,
        };
        let scans: Vec<LeftOutScan> = (0..trials).map(scan).collect();
        let surfaces = vec![("ash".into(), trials / 2), ("oak".into(), trials / 2)];
        LeftOutAccuracy::new(&scans, LibraryCounts { people: 1, across_people: false, surfaces })
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
        // Right at 0.5 s, but wrong again at 0.8 s: the scan must last longer than that.
        let mut relapse = mostly;
        relapse.groups.iter_mut().for_each(|group| group.right[7] = 0);
        let found = relapse.scan_time(Goal::Accuracy(0.95)).enough.unwrap();
        assert!((found.scan_s - 0.9).abs() < 1e-9, "{found:?}");
    }

    #[test]
    fn the_stated_accuracy_is_of_trials_that_did_not_choose_the_time() {
        // Only one group needs longer: without it, the others choose a time at which it is wrong.
        let late = accuracy(200, |i| if i % 10 == 3 { 1.5 } else { 0.5 });
        let lenient = late.scan_time(Goal::Accuracy(0.9)).enough.unwrap();
        assert!((lenient.scan_s - 0.5).abs() < 1e-9 && lenient.accuracy == 0.9, "{lenient:?}");
        // Times chosen like that lose a tenth, so all move later until that group is right, too.
        let found = late.scan_time(Goal::Loss(0.01)).enough.unwrap();
        assert!(found.scan_s == 2.0 && found.accuracy == 1.0, "{found:?}");
    }

    #[test]
    fn a_scan_is_never_shorter_than_one_that_can_be_told_from_an_unknown_surface() {
        let scan = |i: usize| LeftOutScan {
            group: i % 10,
            scan_s: 2.0,
            right: vec![true; looked_after(2.0).count()],
            judged: looked_after(2.0).map(|look| look >= 7).collect(),
            right_whole: true,
        };
        let scans: Vec<LeftOutScan> = (0..200).map(scan).collect();
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
        let counts = LibraryCounts { people: 1, across_people: false, surfaces };
        let none = LeftOutAccuracy::new(&[], counts).scan_time(Goal::Loss(0.01));
        let lacking = vec![("ash".to_string(), 1)];
        assert_eq!(none.shortfall, Some(Shortfall::NothingLeftOut { lacking }));
    }

    #[test]
    fn short_trials_count_by_their_whole_length() {
        let scan = |scan_s: f64, right: bool| LeftOutScan {
            group: 0,
            scan_s,
            right: looked_after(scan_s).map(|_| !right).collect(),
            judged: looked_after(scan_s).map(|_| true).collect(),
            right_whole: right,
        };
        let scans = [scan(0.3, true), scan(1.0, false), scan(1.0, false)];
        let points = LeftOutAccuracy::new(&scans, LibraryCounts::default()).points();
        assert!((points[0].accuracy - 2.0 / 3.0).abs() < 1e-9, "{points:?}");
        assert_eq!(points[3].accuracy, 1.0, "the short one is right by now");
        assert!((points.last().unwrap().accuracy - 1.0 / 3.0).abs() < 1e-9);
    }
}
