//! Many sources, one score a library trial: Eq. 9 in log space.

use std::sync::Arc;

use super::framed::FramedTrial;
use super::rank::Candidate;

/// Log scores of one source against each library trial; `None` where the trial lacks the source.
pub(super) type SourceScores = Vec<Option<f64>>;

/// Weighted sums over sources. A source that a library trial lacks counts as the median of the
/// others, so that lacking one is neither an advantage nor a disadvantage; trials without any are
/// left out.
pub(super) fn merge(
    sources: &[(f64, SourceScores)],
    library: &[Arc<FramedTrial>],
) -> Vec<Candidate> {
    let medians: Vec<f64> = sources.iter().map(|(_, scores)| median(scores)).collect();
    (library.iter().enumerate())
        .filter(|(i, _)| sources.iter().any(|(_, scores)| scores[*i].is_some()))
        .map(|(i, trial)| {
            let terms = (sources.iter().zip(&medians))
                .map(|((weight, scores), median)| weight * scores[i].unwrap_or(*median));
            Candidate { key: trial.key.clone(), log_ds: terms.sum() }
        })
        .collect()
}

fn median(scores: &SourceScores) -> f64 {
    let mut known: Vec<f64> = scores.iter().copied().flatten().collect();
    known.sort_by(f64::total_cmp);
    known.get(known.len() / 2).copied().unwrap_or(0.0)
}
