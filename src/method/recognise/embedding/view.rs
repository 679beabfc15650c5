//! Turns the frames of one view of a series, or the tiles of a picture, into Fourier features: cos ωz and
//! sin ωz for ω = 0.6 and 1.2.
//!
//! z is the value of a band minus the library's mean, divided by the library's standard deviation. The
//! squared distance between two means of such features is the MMD² of a kernel of rank four, Σ_ω cos
//! ω(z − z′). This is Bochner's theorem with two fixed frequencies instead of random ones. Each value
//! costs one sine and one cosine; double-angle formulas give the second frequency.

use multiversion::multiversion;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::features::counts::{Counts, LANES, is_counted};
use crate::lanes::total;
use crate::recognise::rank::median;

/// The lower frequency, in radians per standard deviation.
const OMEGA: f32 = 0.6;

/// Number of features of one band: cosine and sine at both frequencies.
const BAND_FEATURES: usize = 4;

/// Scales that turn the values of the bands of one view into angles.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct BandScale {
    centre: Vec<f32>,
    /// ω/(π·deviation) of each band, so that angles are in half turns.
    factor: Vec<f32>,
}

/// Turns the frames of one view into features. Each band gives features in shape (relative to the
/// series' own mean power) and in level (relative to the library's).
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct ViewEmbedder {
    shape: BandScale,
    level: BandScale,
    /// The library's median of the ln mean power of each channel.
    ln_power: Vec<f64>,
}

impl ViewEmbedder {
    /// Takes means and deviations from the counted frames of library series, at least one.
    pub(super) fn new(pieces: &[Counts]) -> Self {
        let own: Vec<Vec<f64>> = pieces.iter().map(Counts::ln_mean_power).collect();
        let median = |c: usize| median(own.iter().map(|powers| powers[c]).collect());
        let ln_power: Vec<f64> = (0..pieces[0].channels).map(median).collect();
        let shape = scale(pieces, |i| &own[i]);
        Self { level: scale(pieces, |_| &ln_power), shape, ln_power }
    }

    pub(super) fn dims(&self) -> usize {
        2 * BAND_FEATURES * self.shape.centre.len()
    }

    /// Appends the means of cos ωz and sin ωz over the counted frames, as if their samples were
    /// multiplied by e^`ln_gain`.
    pub(super) fn push(&self, counts: &Counts, ln_gain: f64, vector: &mut Vec<f32>) {
        let own = counts.ln_mean_power();
        let library: Vec<f64> = self.ln_power.iter().map(|power| power - 2.0 * ln_gain).collect();
        for (scale, ln_mean) in [(&self.shape, &own), (&self.level, &library)] {
            let mut sums = vec![0.0; BAND_FEATURES * counts.width];
            let table = counts.relative(ln_mean);
            add_bands(&counts.counts, (counts.bins, counts.bands()), &table, scale, &mut sums);
            let frames = counts.frames.max(1) as f64;
            vector.extend(sums.iter().map(|sum| (sum / frames) as f32));
        }
    }
}

/// Mean and deviation of each band over the frames of `pieces`, relative to mean powers `ln_mean`.
fn scale<'a>(pieces: &[Counts], ln_mean: impl Fn(usize) -> &'a Vec<f64> + Sync) -> BandScale {
    let width = pieces[0].width;
    let (mut total, mut frames) = (vec![(0.0, 0.0); width], 0);
    let of_piece = |(i, piece): (usize, &Counts)| piece.sums(&piece.relative(ln_mean(i)));
    let sums: Vec<_> = pieces.par_iter().enumerate().map(of_piece).collect();
    for (piece, sums) in pieces.iter().zip(sums) {
        for (total, (sum, square)) in total.iter_mut().zip(sums) {
            *total = (total.0 + sum, total.1 + square);
        }
        frames += piece.frames;
    }
    let n = frames.max(1) as f64;
    let mean = |(sum, _): &(f64, f64)| (sum / n) as f32;
    let factor = |(sum, square): &(f64, f64)| {
        let deviation = (square / n - (sum / n).powi(2)).max(0.0).sqrt() as f32;
        // 0.001 is added, so that no deviation is 0.
        OMEGA / (std::f32::consts::PI * (deviation + 1e-3))
    };
    let centre = total.iter().map(mean).collect();
    BandScale { centre, factor: total.iter().map(factor).collect() }
}

/// Adds the features of all bands to `sums`, shape ([`BAND_FEATURES`], width). `counts` has shape
/// (width, bins). `table` holds the value of each bin, shape (channels, bins).
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn add_bands(
    counts: &[f32],
    (bins, bands): (usize, usize),
    table: &[f32],
    scale: &BandScale,
    sums: &mut [f64],
) {
    let width = scale.centre.len();
    for (band, counts) in counts.chunks_exact(bins.max(1)).enumerate() {
        let values = table[band / bands * bins..][..bins].as_chunks().0;
        let counts = counts.as_chunks().0;
        let mut acc = [[0f32; LANES]; BAND_FEATURES];
        for i in 0..counts.len().min(values.len()) {
            if is_counted(&counts[i]) {
                add_up(scale, band, &counts[i], &values[i], &mut acc);
            }
        }
        for feature in 0..BAND_FEATURES {
            sums[feature * width + band] += total(&acc[feature]);
        }
    }
}

/// Adds the features of some values of a band to `acc`, each multiplied by its weight.
#[inline(always)]
fn add_up(
    scale: &BandScale,
    band: usize,
    weights: &[f32; LANES],
    values: &[f32; LANES],
    acc: &mut [[f32; LANES]; BAND_FEATURES],
) {
    let (centre, factor) = (scale.centre[band], scale.factor[band]);
    let mut u = [0f32; LANES];
    for lane in 0..LANES {
        let turns = (values[lane] - centre) * factor;
        u[lane] = turns - 2.0 * (0.5 * turns).round_ties_even();
    }
    let (sin, cos) = sin_cos_pi(&u);
    for lane in 0..LANES {
        acc[0][lane] += weights[lane] * cos[lane];
        acc[1][lane] += weights[lane] * sin[lane];
        acc[2][lane] += weights[lane] * (1.0 - 2.0 * sin[lane] * sin[lane]);
        acc[3][lane] += weights[lane] * (2.0 * sin[lane] * cos[lane]);
    }
}

/// sin(πu) and cos(πu) for |u| ≤ 1, with errors below 1e-6. Half the angle is at most π/2; its Taylor
/// series and the double-angle formulas are used.
#[inline(always)]
fn sin_cos_pi(u: &[f32; LANES]) -> ([f32; LANES], [f32; LANES]) {
    const HALF_PI: f32 = std::f32::consts::FRAC_PI_2;
    let (mut sin, mut cos) = ([0f32; LANES], [0f32; LANES]);
    for lane in 0..LANES {
        let x = u[lane] * HALF_PI;
        let x2 = x * x;
        let s = x
            * (1.0
                + x2 * (-1.0 / 6.0
                    + x2 * (1.0 / 120.0
                        + x2 * (-1.0 / 5040.0
                            + x2 * (1.0 / 362_880.0 - x2 * (1.0 / 39_916_800.0))))));
        let c = 1.0
            + x2 * (-0.5
                + x2 * (1.0 / 24.0
                    + x2 * (-1.0 / 720.0
                        + x2 * (1.0 / 40_320.0
                            + x2 * (-1.0 / 3_628_800.0 + x2 * (1.0 / 479_001_600.0))))));
        sin[lane] = 2.0 * s * c;
        cos[lane] = 1.0 - 2.0 * s * s;
    }
    (sin, cos)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames of two channels with three bands each.
    fn frames(n: usize, louder: f32) -> Vec<f32> {
        (0..6 * n).map(|i| ((i * 7919) % 1000) as f32 / 250.0 - 5.0 + louder).collect()
    }

    fn counted(values: &[f32]) -> Counts {
        let mut counts = Counts::new(2, 6);
        counts.add(values);
        counts
    }

    #[test]
    fn features_are_means_of_cosines_and_sines_of_each_band() {
        let values = frames(300, 0.0);
        let embedder = ViewEmbedder::new(&[counted(&values)]);
        let mut vector = Vec::new();
        embedder.push(&counted(&values), 0.0, &mut vector);
        assert_eq!(vector.len(), embedder.dims());
        // From the definition, in shape, for band 4, which belongs to the second channel.
        let power = |c: usize| {
            let of_channel = values.chunks_exact(6).flat_map(|row| &row[3 * c..3 * c + 3]);
            of_channel.map(|&x| f64::from(x).exp()).sum::<f64>() / 900.0
        };
        let relative: Vec<f64> = (values.iter().skip(4).step_by(6))
            .map(|&x| (f64::from(x).exp() / power(1) + 1e-4).ln())
            .collect();
        let mean = relative.iter().sum::<f64>() / 300.0;
        let deviation =
            (relative.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 300.0).sqrt() + 1e-3;
        let z = |x: &f64| (x - mean) / deviation;
        let cos = relative.iter().map(|x| (0.6 * z(x)).cos()).sum::<f64>() / 300.0;
        let sin2 = relative.iter().map(|x| (1.2 * z(x)).sin()).sum::<f64>() / 300.0;
        assert!((f64::from(vector[4]) - cos).abs() < 2e-3, "{} vs {cos}", vector[4]);
        assert!((f64::from(vector[18 + 4]) - sin2).abs() < 2e-3, "{} vs {sin2}", vector[22]);
    }

    #[test]
    fn a_gain_moves_the_level_and_not_the_shape() {
        let embedder = ViewEmbedder::new(&[counted(&frames(200, 0.0)), counted(&frames(200, 1.0))]);
        let vector = |values: &[f32], ln_gain: f64| {
            let mut vector = Vec::new();
            embedder.push(&counted(values), ln_gain, &mut vector);
            vector
        };
        let (quiet, loud) = (vector(&frames(200, 0.0), 0.0), vector(&frames(200, 2.0), 0.0));
        let played = vector(&frames(200, 0.0), 1.0);
        let near = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-3);
        assert!(near(&quiet[..24], &loud[..24]) && !near(&quiet[24..], &loud[24..]));
        assert!(near(&played, &loud));
    }

    #[test]
    fn sine_and_cosine_are_good_to_1e_6() {
        for i in -1000..=1000 {
            let u = i as f32 / 1000.0;
            let (sin, cos) = sin_cos_pi(&[u; LANES]);
            let exact = std::f64::consts::PI * f64::from(u);
            assert!((f64::from(sin[0]) - exact.sin()).abs() < 1e-6, "{u}");
            assert!((f64::from(cos[0]) - exact.cos()).abs() < 1e-6, "{u}");
        }
    }
}
