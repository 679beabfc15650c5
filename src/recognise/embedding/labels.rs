//! Labels of a library's trials for training: their classes, and the groups to leave out.

use crate::trial::TrialKey;

/// At most this many groups of trials are left out, one at a time.
const MOST_GROUPS: usize = 10;

/// Classes and groups of the trials of a library, sorted by key.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Labels {
    pub surfaces: Vec<String>,
    /// Class of each trial: the index of its surface.
    pub class: Vec<usize>,
    pub classes: usize,
    /// Group of each trial. The trials of a group are left out together.
    pub group: Vec<usize>,
    pub groups: usize,
    /// Whether groups are users, so that results on left-out trials hold for other people, too.
    pub across_users: bool,
}

impl Labels {
    /// Groups are users if most trials can then be named by the other users' trials. If not, a group
    /// is the trials of one user with one number. If there are too many groups, several are joined.
    pub(super) fn new(keys: &[&TrialKey]) -> Self {
        let (surfaces, class) = places(keys.iter().map(|key| key.surface.as_str()));
        let (users, user) = places(keys.iter().map(|key| key.user.as_str()));
        let (_, session) = places(keys.iter().map(|key| (key.user.as_str(), key.number)));
        let joined = |groups: Vec<usize>| -> Vec<usize> {
            groups.into_iter().map(|group| group % MOST_GROUPS).collect()
        };
        let by_user = joined(user);
        let across_users = users.len() > 1 && known_elsewhere(&class, &by_user) * 2 > keys.len();
        let group = if across_users { by_user } else { joined(session) };
        Self {
            classes: surfaces.len(),
            surfaces: surfaces.into_iter().map(String::from).collect(),
            class,
            groups: group.iter().max().map_or(0, |last| last + 1),
            group,
            across_users,
        }
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(keys: &[TrialKey]) -> Labels {
        Labels::new(&keys.iter().collect::<Vec<_>>())
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
        assert_eq!((labels.groups, labels.across_users), (3, false));
        assert_eq!(labels.group, [0, 1, 2, 0, 1, 2]);
        assert_eq!(labels.class, [0, 0, 0, 1, 1, 1]);
    }

    #[test]
    fn several_peoples_trials_are_left_out_person_by_person() {
        let labels = labels(&keys(&[("anna", 2), ("expert", 3)]));
        assert_eq!((labels.groups, labels.across_users), (2, true));
        assert_eq!(labels.group, [0, 0, 1, 1, 1, 0, 0, 1, 1, 1]);
    }

    #[test]
    fn a_person_with_a_trial_or_two_does_not_make_a_library_of_several_people() {
        let mut few = keys(&[("expert", 5)]);
        few.insert(0, TrialKey::new("ash", "anna", 1));
        assert!(!labels(&few).across_users);
    }
}
