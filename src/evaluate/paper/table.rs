//! From tables of scores to answers: which library trial is nearest, for any product of sources.
//!
//! The score of one source between two trials does not depend on which other sources are used. So
//! it is computed once, and every row of the paper's tables is a sum of logarithms.

use crate::recognise::{log_discrepancy, medians};
use crate::trial::TrialKey;

/// ln of the scores of one query in one stream.
#[derive(Clone, Debug, PartialEq)]
pub struct LogScores {
    /// Library trials by index, ascending.
    pub library: std::sync::Arc<[usize]>,
    /// ln of the score of each; NaN where one side lacks the source.
    pub values: Vec<f64>,
}

impl LogScores {
    fn of(&self, trial: usize) -> Option<f64> {
        let at = self.library.binary_search(&trial).ok()?;
        self.values.get(at).copied().filter(|value| !value.is_nan())
    }
}

/// The library trial that is nearest to a query (Eq. 9, 1-NN), by index.
///
/// `terms` are weights and scores. As in the method `reference`, a source that a library trial
/// lacks counts as the median of the others, trials without any are left out, and a tie goes to the
/// smaller key: `keys` must ascend. `None` if no trial has a score.
pub fn nearest(library: &[usize], terms: &[(f64, &LogScores)], keys: &[TrialKey]) -> Option<usize> {
    debug_assert!(keys.is_sorted());
    let scores_of = |&trial: &usize| terms.iter().map(|(_, scores)| scores.of(trial)).collect();
    let scores: Vec<Vec<Option<f64>>> = library.iter().map(scores_of).collect();
    let weights: Vec<f64> = terms.iter().map(|(weight, _)| *weight).collect();
    let medians = medians(terms.len(), &scores);
    let mut best: Option<(f64, usize)> = None;
    for (&trial, scores) in library.iter().zip(&scores) {
        let Some(log_ds) = log_discrepancy(&weights, scores, &medians) else { continue };
        let better = best.is_none_or(|(least, found)| {
            log_ds.total_cmp(&least).then_with(|| trial.cmp(&found)).is_lt()
        });
        if better {
            best = Some((log_ds, trial));
        }
    }
    best.map(|(_, trial)| trial)
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
