//! Many sources, one score a library trial: Eq. 9 in log space.

use super::rank::Candidate;
use crate::trial::TrialKey;

/// ln of the scores of one library trial, a slot a source; `None` where it lacks the source.
pub type TrialScores = Vec<Option<f64>>;

/// Eq. 9, Σ weight · ln score over sources. A source that the library trial lacks counts as the
/// median of the others, so that lacking one is neither an advantage nor a disadvantage. `None` for
/// a trial without any.
pub fn log_discrepancy(weights: &[f64], scores: &[Option<f64>], medians: &[f64]) -> Option<f64> {
    scores.iter().any(Option::is_some).then(|| {
        let terms = scores.iter().zip(medians).zip(weights);
        terms.map(|((score, median), weight)| weight * score.unwrap_or(*median)).sum()
    })
}

/// The median over a library of each source's score; 0 where no trial has the source.
pub fn medians(sources: usize, library: &[TrialScores]) -> Vec<f64> {
    let median = |source: usize| {
        let mut known: Vec<f64> = library.iter().filter_map(|scores| scores[source]).collect();
        known.sort_by(f64::total_cmp);
        known.get(known.len() / 2).copied().unwrap_or(0.0)
    };
    (0..sources).map(median).collect()
}

/// A candidate for each trial that has a score.
pub fn candidates<'a>(
    weights: &[f64],
    library: &[TrialScores],
    medians: &[f64],
    keys: impl Iterator<Item = &'a TrialKey>,
) -> Vec<Candidate> {
    (library.iter().zip(keys))
        .filter_map(|(scores, key)| {
            let log_ds = log_discrepancy(weights, scores, medians)?;
            Some(Candidate { key: key.clone(), log_ds })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_decide_and_a_gap_counts_as_the_median() {
        let library = [vec![Some(0.5), Some(1.5)], vec![Some(1.0), None], vec![None, None]];
        let medians = medians(2, &library);
        assert_eq!(medians, [1.0, 1.5]);
        let combined = |scores: &TrialScores| log_discrepancy(&[3.0, 1.0], scores, &medians);
        assert_eq!(library.iter().map(combined).collect::<Vec<_>>(), [Some(3.0), Some(4.5), None]);
    }
}
