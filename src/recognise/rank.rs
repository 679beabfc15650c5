//! From scores against trials to a ranking of surfaces: 1-NN and k-NN, ties, margin.

use std::collections::BTreeMap;

use crate::scene::SourceId;
use crate::trial::TrialKey;

/// A library trial and how unlike the query it is.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Candidate {
    /// The library trial.
    pub key: TrialKey,
    /// ln of the discrepancy score; smaller is more alike.
    pub log_ds: f64,
}

/// A surface and how unlike the query it is.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct RankedSurface {
    /// The label.
    pub surface: String,
    /// Discrepancy score; smaller is more alike.
    pub score: f64,
}

/// The surfaces of a library, the most alike first.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Ranking {
    /// All surfaces of the library.
    pub ranked: Vec<RankedSurface>,
    /// ln of the ratio of the second score to the first; 0 for a tie.
    pub margin: f64,
    /// The sources that were compared.
    pub sources: Vec<SourceId>,
    /// The most alike trial of the library.
    pub nearest: TrialKey,
    /// Probability of the first surface, by a method that gives one.
    pub confidence: Option<f64>,
    /// Share of left-out library trials that fit their nearest surface no better than the query
    /// fits the first (a conformal p-value), by a method and a library that give one.
    #[serde(rename = "fit")]
    pub p_value: Option<f64>,
}

impl Ranking {
    /// The answer: the surface that is most alike.
    pub fn surface(&self) -> &str {
        &self.ranked[0].surface
    }
}

/// Ranks surfaces by the `k` candidates that are most alike.
///
/// With k = 1 a surface counts by its best trial. With more, the k nearest trials weigh by 1/DS and
/// a surface's score is the inverse of its summed weight; surfaces without one follow, by their
/// best trial. Ties go to the smaller label, then the smaller trial number.
///
/// Returns `None` if there are no candidates. The order of candidates does not matter.
pub fn rank(mut candidates: Vec<Candidate>, k: usize, sources: Vec<SourceId>) -> Option<Ranking> {
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
}
