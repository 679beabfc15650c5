//! Splits trials into queries and library, fold by fold (method.md §3).

use std::collections::{BTreeMap, BTreeSet};

use super::EvaluateError;
use crate::trial::{EXPERT, TrialKey};

/// How trials are split into queries and library.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Protocol {
    /// The library is the expert's trials; each fold names the trials of one other user (1 vs 10)
    ExpertVsUsers,
    /// Fold k names trial k of every surface; the library is the same person's other trials (1 vs 1)
    LeaveOneTrialOut,
    /// Each fold names the trials of one user; the library is everybody else's trials (10 vs 1)
    AllVsOneUser,
}

impl Protocol {
    /// All protocols, in order of preference.
    pub const ALL: [Self; 3] = [Self::ExpertVsUsers, Self::LeaveOneTrialOut, Self::AllVsOneUser];

    /// The first of [`Self::ALL`] that fits the trials.
    pub(crate) fn fitting(keys: &[TrialKey]) -> Option<Self> {
        Self::ALL.into_iter().find(|protocol| enough(&protocol.split(keys), keys))
    }

    pub(crate) fn folds_are_users(self) -> bool {
        matches!(self, Self::ExpertVsUsers | Self::AllVsOneUser)
    }

    pub fn name(self) -> &'static str {
        match self {
            Self::ExpertVsUsers => "expert-vs-users",
            Self::LeaveOneTrialOut => "leave-one-trial-out",
            Self::AllVsOneUser => "all-vs-one-user",
        }
    }

    fn split(self, keys: &[TrialKey]) -> Vec<Fold> {
        let users = || keys.iter().map(|key| &*key.user).filter(|user| *user != EXPERT).collect();
        let groups = match self {
            Self::ExpertVsUsers => by_user(keys, users(), |key, _| key.user == EXPERT),
            Self::AllVsOneUser => by_user(keys, users(), |key, user| key.user != user),
            Self::LeaveOneTrialOut => by_trial(keys),
        };
        groups.into_iter().filter_map(|fold| known_only(fold, keys)).collect()
    }

    fn needs(self) -> &'static str {
        match self {
            Self::ExpertVsUsers => {
                "trials of at least two surfaces by `expert`, and trials of them by other users"
            }
            Self::LeaveOneTrialOut => {
                "at least two surfaces with at least two trials each by one person"
            }
            Self::AllVsOneUser => {
                "trials of at least two surfaces by at least two people, one of them not `expert`"
            }
        }
    }
}

/// Queries, and the library that they are compared with. Trials are given by their indices.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fold {
    /// Name of the user or trial that is left out.
    pub name: String,
    pub library: Vec<usize>,
    /// The trials to name. The library has other trials of the same surfaces.
    pub queries: Vec<usize>,
}

/// Whether there is a fold, and each fold's library has at least two surfaces.
pub(super) fn enough(folds: &[Fold], keys: &[TrialKey]) -> bool {
    let surfaces =
        |fold: &Fold| fold.library.iter().map(|&i| &keys[i].surface).collect::<BTreeSet<_>>().len();
    !folds.is_empty() && folds.iter().all(|fold| surfaces(fold) >= 2)
}

/// Splits trials into folds. Drops queries of surfaces that the fold's library lacks, since they
/// could not be named correctly, and then drops folds without queries.
///
/// # Errors
/// If no fold remains, or a library has fewer than two surfaces.
pub fn folds(protocol: Protocol, keys: &[TrialKey]) -> Result<Vec<Fold>, EvaluateError> {
    let folds = protocol.split(keys);
    if enough(&folds, keys) {
        return Ok(folds);
    }
    let fits = Protocol::fitting(keys).map(|other| format!("; {} fits them", other.name()));
    let count = |of: fn(&TrialKey) -> &str| keys.iter().map(of).collect::<BTreeSet<_>>().len();
    Err(EvaluateError::Trials(format!(
        "the protocol {} needs {}; the data hold {} trial(s) of {} surface(s) by {} user(s), {} \
         trial(s) by `expert`{}",
        protocol.name(),
        protocol.needs(),
        keys.len(),
        count(|key| &key.surface),
        count(|key| &key.user),
        keys.iter().filter(|key| key.user == EXPERT).count(),
        fits.unwrap_or_default()
    )))
}

/// A key for sorting names, by which `user2` comes before `user10`.
fn natural(name: &str) -> (&str, u64) {
    let digits = name.bytes().rev().take_while(u8::is_ascii_digit).count();
    let (stem, number) = name.split_at(name.len() - digits);
    (stem, number.parse().unwrap_or(0))
}

/// One fold for each of `users`, whose trials are its queries.
pub(super) fn by_user(
    keys: &[TrialKey],
    users: BTreeSet<&str>,
    in_library: impl Fn(&TrialKey, &str) -> bool,
) -> Vec<Fold> {
    let mut users: Vec<&str> = users.into_iter().collect();
    users.sort_by_key(|user| natural(user));
    let fold = |user: &str| Fold {
        name: user.into(),
        library: (0..keys.len()).filter(|&i| in_library(&keys[i], user)).collect(),
        queries: (0..keys.len()).filter(|&i| keys[i].user == user).collect(),
    };
    users.into_iter().map(fold).collect()
}

/// One fold for each person and trial number; its library is the same person's other trials.
fn by_trial(keys: &[TrialKey]) -> Vec<Fold> {
    let mut groups: BTreeMap<(u32, (&str, u64)), Vec<usize>> = BTreeMap::new();
    for (i, key) in keys.iter().enumerate() {
        groups.entry((key.number, natural(&key.user))).or_default().push(i);
    }
    let fold = |((number, user), queries): ((u32, (&str, u64)), Vec<usize>)| {
        let library = (0..keys.len())
            .filter(|&i| natural(&keys[i].user) == user && keys[i].number != number)
            .collect();
        let user = &keys[queries[0]].user;
        let name = if user == EXPERT {
            format!("trial {number}")
        } else {
            format!("{user} trial {number}")
        };
        Fold { name, library, queries }
    };
    groups.into_iter().map(fold).collect()
}

/// Drops queries of surfaces that the fold's library lacks; `None` if no query is left.
pub(super) fn known_only(mut fold: Fold, keys: &[TrialKey]) -> Option<Fold> {
    let known: BTreeSet<&str> = fold.library.iter().map(|&i| keys[i].surface.as_str()).collect();
    fold.queries.retain(|&i| known.contains(keys[i].surface.as_str()));
    (!fold.queries.is_empty()).then_some(fold)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keys() -> Vec<TrialKey> {
        let mut keys = Vec::new();
        for surface in ["a", "b"] {
            keys.extend((1..=3).map(|n| TrialKey::new(surface, EXPERT, n)));
            keys.extend((1..=2).map(|u| TrialKey::new(surface, format!("user{u}"), u)));
        }
        keys
    }

    #[test]
    fn expert_vs_users_has_a_fold_a_user_and_the_expert_as_library() {
        let folds = folds(Protocol::ExpertVsUsers, &keys()).unwrap();
        assert_eq!(folds.iter().map(|f| f.name.as_str()).collect::<Vec<_>>(), ["user1", "user2"]);
        assert!(folds.iter().all(|f| f.library == [0, 1, 2, 5, 6, 7] && f.queries.len() == 2));
    }

    #[test]
    fn leave_one_trial_out_stays_within_a_person() {
        let folds = folds(Protocol::LeaveOneTrialOut, &keys()).unwrap();
        assert_eq!(folds.len(), 3, "users with a single trial have no library of their own");
        assert_eq!(
            folds[1],
            Fold { name: "trial 2".into(), library: vec![0, 2, 5, 7], queries: vec![1, 6] }
        );
    }

    #[test]
    fn all_vs_one_user_leaves_out_just_that_user() {
        let folds = folds(Protocol::AllVsOneUser, &keys()).unwrap();
        assert_eq!(folds[0].library, [0, 1, 2, 4, 5, 6, 7, 9]);
    }

    #[test]
    fn a_stray_trial_is_neither_a_class_nor_a_loss() {
        let mut keys = keys();
        keys.push(TrialKey::new("stray", "user1", 1));
        let folds = folds(Protocol::ExpertVsUsers, &keys).unwrap();
        assert!(folds.iter().all(|f| f.queries.len() == 2));
    }

    #[test]
    fn the_protocol_that_fits_is_chosen_and_named_where_another_does_not() {
        let natural = |keys: &[(&str, &str, u32)]| {
            let key =
                |&(surface, user, number): &(&str, &str, u32)| TrialKey::new(surface, user, number);
            let keys: Vec<TrialKey> = keys.iter().map(key).collect();
            (Protocol::fitting(&keys), folds(Protocol::ExpertVsUsers, &keys))
        };
        assert_eq!(Protocol::fitting(&keys()), Some(Protocol::ExpertVsUsers));
        let alone = [("a", EXPERT, 1), ("a", EXPERT, 2), ("b", EXPERT, 1), ("b", EXPERT, 2)];
        let (protocol, refused) = natural(&alone);
        assert_eq!(protocol, Some(Protocol::LeaveOneTrialOut));
        let refused = refused.unwrap_err().to_string();
        assert!(refused.ends_with("; leave-one-trial-out fits them"), "{refused}");
        let users = [("a", "user1", 1), ("b", "user1", 1), ("a", "user2", 1), ("b", "user2", 1)];
        assert_eq!(natural(&users).0, Some(Protocol::AllVsOneUser));
    }

    #[test]
    fn too_little_data_says_what_was_needed_and_found() {
        let keys = [TrialKey::new("a", EXPERT, 1)];
        let error = folds(Protocol::LeaveOneTrialOut, &keys).unwrap_err().to_string();
        assert!(
            error.contains("at least two surfaces") && error.contains("1 trial(s) of 1"),
            "{error}"
        );
    }
}
