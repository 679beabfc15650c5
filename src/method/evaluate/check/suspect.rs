//! Finds the trials whose labels look wrong, by the answers that they get when they are left out, and people
//! and sessions whose trials move together: many of them are clearly named another surface. Then the session
//! differs from the others, and a wrong answer says nothing about a label.

use std::collections::{BTreeMap, BTreeSet};

use super::Audited;
use super::finding::{FaultKind, Finding};
use super::inspect::{Inspected, Measured, median, usual};
use crate::evaluate::outcome::{Prediction, Share};
use crate::scene::SourceId;
use crate::trial::TrialKey;

/// Least probability of another name that makes a label suspect, so that of ten answers this sure, at most
/// one is wrong where labels are right. More would miss wrong labels wherever several are in the library,
/// since these lower the probabilities that it states.
const SURE: f64 = 0.9;
/// Fewest other trials of a surface by which a trial's label can be judged.
const FEWEST_OTHERS: usize = 3;
/// Fewest clearly wrong answers of a session that make it differ.
const MANY: usize = 3;
/// A level differs from this on, as ln of an amplitude: 3 dB.
const LEVEL: f64 = 3.0 * std::f64::consts::LN_10 / 20.0;
/// A rate differs from this on, as ln of a ratio: 1 %.
const RATE: f64 = 0.01;
/// The edge of a band differs from this on, as ln of a ratio: a quarter.
const BAND: f64 = 0.223;

/// The trials that look mislabelled, each with the surface that it was named.
pub(super) type Suspects<'p> = BTreeMap<&'p TrialKey, &'p str>;

/// The trials whose answer is not their label, and so sure that the label looks wrong: its probability is
/// [`SURE`] or more, beyond what the numbers of trials of both surfaces would make of it, and its margin is
/// that of most trials of the surface that it names. A method without probabilities counts as sure as the
/// lower end of its accuracy. Wrong answers say nothing about labels unless most of these trials are shown
/// to be named right, and more than if the most frequent surface were always named.
pub(super) fn suspects(predictions: &[Prediction]) -> Suspects<'_> {
    // Over queries, since it tells of these trials and not of other people.
    let (low, _) = Share::count(predictions.iter().map(Prediction::is_correct)).interval();
    let mut trials: BTreeMap<&str, usize> = BTreeMap::new();
    let mut margins: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
    for p in predictions {
        *trials.entry(&p.key.surface).or_default() += 1;
        if p.is_correct() {
            margins.entry(&p.surface).or_default().push(p.margin);
        }
    }
    margins.values_mut().for_each(|margins| margins.sort_by(f64::total_cmp));
    let most = trials.values().max().map_or(0.0, |&most| most as f64 / predictions.len() as f64);
    let is_sure = |p: &Prediction| {
        let probability = p.confidence.unwrap_or(low);
        let (others, named) = (trials[&*p.key.surface] - 1, trials.get(&*p.surface).copied());
        let odds = probability / (1.0 - probability) * others as f64 / named.unwrap_or(0) as f64;
        others >= FEWEST_OTHERS && odds >= SURE / (1.0 - SURE) - 1e-9
    };
    let is_clear = |p: &&Prediction| {
        let usual = margins.get(&*p.surface).map(|margins| margins[margins.len() / 2]);
        !p.is_correct() && usual.is_some_and(|usual| p.margin >= usual) && is_sure(p)
    };
    let clear = predictions.iter().filter(|_| low > most.max(0.5)).filter(is_clear);
    clear.map(|p| (&p.key, p.surface.as_str())).collect()
}

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
        let mut suspects = suspects(predictions);
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

    /// Predictions of `count` trials of `surface`, each named `named` with `confidence`.
    fn answers(surface: &str, count: u32, named: &str, confidence: f64) -> Vec<Prediction> {
        let of = |n| Prediction {
            key: TrialKey::new(surface, named, n),
            surface: named.into(),
            margin: 1.0,
            confidence: Some(confidence),
            ..Prediction::default()
        };
        (1..=count).map(of).collect()
    }

    #[test]
    fn a_label_is_suspect_only_by_a_sure_answer_of_answers_that_are_shown_to_be_mostly_right() {
        let count = |all: &[Vec<Prediction>]| suspects(&all.concat()).len();
        let right = |a, b| [answers("a", a, "a", 0.99), answers("b", b, "b", 0.99)].concat();
        let wrong = |confidence| answers("a", 1, "b", confidence);
        assert_eq!(count(&[right(9, 10), wrong(0.95)]), 1);
        assert_eq!(
            count(&[right(9, 10), wrong(0.8)]),
            0,
            "an answer as unsure as this is often wrong"
        );
        assert_eq!(count(&[right(2, 20), wrong(0.99)]), 0, "two others say little of a surface");
        assert_eq!(count(&[right(4, 40), wrong(0.98)]), 0, "as the numbers of trials make it");
        let noise = [answers("a", 5, "b", 0.95), answers("b", 4, "a", 0.95)].concat();
        assert_eq!(count(&[right(6, 5), noise]), 0, "eleven of twenty may be chance");
    }
}
