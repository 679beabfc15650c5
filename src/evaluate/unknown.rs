//! Measures how often a method calls queries unknown, by leaving whole surfaces out of the library.

use std::collections::BTreeSet;

use serde::Serializer;

use super::evaluation::Run;
use super::{EvaluateError, Share};
use crate::recognise::{RecogniseError, Rejection, RejectionError};

/// How many queries were called unknown, for surfaces left out of the library and for those in it.
/// Shares are fractions from 0 to 1, with 95 % Wilson intervals.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct UnknownOutcome {
    /// The stated rate of known surfaces called unknown, and its interval for the smallest library.
    pub stated: Rejection,
    /// Number of groups of surfaces that were left out in turn.
    pub groups: usize,
    /// How many queries of left-out surfaces were called unknown.
    #[serde(flatten, serialize_with = "caught")]
    pub unknown: Share,
    /// How many queries of surfaces in the library were called unknown.
    #[serde(flatten, serialize_with = "rejected")]
    pub known: Share,
    pub folds: usize,
    /// Number of folds in which the share of false rejections lies in the interval stated for the fold.
    pub folds_as_stated: usize,
}

fn caught<S: Serializer>(share: &Share, to: S) -> Result<S::Ok, S::Error> {
    Share::write(Some(*share), Some("unknown_queries"), "unknown_caught", to)
}

fn rejected<S: Serializer>(share: &Share, to: S) -> Result<S::Ok, S::Error> {
    Share::write(Some(*share), Some("known_queries"), "false_rejections", to)
}

impl UnknownOutcome {
    /// Leaves each group of surfaces out of a fold's library in turn, and names all queries of the
    /// fold at a stated `rate` of false rejections. Surface k, in alphabetical order, is in group
    /// k mod `groups`. So surfaces with similar names, which may be similar, are in different groups.
    ///
    /// # Errors
    /// If a trial cannot be compared, or if the method or a library cannot recognise unknown
    /// surfaces at this rate.
    pub fn of(run: &Run<'_, '_>, groups: usize, rate: Option<f64>) -> Result<Self, EvaluateError> {
        let folds = run.on.folds;
        let surface = |i: usize| run.on.trials.key(i).surface.as_str();
        let surfaces: BTreeSet<&str> =
            folds.iter().flat_map(|fold| &fold.library).map(|&i| surface(i)).collect();
        let surfaces: Vec<&str> = surfaces.into_iter().collect();
        let groups = groups.min(surfaces.len());
        // The search finds every surface, since the surfaces of queries are also in a library.
        let group = |i: usize| surfaces.binary_search(&surface(i)).unwrap_or(0) % groups.max(1);
        let (mut unknown, mut known) = (Share::default(), Share::default());
        let mut folds_as_stated = 0;
        let mut stated: Option<Rejection> = None;
        for (index, fold) in folds.iter().enumerate() {
            let mut queries = Vec::new();
            let (mut of_fold, mut in_fold) = (Share::default(), None);
            for left_out in 0..groups {
                let model = run.fit(fold.library.iter().filter(|&&i| group(i) != left_out))?;
                let embedding = model.clone().embedding().ok_or(RejectionError::NoPValue)?;
                let rejection = embedding.rejection(rate)?;
                if queries.is_empty() {
                    // All models expect the same rates and channels, so one preparation fits all.
                    let query =
                        |&i: &usize| Ok((i, run.query(&model, i, run.on.query_seconds)?.prepared));
                    queries =
                        fold.queries.iter().map(query).collect::<Result<_, RecogniseError>>()?;
                }
                for (i, query) in &queries {
                    let p_value = model.rank(query)?.p_value;
                    let count = if group(*i) == left_out { &mut unknown } else { &mut of_fold };
                    count.add(p_value.is_some_and(|p| rejection.rejects(p)));
                }
                in_fold.get_or_insert(rejection.rate_low..=rejection.rate_high);
                if stated.as_ref().is_none_or(|stated| rejection.trials < stated.trials) {
                    stated = Some(rejection);
                }
                let done = index * groups + left_out + 1;
                (run.on.progress)("leaving surfaces out", done, folds.len() * groups);
            }
            known.join(of_fold);
            folds_as_stated += usize::from(in_fold.is_some_and(|it| it.contains(&of_fold.value())));
        }
        // At least one fold has at least two surfaces, so there is a model.
        let stated = stated.expect("at least one model");
        let folds = folds.len();
        Ok(Self { stated, groups, unknown, known, folds, folds_as_stated })
    }
}
