//! Splits trials into queries and library, fold by fold (`src/method/README.md` §3).

use std::collections::{BTreeMap, BTreeSet};

use super::{EvaluateError, Over};
use crate::trial::{EXPERT, TrialKey, sessions_count};

/// How trials are split into queries and library.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Protocol {
    /// Each fold names the trials of one person; the library is everybody else's trials (10 vs 1)
    AllVsOneUser,
    /// Each fold names the trials of one session; the library is the trials of all other sessions
    LeaveOneSessionOut,
    /// Fold k names trial k of every surface; the library is the same person's other trials (1 vs 1)
    LeaveOneTrialOut,
    /// The library is the expert's trials; each fold names the trials of one other user (1 vs 10)
    ExpertVsUsers,
}

impl Protocol {
    /// The protocols that data get by default, the hardest first.
    const DEFAULTS: [Self; 3] =
        [Self::AllVsOneUser, Self::LeaveOneSessionOut, Self::LeaveOneTrialOut];

    /// The hardest protocol that asks at least half of the trials, or else the one that asks most of
    /// them; `None` if none fits.
    pub fn fitting(keys: &[TrialKey]) -> Option<Self> {
        let asked = Self::DEFAULTS.map(|protocol| {
            let folds = protocol.split(keys);
            let queries: usize = folds.iter().map(|fold| fold.queries.len()).sum();
            (protocol, if enough(&folds, keys) { queries } else { 0 })
        });
        let half = asked.iter().find(|(_, asked)| 2 * asked >= keys.len().max(1));
        // Of equals, the last is taken, so the hardest.
        let found = half.or_else(|| asked.iter().rev().max_by_key(|(_, asked)| *asked));
        found.filter(|(_, asked)| *asked > 0).map(|(protocol, _)| *protocol)
    }

    /// The trials that are left out, and what that leaves unsaid.
    pub fn left_out(self) -> &'static str {
        match self {
            Self::AllVsOneUser => "each person left out in turn",
            Self::LeaveOneSessionOut => "each session left out in turn",
            Self::LeaveOneTrialOut => "trials left out within sessions: another day will be worse",
            Self::ExpertVsUsers => "other people's trials, named by those of `expert`",
        }
    }

    /// People or sessions if each fold leaves one of them out; queries if it leaves out single trials.
    pub(crate) fn over(self) -> Over {
        match self {
            Self::ExpertVsUsers | Self::AllVsOneUser => Over::People,
            Self::LeaveOneSessionOut => Over::Sessions,
            Self::LeaveOneTrialOut => Over::Queries,
        }
    }

    pub fn name(self) -> &'static str {
        match self {
            Self::ExpertVsUsers => "expert-vs-users",
            Self::LeaveOneTrialOut => "leave-one-trial-out",
            Self::LeaveOneSessionOut => "leave-one-session-out",
            Self::AllVsOneUser => "all-vs-one-user",
        }
    }

    fn split(self, keys: &[TrialKey]) -> Vec<Fold> {
        let groups = match self {
            Self::ExpertVsUsers => {
                let mut others = by_user(keys);
                others.retain(|fold| fold.name != EXPERT);
                others.iter_mut().for_each(|fold| fold.library.retain(|&i| keys[i].user == EXPERT));
                others
            }
            Self::AllVsOneUser => by_user(keys),
            Self::LeaveOneSessionOut if !sessions_count(keys.iter()) => Vec::new(),
            Self::LeaveOneSessionOut => by_group(keys, TrialKey::of_session, session_name),
            Self::LeaveOneTrialOut => by_trial(keys),
        };
        groups.into_iter().filter_map(|fold| known_only(fold, keys)).collect()
    }

    pub(crate) fn needs(self) -> &'static str {
        match self {
            Self::ExpertVsUsers => {
                "trials of at least two surfaces by `expert`, and trials of them by other users"
            }
            Self::LeaveOneTrialOut => {
                "at least two surfaces with at least two trials each by one person"
            }
            Self::LeaveOneSessionOut => {
                "at least two surfaces with trials in at least two sessions each, and a session of \
                 several trials (`session` in trial.toml)"
            }
            Self::AllVsOneUser => "trials of at least two surfaces by at least two people",
        }
    }
}

/// The folds of a measurement, and what they leave out.
#[derive(Clone, Debug)]
pub struct Split {
    /// The protocol, `split` for folds of a file, or `group-by KEY`.
    pub name: String,
    pub left_out: String,
    pub over: Over,
    pub folds: Vec<Fold>,
}

impl Split {
    pub fn by_protocol(protocol: Protocol, keys: &[TrialKey]) -> Result<Self, EvaluateError> {
        let (name, left_out) = (protocol.name().into(), protocol.left_out().into());
        Ok(Self { name, left_out, over: protocol.over(), folds: folds(protocol, keys)? })
    }

    /// A fold for each of some groups; `groups` holds the group of each trial, a value of `key`.
    pub fn by_key(key: &str, groups: &[String], keys: &[TrialKey]) -> Result<Self, EvaluateError> {
        let places = by_group(groups, String::as_str, str::to_string);
        let name = format!("group-by {key}");
        Self::checked(name, &format!("each {key} left out in turn"), Over::Groups, places, keys)
    }

    /// The folds that a table gives to trials: `train` and `test`, or any names, each left out in turn.
    pub fn by_table(of: &[String], keys: &[TrialKey]) -> Result<Self, EvaluateError> {
        let places = by_group(of, String::as_str, str::to_string);
        let is_one = places.iter().any(|fold| fold.name == TEST);
        let folds: Vec<Fold> =
            places.into_iter().filter(|fold| !is_one || fold.name == TEST).collect();
        // An interval is over people or sessions only if each fold is one of them.
        let each_is = |of: fn(&TrialKey) -> (&str, Option<&str>)| {
            let one_of = |fold: &Fold| {
                let first = of(&keys[fold.queries[0]]);
                fold.queries.iter().all(|&i| of(&keys[i]) == first).then_some(first)
            };
            let all: Option<BTreeSet<_>> = folds.iter().map(one_of).collect();
            all.is_some_and(|all| all.len() == folds.len())
        };
        let over = match () {
            () if is_one => Over::Queries,
            () if each_is(|key| (&key.user, None)) => Over::People,
            () if each_is(TrialKey::of_session) => Over::Sessions,
            () => Over::Queries,
        };
        Self::checked("split".into(), "trials left out as the file says", over, folds, keys)
    }

    /// Drops what cannot be asked, and adds to `left_out` what is on both sides of a fold.
    fn checked(
        name: String,
        left_out: &str,
        over: Over,
        folds: Vec<Fold>,
        keys: &[TrialKey],
    ) -> Result<Self, EvaluateError> {
        let folds: Vec<_> = folds.into_iter().filter_map(|fold| known_only(fold, keys)).collect();
        if !enough(&folds, keys) {
            return Err(EvaluateError::Trials(format!(
                "{name} leaves no fold to ask: each needs a library of at least two surfaces, and \
                 trials of them outside it"
            )));
        }
        let on_both_sides = |of: fn(&TrialKey) -> (&str, Option<&str>)| {
            folds.iter().any(|fold| {
                let library: BTreeSet<_> = fold.library.iter().map(|&i| of(&keys[i])).collect();
                fold.queries.iter().any(|&i| library.contains(&of(&keys[i])))
            })
        };
        let untold = match () {
            () if on_both_sides(TrialKey::of_session) => {
                "; trials of one session are on both sides: another day will be worse"
            }
            () if on_both_sides(|key| (&key.user, None)) => {
                "; trials of one person are on both sides: another person will be worse"
            }
            () => "",
        };
        Ok(Self { name, left_out: format!("{left_out}{untold}"), over, folds })
    }
}

/// The names of the two parts of a table that makes one fold.
pub const TRAIN: &str = "train";
pub const TEST: &str = "test";

/// Queries, and the library that they are compared with. Trials are given by their indices.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fold {
    /// Name of the person, session or trial that is left out.
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
    let surfaces = count(|key| &key.surface);
    let of_one = if surfaces < 2 { ". Folders are the surfaces: SURFACE/TRIAL" } else { "" };
    Err(EvaluateError::Trials(format!(
        "the protocol {} needs {}; the data hold {} trial(s) of {} surface(s) by {} user(s), {} \
         trial(s) by `expert`{}{of_one}",
        protocol.name(),
        protocol.needs(),
        keys.len(),
        surfaces,
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

/// The name of a trial's session. No name of a person or session holds a slash.
fn session_name((user, session): (&str, Option<&str>)) -> String {
    let user = if user == EXPERT { String::new() } else { format!("{user}/") };
    format!("{user}{}", session.unwrap_or("without session"))
}

fn by_user(keys: &[TrialKey]) -> Vec<Fold> {
    by_group(keys, |key| key.user.as_str(), str::to_string)
}

/// One fold for each group, which names the group's trials by all others.
fn by_group<'k, K, G: Ord + Copy>(
    keys: &'k [K],
    group: impl Fn(&'k K) -> G,
    name: impl Fn(G) -> String,
) -> Vec<Fold> {
    let mut groups: BTreeMap<G, Vec<usize>> = BTreeMap::new();
    keys.iter().enumerate().for_each(|(i, key)| groups.entry(group(key)).or_default().push(i));
    let fold = |(of, queries): (G, Vec<usize>)| {
        let library = (0..keys.len()).filter(|&i| group(&keys[i]) != of).collect();
        Fold { name: name(of), library, queries }
    };
    let mut folds: Vec<Fold> = groups.into_iter().map(fold).collect();
    folds.sort_by(|a, b| natural(&a.name).cmp(&natural(&b.name)));
    folds
}

/// One fold for each person and trial number; its library is the same person's other trials.
fn by_trial(keys: &[TrialKey]) -> Vec<Fold> {
    let mut groups: BTreeMap<(u32, &str), Vec<usize>> = BTreeMap::new();
    for (i, key) in keys.iter().enumerate() {
        groups.entry((key.number, &key.user)).or_default().push(i);
    }
    let mut groups: Vec<_> = groups.into_iter().collect();
    groups.sort_by_key(|&((number, user), _)| (number, natural(user)));
    let fold = |((number, user), queries): ((u32, &str), Vec<usize>)| {
        let others = |&i: &usize| keys[i].user == user && keys[i].number != number;
        let user = if user == EXPERT { String::new() } else { format!("{user} ") };
        let library = (0..keys.len()).filter(others).collect();
        Fold { name: format!("{user}trial {number}"), library, queries }
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
    fn each_protocol_has_its_folds_and_a_stray_trial_is_neither_a_class_nor_a_loss() {
        use Protocol::{AllVsOneUser, ExpertVsUsers, LeaveOneTrialOut};
        let mut keys = keys();
        keys.push(TrialKey::new("stray", "user1", 1));
        let expected: [(_, &str, &[usize], &[usize]); 8] = [
            (ExpertVsUsers, "user1", &[0, 1, 2, 5, 6, 7], &[3, 8]),
            (ExpertVsUsers, "user2", &[0, 1, 2, 5, 6, 7], &[4, 9]),
            // Users with a single trial have no library of their own.
            (LeaveOneTrialOut, "trial 1", &[1, 2, 6, 7], &[0, 5]),
            (LeaveOneTrialOut, "trial 2", &[0, 2, 5, 7], &[1, 6]),
            (LeaveOneTrialOut, "trial 3", &[0, 1, 5, 6], &[2, 7]),
            (AllVsOneUser, EXPERT, &[3, 4, 8, 9, 10], &[0, 1, 2, 5, 6, 7]),
            (AllVsOneUser, "user1", &[0, 1, 2, 4, 5, 6, 7, 9], &[3, 8]),
            (AllVsOneUser, "user2", &[0, 1, 2, 3, 5, 6, 7, 8, 10], &[4, 9]),
        ];
        for of_protocol in expected.chunk_by(|a, b| a.0 == b.0) {
            let folds = folds(of_protocol[0].0, &keys).unwrap();
            let found = folds.iter().map(|f| (&*f.name, &*f.library, &*f.queries));
            assert!(found.eq(of_protocol.iter().map(|row| (row.1, row.2, row.3))), "{folds:?}");
        }
    }

    #[test]
    fn people_whose_names_end_in_one_number_written_in_two_ways_are_two_people() {
        let of = |user| ["a", "b"].map(|s| [1, 2].map(|n| TrialKey::new(s, user, n))).concat();
        let keys = ["user1", "user01"].map(of).concat();
        let folds = folds(Protocol::LeaveOneTrialOut, &keys).unwrap();
        assert_eq!((folds.len(), &*folds[0].library), (4, &[5, 7][..]));
    }

    /// Two trials of `a` and of `b` in each of these sessions, by one person.
    fn sessions(names: &[&str]) -> Vec<TrialKey> {
        let of = |surface: &'static str| {
            names.iter().enumerate().flat_map(move |(at, session)| {
                [1, 2].map(|n| TrialKey {
                    session: Some((*session).into()),
                    ..TrialKey::new(surface, EXPERT, 2 * at as u32 + n)
                })
            })
        };
        ["a", "b"].into_iter().flat_map(of).collect()
    }

    #[test]
    fn the_hardest_protocol_that_the_data_allow_is_chosen_whatever_people_are_called() {
        let of = |people: &[&str]| {
            let by = |surface: &'static str| {
                people.iter().flat_map(move |user| [1, 2].map(|n| TrialKey::new(surface, *user, n)))
            };
            Protocol::fitting(&["a", "b"].into_iter().flat_map(by).collect::<Vec<_>>())
        };
        for people in [["anna", "ben"], [EXPERT, "ben"], ["ben", EXPERT]] {
            assert_eq!(of(&people), Some(Protocol::AllVsOneUser), "{people:?}");
        }
        assert_eq!(of(&["anna"]), Some(Protocol::LeaveOneTrialOut));
        let mut days = sessions(&["monday", "tuesday"]);
        assert_eq!(Protocol::fitting(&days), Some(Protocol::LeaveOneSessionOut));
        // A visitor with one trial does not make a library of two people.
        days.push(TrialKey::new("a", "visitor", 1));
        assert_eq!(Protocol::fitting(&days), Some(Protocol::LeaveOneSessionOut));
        assert_eq!(Protocol::fitting(&[TrialKey::new("a", EXPERT, 1)]), None);
    }

    #[test]
    fn a_session_is_left_out_with_all_of_its_trials_and_belongs_to_one_person() {
        let days = sessions(&["monday", "tuesday"]);
        let found = folds(Protocol::LeaveOneSessionOut, &days).unwrap();
        assert_eq!(found[0].name, "monday");
        assert_eq!(found[0].queries, [0, 1, 4, 5]);
        assert_eq!(found[0].library, [2, 3, 6, 7]);
        let mut two = days.clone();
        two.extend(days.into_iter().map(|key| TrialKey { user: "anna".into(), ..key }));
        assert_eq!(folds(Protocol::LeaveOneSessionOut, &two).unwrap().len(), 4);
        assert!(!sessions_count(sessions(&["monday"]).iter()));
        // A session for each trial tells nothing of sessions.
        let mut single = sessions(&["1", "2"]);
        for (at, key) in single.iter_mut().enumerate() {
            key.session = Some(at.to_string());
        }
        let error = folds(Protocol::LeaveOneSessionOut, &single).unwrap_err().to_string();
        assert!(error.contains("several trials") && error.contains("trial-out fits"), "{error}");
    }

    #[test]
    fn people_and_sessions_whose_names_run_together_are_not_one_session() {
        let of = |(user, session): (&str, &str)| {
            let user = user.to_string();
            sessions(&[session]).into_iter().map(move |key| TrialKey { user: user.clone(), ..key })
        };
        let all = [("anna", "b c"), ("anna b", "c"), (EXPERT, "anna b c")];
        let keys: Vec<TrialKey> = all.into_iter().flat_map(of).collect();
        let folds = folds(Protocol::LeaveOneSessionOut, &keys).unwrap();
        let names: BTreeSet<&str> = folds.iter().map(|fold| fold.name.as_str()).collect();
        assert_eq!(names, ["anna b c", "anna b/c", "anna/b c"].into());
        assert!(folds.iter().all(|fold| fold.queries.len() == 4 && fold.library.len() == 8));
    }

    #[test]
    fn too_little_data_says_what_was_needed_and_found_and_which_protocol_fits() {
        let keys = [TrialKey::new("a", EXPERT, 1)];
        let error = folds(Protocol::LeaveOneTrialOut, &keys).unwrap_err().to_string();
        for part in ["at least two surfaces", "1 trial(s) of 1"] {
            assert!(error.contains(part), "{error}");
        }
        let error = folds(Protocol::ExpertVsUsers, &sessions(&[""])).unwrap_err().to_string();
        assert!(error.ends_with("; leave-one-trial-out fits them"), "{error}");
    }
}
