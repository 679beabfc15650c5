//! How many queries of surfaces that the library lacks a method calls unknown: whole surfaces are
//! left out.

use std::collections::BTreeSet;

use super::evaluation::Run;
use super::{EvaluateError, wilson_interval};
use crate::recognise::{RecogniseError, Rejection};

/// Queries of surfaces that were left out of the library, and of those that were not. Shares are
/// fractions from 0 to 1, with 95 % Wilson intervals.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct UnknownOutcome {
    /// False rejections as stated, with the interval that the smallest library leaves.
    pub stated: Rejection,
    /// Number of groups of surfaces that were left out in turn.
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
    /// Number of folds.
    pub folds: usize,
    /// Folds whose own share of false rejections lies in the interval stated there.
    pub folds_as_stated: usize,
}

/// How many of how many.
#[derive(Clone, Copy, Default)]
struct Count {
    hits: usize,
    of: usize,
}

impl Count {
    fn add(&mut self, hit: bool) {
        *self = Self { hits: self.hits + usize::from(hit), of: self.of + 1 };
    }

    fn join(&mut self, other: Self) {
        *self = Self { hits: self.hits + other.hits, of: self.of + other.of };
    }

    fn share(self) -> f64 {
        self.hits as f64 / self.of.max(1) as f64
    }
}

impl UnknownOutcome {
    /// Names every query of every fold by the fold's library without each group of surfaces in
    /// turn, at a stated `rate` of false rejections. Surface k, in alphabetical order, is in group
    /// k mod `groups`, so that look-alikes with similar names are in different ones.
    ///
    /// # Errors
    /// If a trial cannot be compared, or if the method or a library cannot recognise unknown
    /// surfaces at this rate.
    pub fn of(run: &Run<'_, '_>, groups: usize, rate: Option<f64>) -> Result<Self, EvaluateError> {
        let folds = run.on().folds;
        let surface = |i: usize| run.on().trials.key(i).surface.as_str();
        let surfaces: BTreeSet<&str> =
            folds.iter().flat_map(|fold| &fold.library).map(|&i| surface(i)).collect();
        let surfaces: Vec<&str> = surfaces.into_iter().collect();
        let groups = groups.min(surfaces.len());
        // Every surface of a fold's queries is in its library.
        let group = |i: usize| surfaces.binary_search(&surface(i)).unwrap_or(0) % groups.max(1);
        let (mut unknown, mut known) = (Count::default(), Count::default());
        let mut folds_as_stated = 0;
        let mut stated: Option<Rejection> = None;
        for (index, fold) in folds.iter().enumerate() {
            let mut queries = Vec::new();
            let (mut of_fold, mut in_fold) = (Count::default(), None);
            for left_out in 0..groups {
                let model = run.fit(fold.library.iter().filter(|&&i| group(i) != left_out))?;
                let rejection = model.rejection(rate)?;
                if queries.is_empty() {
                    // The libraries have one shape, so what one model prepares serves all.
                    let query = |&i: &usize| {
                        Ok((i, run.query(&*model, i, run.on().query_seconds)?.prepared))
                    };
                    queries =
                        fold.queries.iter().map(query).collect::<Result<_, RecogniseError>>()?;
                }
                for (i, query) in &queries {
                    let p_value = model.rank(query)?.p_value;
                    let count = if group(*i) == left_out { &mut unknown } else { &mut of_fold };
                    count.add(p_value.is_some_and(|p| rejection.rejects(p)));
                }
                in_fold.get_or_insert_with(|| rejection.rate_low..=rejection.rate_high);
                if stated.as_ref().is_none_or(|stated| rejection.trials < stated.trials) {
                    stated = Some(rejection);
                }
                let done = index * groups + left_out + 1;
                (run.on().progress)("leaving surfaces out", done, folds.len() * groups);
            }
            known.join(of_fold);
            folds_as_stated += usize::from(in_fold.is_some_and(|it| it.contains(&of_fold.share())));
        }
        // `folds` gives at least one fold, and a fold at least two surfaces.
        let stated = stated.expect("at least one model");
        let counts = (unknown, known);
        Ok(Self::new(stated, groups, counts, (folds.len(), folds_as_stated)))
    }

    fn new(
        stated: Rejection,
        groups: usize,
        (unknown, known): (Count, Count),
        (folds, folds_as_stated): (usize, usize),
    ) -> Self {
        let of_unknown = wilson_interval(unknown.hits, unknown.of);
        let of_known = wilson_interval(known.hits, known.of);
        Self {
            stated,
            groups,
            unknown_queries: unknown.of,
            unknown_caught: unknown.share(),
            unknown_caught_low: of_unknown.0,
            unknown_caught_high: of_unknown.1,
            known_queries: known.of,
            false_rejections: known.share(),
            false_rejections_low: of_known.0,
            false_rejections_high: of_known.1,
            folds,
            folds_as_stated,
        }
    }
}
