//! Combines the scores of the sources (Eq. 9), and ranks surfaces by 1-NN or k-NN.

use std::collections::BTreeMap;

use crate::scene::SourceId;
use crate::trial::TrialKey;

/// A library trial and how unlike the query it is.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Candidate {
    pub key: TrialKey,
    /// ln of the discrepancy score; smaller is more alike.
    pub log_ds: f64,
}

#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct RankedSurface {
    pub surface: String,
    /// Discrepancy score; smaller is more alike.
    pub score: f64,
}

/// The surfaces of a library, the most alike first.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Ranking {
    pub ranked: Vec<RankedSurface>,
    /// ln of the ratio of the second score to the first; 0 for a tie or a single surface.
    pub margin: f64,
    pub sources: Vec<SourceId>,
    /// The library trial that is most like the query.
    pub nearest: TrialKey,
    /// Probability of the first surface; `None` if the method gives no probability.
    pub confidence: Option<f64>,
    /// Conformal p-value: share of left-out library trials that fit their nearest surface no better
    /// than the query fits the first. `None` if the method or the library cannot give it.
    #[serde(rename = "fit")]
    pub p_value: Option<f64>,
}

impl Ranking {
    /// The answer: the surface that is most like the query.
    pub fn surface(&self) -> &str {
        &self.ranked[0].surface
    }

    /// The probability of each surface, in the order of `ranked`; empty if the method gives none.
    pub fn probabilities(&self) -> Vec<f64> {
        let scores: Vec<f64> = self.ranked.iter().map(|one| one.score).collect();
        stated_probabilities(&scores, self.confidence)
    }
}

/// Ranks surfaces by the `k` candidates that are most like the query.
///
/// With k = 1, the score of a surface is that of its best trial. With larger k, the k nearest trials
/// vote with weight 1/DS, and a surface scores 1/(sum of its weights). Surfaces without a vote come
/// last, ordered by their best trial. Ties go to the smaller label, then the smaller trial number.
///
/// Returns `None` if there are no candidates. The order of candidates does not matter.
pub(super) fn rank(
    mut candidates: Vec<Candidate>,
    k: usize,
    sources: Vec<SourceId>,
) -> Option<Ranking> {
    candidates.sort_by(|a, b| a.log_ds.total_cmp(&b.log_ds).then_with(|| a.key.cmp(&b.key)));
    let nearest = candidates.first()?.key.clone();
    let mut voted: BTreeMap<&str, f64> = BTreeMap::new();
    for candidate in candidates.iter().take(k.max(1)) {
        let weight = -candidate.log_ds;
        voted
            .entry(&candidate.key.surface)
            .and_modify(|sum| *sum = log_add(*sum, weight))
            .or_insert(weight);
    }
    let mut order: Vec<(&str, f64)> = voted.iter().map(|(&s, &weight)| (s, -weight)).collect();
    order.sort_by(|a, b| a.1.total_cmp(&b.1).then_with(|| a.0.cmp(b.0)));
    let mut seen: std::collections::BTreeSet<&str> = voted.keys().copied().collect();
    for candidate in candidates.iter().skip(k.max(1)) {
        if seen.insert(&candidate.key.surface) {
            order.push((&candidate.key.surface, candidate.log_ds));
        }
    }
    let margin = order.get(1).map_or(0.0, |second| (second.1 - order[0].1).max(0.0));
    let ranked = order
        .into_iter()
        .map(|(surface, log_ds)| RankedSurface {
            surface: surface.into(),
            score: log_ds.exp().min(f64::MAX),
        })
        .collect();
    Some(Ranking { ranked, margin, sources, nearest, confidence: None, p_value: None })
}

/// ln(eᵃ + eᵇ) without overflow.
fn log_add(a: f64, b: f64) -> f64 {
    let (low, high) = if a < b { (a, b) } else { (b, a) };
    high + (low - high).exp().ln_1p()
}

/// ln of a library trial's score by each source; `None` for a source that the trial lacks.
pub(super) type TrialScores = Vec<Option<f64>>;

/// Eq. 9: Σ weight · ln score over sources. A source that the trial lacks counts as the median score
/// of that source over the library, so that lacking a source is neither an advantage nor a
/// disadvantage. `None` for a trial without any of the sources.
pub fn log_discrepancy(weights: &[f64], scores: &[Option<f64>], medians: &[f64]) -> Option<f64> {
    scores.iter().any(Option::is_some).then(|| {
        let terms = scores.iter().zip(medians).zip(weights);
        terms.map(|((score, median), weight)| weight * score.unwrap_or(*median)).sum()
    })
}

/// Median score of each source over a library; 0 for a source that no trial has.
pub fn medians(sources: usize, library: &[TrialScores]) -> Vec<f64> {
    let known = |source: usize| library.iter().filter_map(|scores| scores[source]).collect();
    (0..sources).map(|source| median(known(source))).collect()
}

/// The median of `values`: the upper middle value if their number is even, 0 if there are none.
pub(super) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

/// The probabilities of all surfaces, best first, of which the first is the stated confidence; empty if
/// there is none.
///
/// Scores of such a method are 1/p for probabilities p. If the first p exceeds the confidence that
/// the library supports, each of n surfaces gets (1 − s) p + s/n, with s chosen to make them equal.
pub fn stated_probabilities(scores: &[f64], confidence: Option<f64>) -> Vec<f64> {
    let (Some(first), Some(best)) = (confidence, scores.first()) else { return Vec::new() };
    let (alike, best) = (1.0 / scores.len() as f64, best.recip());
    let shared = if best > alike { ((best - first) / (best - alike)).clamp(0.0, 1.0) } else { 0.0 };
    scores.iter().map(|score| (1.0 - shared) * score.recip() + shared * alike).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn candidate(surface: &str, number: u32, log_ds: f64) -> Candidate {
        Candidate { key: TrialKey::new(surface, "expert", number), log_ds }
    }

    #[test]
    fn a_tie_goes_to_the_smaller_label_with_margin_zero() {
        let ranking =
            rank(vec![candidate("b", 1, 0.5), candidate("a", 2, 0.5)], 1, vec![]).unwrap();
        assert_eq!(ranking.surface(), "a");
        assert_eq!(ranking.margin, 0.0);
    }

    #[test]
    fn one_neighbour_follows_the_best_trial_and_three_the_majority() {
        let candidates = vec![
            candidate("a", 1, 1.0),
            candidate("b", 1, 1.1),
            candidate("b", 2, 1.1),
            candidate("c", 1, 9.0),
        ];
        assert_eq!(rank(candidates.clone(), 1, vec![]).unwrap().surface(), "a");
        let three = rank(candidates, 3, vec![]).unwrap();
        let order: Vec<_> = three.ranked.iter().map(|r| r.surface.as_str()).collect();
        assert_eq!(order, ["b", "a", "c"]);
        assert!((three.ranked[0].score - 1.1f64.exp() / 2.0).abs() < 1e-12);
    }

    #[test]
    fn weights_decide_and_a_gap_counts_as_the_median() {
        let library = [vec![Some(0.5), Some(1.5)], vec![Some(1.0), None], vec![None, None]];
        let medians = medians(2, &library);
        assert_eq!(medians, [1.0, 1.5]);
        let combined = |scores: &TrialScores| log_discrepancy(&[3.0, 1.0], scores, &medians);
        assert_eq!(library.iter().map(combined).collect::<Vec<_>>(), [Some(3.0), Some(4.5), None]);
    }
}
