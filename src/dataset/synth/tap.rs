//! A tap: a click and resonances that die away, in the room's noise (mi1).

use std::f64::consts::TAU;

use super::effect::Draws;
use super::hand::Hand;
use super::noise::{coloured, fill_normal, quantised};
use super::parameters::Difficulty;
use super::vibration::{MICROPHONE_END_HZ, room};

/// Number of resonances.
const MODES: u32 = 5;
/// When the stylus touches the surface, in s.
const TOUCH_S: f64 = 0.02;
/// Time in which the click decays to 1/e, in s.
const CLICK_S: f64 = 0.001;

/// The sound of a tap, in full scales of the converter.
pub(super) fn sound(
    draws: &Draws<'_>,
    d: &Difficulty,
    hand: &Hand,
    frames: usize,
    rate_hz: f64,
) -> Vec<f32> {
    let rng = &mut draws.noise("tap");
    let mut samples = coloured(rng, frames, rate_hz, MICROPHONE_END_HZ, room(draws, d));
    let touch = ((TOUCH_S * rate_hz) as usize).min(frames);
    let level = (draws.value("tap level", d.tap_level) + hand.force).exp();

    let click = level * draws.value("tap click", d.tap_click).exp();
    let click_frames = (8.0 * CLICK_S * rate_hz) as usize;
    let mut white = vec![0.0; click_frames.min(frames - touch)];
    fill_normal(rng, &mut white);
    for (i, (x, w)) in samples[touch..].iter_mut().zip(&white).enumerate() {
        *x += (click * (-(i as f64) / (CLICK_S * rate_hz)).exp()) as f32 * w;
    }

    for mode in 0..MODES {
        let strength = level * draws.nth("tap mode", mode, d.tap_mode).exp();
        let hz = draws.nth("tap frequency", mode, d.tap_frequency).exp().clamp(80.0, 8_000.0);
        let decay_s = draws.nth("tap decay", mode, d.tap_decay).exp();
        resonance(&mut samples[touch..], strength, TAU * hz / rate_hz, decay_s * rate_hz);
    }

    let gain = draws.value("microphone gain", d.microphone_gain).exp() as f32;
    samples.iter_mut().for_each(|x| *x = quantised(gain * *x));
    samples
}

/// Adds strength · exp(−i / decay) · sin(i · turn), by turning a complex number step by step.
fn resonance(samples: &mut [f32], strength: f64, turn: f64, decay: f64) {
    let shrink = (-1.0 / decay).exp();
    let (turn_im, turn_re) = turn.sin_cos();
    let (mut re, mut im) = (strength, 0.0);
    for x in samples {
        *x += im as f32;
        (re, im) = (shrink * (re * turn_re - im * turn_im), shrink * (re * turn_im + im * turn_re));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_resonance_is_a_damped_sine() {
        let mut samples = vec![0.0; 500];
        resonance(&mut samples, 0.5, 0.3, 80.0);
        for (i, &x) in samples.iter().enumerate() {
            let i = i as f64;
            let expected = 0.5 * (-i / 80.0).exp() * (0.3 * i).sin();
            assert!((f64::from(x) - expected).abs() < 1e-6);
        }
    }
}
