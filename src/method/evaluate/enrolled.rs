//! Measures how much it helps to enroll a new user, that is, to add one or a few of the user's scans of
//! every surface to the library.

use std::collections::BTreeMap;

use serde::Serializer;

use super::evaluation::{Measured, Run};
use super::{EvaluateError, Fold, Share};
use crate::trial::TrialKey;

/// Moves the first `count` trials of each surface and user from the queries of each fold to its
/// library. Drops folds that then have no queries. Each fold should leave out one user.
pub fn enrol(folds: &[Fold], keys: &[TrialKey], count: usize) -> Result<Vec<Fold>, EvaluateError> {
    let enrolled = folds.iter().map(|fold| enrol_in(fold, keys, count));
    let folds: Vec<Fold> = enrolled.filter(|fold| !fold.queries.is_empty()).collect();
    if folds.is_empty() {
        return Err(EvaluateError::Trials(format!(
            "no user has more than {count} trial(s) of a surface, so none is left to name"
        )));
    }
    Ok(folds)
}

fn enrol_in(fold: &Fold, keys: &[TrialKey], count: usize) -> Fold {
    let mut of_surface: BTreeMap<(&str, &str), Vec<usize>> = BTreeMap::new();
    for &i in &fold.queries {
        of_surface.entry((&keys[i].surface, &keys[i].user)).or_default().push(i);
    }
    let (mut library, mut queries) = (fold.library.clone(), Vec::new());
    for mut trials in of_surface.into_values() {
        trials.sort_by_key(|&i| keys[i].number);
        let rest = trials.split_off(count.min(trials.len()));
        library.extend(trials);
        queries.extend(rest);
    }
    library.sort_unstable();
    queries.sort_unstable();
    Fold { name: fold.name.clone(), library, queries }
}

/// Accuracies, from 0 to 1, on the same queries with and without the user's trials in the library.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct EnrolmentOutcome {
    /// Number of trials of each surface that the user enrolled.
    pub trials: usize,
    /// Share of queries named correctly with the user's trials in the library.
    pub accuracy: f64,
    /// Share of the same queries named correctly without the user's trials in the library.
    #[serde(flatten, serialize_with = "without")]
    pub without: Share,
    pub gain: f64,
}

fn without<S: Serializer>(share: &Share, to: S) -> Result<S::Ok, S::Error> {
    share.write(None, "accuracy_without", to)
}

impl EnrolmentOutcome {
    /// Names the queries of the run again without the enrolled trials, and compares the accuracy
    /// with that of `with`. `before` holds the folds from which `enrol` made the folds of the run.
    ///
    /// # Errors
    /// If a trial cannot be read or compared.
    pub fn of(
        run: &Run<'_, '_>,
        with: &Measured,
        before: &[Fold],
        count: usize,
    ) -> Result<Self, EvaluateError> {
        let without = |fold: &Fold| {
            let library = before.iter().find(|other| other.name == fold.name)?.library.clone();
            Some(Fold { library, ..fold.clone() })
        };
        let folds: Vec<Fold> = run.on.folds.iter().filter_map(without).collect();
        let without = run.measure_by(&folds, &[run.on.query_seconds])?.swap_remove(0).outcome;
        let (accuracy, without) = (with.outcome.share.value(), without.share);
        Ok(Self { trials: count, accuracy, without, gain: accuracy - without.value() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluate::{EvaluatedTrials, Evaluation, Protocol, folds};
    use crate::features::{FeatureVector, SourceFeatures};
    use crate::recognise::{MethodName, MethodSpec};
    use crate::scene::{Scene, SourceId};
    use crate::trial::EXPERT;

    fn keys() -> Vec<TrialKey> {
        let mut keys = Vec::new();
        for surface in ["a", "b"] {
            keys.extend((1..=2).map(|n| TrialKey::new(surface, EXPERT, n)));
            // The trial numbers are out of order, since `enrol` must sort trials by number.
            keys.extend([3, 1, 2].map(|n| TrialKey::new(surface, "user1", n)));
            keys.push(TrialKey::new(surface, "user2", 1));
        }
        keys
    }

    #[test]
    fn a_user_s_first_trials_of_each_surface_join_the_library_and_are_no_queries() {
        let keys = keys();
        let of = |protocol| enrol(&folds(protocol, &keys).unwrap(), &keys, 1).unwrap();
        let by_expert = of(Protocol::ExpertVsUsers);
        // user2 has no second trial to name.
        assert_eq!(by_expert.len(), 1);
        assert_eq!(by_expert[0].library, [0, 1, 3, 6, 7, 9], "trial 1 by user1 is enrolled");
        assert_eq!(by_expert[0].queries, [2, 4, 8, 10]);
        assert_eq!(of(Protocol::AllVsOneUser)[1].library, [0, 1, 3, 5, 6, 7, 9, 11]);
    }

    /// The user's trials of `a` are nearer to the expert's trials of `b`, so only enrolling helps.
    #[test]
    fn the_gain_is_measured_on_the_same_queries() {
        let value = |key: &TrialKey| {
            let hand = if key.user == EXPERT { 0.0 } else { 6.0 };
            hand + if key.surface == "a" { 0.0 } else { 10.0 } + 0.01 * f64::from(key.number)
        };
        let trial = |key: TrialKey| {
            let values = vec![value(&key)];
            let source = SourceId::new("mi2").unwrap();
            let features = SourceFeatures { values, rate_hz: 0.0 };
            FeatureVector { key, sources: [(source, features)].into() }
        };
        let keys = keys();
        let trials: Vec<FeatureVector> = keys.iter().cloned().map(trial).collect();
        let before = folds(Protocol::ExpertVsUsers, &keys).unwrap();
        let folds = enrol(&before, &keys, 1).unwrap();
        let scene = Scene::lmt108();
        let evaluation = Evaluation {
            trials: EvaluatedTrials::Features(&trials),
            ..Evaluation::new(&scene, &[], &folds)
        };
        let method = MethodSpec::from(MethodName::Knn).build(&scene);
        let run = evaluation.prepare(&*method).unwrap();
        let measured = run.measure().unwrap();
        let outcome = EnrolmentOutcome::of(&run, &measured, &before, 1).unwrap();
        assert_eq!((measured.outcome.queries, outcome.accuracy), (4, 1.0));
        assert_eq!((outcome.without.value(), outcome.gain), (0.5, 0.5));
    }

    #[test]
    fn none_enrolled_changes_nothing_and_all_enrolled_leaves_nothing_to_name() {
        let keys = keys();
        let folds = folds(Protocol::ExpertVsUsers, &keys).unwrap();
        assert_eq!(enrol(&folds, &keys, 0).unwrap(), folds);
        let error = enrol(&folds, &keys, 3).unwrap_err().to_string();
        assert!(error.contains("none is left to name"), "{error}");
    }
}
