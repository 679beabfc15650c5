//! Processes whose correlation time is known, to hold T* against.

#![allow(dead_code)] // Not every test and tool uses all of it.

use rand::Rng;
use surfaced::trial::{Series, SignalError};

/// A number of the standard normal distribution (Box and Muller 1958).
pub fn normal(rng: &mut impl Rng) -> f64 {
    // The half keeps the logarithm finite.
    let u = (f64::from(rng.next_u32()) + 0.5) / 4_294_967_296.0;
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * uniform(rng)).cos()
}

/// A number from 0 up to 1.
fn uniform(rng: &mut impl Rng) -> f64 {
    f64::from(rng.next_u32()) / 4_294_967_296.0
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

/// Random telegraph: ±1, with autocorrelation exp(−t/τ).
pub fn telegraph(frames: usize, tau: f64, rng: &mut impl Rng) -> Vec<f32> {
    let flip = 0.5 * (1.0 - (-1.0 / tau).exp());
    let mut x = if uniform(rng) < 0.5 { -1.0 } else { 1.0 };
    (0..frames)
        .map(|_| {
            if uniform(rng) < flip {
                x = -x;
            }
            x
        })
        .collect()
}

/// Stochastic volatility: independent normal numbers times exp(h), h an AR(1) of variance 1 and
/// correlation time τ. Uncorrelated, and far from independent.
pub fn volatility(frames: usize, tau: f64, rng: &mut impl Rng) -> Vec<f32> {
    let mut x = ar1(frames, tau, rng);
    x.iter_mut().for_each(|x| *x = (0.5 * *x).exp() * normal(rng) as f32);
    x
}

/// AR(1) with φ = exp(−1/τ) whose innovations have Student's t distribution with two degrees of
/// freedom, and so no variance.
pub fn heavy_tailed(frames: usize, tau: f64, rng: &mut impl Rng) -> Vec<f32> {
    let phi = (-1.0 / tau).exp();
    let mut x = 0.0;
    let mut next = || {
        // χ² of two degrees of freedom over two is exponential; the half keeps it above zero.
        let spread = -((f64::from(rng.next_u32()) + 0.5) / 4_294_967_296.0).ln();
        x = phi * x + normal(rng) / spread.sqrt();
        x as f32
    };
    // Far enough from the start for it to be forgotten.
    (0..(30.0 * tau) as usize).for_each(|_| {
        next();
    });
    (0..frames).map(|_| next()).collect()
}

/// Steps of a line from −1 to 1, with noise of deviation `noise`.
pub fn ramp(frames: usize, noise: f64, rng: &mut impl Rng) -> Vec<f32> {
    let at = |i: usize| 2.0 * i as f64 / frames as f64 - 1.0;
    (0..frames).map(|i| (at(i) + noise * normal(rng)) as f32).collect()
}

/// A sine of `period` samples and unit amplitude, its phase drawn at random.
pub fn sine(frames: usize, period: f64, rng: &mut impl Rng) -> Vec<f32> {
    let phase = uniform(rng);
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
