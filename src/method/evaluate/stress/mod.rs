//! Measures how each method copes with disturbances, from none to absurd.
//!
//! ```text
//! disturb (Trial ─► Trial, seeded) ─► run (method × disturbance × level) ─► report ─► figure
//! ```
//!
//! Most disturbances change the queries and leave the library clean; a few change the library. A run
//! measures at each level:
//! - the accuracy,
//! - the share of queries of unknown surfaces that would be rejected. For this, a library lacks
//!   every fourth surface, and a threshold on the margin rejects 5 % of the undisturbed answers,
//! - the expected calibration error, for methods that state a probability.
//!
//! Unknown surfaces are no disturbance of their own, since they have no severity.
//! [`crate::evaluate::UnknownOutcome`] measures whether the stated rate of false rejections holds.

#[doc(hidden)]
pub mod disturb;
mod figure;
mod report;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use rayon::prelude::*;

use self::disturb::Kind;
pub use self::disturb::{Disturbance, all};
#[doc(hidden)]
pub use self::figure::{Measure, figure};
#[doc(hidden)]
pub use self::report::StressReport;
use self::report::{DisturbanceLevel, DisturbanceSeries, MethodReport, StressCell};
use crate::evaluate::{EvaluateError, Evaluation, Fold, ProgressFn, Run, Share};
use crate::library::Entry;
use crate::recognise::{Method, Model, Ranking, RecogniseError, chance};
use crate::scene::Scene;
use crate::seed;
use crate::trial::Trial;

/// One surface in this many is left out of a library, so that its queries are unknown.
const UNKNOWN_SHARE: usize = 4;
/// Share of undisturbed answers that the threshold on the margin (lead of the answer) rejects.
const REJECTED: f64 = 0.05;
/// Number of bins into which the calibration error sorts stated probabilities.
const BINS: usize = 10;

pub struct StressPlan<'a> {
    pub scene: &'a Scene,
    pub entries: &'a [Entry],
    /// Queries and libraries; see [`StressPlan::limited`].
    pub folds: &'a [Fold],
    pub disturbances: &'a [Disturbance],
    pub seed: u64,
}

impl StressPlan<'_> {
    /// The first folds that together hold this number of queries; the last fold is thinned to fit.
    pub fn limited(folds: Vec<Fold>, queries: usize) -> Vec<Fold> {
        let mut left = queries;
        let mut kept = Vec::new();
        for mut fold in folds {
            if left == 0 {
                break;
            }
            let step = fold.queries.len().div_ceil(left).max(1);
            fold.queries = fold.queries.into_iter().step_by(step).take(left).collect();
            left -= fold.queries.len();
            kept.push(fold);
        }
        kept
    }

    /// The share of the queries that is named right if their most frequent surface is always named.
    fn chance(&self) -> f64 {
        let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
        for &query in self.folds.iter().flat_map(|fold| &fold.queries) {
            *counts.entry(&self.entries[query].key.surface).or_default() += 1;
        }
        chance(counts.values().copied())
    }

    /// For each entry, whether it is also compared with a library without its surface.
    pub fn unknown(&self) -> Vec<bool> {
        let surfaces: BTreeSet<&str> =
            self.entries.iter().map(|entry| entry.key.surface.as_str()).collect();
        let left_out: BTreeSet<&str> = match surfaces.len() > UNKNOWN_SHARE {
            true => surfaces.into_iter().step_by(UNKNOWN_SHARE).collect(),
            false => BTreeSet::new(),
        };
        self.entries.iter().map(|entry| left_out.contains(&*entry.key.surface)).collect()
    }
}

/// A query's answer from the whole library and, if asked for, from a library without its surface.
#[derive(Clone, Copy, Debug, Default)]
struct StressAnswer {
    /// `None` if the query could not be compared.
    known: Option<NamedQuery>,
    unknown: Option<Option<NamedQuery>>,
}

#[derive(Clone, Copy, Debug)]
struct NamedQuery {
    right: bool,
    margin: f64,
    confidence: Option<f64>,
}

/// Runs one method through all disturbances.
///
/// # Errors
/// If the library cannot be prepared. Queries that a method refuses count as named wrong.
pub fn run(
    method: &dyn Method,
    plan: &StressPlan<'_>,
    progress: ProgressFn<'_>,
) -> Result<MethodReport, EvaluateError> {
    let evaluation = Evaluation::new(plan.scene, plan.entries, plan.folds);
    let run = Evaluation { progress, ..evaluation }.prepare(method)?;
    let levels: usize = plan.disturbances.iter().map(|d| d.levels.len()).sum();
    let (mut done, total) = (0, plan.folds.len() * levels);
    let unknown = plan.unknown();
    let mut clean = Vec::new();
    let mut cells: Vec<Vec<Vec<StressAnswer>>> =
        plan.disturbances.iter().map(|d| vec![Vec::new(); d.levels.len()]).collect();
    for (index, fold) in plan.folds.iter().enumerate() {
        let models = Models::fit(&run, &unknown, fold, &fold.library)?;
        let load = |&query: &usize| Ok((query, run.recording(query)?));
        let queries = fold.queries.par_iter().map(load);
        let queries: Vec<(usize, Trial)> = queries.collect::<Result<_, RecogniseError>>()?;
        clean.extend(models.answers(&run, plan, &queries, Trial::clone));
        // Queries of one level come together, so that the library is cut to their length only once.
        for (d, of_disturbance) in plan.disturbances.iter().zip(&mut cells) {
            for (at, (&level, of_level)) in d.levels.iter().zip(of_disturbance).enumerate() {
                of_level.extend(match d.kind {
                    Kind::Library(change) => {
                        let key = [index.to_le_bytes(), at.to_le_bytes()];
                        let key = [b"library", d.name.as_bytes(), &key[0], &key[1]];
                        let entries = fold.library.iter().map(|&i| plan.entries[i].clone());
                        let entries =
                            change(entries.collect(), level, &mut seed::rng(plan.seed, &key));
                        let (name, library) = (fold.name.clone(), (0..entries.len()).collect());
                        let all = [Fold { name, library, queries: Vec::new() }];
                        let changed = Evaluation::new(plan.scene, &entries, &all);
                        let changed = changed.prepare(method)?;
                        let models = Models::fit(&changed, &unknown, fold, &all[0].library)?;
                        models.answers(&changed, plan, &queries, Trial::clone)
                    }
                    _ => models.answers(&run, plan, &queries, |raw| {
                        let (at, key) = (at.to_le_bytes(), raw.key.to_string());
                        let key = [b"stress", d.name.as_bytes(), &at, key.as_bytes()];
                        d.disturbed(raw, level, plan.scene, seed::rng(plan.seed, &key))
                    }),
                });
                done += 1;
                progress("disturbing", done, total);
            }
        }
    }
    Ok(sum_up(method.name(), plan, &clean, &cells))
}

/// A model of the whole library, and one without the surfaces that should be unknown.
struct Models<'u> {
    all: Arc<dyn Model>,
    without: Option<Arc<dyn Model>>,
    /// See [`StressPlan::unknown`].
    unknown: &'u [bool],
}

impl<'u> Models<'u> {
    /// Fits both models; `places` are indices of the fold's library trials in the prepared library.
    /// If a disturbance changed the library's size, there is only the model of the whole library.
    fn fit(
        run: &Run<'_, '_>,
        unknown: &'u [bool],
        fold: &Fold,
        places: &[usize],
    ) -> Result<Self, EvaluateError> {
        let known = (fold.library.iter().zip(places))
            .filter(|(trial, _)| !unknown[**trial])
            .map(|(_, place)| place);
        let known: Vec<&usize> = known.collect();
        let some_unknown = fold.library.len() == places.len() && known.len() < places.len();
        let without = some_unknown.then(|| run.fit(known)).transpose()?;
        Ok(Self { all: run.fit(places)?, without, unknown })
    }

    /// The answers to queries, given as (index, trial), after `change` was applied to each trial.
    fn answers(
        &self,
        run: &Run<'_, '_>,
        plan: &StressPlan<'_>,
        queries: &[(usize, Trial)],
        change: impl Fn(&Trial) -> Trial + Sync,
    ) -> Vec<StressAnswer> {
        let answer = |(query, raw): &(usize, Trial)| {
            // Both models expect the same rates and channels, so the query is prepared once.
            let Ok(disturbed) = run.query_of(&self.all, change(raw)) else {
                return StressAnswer::default();
            };
            let named = |ranking: Ranking| NamedQuery {
                right: ranking.surface() == plan.entries[*query].key.surface,
                margin: ranking.margin,
                confidence: ranking.confidence,
            };
            let rank = |model: &Arc<dyn Model>| model.rank(&disturbed.prepared).ok().map(named);
            let unknown = self.without.as_ref().filter(|_| self.unknown[*query]);
            StressAnswer { known: rank(&self.all), unknown: unknown.map(rank) }
        };
        queries.par_iter().map(answer).collect()
    }
}

fn sum_up(
    method: &str,
    plan: &StressPlan<'_>,
    clean: &[StressAnswer],
    cells: &[Vec<Vec<StressAnswer>>],
) -> MethodReport {
    let mut margins: Vec<f64> = clean.iter().filter_map(|a| Some(a.known?.margin)).collect();
    margins.sort_by(f64::total_cmp);
    let threshold = margins.get((REJECTED * margins.len() as f64) as usize).copied().unwrap_or(0.0);
    let undisturbed = cell(clean, threshold);
    let right = Share::count(clean.iter().map(|a| a.known.is_some_and(|named| named.right)));
    let may_be_chance = right.interval().0 <= plan.chance();
    let series = |(d, levels): (&Disturbance, &Vec<Vec<StressAnswer>>)| {
        let levels = (d.levels.iter().zip(levels))
            .map(|(&level, answers)| DisturbanceLevel { level, cell: cell(answers, threshold) })
            .collect();
        DisturbanceSeries::new(d.name, d.axis, levels, right)
    };
    let disturbances = plan.disturbances.iter().zip(cells).map(series).collect();
    MethodReport { method: method.into(), may_be_chance, clean: undisturbed, disturbances }
}

fn cell(answers: &[StressAnswer], threshold: f64) -> StressCell {
    let known: Vec<NamedQuery> = answers.iter().filter_map(|a| a.known).collect();
    // Queries that cannot be compared at all count as named wrong, and as rejected.
    let rejected = |named: Option<NamedQuery>| named.is_none_or(|named| named.margin < threshold);
    let right = Share::count(answers.iter().map(|a| a.known.is_some_and(|named| named.right)));
    let known_rejected = Share::count(answers.iter().map(|a| rejected(a.known)));
    let unknown = Share::count(answers.iter().filter_map(|a| a.unknown).map(rejected));
    StressCell {
        accuracy: right.value(),
        accuracy_interval: (right.of > 0).then(|| right.interval()),
        known_rejected: known_rejected.value(),
        unknown_rejected: (unknown.of > 0).then(|| unknown.value()),
        unknown_interval: (unknown.of > 0).then(|| unknown.interval()),
        calibration_error: calibration_error(&known),
        refused: answers.len() - known.len(),
    }
}

/// Expected calibration error (Guo et al. 2017): the difference between the share of right answers
/// and the mean stated probability within each tenth of probability, averaged over answers. `None`
/// if an answer states no probability.
fn calibration_error(answers: &[NamedQuery]) -> Option<f64> {
    let mut bins = [(0.0, 0.0); BINS];
    for named in answers {
        let stated = named.confidence?;
        let bin = ((stated * BINS as f64) as usize).min(BINS - 1);
        bins[bin].0 += stated;
        bins[bin].1 += f64::from(u8::from(named.right));
    }
    let off: f64 = bins.iter().map(|(stated, right)| f64::abs(stated - right)).sum();
    (!answers.is_empty()).then(|| off / answers.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn named(right: bool, confidence: f64) -> NamedQuery {
        NamedQuery { right, margin: confidence, confidence: Some(confidence) }
    }

    #[test]
    fn the_calibration_error_is_the_gap_between_statement_and_truth() {
        let sure = [named(true, 0.95), named(false, 0.95), named(true, 0.95), named(false, 0.95)];
        assert!((calibration_error(&sure).unwrap() - 0.45).abs() < 1e-12);
        assert_eq!(calibration_error(&[named(true, 1.0)]), Some(0.0));
        assert_eq!(calibration_error(&[]), None);
    }

    #[test]
    fn folds_are_taken_until_there_are_queries_enough() {
        let fold =
            |name: &str, queries: Vec<usize>| Fold { name: name.into(), library: vec![0], queries };
        let folds = vec![fold("a", (0..20).collect()), fold("b", (20..40).collect())];
        let limited = StressPlan::limited(folds.clone(), 25);
        assert_eq!(limited[0].queries.len(), 20);
        assert_eq!(limited[1].queries, [20, 24, 28, 32, 36]);
        assert_eq!(StressPlan::limited(folds, 10)[0].queries, [0, 2, 4, 6, 8, 10, 12, 14, 16, 18]);
    }
}
