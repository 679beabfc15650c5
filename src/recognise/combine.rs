//! Many sources, one score a library trial: Eq. 9 in log space.

use super::rank::Candidate;
use crate::trial::TrialKey;

/// Log scores of one source against each library trial; `None` where the trial lacks the source.
pub type SourceScores = Vec<Option<f64>>;

/// Σ weight · ln score over sources, for each of the library's trials. A source that a library
/// trial lacks counts as the median of the others, so that lacking one is neither an advantage nor
/// a disadvantage; trials without any are left out.
pub fn combine(sources: &[(f64, SourceScores)], library: &[&TrialKey]) -> Vec<Candidate> {
    let medians: Vec<f64> = sources.iter().map(|(_, scores)| median(scores)).collect();
    (library.iter().enumerate())
        .filter(|(i, _)| sources.iter().any(|(_, scores)| scores[*i].is_some()))
        .map(|(i, key)| {
            let terms = (sources.iter().zip(&medians))
                .map(|((weight, scores), median)| weight * scores[i].unwrap_or(*median));
            Candidate { key: (*key).clone(), log_ds: terms.sum() }
        })
        .collect()
}

/// The median of the scores there are; 0 without any.
pub fn median(scores: &SourceScores) -> f64 {
    let mut known: Vec<f64> = scores.iter().copied().flatten().collect();
    known.sort_by(f64::total_cmp);
    known.get(known.len() / 2).copied().unwrap_or(0.0)
}
