//! A picture, or a quarter of it, as a vector (method §11): Fourier features of its tiles, moments,
//! covariance of pixels with those beside them, and the means of its channels.

use serde::{Deserialize, Serialize};

use super::band_sums::{Counts, ViewEmbedder};
use super::linear::{EigenPairs, push_upper};
use super::tiles::{CHANNELS, Part, PictureTiles, STACKED};

/// Added to the variances of a covariance, in its own unit.
const RIDGE: f64 = 1e-4;

/// The unit of variance in level: that of a deviation of a tenth of full scale.
const UNIT: f64 = 0.01;

/// How pictures of one source become vectors.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct PictureEmbedder {
    tiles: ViewEmbedder,
}

impl PictureEmbedder {
    /// In units of some pictures, at least one.
    pub fn new(pictures: &[&PictureTiles]) -> Self {
        let counts: Vec<Counts> = pictures.iter().map(|p| p.counts(Part::Whole)).collect();
        Self { tiles: ViewEmbedder::new(&counts) }
    }

    /// Length of a vector.
    pub fn dims(&self) -> usize {
        self.tiles.dims() + 4 * CHANNELS + STACKED * (STACKED + 1)
    }

    /// The vector of a part of a picture, its pixels times a gain of `ln_gain`.
    pub fn vector(&self, picture: &PictureTiles, part: Part, ln_gain: f64) -> Vec<f32> {
        let mut vector = Vec::with_capacity(self.dims());
        self.tiles.push(&picture.counts(part), ln_gain, &mut vector);
        let statistics = picture.statistics(part);
        for [mean, deviation, skewness, kurtosis] in statistics.moments {
            vector.extend([
                (mean * ln_gain.exp()) as f32,
                (deviation.ln() + ln_gain) as f32,
                skewness.cbrt() as f32,
                kurtosis.max(1e-9).ln() as f32,
            ]);
        }
        let mut variances: Vec<f64> =
            (0..STACKED).map(|i| statistics.covariance[i * (STACKED + 1)]).collect();
        variances.sort_by(f64::total_cmp);
        // Of a grey picture, two channels of three do not vary.
        let own = variances[STACKED / 2].max(1e-3 * variances[STACKED - 1]).max(1e-12);
        let power = (2.0 * ln_gain).exp();
        let eigen = EigenPairs::new(statistics.covariance, STACKED);
        for unit in [own, UNIT / power] {
            push_upper(&eigen.map(|x| (x.max(0.0) / unit + RIDGE).ln()), STACKED, &mut vector);
        }
        vector
    }
}
