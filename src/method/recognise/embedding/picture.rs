//! Turns a picture, or a quarter of it, into a vector (README §4): Fourier features of its tiles,
//! means and moments of its channels, and the covariance of pixels with displaced pixels.

use serde::{Deserialize, Serialize};

use super::eigen::{EigenPairs, push_upper};
use super::view::ViewEmbedder;
use crate::features::counts::Counts;
use crate::features::pixels::STACKED;
use crate::features::tiles::{CHANNELS, PictureTiles};

/// Added to the eigenvalues of a covariance after they are divided by their unit.
const RIDGE: f64 = 1e-4;

/// Unit of variance in level: the square of a standard deviation of a tenth of full scale.
const UNIT: f64 = 0.01;

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct PictureEmbedder {
    tiles: ViewEmbedder,
}

impl PictureEmbedder {
    /// Takes means and deviations from the counted tiles of pictures, at least one.
    pub(super) fn new(pictures: &[Counts]) -> Self {
        Self { tiles: ViewEmbedder::new(pictures) }
    }

    pub(super) fn dims(&self) -> usize {
        self.tiles.dims() + 4 * CHANNELS + STACKED * (STACKED + 1)
    }

    /// The vector of a picture or of one quarter, as if its pixels were multiplied by e^`ln_gain`.
    pub(super) fn vector(
        &self,
        picture: &PictureTiles,
        quarter: Option<usize>,
        ln_gain: f64,
    ) -> Vec<f32> {
        let mut vector = Vec::with_capacity(self.dims());
        self.tiles.push(&picture.counts(quarter), ln_gain, &mut vector);
        let statistics = picture.statistics(quarter);
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
        // In a grey picture, two of the three channels do not vary, so the median may be 0.
        let own = variances[STACKED / 2].max(1e-3 * variances[STACKED - 1]).max(1e-12);
        let power = (2.0 * ln_gain).exp();
        let least = RIDGE * own.min(UNIT / power);
        let eigen = EigenPairs::new(statistics.covariance, STACKED, least);
        for unit in [own, UNIT / power] {
            push_upper(&eigen.map(|x| (x.max(0.0) / unit + RIDGE).ln()), STACKED, &mut vector);
        }
        vector
    }
}
