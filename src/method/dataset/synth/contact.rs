//! Generates the signals of a contact between stylus and surface: sound (mi1, mi2), acceleration
//! (ac), forces (fr), reflectance (ir) and metal (me). The user's hand shapes all of them.

use std::cell::RefCell;
use std::f64::consts::TAU;

use rand::Rng;
use realfft::RealFftPlanner;
use realfft::num_complex::Complex;

use super::parameters::{Draws, logistic};
use crate::seed::{normal, uniform};

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
/// The gain follows the force, linearly within each block of this many frames.
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
    pub(super) fn draw(draws: &Draws<'_>) -> Self {
        let rng = &mut draws.noise("drift");
        Self {
            force: draws.value("force"),
            speed: draws.value("speed"),
            drift: std::array::from_fn(|_| draws.d.force_drift * normal(rng)),
        }
    }

    /// Multiplies a signal of the whole drag by (force/mean force)^`power`, sample by sample.
    pub(super) fn modulate(&self, samples: &mut [f32], power: f64) {
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
const MICROPHONE_END_HZ: f64 = 12_000.0;
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

thread_local! {
    static PLANNER: RefCell<RealFftPlanner<f32>> = RefCell::new(RealFftPlanner::new());
}

/// Distance in Hz between the points of a spectrum that are computed; the rest is interpolated.
const KNOT_HZ: f64 = 10.0;

/// Fills `out` with nearly normal numbers (mean 0, variance 1): sums of four uniform numbers, which
/// never exceed 3.5 standard deviations. Generation must be fast, and exact tails do not matter.
fn fill_normal(rng: &mut impl Rng, out: &mut [f32]) {
    // The sum of four uniform 16-bit numbers has mean 4·(2^16 − 1)/2 and variance 4·(2^32 − 1)/12.
    const MEAN: f32 = 131_070.0;
    const SCALE: f32 = 2.642_898e-5;
    let mut bytes = [0u8; 4096];
    for block in out.chunks_mut(bytes.len() / 8) {
        let bytes = &mut bytes[..block.len() * 8];
        rng.fill_bytes(bytes);
        for (x, b) in block.iter_mut().zip(bytes.chunks_exact(8)) {
            let word = |at: usize| u32::from(u16::from_le_bytes([b[at], b[at + 1]]));
            let sum = word(0) + word(2) + word(4) + word(6);
            *x = (sum as f32 - MEAN) * SCALE;
        }
    }
}

/// Stationary noise whose spectrum is `density`, the amplitude per √Hz at a frequency in Hz, and 0 above
/// `end_hz`. Its variance is the integral of the squared density.
fn coloured(
    rng: &mut impl Rng,
    frames: usize,
    rate_hz: f64,
    end_hz: f64,
    density: impl Fn(f64) -> f64,
) -> Vec<f32> {
    let len = smooth_length(frames);
    let bin_hz = rate_hz / len as f64;
    let count = ((end_hz / bin_hz) as usize).clamp(1, len / 2);
    // A bin of amplitude a and its mirror image add 4a² to the variance of the noise.
    let scale = 0.5 * bin_hz.sqrt();
    let knots: Vec<f32> = (0..=(count as f64 * bin_hz / KNOT_HZ) as usize + 1)
        .map(|k| (scale * density(k as f64 * KNOT_HZ)) as f32)
        .collect();
    let mut normals = vec![0.0; 2 * count];
    fill_normal(rng, &mut normals);
    let plan = PLANNER.with_borrow_mut(|planner| planner.plan_fft_inverse(len));
    let (mut bins, mut time) = (plan.make_input_vec(), plan.make_output_vec());
    for (k, (bin, pair)) in (1..).zip(bins[1..].iter_mut().zip(normals.chunks_exact(2))) {
        let at = k as f32 * (bin_hz / KNOT_HZ) as f32;
        let knot = (at as usize).min(knots.len() - 2);
        let part = at - knot as f32;
        let amplitude = knots[knot] + part * (knots[knot + 1] - knots[knot]);
        *bin = Complex::new(amplitude * pair[0], amplitude * pair[1]);
    }
    // The inverse transform requires a real number in the last bin, at half the rate.
    bins[len / 2].im = 0.0;
    plan.process(&mut bins, &mut time).expect("buffers of the plan's lengths");
    time.truncate(frames);
    time
}

/// AR(1) noise of mean 0 and variance 1; its correlation falls to 1/e after `time_frames`.
fn correlated(rng: &mut impl Rng, frames: usize, time_frames: f64) -> Vec<f32> {
    let keep = (-1.0 / time_frames.max(1e-3)).exp();
    let (keep, fresh) = (keep as f32, (1.0 - keep * keep).sqrt() as f32);
    let mut noise = vec![0.0; frames];
    fill_normal(rng, &mut noise);
    let mut state = noise.first().copied().unwrap_or(0.0);
    for x in &mut noise {
        state = keep * state + fresh * *x;
        *x = state;
    }
    noise
}

/// Rounds a value like a 16-bit converter; 1 is full scale.
fn quantised(x: f32) -> f32 {
    // Adding 384 rounds to 16 bits, since an f32 between 256 and 512 has steps of 2^-15.
    ((x.clamp(-1.0, 1.0 - 1.0 / 32_768.0)) + 384.0) - 384.0
}

/// The smallest even number from `n` on without a prime factor above 5.
fn smooth_length(n: usize) -> usize {
    let smooth = |mut x: usize| {
        for p in [2, 3, 5] {
            while x.is_multiple_of(p) {
                x /= p;
            }
        }
        x == 1
    };
    (n.max(2)..).find(|&x| x.is_multiple_of(2) && smooth(x)).unwrap_or(n)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::seed;

    fn variance(xs: &[f32]) -> f64 {
        xs.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>() / xs.len() as f64
    }

    #[test]
    fn white_noise_has_variance_1() {
        let mut noise = vec![0.0; 100_000];
        fill_normal(&mut seed::rng(1, &[b"white"]), &mut noise);
        assert!((variance(&noise) - 1.0).abs() < 0.02);
        assert!(noise.iter().sum::<f32>().abs() / 1e5 < 0.01);
    }

    #[test]
    fn coloured_noise_has_the_variance_of_its_spectrum() {
        let rng = &mut seed::rng(1, &[b"coloured"]);
        let noise = coloured(rng, 50_001, 10_000.0, 1_000.0, |_| 0.1);
        assert_eq!(noise.len(), 50_001);
        assert!((variance(&noise) - 10.0).abs() < 0.5, "{}", variance(&noise));
    }

    #[test]
    fn correlated_noise_forgets_at_its_pace() {
        let noise = correlated(&mut seed::rng(1, &[b"ar"]), 200_000, 20.0);
        let lagged = noise.iter().zip(&noise[20..]).map(|(a, b)| a * b).sum::<f32>();
        let correlation = lagged / noise.iter().map(|a| a * a).sum::<f32>();
        assert!((correlation - (-1f32).exp()).abs() < 0.05, "{correlation}");
    }

    #[test]
    fn quantised_values_are_16_bit() {
        for x in [-2.0, -0.3, 0.0, 0.123_456, 0.99, 7.0] {
            let steps = quantised(x) * 32_768.0;
            assert_eq!(steps, steps.round());
            assert!((-32_768.0..=32_767.0).contains(&steps));
        }
    }

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
