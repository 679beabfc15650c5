//! Finds the trials whose labels look wrong, by the answers that they get when they are left out.

use std::collections::BTreeMap;

use crate::evaluate::outcome::{Prediction, Share};
use crate::trial::TrialKey;

/// Least probability of another name that makes a label suspect, so that of ten answers this sure, at most
/// one is wrong where labels are right. More would miss wrong labels wherever several are in the library,
/// since these lower the probabilities that it states.
const SURE: f64 = 0.9;
/// Fewest other trials of a surface by which a trial's label can be judged.
const FEWEST_OTHERS: usize = 3;

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

#[cfg(test)]
mod tests {
    use super::*;

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
