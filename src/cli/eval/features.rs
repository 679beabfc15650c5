//! `surfaced eval` on feature tables: the comparison classifiers alone can use them.

use super::{Answer, Args, Report, finish};
use crate::cli::{Done, Failure, show};
use crate::dataset::table::FeatureTables;
use crate::evaluate::{self, EvaluateError};
use crate::recognise::RecogniseError;
use crate::recognise::features::{FeatureVector, SourceFeatures};
use crate::scene::{Scene, SourceId};
use crate::trial::TrialKey;

/// Runs the command.
pub fn run(args: &Args, tables: &FeatureTables) -> Done {
    let Some(protocol) = args.protocol else {
        return Err(Failure::Usage("--paper needs recordings; these are feature tables".into()));
    };
    if args.query_seconds.is_some() {
        return Err(Failure::Usage("--query-seconds needs recordings; these are features".into()));
    }
    let trials = vectors(tables, &args.sources.sources)?;
    say!(
        "{}: feature tables {}, {} trials",
        tables.name,
        tables.sources.iter().map(SourceId::as_str).collect::<Vec<_>>().join(", "),
        trials.len()
    );
    let keys: Vec<TrialKey> = trials.iter().map(|trial| trial.key.clone()).collect();
    let folds = evaluate::folds(protocol, &keys)?;
    let method = args.method.spec()?.build(&Scene::lmt108());
    let steps = show::Steps::new();
    let progress = |step, done, of| steps.show(step, done, of);
    let (outcome, predictions) = evaluate::run_features(&*method, &trials, &folds, &progress)
        .map_err(|error| match error {
            EvaluateError::Recognise(e @ RecogniseError::NeedsRecordings(_)) => {
                Failure::Usage(e.to_string())
            }
            other => other.into(),
        })?;
    drop(steps);
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
fn vectors(tables: &FeatureTables, asked: &[SourceId]) -> Result<Vec<FeatureVector>, Failure> {
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
    Ok(trials.collect())
}

fn features(
    of_trial: &std::collections::BTreeMap<SourceId, Vec<f64>>,
    wanted: &dyn Fn(&SourceId) -> bool,
) -> std::collections::BTreeMap<SourceId, SourceFeatures> {
    let kept = of_trial.iter().filter(|(id, _)| wanted(id));
    kept.map(|(id, values)| (id.clone(), SourceFeatures { values: values.clone(), rate_hz: 0.0 }))
        .collect()
}
