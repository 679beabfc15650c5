//! The hand that moves the stylus: one force and one speed for all sources of a trial.

use super::effect::Draws;
use super::parameters::Difficulty;
use crate::seed::normal;

/// Number of points of the slow change of force within a drag.
const DRIFT_KNOTS: usize = 12;
/// Frames over which that change is taken to be linear.
const BLOCK: usize = 64;

/// How one trial was made.
#[derive(Debug)]
pub(super) struct Hand {
    /// ln of the mean force
    pub force: f64,
    /// ln of the speed
    pub speed: f64,
    /// ln of the force over its mean, at equidistant times of the drag
    drift: [f64; DRIFT_KNOTS],
}

impl Hand {
    pub fn draw(draws: &Draws<'_>, d: &Difficulty) -> Self {
        let rng = &mut draws.noise("drift");
        Self {
            force: draws.value("force", d.force),
            speed: draws.value("speed", d.speed),
            drift: std::array::from_fn(|_| d.force_drift * normal(rng)),
        }
    }

    /// Multiplies a signal that spans the drag by the relative force to a power.
    pub fn modulate(&self, samples: &mut [f32], power: f64) {
        let gain = |at: usize, len: usize| {
            let x = at as f64 / len as f64 * (DRIFT_KNOTS - 1) as f64;
            let knot = (x as usize).min(DRIFT_KNOTS - 2);
            let (a, b) = (self.drift[knot], self.drift[knot + 1]);
            (power * (a + (x - knot as f64) * (b - a))).exp() as f32
        };
        let len = samples.len();
        for (block, samples) in samples.chunks_mut(BLOCK).enumerate() {
            let start = gain(block * BLOCK, len);
            let step = (gain((block + 1) * BLOCK, len) - start) / BLOCK as f32;
            for (i, x) in samples.iter_mut().enumerate() {
                *x *= start + step * i as f32;
            }
        }
    }
}
