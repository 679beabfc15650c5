//! Generates the signals of a contact between stylus and surface: sound (mi1, mi2), acceleration
//! (ac), forces (fr), reflectance (ir) and metal (me). The user's hand shapes all of them.

use std::f64::consts::TAU;

use super::effect::{Draws, logistic};
use super::noise::{coloured, correlated, fill_normal, quantised};
use crate::seed::{normal, uniform};

/// The input for the signal of one source in one trial: random draws, hand, length and rate.
pub(super) struct Contact<'a> {
    pub draws: &'a Draws<'a>,
    pub hand: &'a Hand,
    pub frames: usize,
    pub rate_hz: f64,
}

/// Forces on the two force sensors, interleaved, as fractions of full scale.
pub(super) fn friction(&Contact { draws, hand, frames, rate_hz }: &Contact<'_>) -> Vec<f32> {
    let time_s = (draws.value("friction correlation") - hand.speed).exp();
    let common = draws.value("friction common").exp() as f32;
    let swing = draws.value("friction swing").exp() as f32;
    let share = logistic(draws.value("friction share")) as f32;
    let rng = &mut draws.noise("friction");
    let both = correlated(rng, frames, time_s * rate_hz);
    let between = correlated(rng, frames, time_s * rate_hz);
    let level = draws.value("friction level") + hand.force;
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
pub(super) fn reflectance(&Contact { draws, hand, frames, rate_hz }: &Contact<'_>) -> Vec<f32> {
    let time_s = (draws.value("reflectance correlation") - hand.speed).exp();
    let level = logistic(draws.value("reflectance level")) as f32;
    let width = draws.value("reflectance width").exp() as f32;
    let skew = 0.5 * draws.value("reflectance skew").tanh() as f32;
    // A mean near black (0) or near white (1) leaves less room for variation.
    let width = width * 4.0 * level * (1.0 - level);
    // For a standard normal x, x + skew·(x² − 1) has mean 0 and variance 1 + 2·skew².
    let scale = width / (1.0 + 2.0 * skew * skew).sqrt();
    let mut samples = correlated(&mut draws.noise("reflectance"), frames, time_s * rate_hz);
    for x in &mut samples {
        *x = quantised((level + scale * (*x + skew * (*x * *x - 1.0))).max(0.0));
    }
    samples
}

/// Output of the metal detector: 1 while it senses metal, else 0. Always 0 for an insulator.
pub(super) fn metal(contact: &Contact<'_>, conducts: bool) -> Vec<f32> {
    let &Contact { draws, frames, rate_hz, .. } = contact;
    if !conducts {
        return vec![0.0; frames];
    }
    let felt = logistic(draws.value("metal contact"));
    let rng = &mut draws.noise("metal");
    // The detector senses metal for a share `felt` of the time; each state lasts for a random time.
    let mut samples = Vec::with_capacity(frames);
    let mut on = uniform(rng) < felt;
    while samples.len() < frames {
        let mean_s = draws.d.metal_correlation_s / if on { 1.0 - felt } else { felt };
        let stay = (-(1.0 - uniform(rng)).ln() * mean_s * rate_hz) as usize;
        let end = (samples.len() + 1).saturating_add(stay).min(frames);
        samples.resize(end, if on { 1.0 } else { 0.0 });
        on = !on;
    }
    samples
}

/// Number of random values in a drag, between which ln of the force changes linearly.
const DRIFT_KNOTS: usize = 12;
/// Number of frames in which the gain that the force causes changes linearly.
const BLOCK: usize = 64;

#[derive(Debug)]
pub(super) struct Hand {
    /// ln of the mean force
    pub force: f64,
    /// ln of the speed
    pub speed: f64,
    /// ln of force/mean force, at equidistant times of the drag
    drift: [f64; DRIFT_KNOTS],
}

impl Hand {
    pub fn draw(draws: &Draws<'_>) -> Self {
        let rng = &mut draws.noise("drift");
        Self {
            force: draws.value("force"),
            speed: draws.value("speed"),
            drift: std::array::from_fn(|_| draws.d.force_drift * normal(rng)),
        }
    }

    /// Multiplies a signal of the whole drag by (force/mean force)^`power`, sample by sample.
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

const MODES: u32 = 5;
/// Time from the start of the recording until the stylus touches the surface, in s.
const TOUCH_S: f64 = 0.02;
/// Time in which the click of a tap decays to 1/e, in s.
const CLICK_S: f64 = 0.001;

/// The sound of a tap; 1 is full scale of the converter.
pub(super) fn tap_sound(&Contact { draws, hand, frames, rate_hz }: &Contact<'_>) -> Vec<f32> {
    let rng = &mut draws.noise("tap");
    let mut samples = coloured(rng, frames, rate_hz, MICROPHONE_END_HZ, room(draws));
    let touch = ((TOUCH_S * rate_hz) as usize).min(frames);
    let level = (draws.value("tap level") + hand.force).exp();

    let click = level * draws.value("tap click").exp();
    let click_frames = (8.0 * CLICK_S * rate_hz) as usize;
    let mut white = vec![0.0; click_frames.min(frames - touch)];
    fill_normal(rng, &mut white);
    for (i, (x, w)) in samples[touch..].iter_mut().zip(&white).enumerate() {
        *x += (click * (-(i as f64) / (CLICK_S * rate_hz)).exp()) as f32 * w;
    }

    for mode in 0..MODES {
        let strength = level * draws.nth("tap mode", mode).exp();
        let hz = draws.nth("tap frequency", mode).exp().clamp(80.0, 8_000.0);
        let decay_s = draws.nth("tap decay", mode).exp();
        resonance(&mut samples[touch..], strength, TAU * hz / rate_hz, decay_s * rate_hz);
    }

    let gain = draws.value("microphone gain").exp() as f32;
    samples.iter_mut().for_each(|x| *x = quantised(gain * *x));
    samples
}

/// Adds strength · exp(−i / decay) · sin(i · turn) to sample i, by rotating a complex number.
fn resonance(samples: &mut [f32], strength: f64, turn: f64, decay: f64) {
    let shrink = (-1.0 / decay).exp();
    let (turn_im, turn_re) = turn.sin_cos();
    let (mut re, mut im) = (strength, 0.0);
    for x in samples {
        *x += im as f32;
        (re, im) = (shrink * (re * turn_re - im * turn_im), shrink * (re * turn_im + im * turn_re));
    }
}

const BUMPS: u32 = 4;
/// Width of a bump of a spectrum: the standard deviation of the ln of the frequency.
const BUMP_WIDTH: f64 = 0.25;
/// Highest frequency that the microphone picks up, in Hz.
const MICROPHONE_END_HZ: f64 = 12_000.0;
/// Highest frequency that the accelerometer senses, in Hz.
const ACCELEROMETER_END_HZ: f64 = 1_600.0;
/// The amplitude of sound and acceleration grows in proportion to force to this power.
const FORCE_POWER: f64 = 0.7;

/// A smooth spectrum: a power law, scaled to 1 at `middle_hz`, times a few bumps.
struct Spectrum {
    middle_hz: f64,
    slope: f64,
    /// for each bump, ln of its centre in Hz, and its relative height
    bumps: [(f64, f64); BUMPS as usize],
}

impl Spectrum {
    fn draw(draws: &Draws<'_>, name: &str) -> Self {
        let (heights, centres) = (format!("{name} bump"), format!("{name} centre"));
        let bump = |i| (draws.nth(&centres, i), draws.nth(&heights, i).exp());
        Self {
            middle_hz: draws.d.effects[&*centres].centre.exp(),
            slope: draws.value(&format!("{name} slope")),
            bumps: std::array::from_fn(|i| bump(i as u32)),
        }
    }

    /// Amplitude of the spectrum at a frequency in Hz.
    fn density(&self, hz: f64) -> f64 {
        let hz = hz.max(20.0);
        let bumps: f64 = self
            .bumps
            .iter()
            .map(|(centre, height)| {
                height * (-0.5 * ((hz.ln() - centre) / BUMP_WIDTH).powi(2)).exp()
            })
            .sum();
        (hz / self.middle_hz).powf(-self.slope) * (1.0 + bumps)
    }
}

/// Spectrum of the room's noise: returns the amplitude per √Hz for a frequency in Hz.
fn room(draws: &Draws<'_>) -> impl Fn(f64) -> f64 + use<> {
    let level = draws.value("room level").exp();
    let slope = draws.value("room slope");
    // Scales the noise to the standard deviation `level`, which is exact for slope 0.
    let unit = level / MICROPHONE_END_HZ.sqrt();
    move |hz| unit * (hz.max(20.0) / 1_000.0).powf(-slope)
}

/// The sound of a drag; 1 is full scale of the converter.
pub(super) fn drag_sound(&Contact { draws, hand, frames, rate_hz }: &Contact<'_>) -> Vec<f32> {
    let spectrum = Spectrum::draw(draws, "sound");
    let room = room(draws);
    let gain = draws.value("microphone gain").exp();
    let level = draws.value("sound level") + FORCE_POWER * hand.force + hand.speed;
    let unit = level.exp() / MICROPHONE_END_HZ.sqrt();
    let speed = hand.speed.exp();
    let density = |hz: f64| gain * (unit * spectrum.density(hz / speed)).hypot(room(hz));
    let rng = &mut draws.noise("sound");
    let mut samples = coloured(rng, frames, rate_hz, MICROPHONE_END_HZ, density);
    hand.modulate(&mut samples, FORCE_POWER);
    samples.iter_mut().for_each(|x| *x = quantised(*x));
    samples
}

/// Acceleration along x, y and z, interleaved; 1 is full scale of the converter.
pub(super) fn acceleration(&Contact { draws, hand, frames, rate_hz }: &Contact<'_>) -> Vec<f32> {
    let spectrum = Spectrum::draw(draws, "acceleration");
    let level = draws.value("acceleration level") + FORCE_POWER * hand.force + hand.speed;
    let speed = hand.speed.exp();
    let rng = &mut draws.noise("acceleration");
    let mut interleaved = vec![0.0; 3 * frames];
    for axis in 0..3 {
        let share = draws.nth("acceleration axis", axis);
        let unit = (level + share).exp() / ACCELEROMETER_END_HZ.sqrt();
        let density = |hz: f64| unit * spectrum.density(hz / speed);
        let mut samples = coloured(rng, frames, rate_hz, ACCELEROMETER_END_HZ, density);
        hand.modulate(&mut samples, FORCE_POWER);
        for (frame, x) in interleaved.chunks_exact_mut(3).zip(samples) {
            frame[axis as usize] = quantised(x);
        }
    }
    interleaved
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
