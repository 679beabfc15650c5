//! What the slow sensors feel while dragging: forces (fr), reflectance (ir) and metal (me).
//!
//! Each is a marginal distribution with a correlation time, which a faster hand shortens.

use super::effect::{Draws, logistic};
use super::hand::Hand;
use super::noise::{correlated, quantised};
use super::parameters::Difficulty;
use crate::seed::uniform;

/// Forces on the two resistors, interleaved, as fractions of full scale.
pub(super) fn friction(
    draws: &Draws<'_>,
    d: &Difficulty,
    hand: &Hand,
    frames: usize,
    rate_hz: f64,
) -> Vec<f32> {
    let time_s = (draws.value("friction correlation", d.friction_correlation) - hand.speed).exp();
    let common = draws.value("friction common", d.friction_common).exp() as f32;
    let swing = draws.value("friction swing", d.friction_swing).exp() as f32;
    let share = logistic(draws.value("friction share", d.friction_share)) as f32;
    let rng = &mut draws.noise("friction");
    let both = correlated(rng, frames, time_s * rate_hz);
    let between = correlated(rng, frames, time_s * rate_hz);
    let level = draws.value("friction level", d.friction_level) + hand.force;
    let mut load = vec![level.exp() as f32; frames];
    hand.modulate(&mut load, 1.0);
    let mut interleaved = Vec::with_capacity(2 * frames);
    for ((load, both), between) in load.iter().zip(both).zip(between) {
        let first = share + swing * between * share * (1.0 - share) * 4.0;
        for part in [first, 1.0 - first] {
            let x = load * part * (1.0 + common * both);
            interleaved.push(quantised(x.max(0.0)));
        }
    }
    interleaved
}

/// Reflected infrared light, as a fraction of full scale.
pub(super) fn reflectance(
    draws: &Draws<'_>,
    d: &Difficulty,
    hand: &Hand,
    frames: usize,
    rate_hz: f64,
) -> Vec<f32> {
    let time_s =
        (draws.value("reflectance correlation", d.reflectance_correlation) - hand.speed).exp();
    let level = logistic(draws.value("reflectance level", d.reflectance_level)) as f32;
    let width = draws.value("reflectance width", d.reflectance_width).exp() as f32;
    let skew = 0.5 * draws.value("reflectance skew", d.reflectance_skew).tanh() as f32;
    // Near black and near white there is less room to move.
    let width = width * 4.0 * level * (1.0 - level);
    // For a normal x, x + skew·(x² − 1) has mean 0 and variance 1 + 2·skew².
    let scale = width / (1.0 + 2.0 * skew * skew).sqrt();
    let mut samples = correlated(&mut draws.noise("reflectance"), frames, time_s * rate_hz);
    for x in &mut samples {
        *x = quantised((level + scale * (*x + skew * (*x * *x - 1.0))).max(0.0));
    }
    samples
}

/// 1 while metal is felt, 0 otherwise. Always 0 unless the surface conducts.
pub(super) fn metal(
    draws: &Draws<'_>,
    d: &Difficulty,
    conducts: bool,
    frames: usize,
    rate_hz: f64,
) -> Vec<f32> {
    if !conducts {
        return vec![0.0; frames];
    }
    let felt = logistic(draws.value("metal contact", d.metal_contact));
    let rng = &mut draws.noise("metal");
    // Stays for a while in each state; shares of the time are `felt` and 1 − `felt`.
    let mut samples = Vec::with_capacity(frames);
    let mut on = uniform(rng) < felt;
    while samples.len() < frames {
        let mean_s = d.metal_correlation_s / if on { 1.0 - felt } else { felt };
        let stay = (-(1.0 - uniform(rng)).ln() * mean_s * rate_hz) as usize;
        let end = (samples.len() + 1).saturating_add(stay).min(frames);
        samples.resize(end, if on { 1.0 } else { 0.0 });
        on = !on;
    }
    samples
}
