//! Finds people and sessions whose trials move together: many of them are clearly named another surface.
//! Then the session differs from the others, and a wrong answer says nothing about a label.

use std::collections::{BTreeMap, BTreeSet};

use super::finding::{FaultKind, Finding};
use super::inspect::{Inspected, Measured, median, usual};
use super::{Audited, Suspects};
use crate::evaluate::outcome::Prediction;
use crate::scene::SourceId;
use crate::trial::TrialKey;

/// Fewest clearly wrong answers of a session that make it differ.
const MANY: usize = 3;
/// A level differs from this on, as ln of an amplitude: 3 dB.
const LEVEL: f64 = 3.0 * std::f64::consts::LN_10 / 20.0;
/// A rate differs from this on, as ln of a ratio: 1 %.
const RATE: f64 = 0.01;
/// The edge of a band differs from this on, as ln of a ratio: a quarter.
const BAND: f64 = 0.223;

/// Takes out of `suspects` those that move together, and returns them session by session: a third of the
/// trials of a person's session, or half of those of one surface in it. Empty if there is one session.
pub(super) fn moved<'p>(
    predictions: &'p [Prediction],
    suspects: &mut Suspects<'p>,
) -> Vec<Vec<&'p TrialKey>> {
    let mut sessions: BTreeMap<_, Vec<&TrialKey>> = BTreeMap::new();
    for Prediction { key, .. } in predictions {
        sessions.entry(key.of_session()).or_default().push(key);
    }
    if sessions.len() < 2 {
        return Vec::new();
    }
    let mut all = Vec::new();
    for session in sessions.values() {
        let are_many = |suspected: usize, tested: usize, share: usize| {
            suspected >= MANY && suspected * share >= tested
        };
        let suspected = |of: &dyn Fn(&TrialKey) -> bool| {
            let trials: Vec<&TrialKey> = session.iter().copied().filter(|key| of(key)).collect();
            let count = trials.iter().filter(|key| suspects.contains_key(*key)).count();
            (count, trials.len())
        };
        let (count, tested) = suspected(&|_| true);
        let whole = are_many(count, tested, 3);
        let is_moved = |key: &&TrialKey| {
            let (count, tested) = suspected(&|other| other.surface == key.surface);
            suspects.contains_key(*key) && (whole || are_many(count, tested, 2))
        };
        let moved: Vec<&TrialKey> = session.iter().copied().filter(is_moved).collect();
        suspects.retain(|key, _| !moved.contains(key));
        all.extend((!moved.is_empty()).then_some(moved));
    }
    all
}

/// A finding for each session of [`moved`] trials, which says in what the session differs.
pub(super) fn differing(
    moved: &[Vec<&TrialKey>],
    inspected: &[Inspected],
    audited: &Audited<'_>,
) -> Vec<Finding> {
    let finding = |trials: &Vec<&TrialKey>| {
        let (user, session) = trials[0].of_session();
        let name = match session {
            Some(session) => format!("session {session} of {user}"),
            None => format!("the trials of {user}"),
        };
        let is_of = |one: &Inspected| one.entry.key.of_session() == (user, session);
        let (own, others): (Vec<&Inspected>, Vec<&Inspected>) =
            inspected.iter().partition(|one| is_of(one));
        let differences = differences(&own, &others);
        let what = match differences.is_empty() {
            true => "neither in level, rate nor band; look at force, speed, tool and labels".into(),
            false => differences.join("; "),
        };
        let names = own.iter().filter(|one| trials.contains(&&one.entry.key));
        let names: Vec<String> = names.map(|one| one.entry.name_in(audited.root)).collect();
        let (count, all) = (names.len(), own.len());
        let text = format!(
            "{name} differs from the others: {count} of its {all} trials are clearly named other \
             surfaces when left out. It differs: {what}"
        );
        Finding::new(FaultKind::Session, names, text)
    };
    moved.iter().map(finding).collect()
}

/// How the series of a session differ from those of the others: a text for each source.
fn differences(own: &[&Inspected], others: &[&Inspected]) -> Vec<String> {
    let sources: BTreeSet<&SourceId> = own.iter().flat_map(|one| one.series.keys()).collect();
    let of_source = |id: &SourceId| {
        let usual = |surface: Option<&str>, of| usual(others.iter().copied(), id, surface, of);
        // The median over the session's trials, each compared with its surface elsewhere.
        let change = |of: fn(&Measured) -> f64| {
            let one = |one: &&Inspected| {
                let surface = Some(one.entry.key.surface.as_str());
                Some(of(one.series.get(id)?) - usual(surface, of).or_else(|| usual(None, of))?)
            };
            median(own.iter().filter_map(one).collect()).unwrap_or(0.0)
        };
        let ratio = |change: f64| format!("{:.2} times", change.exp());
        let [level, rate, band] = [
            change(|m| m.level),
            change(|m| m.rate_hz.ln()),
            change(|m| m.edge_hz.max(f64::MIN_POSITIVE).ln()),
        ];
        let decibel = 20.0 / std::f64::consts::LN_10 * level;
        let all = [
            (level.abs() >= LEVEL).then(|| format!("{decibel:+.0} dB in level")),
            (rate.abs() >= RATE).then(|| format!("{} the rate", ratio(rate))),
            (band.abs() >= BAND).then(|| format!("{} the band (95 % of the power)", ratio(band))),
        ];
        let all: Vec<String> = all.into_iter().flatten().collect();
        (!all.is_empty()).then(|| format!("{id} has {}", all.join(", ")))
    };
    sources.into_iter().filter_map(of_source).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Predictions of 9 trials of each of two surfaces in each session; `wrong` tells which are wrong.
    fn predictions(wrong: impl Fn(&TrialKey) -> bool) -> Vec<Prediction> {
        let keys = ["monday", "friday"].into_iter().flat_map(|session| {
            (1..=9).flat_map(move |n| {
                ["a", "b"]
                    .map(|s| TrialKey::new(s, "anna", n).with_session(Some(session.to_string())))
            })
        });
        let other = |key: &TrialKey| if key.surface == "a" { "b" } else { "a" };
        let of = |key: TrialKey| Prediction {
            surface: if wrong(&key) { other(&key).into() } else { key.surface.clone() },
            margin: 1.0,
            confidence: Some(0.95),
            key,
            ..Prediction::default()
        };
        keys.map(of).collect()
    }

    fn split(predictions: &[Prediction]) -> (usize, Vec<usize>) {
        let mut suspects = super::super::suspects(predictions);
        let moved = moved(predictions, &mut suspects);
        (suspects.len(), moved.iter().map(Vec::len).collect())
    }

    #[test]
    fn many_trials_of_a_session_move_together_and_single_ones_stay_suspects() {
        let on = |key: &TrialKey, day: &str| key.session.as_deref() == Some(day);
        let single = predictions(|key| key.number == 1 && key.surface == "a");
        assert_eq!(split(&single), (2, vec![]));
        let half = predictions(|key| on(key, "friday") && key.surface == "a" && key.number < 6);
        assert_eq!(split(&half), (0, vec![5]), "half of a surface in one session");
        let both = predictions(|key| {
            (on(key, "friday") && key.surface == "a") || (on(key, "monday") && key.number == 1)
        });
        assert_eq!(split(&both), (2, vec![9]));
    }

    #[test]
    fn within_one_session_all_stay_suspects() {
        let all = predictions(|key| key.surface == "a" && key.number < 4);
        let monday: Vec<Prediction> =
            all.into_iter().filter(|p| p.key.session.as_deref() == Some("monday")).collect();
        assert_eq!(split(&monday), (3, vec![]));
    }
}
