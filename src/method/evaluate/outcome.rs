//! The result of an evaluation: accuracies with intervals, precision, confusion matrix and latencies.

use std::collections::BTreeSet;

use ndarray::Array1;
use serde::ser::{Serialize, SerializeMap, SerializeStruct, Serializer};

use crate::recognise::{wilson_interval, wilson_of_groups};
use crate::scene::SourceId;
use crate::trial::TrialKey;

/// A number of queries, and how many of them were named right (or were called unknown).
///
/// JSON has the fraction and its 95 % Wilson interval as `accuracy`, `accuracy_low` and
/// `accuracy_high`; `#[serde(flatten)]` puts them into the surrounding object.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Share {
    pub right: usize,
    pub of: usize,
}

impl Share {
    pub fn count(each: impl IntoIterator<Item = bool>) -> Self {
        let mut share = Self::default();
        each.into_iter().for_each(|right| share.add(right));
        share
    }

    pub fn add(&mut self, right: bool) {
        *self = Self { right: self.right + usize::from(right), of: self.of + 1 };
    }

    pub(crate) fn join(&mut self, other: Self) {
        *self = Self { right: self.right + other.right, of: self.of + other.of };
    }

    /// The fraction, from 0 to 1; 0 if there are no queries.
    pub fn value(self) -> f64 {
        self.right as f64 / self.of.max(1) as f64
    }

    /// The 95 % Wilson interval of the fraction.
    pub fn interval(self) -> (f64, f64) {
        wilson_interval(self.right, self.of)
    }

    /// Writes a share as `key`, `key_low` and `key_high`. The number of queries comes first, under
    /// the name `count`, if that is given.
    pub(crate) fn write<S: Serializer>(
        self,
        count: Option<&str>,
        key: &str,
        to: S,
    ) -> Result<S::Ok, S::Error> {
        let (low, high) = self.interval();
        let mut map = to.serialize_map(None)?;
        if let Some(count) = count {
            map.serialize_entry(count, &self.of)?;
        }
        map.serialize_entry(key, &self.value())?;
        map.serialize_entry(&format!("{key}_low"), &low)?;
        map.serialize_entry(&format!("{key}_high"), &high)?;
        map.end()
    }
}

impl Serialize for Share {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        self.write(None, "accuracy", to)
    }
}

/// The answer to a query; by default, none was given.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Prediction {
    /// The query; its surface is the truth.
    pub key: TrialKey,
    pub fold: usize,
    /// The answer; empty if the query could not be named.
    pub surface: String,
    /// ln of the ratio of the second-best surface's score to the best surface's score.
    pub margin: f64,
    /// Time from raw samples to the answer, in milliseconds.
    pub query_ms: f64,
    pub sources: Vec<SourceId>,
    /// Stated probability of the answer; `None` if the method gives none.
    pub confidence: Option<f64>,
    /// Conformal p-value of the answer; see [`crate::recognise::Ranking`].
    pub p_value: Option<f64>,
    /// Each surface of the library with its probability; empty if the method gives none.
    pub probabilities: Vec<(String, f64)>,
}

impl Prediction {
    pub fn is_correct(&self) -> bool {
        self.surface == self.key.surface
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct FoldAccuracy {
    /// Name of the user or trial that was left out.
    pub name: String,
    pub share: Share,
}

impl Serialize for FoldAccuracy {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        let mut fields = to.serialize_struct("FoldAccuracy", 3)?;
        fields.serialize_field("name", &self.name)?;
        fields.serialize_field("accuracy", &self.share.value())?;
        fields.serialize_field("queries", &self.share.of)?;
        fields.end()
    }
}

#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Confusion {
    /// The surfaces, sorted.
    pub labels: Vec<String>,
    /// Numbers of queries, `counts[truth][answer]`; both are indices of `labels`.
    pub counts: Vec<Vec<u32>>,
}

/// Least probability in a log loss, so that one query does not outweigh all others.
const LEAST_PROBABILITY: f64 = 1e-6;

/// Result of an evaluation. Accuracies are fractions from 0 to 1.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Outcome {
    #[serde(rename = "accuracy", serialize_with = "value")]
    pub share: Share,
    #[serde(flatten)]
    pub interval: Interval,
    /// Mean over folds of the share of queries named correctly.
    pub accuracy_mean: f64,
    /// Sample standard deviation (n − 1) of the folds' accuracies; `None` for a single fold.
    pub accuracy_std: Option<f64>,
    /// Mean over classes of the precision TP/(TP+FP), taken as 0 for a class that is never the answer.
    pub precision_mean: f64,
    /// Mean over queries of −ln of the probability of the true surface, which counts as at least
    /// 1e-6; `None` if the method gives no probabilities.
    pub log_loss: Option<f64>,
    pub classes: usize,
    /// The fewest and the most surfaces in the library of a fold, among which its queries are named.
    pub candidates: [usize; 2],
    /// Surfaces that could be the answer, but have no query.
    pub never_queried: Vec<String>,
    pub queries: usize,
    /// Number of trials in the largest library of a fold.
    pub library_trials: usize,
    /// Median time from raw samples to the answer, in milliseconds.
    pub query_ms_p50: f64,
    pub query_ms_p99: f64,
    pub method: String,
    pub sources: Vec<SourceId>,
    pub folds: Vec<FoldAccuracy>,
    pub surfaces: Vec<SurfaceAccuracy>,
    pub confusion: Confusion,
}

/// How well one surface is named. A share is `None` if it is of nothing.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct SurfaceAccuracy {
    pub surface: String,
    pub queries: u32,
    /// The share of its queries that are named so.
    pub recall: Option<f64>,
    /// The share of the answers with its name that are right.
    pub precision: Option<f64>,
    /// The harmonic mean of both.
    pub f1: Option<f64>,
}

impl Outcome {
    /// Computes the result from predictions; `None` if there are none. `fold_names` are indexed by
    /// [`Prediction::fold`]; `labels` are the surfaces that could be the answer, sorted.
    pub(crate) fn new(
        predictions: &[Prediction],
        fold_names: &[String],
        labels: Vec<String>,
        library_trials: usize,
        method: &str,
    ) -> Option<Self> {
        let of_fold = |(fold, name): (usize, &String)| {
            let of_this = predictions.iter().filter(|p| p.fold == fold);
            let share = Share::count(of_this.map(Prediction::is_correct));
            (share.of > 0).then(|| FoldAccuracy { name: name.clone(), share })
        };
        let folds: Vec<_> = fold_names.iter().enumerate().filter_map(of_fold).collect();
        let accuracies: Array1<f64> = folds.iter().map(|fold| fold.share.value()).collect();
        let confusion = Confusion::new(predictions, labels);
        let surfaces = confusion.surfaces();
        let precisions = surfaces.iter().filter_map(|one| one.precision);
        let times = || predictions.iter().map(|p| p.query_ms).collect();
        let sources: BTreeSet<_> = predictions.iter().flat_map(|p| &p.sources).collect();
        let queried: BTreeSet<&str> = predictions.iter().map(|p| p.key.surface.as_str()).collect();
        let never_queried =
            confusion.labels.iter().filter(|label| !queried.contains(label.as_str()));
        Some(Self {
            share: Share::count(predictions.iter().map(Prediction::is_correct)),
            interval: Interval::of(&folds, Over::Queries),
            accuracy_mean: accuracies.mean()?,
            accuracy_std: (folds.len() > 1).then(|| accuracies.std(1.0)),
            precision_mean: precisions.sum::<f64>() / surfaces.len() as f64,
            log_loss: log_loss(predictions, confusion.labels.len()),
            classes: confusion.labels.len(),
            candidates: [confusion.labels.len(); 2],
            never_queried: never_queried.cloned().collect(),
            queries: predictions.len(),
            library_trials,
            query_ms_p50: percentile(times(), 0.50),
            query_ms_p99: percentile(times(), 0.99),
            method: method.into(),
            sources: sources.into_iter().cloned().collect(),
            folds,
            surfaces,
            confusion,
        })
    }

    /// The same result with the interval over the groups that were left out.
    pub fn over(self, groups: Over) -> Self {
        Self { interval: Interval::of(&self.folds, groups), ..self }
    }
}

impl Confusion {
    fn new(predictions: &[Prediction], labels: Vec<String>) -> Self {
        let index = |surface: &String| labels.binary_search(surface);
        let mut counts = vec![vec![0; labels.len()]; labels.len()];
        for p in predictions {
            if let (Ok(truth), Ok(answer)) = (index(&p.key.surface), index(&p.surface)) {
                counts[truth][answer] += 1;
            }
        }
        Self { labels, counts }
    }

    /// The most frequent mistakes as (truth, answer, count), the worst first.
    pub fn worst(&self, most: usize) -> Vec<(&str, &str, u32)> {
        let cells = self.labels.iter().zip(&self.counts).flat_map(|(truth, row)| {
            self.labels.iter().zip(row).map(|(answer, &count)| (&**truth, &**answer, count))
        });
        let mut mistakes: Vec<_> = cells.filter(|(t, a, count)| t != a && *count > 0).collect();
        // The sort is stable, and labels are sorted, so equal counts stay in alphabetical order.
        mistakes.sort_by_key(|&(_, _, count)| std::cmp::Reverse(count));
        mistakes.truncate(most);
        mistakes
    }

    fn surfaces(&self) -> Vec<SurfaceAccuracy> {
        let of_class = |(class, surface): (usize, &String)| {
            let right = f64::from(self.counts[class][class]);
            let queries: u32 = self.counts[class].iter().sum();
            let answers: u32 = self.counts.iter().map(|row| row[class]).sum();
            let share = |of: u32| (of > 0).then(|| right / f64::from(of));
            // 2 P R / (P + R), in counts.
            let f1 = (queries + answers > 0).then(|| 2.0 * right / f64::from(queries + answers));
            let (recall, precision) = (share(queries), share(answers));
            SurfaceAccuracy { surface: surface.clone(), queries, recall, precision, f1 }
        };
        self.labels.iter().enumerate().map(of_class).collect()
    }
}

/// See [`Outcome::log_loss`]. A query without an answer gives each of the `classes` an equal share.
fn log_loss(predictions: &[Prediction], classes: usize) -> Option<f64> {
    if predictions.iter().all(|p| p.probabilities.is_empty()) {
        return None;
    }
    let of = |p: &Prediction| {
        let of_truth = p.probabilities.iter().find(|(surface, _)| *surface == p.key.surface);
        match of_truth {
            Some((_, probability)) => -probability.max(LEAST_PROBABILITY).ln(),
            None => (classes.max(1) as f64).ln(),
        }
    };
    Some(predictions.iter().map(of).sum::<f64>() / predictions.len() as f64)
}

/// The percentile of some values by nearest rank; `share` is from 0 to 1. 0 if there are no values.
pub fn percentile(mut values: Vec<f64>, share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let rank = (share * values.len() as f64).ceil() as usize;
    values.get(rank.saturating_sub(1)).copied().unwrap_or(0.0)
}

/// Fewest people or sessions for a confidence interval over them; with fewer, it is over queries.
const LEAST_GROUPS: usize = 3;

/// The units of a confidence interval: it brackets the accuracy of the next person, session and so on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Over {
    People,
    Sessions,
    /// The values of a key by which trials are left out.
    Groups,
    #[default]
    Queries,
}

impl Over {
    pub fn plural(self) -> &'static str {
        match self {
            Self::People => "people",
            Self::Sessions => "sessions",
            Self::Groups => "groups",
            Self::Queries => "queries",
        }
    }

    /// These groups if there are at least three of them, else queries.
    pub fn counted(self, groups: usize) -> Self {
        if groups >= LEAST_GROUPS { self } else { Self::Queries }
    }
}

/// The 95 % confidence interval of an accuracy. It is over people or sessions if at least three were
/// left out, since one person's queries say little about another person. Otherwise it is over queries
/// ([`Share::interval`]).
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct Interval {
    #[serde(rename = "accuracy_low")]
    pub low: f64,
    #[serde(rename = "accuracy_high")]
    pub high: f64,
    #[serde(rename = "interval_over")]
    pub over: Over,
}

impl Interval {
    /// The interval of the accuracy on all queries of some folds, which are groups of this kind.
    pub(crate) fn of(groups: &[FoldAccuracy], over: Over) -> Self {
        let over = over.counted(groups.len());
        let shares = groups.iter().map(|group| group.share);
        let (low, high) = if over == Over::Queries {
            let mut all = Share::default();
            shares.for_each(|share| all.join(share));
            all.interval()
        } else {
            wilson_of_groups(&shares.map(|share| (share.right, share.of)).collect::<Vec<_>>())
        };
        Self { low, high, over }
    }
}

pub(super) fn value<S: Serializer>(share: &Share, to: S) -> Result<S::Ok, S::Error> {
    to.serialize_f64(share.value())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_share_has_its_keys_in_json() {
        let json = serde_json::to_value(Share::count([true, true, false, true])).unwrap();
        let (low, high) = wilson_interval(3, 4);
        let wanted =
            serde_json::json!({"accuracy": 0.75, "accuracy_low": low, "accuracy_high": high});
        assert_eq!(json, wanted);
        assert_eq!(Share::default().value(), 0.0);
        let (low, high) = wilson_interval(10, 10);
        assert!((low - 0.722_467).abs() < 1e-6 && (high - 1.0).abs() < 1e-12);
    }

    fn prediction(truth: &str, answer: &str, fold: usize) -> Prediction {
        let key = TrialKey::new(truth, "user1", 1);
        Prediction { key, fold, surface: answer.into(), ..Prediction::default() }
    }

    fn outcome(predictions: &[Prediction]) -> Outcome {
        let labels = ["a", "b", "c"].map(String::from).to_vec();
        let names = ["user1", "user2"].map(String::from);
        Outcome::new(predictions, &names, labels, 9, "svm").unwrap()
    }

    #[test]
    fn accuracy_is_a_mean_over_folds_and_precision_over_classes() {
        assert_eq!(outcome(&[prediction("a", "a", 0)]).accuracy_std, None, "one fold");
        let outcome =
            outcome(&[prediction("a", "a", 0), prediction("b", "a", 0), prediction("c", "c", 1)]);
        assert_eq!(outcome.accuracy_mean, 0.75);
        assert!((outcome.accuracy_std.unwrap() - 0.125f64.sqrt()).abs() < 1e-15);
        // Precision: 1 of 2 answers for a, no answer for b, 1 of 1 answer for c.
        assert_eq!(outcome.precision_mean, 0.5);
        assert_eq!(outcome.confusion.counts[1], [1, 0, 0]);
        let of = |class: usize| {
            let SurfaceAccuracy { queries, recall, precision, f1, .. } = outcome.surfaces[class];
            (queries, recall, precision, f1)
        };
        assert_eq!(of(0), (1, Some(1.0), Some(0.5), Some(2.0 / 3.0)));
        assert_eq!(of(1), (1, Some(0.0), None, Some(0.0)));
    }

    #[test]
    fn log_loss_is_that_of_the_true_surfaces_where_there_are_probabilities() {
        assert_eq!(outcome(&[prediction("a", "a", 0)]).log_loss, None);
        let sure = |truth: &str, p: f64| Prediction {
            probabilities: vec![("a".into(), p), ("b".into(), 1.0 - p)],
            ..prediction(truth, "a", 0)
        };
        let found = outcome(&[sure("a", 0.5), sure("b", 1.0), prediction("c", "", 0)]).log_loss;
        let expected = (2f64.ln() + 1e6f64.ln() + 3f64.ln()) / 3.0;
        assert!((found.unwrap() - expected).abs() < 1e-12, "{found:?}");
    }

    #[test]
    fn the_headline_is_the_share_of_all_queries_and_surfaces_without_any_are_named() {
        let mut predictions = vec![prediction("b", "a", 1)];
        predictions.extend((0..12).map(|_| prediction("a", "a", 0)));
        let outcome = outcome(&predictions);
        assert_eq!(outcome.share, Share { right: 12, of: 13 });
        assert_eq!(outcome.accuracy_mean, 0.5);
        assert_eq!(outcome.never_queried, ["c"]);
    }

    #[test]
    fn an_interval_is_over_people_from_three_on() {
        let share = |right| Share { right, of: 10 };
        let people = [2, 5, 8].map(|n| FoldAccuracy { name: String::new(), share: share(n) });
        let of_people = Interval::of(&people, Over::People);
        let of_queries = wilson_interval(15, 30);
        assert_eq!(of_people.over, Over::People);
        assert!(of_people.low < of_queries.0 && of_people.high > of_queries.1);
        let two = Interval::of(&people[..2], Over::People);
        assert_eq!((two.low, two.high), wilson_interval(7, 20));
        assert_eq!(two.over, Over::Queries);
        assert_eq!(Interval::of(&people, Over::Queries).over, Over::Queries);
    }

    #[test]
    fn a_percentile_is_a_value_that_occurred() {
        assert_eq!(percentile(vec![3.0, 2.0, 1.0, 4.0], 0.5), 2.0);
        assert_eq!(percentile(vec![3.0, 2.0, 1.0, 4.0], 0.99), 4.0);
    }
}
