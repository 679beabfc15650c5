//! Turns one recording into numbers. Nothing here knows of labels, models or rankings.
//!
//! For the method `embedding` (`src/method/README.md` §4), a trial becomes [`frames::TrialFrames`]:
//!
//! | file | holds |
//! |---|---|
//! | `sources` | the sources of a trial, checked against the scene |
//! | `frames` | a trial as frames and sums, with its copies and beginnings |
//! | `views` | how long frames are |
//! | `growing` | a series as it grows: every recording goes this way |
//! | `windowed_frames` | log-band frames, which hand-made features have too |
//! | `passed` | the part of a series within its band |
//! | `moments`, `quantiles`, `places` | sums of a series, and what they say |
//! | `tiles`, `pixels` | a picture as frames, and its sums |
//! | `counts` | histograms of frames and tiles |
//! | `copies` | augmented copies of a library's trials |
//! | `packed` | numbers in few bytes |
//!
//! A [`FeatureVector`] holds hand-made features, for the comparison classifiers:
//!
//! | source | features, for each channel | |
//! |---|---|---|
//! | any series | `series_statistics::moments` | level, spread, moments and ratios in time |
//! | domain `spectrum` | log-band levels, mean and deviation over frames of 46 ms | up to 40 bands |
//! | domain `time` | the same over frames of 0.2 s, to 500 Hz | up to 16 bands |
//! | picture | `picture_statistics::features` | colour statistics, co-occurrence |
//!
//! The features of a trial do not depend on other trials.

pub(crate) mod copies;
pub(crate) mod counts;
pub(crate) mod frames;
pub(crate) mod growing;
pub(crate) mod moments;
pub(crate) mod packed;
mod passed;
mod picture_statistics;
pub(crate) mod pixels;
pub(crate) mod places;
pub(crate) mod quantiles;
mod series_statistics;
pub(crate) mod sources;
pub(crate) mod tiles;
pub(crate) mod views;
pub(crate) mod windowed_frames;

use std::collections::BTreeMap;

use self::sources::{SourceError, of_known_sources};
use crate::scene::{Scene, SourceId};
use crate::trial::{Signal, Trial, TrialKey};

#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct SourceFeatures {
    /// The values, in the order of the second table at the top of this module.
    pub values: Vec<f64>,
    /// The recording's rate in Hz; 0 for pictures and for features that were read from a table.
    pub rate_hz: f64,
}

#[derive(Clone, Debug, PartialEq)]
pub struct FeatureVector {
    pub key: TrialKey,
    pub sources: BTreeMap<SourceId, SourceFeatures>,
}

impl FeatureVector {
    /// The features of each source of a trial that the scene describes.
    ///
    /// # Errors
    /// If a source has another kind or another number of channels than the scene says.
    pub fn new(key: &TrialKey, trial: &Trial, scene: &Scene) -> Result<Self, SourceError> {
        let sources = of_known_sources(key, trial, scene, |spec, signal| match signal {
            Signal::Image(image) => {
                SourceFeatures { values: picture_statistics::features(image), rate_hz: 0.0 }
            }
            Signal::Series(series) => SourceFeatures {
                values: series_statistics::features(series, &spec.domain),
                rate_hz: series.rate_hz(),
            },
        })?;
        Ok(Self { key: key.clone(), sources })
    }
}

/// Hue (in turns, 0 to below 1), saturation and value (0 to 1) of 8-bit red, green and blue.
///
/// Grey has hue 0 and saturation 0; black also has value 0 (Smith 1978, "Color gamut transform pairs",
/// like MATLAB's `rgb2hsv`).
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
