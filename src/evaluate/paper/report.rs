//! The results of a run in all settings of the paper, compared with the published results.

use super::part::{PaperPart, RowPart};
use super::rows::{ALL, Row, rows};
use crate::evaluate::{Confusion, Outcome, Prediction, Protocol};
use crate::recognise::{log_discrepancy, medians};
use crate::trial::TrialKey;

/// Results in one setting. Our accuracies are fractions from 0 to 1, the paper's are percentages.
#[derive(Clone, Debug, serde::Serialize)]
pub struct ReportRow {
    #[serde(flatten)]
    pub row: Row,
    pub sources: Vec<&'static str>,
    pub missing: Vec<String>,
    pub not_run: Option<String>,
    pub accuracy_mean: Option<f64>,
    /// Sample standard deviation over folds.
    pub accuracy_std: Option<f64>,
    /// Lower end of the 95 % Wilson interval over queries.
    pub accuracy_low: Option<f64>,
    pub accuracy_high: Option<f64>,
    /// Mean over classes of TP/(TP+FP).
    pub precision_mean: Option<f64>,
    pub classes: usize,
    pub queries: usize,
    /// Number of trials in the largest library of a fold.
    pub library_trials: usize,
    /// Our accuracy minus the paper's, in percentage points.
    pub difference_points: Option<f64>,
}

#[derive(Clone, Debug, serde::Serialize)]
pub struct PaperReport {
    pub data: String,
    pub synthetic: bool,
    pub settings: String,
    pub rows: Vec<ReportRow>,
    /// Confusion matrix (truth against answer) with all sources, by `expert-vs-users`.
    pub confusion: Option<Confusion>,
}

impl PaperReport {
    pub fn new(part: &PaperPart) -> Self {
        let keys: Vec<TrialKey> =
            part.trials.iter().map(|(s, user, number)| TrialKey::new(s, user, *number)).collect();
        let mut confusion = None;
        let mut report = Vec::new();
        for (row, answers) in rows().into_iter().zip(&part.rows) {
            let outcome = outcome(answers, &keys);
            let is_main = row.name == ALL && row.protocol == Protocol::ExpertVsUsers;
            report.push(report_row(row, answers, outcome.as_ref()));
            if is_main {
                confusion = outcome.map(|outcome| outcome.confusion);
            }
        }
        let PaperPart { data, synthetic, settings, .. } = part.clone();
        Self { data, synthetic, settings, rows: report, confusion }
    }
}

fn outcome(row: &RowPart, keys: &[TrialKey]) -> Option<Outcome> {
    let predictions: Vec<Prediction> = (row.answers.iter())
        .filter_map(|&(fold, query, answer)| {
            Some(Prediction {
                key: keys.get(query)?.clone(),
                fold,
                surface: keys.get(answer)?.surface.clone(),
                margin: 0.0,
                query_ms: 0.0,
                sources: Vec::new(),
            })
        })
        .collect();
    Outcome::new(&predictions, &row.folds, row.labels.clone(), row.library_trials, "reference")
}

fn report_row(row: Row, part: &RowPart, outcome: Option<&Outcome>) -> ReportRow {
    let mut sources: Vec<&str> = row.terms.iter().map(|(_, stream)| stream.source).collect();
    sources.dedup();
    sources.retain(|source| !part.missing.iter().any(|missing| missing == source));
    let difference = |outcome: &Outcome| {
        // A setting without all its sources is not comparable with the paper's.
        let published = row.published.filter(|_| part.missing.is_empty())?;
        Some(outcome.accuracy_mean * 100.0 - published.accuracy)
    };
    ReportRow {
        sources,
        missing: part.missing.clone(),
        not_run: part.not_run.clone(),
        accuracy_mean: outcome.map(|o| o.accuracy_mean),
        accuracy_std: outcome.map(|o| o.accuracy_std),
        accuracy_low: outcome.map(|o| o.share.interval().0),
        accuracy_high: outcome.map(|o| o.share.interval().1),
        precision_mean: outcome.map(|o| o.precision_mean),
        classes: outcome.map_or(0, |o| o.classes),
        queries: outcome.map_or(0, |o| o.queries),
        library_trials: part.library_trials,
        difference_points: outcome.and_then(difference),
        row,
    }
}

// The score of one source between two trials does not depend on the other sources used. So the
// score is computed once, and each row of the paper's tables only adds logarithms of scores.

/// ln of the scores between one query and library trials, in one stream (a sampled source).
#[derive(Clone, Debug, PartialEq)]
pub struct LogScores {
    /// Indices of the library trials, ascending.
    pub library: std::sync::Arc<[usize]>,
    /// ln of the score of each library trial; NaN if query or trial lacks the source.
    pub values: Vec<f64>,
}

impl LogScores {
    fn of(&self, trial: usize) -> Option<f64> {
        let at = self.library.binary_search(&trial).ok()?;
        self.values.get(at).copied().filter(|value| !value.is_nan())
    }
}

/// Index of the library trial that is nearest to a query (Eq. 9, 1-NN).
///
/// `terms` are the weights and scores of streams; `keys` must be sorted. As in the method `reference`,
/// the stream's median over the other trials replaces a missing score, and a tie goes to the smaller
/// key. Trials without any score are left out. `None` if no trial has a score.
pub fn nearest(library: &[usize], terms: &[(f64, &LogScores)], keys: &[TrialKey]) -> Option<usize> {
    debug_assert!(keys.is_sorted());
    let scores_of = |&trial: &usize| terms.iter().map(|(_, scores)| scores.of(trial)).collect();
    let scores: Vec<Vec<Option<f64>>> = library.iter().map(scores_of).collect();
    let weights: Vec<f64> = terms.iter().map(|(weight, _)| *weight).collect();
    let medians = medians(terms.len(), &scores);
    let scored = library
        .iter()
        .zip(&scores)
        .filter_map(|(&trial, scores)| Some((log_discrepancy(&weights, scores, &medians)?, trial)));
    let nearest = scored.min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    nearest.map(|(_, trial)| trial)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scores(values: &[f64]) -> LogScores {
        LogScores { library: (0..values.len()).collect(), values: values.to_vec() }
    }

    fn keys() -> Vec<TrialKey> {
        ["a", "b", "c"].map(|surface| TrialKey::new(surface, "expert", 1)).to_vec()
    }

    #[test]
    fn weights_decide_between_sources() {
        let (x, y) = (scores(&[0.0, 1.0, 9.0]), scores(&[1.5, 0.0, 9.0]));
        assert_eq!(nearest(&[0, 1, 2], &[(1.0, &x), (1.0, &y)], &keys()), Some(1));
        assert_eq!(nearest(&[0, 1, 2], &[(3.0, &x), (1.0, &y)], &keys()), Some(0));
        assert_eq!(nearest(&[1, 2], &[(3.0, &x), (1.0, &y)], &keys()), Some(1));
    }

    #[test]
    fn a_tie_goes_to_the_smaller_key_and_a_gap_to_the_median() {
        let x = scores(&[0.5, 0.5, 0.5]);
        assert_eq!(nearest(&[0, 1, 2], &[(1.0, &x)], &keys()), Some(0));
        let gap = scores(&[f64::NAN, 1.0, 2.0]);
        assert_eq!(nearest(&[0, 1, 2], &[(1.0, &x), (1.0, &gap)], &keys()), Some(1));
        assert_eq!(nearest(&[0], &[(1.0, &gap)], &keys()), None);
    }
}
