//! `surfaced eval` on feature tables: the comparison classifiers alone can use them.

use std::sync::Arc;

use super::{Answer, Args, Report, finish};
use crate::cli::method::WithClassifier;
use crate::cli::{Done, Failure, show};
use crate::dataset::table::FeatureTables;
use crate::evaluate::{self, EvaluateError, Fold, Outcome, Prediction};
use crate::recognise::Method;
use crate::recognise::features::{FeatureVector, SourceFeatures};
use crate::scene::{Scene, SourceId};
use crate::trial::TrialKey;

struct Tables<'a> {
    trials: &'a [Arc<FeatureVector>],
    folds: &'a [Fold],
}

impl WithClassifier for Tables<'_> {
    type Output = Result<(Outcome, Vec<Prediction>), EvaluateError>;

    fn with(self, method: impl Method<Prepared = FeatureVector> + 'static) -> Self::Output {
        let steps = show::Steps::new();
        let progress = |step, done, of| steps.tell(step, done, of);
        evaluate::run_features(&method, self.trials, self.folds, &progress)
    }
}

/// Runs the command.
pub fn run(args: &Args, tables: &FeatureTables) -> Done {
    let Some(protocol) = args.protocol else {
        return Err(Failure::Usage("--paper needs recordings; these are feature tables".into()));
    };
    if args.query_seconds.is_some() {
        return Err(Failure::Usage("--query-seconds needs recordings; these are features".into()));
    }
    let trials = vectors(tables, &args.sources.sources)?;
    eprintln!(
        "{}: feature tables {}, {} trials",
        tables.name,
        tables.sources.iter().map(SourceId::as_str).collect::<Vec<_>>().join(", "),
        trials.len()
    );
    let keys: Vec<TrialKey> = trials.iter().map(|trial| trial.key.clone()).collect();
    let folds = evaluate::folds(protocol, &keys)?;
    let work = Tables { trials: &trials, folds: &folds };
    let Ok(outcome) = args.method.apply_to_features(&Scene::lmt108(), work) else {
        return Err(Failure::Usage(
            "this method needs recordings; on feature tables use --method naive-bayes, svm, knn, \
             mahalanobis, adaboost or random-forest"
                .into(),
        ));
    };
    let (outcome, predictions) = outcome?;
    finish(
        args.json,
        Report {
            outcome,
            protocol: protocol.name(),
            data: tables.name.clone(),
            synthetic: false,
            query_seconds: None,
            settled: None,
            unknown: None,
            predictions: predictions.into_iter().map(Answer::from).collect(),
        },
    )
}

/// The trials, with those of the tables that were asked for.
fn vectors(tables: &FeatureTables, asked: &[SourceId]) -> Result<Vec<Arc<FeatureVector>>, Failure> {
    if let Some(unknown) = asked.iter().find(|id| !tables.sources.contains(id)) {
        let known: Vec<_> = tables.sources.iter().map(SourceId::as_str).collect();
        return Err(Failure::Usage(format!("no table {unknown}; there are {}", known.join(", "))));
    }
    let wanted = |id: &SourceId| asked.is_empty() || asked.contains(id);
    let vector = |(key, sources): (&TrialKey, _)| FeatureVector {
        key: key.clone(),
        sources: features(sources, &wanted),
    };
    let trials = tables.trials.iter().map(vector).filter(|trial| !trial.sources.is_empty());
    Ok(trials.map(Arc::new).collect())
}

fn features(
    of_trial: &std::collections::BTreeMap<SourceId, Vec<f64>>,
    wanted: &dyn Fn(&SourceId) -> bool,
) -> std::collections::BTreeMap<SourceId, SourceFeatures> {
    let kept = of_trial.iter().filter(|(id, _)| wanted(id));
    kept.map(|(id, values)| (id.clone(), SourceFeatures { values: values.clone(), rate_hz: 0.0 }))
        .collect()
}
