//! Explains the name of a scan by the vote of each source, the threshold, and the nearest trial.

use serde::Serialize;

use crate::recognise::{Evidence, RankedSurface, Ranking, Rejection};
use crate::scene::SourceId;
use crate::trial::TrialKey;

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Why {
    pub winner: String,
    pub runner_up: Option<String>,
    /// The sources, sorted by how strongly they favour the winner, the strongest first. Empty if
    /// the method cannot separate sources.
    pub sources: Vec<SourceSays>,
    /// Sources that were not compared, and the reasons, a line each.
    pub left_out: Vec<String>,
    pub p_value: Option<f64>,
    /// The p-value at or below which a scan is unknown; `None` if unknown surfaces are not detected.
    pub threshold: Option<f64>,
    /// Number of left-out trials from which the threshold was computed.
    pub threshold_trials: Option<usize>,
    pub surfaces: usize,
    pub nearest: TrialKey,
    pub ranked: Vec<RankedSurface>,
}

/// How one source judges the winner and the runner-up (the second surface).
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SourceSays {
    pub source: SourceId,
    /// Natural logarithm of the odds for the winner against the runner-up, by this source alone;
    /// negative if it favours the runner-up. `None` if either surface lacks the source.
    pub for_winner: Option<f64>,
    /// The surface that this source alone would name.
    pub alone: Option<String>,
}

impl Why {
    pub(crate) fn new(
        ranking: Ranking,
        evidence: Option<&Evidence>,
        rejection: Option<&Rejection>,
        left_out: Vec<String>,
    ) -> Self {
        let winner = ranking.surface().to_string();
        let runner_up = ranking.ranked.get(1).map(|second| second.surface.clone());
        let mut sources: Vec<SourceSays> =
            evidence.map_or_else(Vec::new, |all| says(all, &winner, runner_up.as_deref()));
        sources.sort_by(|a, b| {
            let order = |says: &SourceSays| says.for_winner.unwrap_or(f64::NEG_INFINITY);
            order(b).total_cmp(&order(a))
        });
        Self {
            winner,
            runner_up,
            sources,
            left_out,
            p_value: ranking.p_value,
            threshold: rejection.map(|rejection| rejection.rate),
            threshold_trials: rejection.map(|rejection| rejection.trials),
            surfaces: ranking.ranked.len(),
            nearest: ranking.nearest,
            ranked: ranking.ranked,
        }
    }
}

fn says(evidence: &Evidence, winner: &str, runner_up: Option<&str>) -> Vec<SourceSays> {
    let Evidence { surfaces, sources } = evidence;
    let at = |surface: &str| surfaces.iter().position(|other| other == surface);
    let (first, second) = (at(winner), runner_up.and_then(at));
    let of = |source: &crate::recognise::SourceEvidence| {
        let term = |index: Option<usize>| index.map(|i| source.terms[i]).filter(|t| t.is_finite());
        let finite = (0..surfaces.len()).filter(|&i| source.terms[i].is_finite());
        let alone = finite.min_by(|&a, &b| source.terms[a].total_cmp(&source.terms[b]));
        SourceSays {
            source: source.source.clone(),
            for_winner: term(second).zip(term(first)).map(|(second, first)| second - first),
            alone: alone.map(|i| surfaces[i].clone()),
        }
    };
    sources.iter().map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recognise::SourceEvidence;

    #[test]
    fn sources_speak_for_the_winner_or_the_runner_up() {
        let source = |id: &str, terms: [f64; 3]| SourceEvidence {
            source: SourceId::new(id).unwrap(),
            terms: terms.into(),
        };
        let evidence = Evidence {
            surfaces: ["ash", "elm", "oak"].map(String::from).into(),
            sources: vec![
                source("ir", [1.0, f64::INFINITY, 2.0]),
                source("mi2", [7.0, 0.5, 1.0]),
                source("ac", [9.0, f64::INFINITY, f64::INFINITY]),
            ],
        };
        let ranked = ["oak", "ash"].map(|s| RankedSurface { surface: s.into(), score: 1.0 });
        let ranking = Ranking {
            ranked: ranked.into(),
            margin: 1.0,
            sources: Vec::new(),
            nearest: TrialKey::new("oak", "expert", 1),
            confidence: None,
            p_value: None,
        };
        let why = Why::new(ranking, Some(&evidence), None, Vec::new());
        let said: Vec<_> = why
            .sources
            .iter()
            .map(|s| (s.source.as_str(), s.for_winner, s.alone.as_deref().unwrap()))
            .collect();
        let expected = [("mi2", Some(6.0), "elm"), ("ir", Some(-1.0), "ash"), ("ac", None, "ash")];
        assert_eq!(said, expected);
    }
}
