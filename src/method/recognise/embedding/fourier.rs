//! Fourier features: cos ωz and sin ωz for ω = 0.6 and 1.2.
//!
//! z is the value of a band minus the library's mean, divided by the library's standard deviation. The
//! squared distance between two means of such features is the MMD² of a kernel of rank four, Σ_ω cos
//! ω(z − z′). This is Bochner's theorem with two fixed frequencies instead of random ones. Each value
//! costs one sine and one cosine; double-angle formulas give the second frequency.

use serde::{Deserialize, Serialize};

use crate::features::counts::LANES;

/// The lower frequency, in radians per standard deviation.
const OMEGA: f32 = 0.6;

/// Number of features of one band: cosine and sine at both frequencies.
pub(super) const BAND_FEATURES: usize = 4;

/// Scales that turn the values of the bands of one view into angles.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct BandScale {
    centre: Vec<f32>,
    /// ω/(π·deviation) of each band, so that angles are in half turns.
    factor: Vec<f32>,
}

impl BandScale {
    /// Takes means and deviations of bands. 0.001 is added to each deviation, so that none is 0.
    pub(super) fn new(centre: Vec<f32>, deviation: &[f32]) -> Self {
        let factor = |d: &f32| OMEGA / (std::f32::consts::PI * (d + 1e-3));
        Self { factor: deviation.iter().map(factor).collect(), centre }
    }

    pub(super) fn width(&self) -> usize {
        self.centre.len()
    }
}

/// Adds the features of some values of a band to `acc`, each multiplied by its weight.
#[inline(always)]
pub(super) fn add_up(
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
}
