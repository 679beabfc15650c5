//! Noise to make signals from: white, with a given spectrum, or with a correlation time.
//!
//! Generation must be fast, but exact tails do not matter. So a nearly normal number is the sum of
//! four uniform numbers, which never exceeds 3.5 standard deviations.

use std::cell::RefCell;

use rand::Rng;
use realfft::RealFftPlanner;
use realfft::num_complex::Complex;

thread_local! {
    /// Keeps the plans of Fourier transforms, so that later trials can use them.
    static PLANNER: RefCell<RealFftPlanner<f32>> = RefCell::new(RealFftPlanner::new());
}

/// Distance in Hz between the points of a spectrum that are computed; the rest is interpolated.
const KNOT_HZ: f64 = 10.0;

/// Fills `out` with nearly normal numbers (mean 0, variance 1).
pub(super) fn fill_normal(rng: &mut impl Rng, out: &mut [f32]) {
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

/// Stationary noise of `frames` samples with the given spectrum.
///
/// `density` maps a frequency in Hz to an amplitude per √Hz; above `end_hz` the spectrum is 0. The
/// variance is the integral of the squared density.
pub(super) fn coloured(
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
pub(super) fn correlated(rng: &mut impl Rng, frames: usize, time_frames: f64) -> Vec<f32> {
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
pub(super) fn quantised(x: f32) -> f32 {
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
}
