//! How well a method tells surfaces that are not in the library: whole surfaces are left out.

use std::collections::BTreeSet;
use std::sync::Arc;

use super::run::Progress;
use super::{EvaluateError, Fold, wilson_interval};
use crate::library::Entry;
use crate::recognise::{Method, Model, PreparedLibrary, RecogniseError, Rejection};

/// Queries of surfaces that were left out of the library, and of those that were not. Shares are
/// fractions from 0 to 1, with 95 % Wilson intervals.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct UnknownOutcome {
    /// False rejections as stated, with the interval that the smallest library leaves.
    pub stated: Rejection,
    /// The surfaces were left out in so many groups, in turn.
    pub groups: usize,
    /// Queries of surfaces that had been left out.
    pub unknown_queries: usize,
    /// Share of these that were called unknown.
    pub unknown_caught: f64,
    /// Its interval.
    pub unknown_caught_low: f64,
    /// Its interval.
    pub unknown_caught_high: f64,
    /// Queries of surfaces in the library.
    pub known_queries: usize,
    /// Share of these that were called unknown.
    pub false_rejections: f64,
    /// Its interval.
    pub false_rejections_low: f64,
    /// Its interval.
    pub false_rejections_high: f64,
}

/// Names every query of every fold against the fold's library without each group of surfaces in
/// turn. Surface k, in alphabetical order, is in group k mod `groups`, so that look-alikes with
/// like names are in different ones.
///
/// # Errors
/// If a trial cannot be compared, or if the method or a library cannot tell unknown surfaces at
/// `rate` false rejections.
pub fn run_unknown(
    method: &dyn Method,
    entries: &[Entry],
    folds: &[Fold],
    prepared: &PreparedLibrary,
    as_query: impl Fn(&Arc<dyn Model>, &Entry) -> Entry,
    (groups, rate): (usize, f64),
    progress: Progress<'_>,
) -> Result<UnknownOutcome, EvaluateError> {
    let surfaces: BTreeSet<&str> = folds
        .iter()
        .flat_map(|fold| fold.library.iter().map(|&i| entries[i].key.surface.as_str()))
        .collect();
    let surfaces: Vec<&str> = surfaces.into_iter().collect();
    let groups = groups.min(surfaces.len());
    // Every surface of a fold's queries is in its library.
    let group = |i: usize| {
        surfaces.binary_search(&entries[i].key.surface.as_str()).unwrap_or(0) % groups.max(1)
    };
    let (mut unknown, mut caught, mut known, mut rejected) = (0, 0, 0, 0);
    let mut stated: Option<Rejection> = None;
    for (index, fold) in folds.iter().enumerate() {
        let mut queries = Vec::new();
        for left_out in 0..groups {
            let kept = fold.library.iter().filter(|&&i| group(i) != left_out);
            let model = prepared.fit(method, kept)?;
            let rejection = model.rejection(rate)?;
            if queries.is_empty() {
                // The libraries have one shape, so what one model prepares serves all.
                let query = |&i: &usize| -> Result<_, RecogniseError> {
                    let entry = as_query(&model, &entries[i]);
                    Ok((i, model.prepare(&entry, &entry.load()?)?))
                };
                queries = fold.queries.iter().map(query).collect::<Result<_, _>>()?;
            }
            for (i, query) in &queries {
                let p_value = model.rank(query)?.p_value;
                let is_unknown = usize::from(p_value.is_some_and(|p| rejection.rejects(p)));
                if group(*i) == left_out {
                    (unknown, caught) = (unknown + 1, caught + is_unknown);
                } else {
                    (known, rejected) = (known + 1, rejected + is_unknown);
                }
            }
            if stated.as_ref().is_none_or(|stated| rejection.trials < stated.trials) {
                stated = Some(rejection);
            }
            progress("leaving surfaces out", index * groups + left_out + 1, folds.len() * groups);
        }
    }
    let share = |k: usize, n: usize| k as f64 / n.max(1) as f64;
    let of_unknown = wilson_interval(caught, unknown);
    let of_known = wilson_interval(rejected, known);
    Ok(UnknownOutcome {
        // `folds` gives at least one fold, and a fold at least two surfaces.
        stated: stated.expect("at least one model"),
        groups,
        unknown_queries: unknown,
        unknown_caught: share(caught, unknown),
        unknown_caught_low: of_unknown.0,
        unknown_caught_high: of_unknown.1,
        known_queries: known,
        false_rejections: share(rejected, known),
        false_rejections_low: of_known.0,
        false_rejections_high: of_known.1,
    })
}
