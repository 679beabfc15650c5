//! Processes whose correlation time is known, to hold T* against.

use rand::Rng;

use crate::seed::box_muller;
use crate::trial::{Series, SignalError};

/// A number of the standard normal distribution (Box and Muller 1958).
pub fn normal(rng: &mut impl Rng) -> f64 {
    // The half keeps the logarithm finite.
    let u = (f64::from(rng.next_u32()) + 0.5) / 4_294_967_296.0;
    let v = f64::from(rng.next_u32()) / 4_294_967_296.0;
    box_muller(u, v)
}

/// Stationary AR(1): x(t) = φ·x(t − 1) + √(1 − φ²)·ε, φ = exp(−1/τ), with autocorrelation
/// exp(−t/τ); sampled Ornstein–Uhlenbeck is exactly this. τ = 0 is independent noise.
pub fn ar1(frames: usize, tau: f64, rng: &mut impl Rng) -> Vec<f32> {
    let phi = if tau > 0.0 { (-1.0 / tau).exp() } else { 0.0 };
    let gain = (1.0 - phi * phi).sqrt();
    let mut x = normal(rng);
    (0..frames)
        .map(|_| {
            x = phi * x + gain * normal(rng);
            x as f32
        })
        .collect()
}

/// A sine of `period` samples and unit amplitude, its phase drawn at random.
pub fn sine(frames: usize, period: f64, rng: &mut impl Rng) -> Vec<f32> {
    let phase = f64::from(rng.next_u32()) / 4_294_967_296.0;
    (0..frames)
        .map(|i| (std::f64::consts::TAU * (i as f64 / period + phase)).sin() as f32)
        .collect()
}

/// `count` trials of a process.
///
/// # Errors
/// If `make` gives no samples or samples that are not finite.
pub fn trials(
    count: usize,
    rate_hz: f64,
    mut make: impl FnMut() -> Vec<f32>,
) -> Result<Vec<Series>, SignalError> {
    (0..count).map(|_| Series::new(rate_hz, 1, make())).collect()
}
