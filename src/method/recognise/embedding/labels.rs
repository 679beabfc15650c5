//! Labels of a library's trials for training: their classes, and the groups to leave out.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use crate::features::frames::{Prints, TrialFrames};
use crate::recognise::decide::LeftOutBy;
use crate::trial::{TrialKey, sessions_count};

/// At most this many groups of trials are left out, one at a time.
const MOST_GROUPS: usize = 10;

/// Fewest equal windows of two trials, and the least share of the windows that are kept. A few short runs
/// of a sensor at rest are equal by chance.
const FEWEST: usize = 2;
const LEAST_SHARE: f64 = 0.1;

/// Classes and groups of the trials of a library. They depend on the order of the trials, and on which
/// of them share a surface, a person or a session, never on names or numbers.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Labels {
    pub surfaces: Vec<String>,
    /// Class of each trial: the index of its surface.
    pub class: Vec<usize>,
    pub classes: usize,
    /// Group of each trial. The trials of a group are left out together.
    pub group: Vec<usize>,
    pub groups: usize,
    pub left_out: LeftOutBy,
    /// For each trial, the first one with which it shares samples.
    pub together: Vec<usize>,
}

impl Labels {
    /// Groups are users if most trials can then be named by the other users' trials; if not, sessions
    /// if they count ([`sessions_count`]); if not, a group takes one trial of each user and surface. If
    /// there are too many groups, several are joined. Trials that share samples are in one group.
    pub(super) fn new(keys: &[&TrialKey], together: Vec<usize>) -> Self {
        let (surfaces, class) = appearances(keys.iter().map(|key| key.surface.as_str()));
        let joined = |groups: &[usize]| -> Vec<usize> {
            together.iter().map(|&first| groups[first] % MOST_GROUPS).collect()
        };
        let tells = |group: &Vec<usize>| {
            group.iter().any(|&other| other != group[0])
                && known_elsewhere(&class, group) * 2 > keys.len()
        };
        let by_user = joined(&appearances(keys.iter().map(|key| key.user.as_str())).1);
        let (group, left_out) = if tells(&by_user) {
            (by_user, LeftOutBy::People)
        } else if sessions_count(keys.iter().copied()) {
            let sessions = keys.iter().map(|key| key.of_session());
            (joined(&appearances(sessions).1), LeftOutBy::Sessions)
        } else {
            let owners = keys.iter().map(|key| (key.user.as_str(), key.surface.as_str()));
            let mut counts = BTreeMap::new();
            let of_trial = |(trial, owner)| {
                let count: &mut usize = counts.entry(owner).or_default();
                // One that shares samples takes the group of another.
                *count += usize::from(together[trial] == trial);
                count.saturating_sub(1)
            };
            let groups: Vec<usize> = owners.enumerate().map(of_trial).collect();
            (joined(&groups), LeftOutBy::Trials)
        };
        Self {
            classes: surfaces.len(),
            surfaces: surfaces.into_iter().map(String::from).collect(),
            class,
            groups: group.iter().max().map_or(0, |last| last + 1),
            group,
            left_out,
            together,
        }
    }
}

/// The distinct values in the order in which they first appear, and the index of each value among them.
pub(in crate::recognise) fn appearances<T: Copy + Ord>(
    values: impl Iterator<Item = T>,
) -> (Vec<T>, Vec<usize>) {
    let (mut distinct, mut known) = (Vec::new(), BTreeMap::new());
    let place = |value| {
        *known.entry(value).or_insert_with(|| {
            distinct.push(value);
            distinct.len() - 1
        })
    };
    let places = values.map(place).collect();
    (distinct, places)
}

/// The distinct values, sorted, and the index of each value among them.
pub(in crate::recognise) fn places<T: Copy + Ord>(
    values: impl Iterator<Item = T> + Clone,
) -> (Vec<T>, Vec<usize>) {
    let mut distinct: Vec<T> = values.clone().collect();
    distinct.sort_unstable();
    distinct.dedup();
    // Always found, since the list holds these values.
    let place = |value| distinct.binary_search(&value).unwrap_or(0);
    let places = values.map(place).collect();
    (distinct, places)
}

/// How many trials could be named if their group were left out. The other groups must have the class
/// of the trial, one more class, and at least a third of all trials.
fn known_elsewhere(class: &[usize], group: &[usize]) -> usize {
    let groups = group.iter().max().map_or(0, |last| last + 1);
    let classes = class.iter().max().map_or(0, |last| last + 1);
    let of_group = |left_out: usize| {
        let mut trials = vec![0; classes];
        let rest = class.iter().zip(group).filter(|(_, group)| **group != left_out);
        rest.for_each(|(&class, _)| trials[class] += 1);
        let known = trials.iter().filter(|&&n| n > 0).count();
        if known < 2 || 3 * trials.iter().sum::<usize>() < class.len() {
            return 0;
        }
        let members = class.iter().zip(group).filter(|(_, group)| **group == left_out);
        members.filter(|(class, _)| trials[**class] > 0).count()
    };
    (0..groups).map(of_group).sum()
}

/// For each trial, the first one with which it shares samples, directly or by way of others. Trials that
/// do, such as copies, or excerpts that overlap, are left out together, since naming one by the other
/// says nothing of new scans.
pub(super) fn together(library: &[Arc<TrialFrames>]) -> Vec<usize> {
    let mut first: Vec<usize> = (0..library.len()).collect();
    let mut wholes = HashMap::new();
    let mut windows: HashMap<_, Vec<usize>> = HashMap::new();
    for (trial, frames) in library.iter().enumerate() {
        for (source, Prints(whole, of_windows)) in &frames.prints {
            if let Some(whole) = whole {
                join(&mut first, *wholes.entry((source, whole)).or_insert(trial), trial);
            }
            for window in of_windows {
                windows.entry((source, window)).or_default().push(trial);
            }
        }
    }
    let mut shared: BTreeMap<_, usize> = BTreeMap::new();
    for ((source, _), trials) in &windows {
        for other in &trials[1..] {
            *shared.entry((trials[0], *other, *source)).or_default() += 1;
        }
    }
    for ((one, other, source), count) in shared {
        let kept = [one, other].map(|trial| library[trial].prints[source].1.len());
        let least = (LEAST_SHARE * kept[0].min(kept[1]) as f64).ceil() as usize;
        if count >= least.max(FEWEST) {
            join(&mut first, one, other);
        }
    }
    (0..library.len()).map(|trial| root(&first, trial)).collect()
}

fn root(first: &[usize], mut trial: usize) -> usize {
    while first[trial] != trial {
        trial = first[trial];
    }
    trial
}

fn join(first: &mut [usize], one: usize, other: usize) {
    let (a, b) = (root(first, one), root(first, other));
    first[a.max(b)] = a.min(b);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(keys: &[TrialKey]) -> Labels {
        Labels::new(&keys.iter().collect::<Vec<_>>(), (0..keys.len()).collect())
    }

    fn keys(users: &[(&str, u32)]) -> Vec<TrialKey> {
        let of_surface = |surface: &'static str| {
            users.iter().flat_map(move |&(user, trials)| {
                (1..=trials).map(move |n| TrialKey::new(surface, user, n))
            })
        };
        ["ash", "oak"].into_iter().flat_map(of_surface).collect()
    }

    #[test]
    fn one_persons_trials_are_left_out_by_number() {
        let labels = labels(&keys(&[("expert", 3)]));
        assert_eq!((labels.groups, labels.left_out), (3, LeftOutBy::Trials));
        assert_eq!(labels.group, [0, 1, 2, 0, 1, 2]);
        assert_eq!(labels.class, [0, 0, 0, 1, 1, 1]);
    }

    #[test]
    fn several_peoples_trials_are_left_out_person_by_person() {
        let labels = labels(&keys(&[("anna", 2), ("expert", 3)]));
        assert_eq!((labels.groups, labels.left_out), (2, LeftOutBy::People));
        assert_eq!(labels.group, [0, 0, 1, 1, 1, 0, 0, 1, 1, 1]);
    }

    #[test]
    fn sessions_of_one_person_are_left_out_together() {
        let keys: Vec<_> = (keys(&[("expert", 4)]).into_iter())
            .map(|key| TrialKey {
                session: Some(if key.number < 3 { "a" } else { "b" }.into()),
                ..key
            })
            .collect();
        let labels = labels(&keys);
        assert_eq!(
            (labels.group, labels.left_out),
            (vec![0, 0, 1, 1, 0, 0, 1, 1], LeftOutBy::Sessions)
        );
    }

    #[test]
    fn other_names_and_numbers_make_the_same_classes_and_groups() {
        let named = keys(&[("anna", 2), ("expert", 3)]);
        let renamed: Vec<TrialKey> = (named.iter())
            .map(|key| {
                let surface = if key.surface == "ash" { "zinc" } else { "beech" };
                let user = if key.user == "anna" { "x" } else { "b" };
                TrialKey::new(surface, user, 100 - key.number)
            })
            .collect();
        let (a, b) = (labels(&named), labels(&renamed));
        assert_eq!((a.class, a.group), (b.class, b.group));
    }

    #[test]
    fn a_person_with_a_trial_or_two_does_not_make_a_library_of_several_people() {
        let mut few = keys(&[("expert", 5)]);
        few.insert(0, TrialKey::new("ash", "anna", 1));
        assert_eq!(labels(&few).left_out, LeftOutBy::Trials);
    }
}
