//! Hand-made features of a trial, source by source, for the comparison classifiers.

use std::collections::BTreeMap;

use rayon::prelude::*;

use super::{picture_statistics, series_statistics};
use crate::recognise::checks::check_signal;
use crate::recognise::error::RecogniseError;
use crate::scene::{Scene, SourceId, SourceSpec};
use crate::trial::{Signal, Trial, TrialKey};

/// Features of one source of one trial.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct SourceFeatures {
    /// The values, in the order that the documentation of [`super`] gives.
    pub values: Vec<f64>,
    /// The recording's rate in Hz; 0 for pictures, and where only the features are known.
    pub rate_hz: f64,
}

/// Features of a trial, source by source.
#[derive(Clone, Debug, PartialEq)]
pub struct FeatureVector {
    /// The trial's key.
    pub key: TrialKey,
    /// Its features.
    pub sources: BTreeMap<SourceId, SourceFeatures>,
}

impl FeatureVector {
    /// The features of those sources of a trial that the scene describes.
    ///
    /// # Errors
    /// If a source is of another kind, or has another number of channels, than the scene says.
    pub fn new(key: &TrialKey, trial: &Trial, scene: &Scene) -> Result<Self, RecogniseError> {
        let known: Vec<(&SourceSpec, &Signal)> = (trial.signals.iter())
            .filter_map(|(id, signal)| Some((scene.get(id.as_str())?, signal)))
            .collect();
        let features = |(spec, signal): (&SourceSpec, &Signal)| {
            check_signal(spec, signal, key)?;
            let features = match signal {
                Signal::Image(image) => {
                    SourceFeatures { values: picture_statistics::features(image), rate_hz: 0.0 }
                }
                Signal::Series(series) => SourceFeatures {
                    values: series_statistics::features(series, &spec.domain),
                    rate_hz: series.rate_hz(),
                },
            };
            Ok((spec.id.clone(), features))
        };
        let sources = known.into_par_iter().map(features).collect::<Result<_, RecogniseError>>()?;
        Ok(Self { key: key.clone(), sources })
    }
}
