//! Feature tables as trials: the comparison classifiers alone can use them.

use std::collections::BTreeMap;

use crate::cli::Failure;
use crate::dataset::table::FeatureTables;
use crate::recognise::features::{FeatureVector, SourceFeatures};
use crate::scene::SourceId;
use crate::trial::TrialKey;

/// The trials, with the chosen ones of the tables; with all if none is chosen.
///
/// # Errors
/// Wrong usage, if there is no such table.
pub fn vectors(tables: &FeatureTables, chosen: &[SourceId]) -> Result<Vec<FeatureVector>, Failure> {
    if let Some(unknown) = chosen.iter().find(|id| !tables.sources.contains(id)) {
        let known: Vec<_> = tables.sources.iter().map(SourceId::as_str).collect();
        return Err(Failure::Usage(format!("no table {unknown}; there are {}", known.join(", "))));
    }
    let wanted = |id: &SourceId| chosen.is_empty() || chosen.contains(id);
    let vector = |(key, sources): (&TrialKey, _)| FeatureVector {
        key: key.clone(),
        sources: features(sources, &wanted),
    };
    let trials = tables.trials.iter().map(vector).filter(|trial| !trial.sources.is_empty());
    let trials: Vec<FeatureVector> = trials.collect();
    say!(
        "{}: feature tables {}, {} trials",
        tables.name,
        tables.sources.iter().map(SourceId::as_str).collect::<Vec<_>>().join(", "),
        trials.len()
    );
    Ok(trials)
}

fn features(
    of_trial: &BTreeMap<SourceId, Vec<f64>>,
    wanted: &dyn Fn(&SourceId) -> bool,
) -> BTreeMap<SourceId, SourceFeatures> {
    let kept = of_trial.iter().filter(|(id, _)| wanted(id));
    kept.map(|(id, values)| (id.clone(), SourceFeatures { values: values.clone(), rate_hz: 0.0 }))
        .collect()
}
