//! Hand-made features of a trial, for the comparison classifiers, and log-band frames, which
//! `embedding` uses, too. A [`FeatureVector`] holds
//!
//! | source | features, for each channel | |
//! |---|---|---|
//! | any series | `series_statistics::MOMENTS` | level, spread, moments and ratios in time |
//! | domain `spectrum` | log-band levels, mean and deviation over frames of 46 ms | up to 40 bands |
//! | domain `time` | the same over frames of 0.2 s, to 500 Hz | up to 16 bands |
//! | picture | `picture_statistics::FEATURES` | colour statistics, co-occurrence |
//!
//! The features of a trial depend on that trial alone.

pub(crate) mod picture_statistics;
pub(crate) mod series_statistics;
pub(super) mod windowed_frames;

use std::collections::BTreeMap;

use rayon::prelude::*;

use crate::recognise::checks::check_signal;
use crate::recognise::error::RecogniseError;
use crate::scene::{Scene, SourceId, SourceSpec};
use crate::trial::{Signal, Trial, TrialKey};

/// Features of one source of one trial.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct SourceFeatures {
    /// The values, in the order that the documentation of this module gives.
    pub values: Vec<f64>,
    /// The recording's rate in Hz; 0 for pictures, and where only the features are known.
    pub rate_hz: f64,
}

/// Features of a trial, source by source.
#[derive(Clone, Debug, PartialEq)]
pub struct FeatureVector {
    pub key: TrialKey,
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

/// Hue (in turns, 0 to below 1), saturation and value (0 to 1) of 8-bit red, green and blue.
///
/// Grey has hue 0 and saturation 0, black also value 0 (Smith 1978, "Color gamut transform
/// pairs", as MATLAB's `rgb2hsv`).
pub fn hsv(rgb: [u8; 3]) -> [f64; 3] {
    let [r, g, b] = rgb.map(|x| f64::from(x) / 255.0);
    let max = r.max(g).max(b);
    let min = r.min(g).min(b);
    let span = max - min;
    if span == 0.0 {
        return [0.0, 0.0, max];
    }
    let sixths = if max == r {
        (g - b) / span
    } else if max == g {
        2.0 + (b - r) / span
    } else {
        4.0 + (r - g) / span
    };
    [(sixths / 6.0).rem_euclid(1.0), span / max, max]
}
