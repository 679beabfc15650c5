//! Fourier features of log-band frames: means of cos ωz and sin ωz for ω = 0.6 and 1.2.
//!
//! z is the value of a band, less the library's mean, in the library's deviations. The squared
//! distance of two such means is the MMD² of the kernel Σ_ω cos ω(z − z′), of rank four: Bochner's
//! theorem with two frequencies instead of random ones. One sine and cosine a value; the second
//! frequency is the double angle. A shift of all values by one level turns each band's pair by an
//! angle, so that a level can be taken off after the sums are made.

use multiversion::multiversion;
use serde::{Deserialize, Serialize};

/// The lower frequency, in radians a deviation.
const OMEGA: f32 = 0.6;

/// Features of one band: cosine and sine of both frequencies.
pub(super) const BAND_FEATURES: usize = 4;

/// Values that are worked on together.
pub(super) const LANES: usize = 8;

/// Samples that are summed in f32 before the sum goes to f64.
pub(super) const FLUSH: usize = 64;

/// How the bands of one view are brought onto the circle.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct BandScale {
    /// Mean of each band over a library.
    centre: Vec<f32>,
    /// ω/(π·deviation) of each band.
    factor: Vec<f32>,
}

impl BandScale {
    /// From means and deviations of bands; a thousandth is added to each deviation, so that a
    /// constant band has one.
    pub fn new(centre: Vec<f32>, deviation: &[f32]) -> Self {
        let factor = |d: &f32| OMEGA / (std::f32::consts::PI * (d + 1e-3));
        Self { factor: deviation.iter().map(factor).collect(), centre }
    }

    /// Adds the features of some frames, shape (frames, width), to `sums`, shape
    /// ([`BAND_FEATURES`], width).
    ///
    /// # Panics
    /// If `sums` has another length.
    pub fn add(&self, values: &[f32], sums: &mut [f64]) {
        assert_eq!(sums.len(), BAND_FEATURES * self.centre.len(), "one sum a feature");
        add_frames(values, &self.centre, &self.factor, sums);
    }

    /// Means of the features of values from which the `shift` of their band is taken, from the
    /// `sums` over `frames` of values as they were.
    pub fn shifted_means(
        &self,
        sums: &[f64],
        frames: usize,
        shift: impl Fn(usize) -> f64,
    ) -> Vec<f32> {
        let (width, n) = (self.centre.len(), frames.max(1) as f64);
        let mut means = vec![0.0; sums.len()];
        for band in 0..width {
            let angle = shift(band) * f64::from(self.factor[band]) * std::f64::consts::PI;
            for (harmonic, angle) in [(0, angle), (1, 2.0 * angle)] {
                let (turned_sin, turned_cos) = angle.sin_cos();
                let at = 2 * harmonic * width + band;
                let (cos, sin) = (sums[at] / n, sums[at + width] / n);
                means[at] = (cos * turned_cos + sin * turned_sin) as f32;
                means[at + width] = (sin * turned_cos - cos * turned_sin) as f32;
            }
        }
        means
    }
}

#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn add_frames(values: &[f32], centres: &[f32], factors: &[f32], sums: &mut [f64]) {
    let width = centres.len();
    for begin in (0..width).step_by(LANES) {
        let used = LANES.min(width - begin);
        let (mut centre, mut factor) = ([0f32; LANES], [0f32; LANES]);
        centre[..used].copy_from_slice(&centres[begin..begin + used]);
        factor[..used].copy_from_slice(&factors[begin..begin + used]);
        for rows in values.chunks(width * FLUSH) {
            let mut acc = [[0f32; LANES]; BAND_FEATURES];
            for row in rows.chunks_exact(width) {
                let mut u = [0f32; LANES];
                if used == LANES {
                    u.copy_from_slice(&row[begin..begin + LANES]);
                } else {
                    u[..used].copy_from_slice(&row[begin..begin + used]);
                }
                for lane in 0..LANES {
                    let turns = (u[lane] - centre[lane]) * factor[lane];
                    u[lane] = turns - 2.0 * (0.5 * turns).round_ties_even();
                }
                let (sin, cos) = sin_cos_pi(&u);
                for lane in 0..LANES {
                    acc[0][lane] += cos[lane];
                    acc[1][lane] += sin[lane];
                    acc[2][lane] += 1.0 - 2.0 * sin[lane] * sin[lane];
                    acc[3][lane] += 2.0 * sin[lane] * cos[lane];
                }
            }
            for (feature, lanes) in acc.iter().enumerate() {
                let at = feature * width + begin;
                for (sum, &x) in sums[at..at + used].iter_mut().zip(lanes) {
                    *sum += f64::from(x);
                }
            }
        }
    }
}

/// Product of complex numbers, (re, im) each.
#[inline(always)]
pub(super) fn multiply(
    a: (&[f32; LANES], &[f32; LANES]),
    b: (&[f32; LANES], &[f32; LANES]),
) -> ([f32; LANES], [f32; LANES]) {
    let (mut re, mut im) = ([0f32; LANES], [0f32; LANES]);
    for lane in 0..LANES {
        re[lane] = a.0[lane] * b.0[lane] - a.1[lane] * b.1[lane];
        im[lane] = a.0[lane] * b.1[lane] + a.1[lane] * b.0[lane];
    }
    (re, im)
}

/// sin(πu) and cos(πu) for |u| ≤ 1, to within 1e-6: Taylor series of half the angle, at most π/2,
/// and the formulas of the double angle.
#[inline(always)]
pub(super) fn sin_cos_pi(u: &[f32; LANES]) -> ([f32; LANES], [f32; LANES]) {
    const HALF_PI: f32 = std::f32::consts::FRAC_PI_2;
    let (mut sin, mut cos) = ([0f32; LANES], [0f32; LANES]);
    for lane in 0..LANES {
        let x = u[lane] * HALF_PI;
        let x2 = x * x;
        let s = x
            * (1.0
                + x2 * (-1.0 / 6.0
                    + x2 * (1.0 / 120.0
                        + x2 * (-1.0 / 5040.0 + x2 * (1.0 / 362_880.0 - x2 / 39_916_800.0)))));
        let c = 1.0
            + x2 * (-0.5
                + x2 * (1.0 / 24.0
                    + x2 * (-1.0 / 720.0
                        + x2 * (1.0 / 40_320.0 + x2 * (-1.0 / 3_628_800.0 + x2 / 479_001_600.0)))));
        sin[lane] = 2.0 * s * c;
        cos[lane] = 1.0 - 2.0 * s * s;
    }
    (sin, cos)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    #[test]
    fn sine_and_cosine_are_good_to_1e_6() {
        for i in -1000..=1000 {
            let u = i as f32 / 1000.0;
            let (sin, cos) = sin_cos_pi(&[u; LANES]);
            let exact = PI * f64::from(u);
            assert!((f64::from(sin[0]) - exact.sin()).abs() < 1e-6, "{u}");
            assert!((f64::from(cos[0]) - exact.cos()).abs() < 1e-6, "{u}");
        }
    }

    #[test]
    fn features_are_sums_of_cosines_and_sines_of_each_band() {
        let width = 13;
        let values: Vec<f32> =
            (0..width * 70).map(|i| ((i * 7919) % 1000) as f32 / 200.0 - 2.5).collect();
        let scale = BandScale::new(vec![0.1; width], &vec![0.8; width]);
        let mut sums = vec![0.0; BAND_FEATURES * width];
        scale.add(&values, &mut sums);
        let band = 12;
        let angles =
            values[band..].iter().step_by(width).map(|&x| 0.6 * (f64::from(x) - 0.1) / 0.801);
        let expected = angles.fold([0.0; 4], |[a, b, c, d], t| {
            [a + t.cos(), b + t.sin(), c + (2.0 * t).cos(), d + (2.0 * t).sin()]
        });
        for (feature, expected) in expected.iter().enumerate() {
            let got = sums[feature * width + band];
            assert!((got - expected).abs() < 1e-3, "{got} vs {expected}");
        }
    }

    #[test]
    fn a_level_taken_off_afterwards_is_a_level_taken_off_before() {
        let values: Vec<f32> = (0..90).map(|i| (i as f32 * 0.7).sin() * 3.0).collect();
        let lower: Vec<f32> = values.iter().map(|x| x - 9.0).collect();
        let scale = BandScale::new(vec![0.3, -0.2, 1.0], &[1.0, 0.5, 2.0]);
        let sums = |values: &[f32]| {
            let mut sums = vec![0.0; 3 * BAND_FEATURES];
            scale.add(values, &mut sums);
            sums
        };
        let before = scale.shifted_means(&sums(&lower), 30, |_| 0.0);
        let after = scale.shifted_means(&sums(&values), 30, |_| 9.0);
        assert!(before.iter().zip(&after).all(|(a, b)| (a - b).abs() < 1e-4));
    }
}
