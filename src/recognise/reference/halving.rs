//! Successive halving: compares all trials by a few repetitions, and only the best by more.
//!
//! With shared positions, a repetition draws the same samples from every trial, so trials far from the
//! query stand out at once. All repetitions resample the same recording. Dropping a trial after the
//! first of them therefore saves work and rarely changes a label, but tells nothing about confidence.
//! With the default stages 12 % of the work remains. Measured on LMT108's dragging sounds of 20
//! surfaces (`mi2`, leave one trial out, R = 10): the label equalled the exact method's in 200 of 200
//! queries, and in 500 of 500 against a synthetic library of 1080 trials (`cargo bench --bench
//! reference -- halving`).

use std::collections::BTreeSet;

use crate::recognise::rank::{Candidate, RankedSurface, Ranking};

/// A stage of halving: after some repetitions, only the best trials stay.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage {
    /// Number of repetitions done by the end of the stage, counted from the start.
    pub repetitions: usize,
    /// Number of trials that stay after the stage.
    pub keep: usize,
}

/// Stages for the paper's R = 10: one repetition for all trials, two for 64 trials, ten for 16.
pub const STAGES: [Stage; 2] =
    [Stage { repetitions: 1, keep: 64 }, Stage { repetitions: 2, keep: 16 }];

/// Splits candidates into the `keep` best and the rest; both lists begin with the most alike. Ties are
/// resolved as in a ranking, so the order of candidates does not matter.
pub(super) fn split<T>(mut all: Vec<(Candidate, T)>, keep: usize) -> (Vec<T>, Vec<Candidate>) {
    all.sort_by(|(a, _), (b, _)| a.log_ds.total_cmp(&b.log_ds).then_with(|| a.key.cmp(&b.key)));
    let dropped = all.split_off(keep.min(all.len()));
    let stay = all.into_iter().map(|(_, trial)| trial).collect();
    (stay, dropped.into_iter().map(|(candidate, _)| candidate).collect())
}

/// Appends the dropped surfaces to a ranking of those that stayed; the surfaces dropped last come
/// first. Each gets the score it was dropped with, or the score before it in the list if larger.
pub(super) fn append(ranking: &mut Ranking, dropped: Vec<Vec<Candidate>>) {
    let mut seen: BTreeSet<String> = ranking.ranked.iter().map(|r| r.surface.clone()).collect();
    let (first, alone) = (ranking.ranked[0].score, ranking.ranked.len() == 1);
    for candidate in dropped.into_iter().rev().flatten() {
        if seen.insert(candidate.key.surface.clone()) {
            let least = ranking.ranked.last().map_or(first, |last| last.score);
            let score = candidate.log_ds.exp().max(least);
            ranking.ranked.push(RankedSurface { surface: candidate.key.surface, score });
        }
    }
    if let (true, Some(second)) = (alone, ranking.ranked.get(1)) {
        let margin = second.score.ln() - first.ln();
        ranking.margin = if margin.is_finite() { margin } else { 0.0 };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recognise::rank;
    use crate::trial::{EXPERT, TrialKey};

    fn candidate(surface: &str, log_ds: f64) -> Candidate {
        Candidate { key: TrialKey::new(surface, EXPERT, 1), log_ds }
    }

    #[test]
    fn the_best_stay_and_ties_go_by_name() {
        let all = vec![
            (candidate("c", 1.0), 'c'),
            (candidate("a", 2.0), 'a'),
            (candidate("b", 1.0), 'b'),
        ];
        let (stay, dropped) = split(all, 2);
        assert_eq!(stay, ['b', 'c']);
        assert_eq!(dropped, [candidate("a", 2.0)]);
    }

    #[test]
    fn those_that_dropped_out_follow_in_ascending_order() {
        let mut ranking = rank(vec![candidate("a", 1.0)], 1, Vec::new()).unwrap();
        let dropped = vec![
            vec![candidate("d", 0.5), candidate("a", 7.0)],
            vec![candidate("b", 3.0), candidate("c", 2.0)],
        ];
        append(&mut ranking, dropped);
        let names: Vec<_> = ranking.ranked.iter().map(|r| r.surface.as_str()).collect();
        assert_eq!(names, ["a", "b", "c", "d"]);
        assert!(ranking.ranked.is_sorted_by(|a, b| a.score <= b.score));
        assert!((ranking.margin - 2.0).abs() < 1e-12);
    }
}
