//! Tests every lag for an echo: dependence at a single lag, which can fall between bins.

use realfft::RealFftPlanner;
use realfft::num_complex::Complex;

use super::features::Features;

/// An echo exceeds the threshold by this number of robust standard deviations.
const SURE: f64 = 6.0;

/// The last lag above `from`, up to `longest`, at which a covariance c of two features surely exceeds
/// `correlation`: |c| − 6·deviation ≥ `correlation`. The deviation is estimated from the median of |c|
/// over these lags.
pub(super) fn last_echo(
    features: &Features,
    correlation: f64,
    from: usize,
    longest: usize,
) -> Option<usize> {
    if from >= longest {
        return None;
    }
    all_covariances(features, longest)
        .into_iter()
        .filter_map(|covariance| {
            let beyond = &covariance[from + 1..];
            let mut sizes: Vec<f32> = beyond.iter().map(|c| c.abs()).collect();
            let middle = sizes.len() / 2;
            let median = *sizes.select_nth_unstable_by(middle, f32::total_cmp).1;
            // For a normal distribution, standard deviation = 1.4826 · median absolute value.
            let least = correlation + SURE * 1.4826 * f64::from(median);
            beyond.iter().rposition(|c| f64::from(c.abs()) >= least).map(|at| from + 1 + at)
        })
        .max()
}

/// Means of fᵢ(s)·fⱼ(s + t) over all s and trials, for t = 0 to `longest` and all pairs i, j.
fn all_covariances(features: &Features, longest: usize) -> Vec<Vec<f32>> {
    let frames = features.frames;
    // Padding by zeros for the longest lag keeps a trial's end from wrapping to its start.
    let points = (frames + longest).next_power_of_two();
    let mut planner = RealFftPlanner::<f32>::new();
    let (forward, inverse) = (planner.plan_fft_forward(points), planner.plan_fft_inverse(points));
    let mut input = forward.make_input_vec();
    let count = features.columns.len();
    let mut sums: Vec<Vec<Complex<f32>>> =
        (0..count * (count + 1) / 2).map(|_| forward.make_output_vec()).collect();
    for trial in 0..features.trials {
        let spectra: Vec<Vec<Complex<f32>>> = (features.columns.iter())
            .map(|column| {
                input.fill(0.0);
                input[..frames].copy_from_slice(&column[trial * frames..(trial + 1) * frames]);
                let mut spectrum = forward.make_output_vec();
                // The transform fails only if a length is wrong; these lengths come from the plan.
                forward.process(&mut input, &mut spectrum).expect("buffers of the plan's lengths");
                spectrum
            })
            .collect();
        let pairs = (0..count).flat_map(|i| (0..=i).map(move |j| (i, j)));
        for (sum, (i, j)) in sums.iter_mut().zip(pairs) {
            for ((s, a), b) in sum.iter_mut().zip(&spectra[i]).zip(&spectra[j]) {
                *s += a.conj() * b;
            }
        }
    }
    let mut found = Vec::with_capacity(2 * sums.len());
    let mut output = inverse.make_output_vec();
    for sum in &mut sums {
        // These bins are real; the inverse transform fails if rounding leaves an imaginary part.
        sum[0].im = 0.0;
        sum[points / 2].im = 0.0;
        inverse.process(sum, &mut output).expect("buffers of the plan's lengths");
        let scale = |t: usize| 1.0 / (points as f32 * (features.trials * (frames - t)) as f32);
        found.push((0..=longest).map(|t| output[t] * scale(t)).collect());
        // Negative lags are positive lags of the same features in the other order.
        found.push((0..=longest).map(|t| output[(points - t) % points] * scale(t)).collect());
    }
    found
}

#[cfg(test)]
mod tests {
    use super::super::features::{Samples, features};
    use super::*;
    use crate::independence::simulate;

    fn noise(trials: usize, frames: usize, echo: Option<(usize, f32)>, seed: u64) -> Features {
        let mut rng = crate::seed::rng(seed, &[b"echo"]);
        let mut values = simulate::ar1(trials * frames, 0.0, &mut rng);
        if let Some((lag, gain)) = echo {
            for i in (lag..values.len()).rev() {
                values[i] += gain * values[i - lag];
            }
        }
        features(&Samples { trials, frames, channels: vec![values] })
    }

    #[test]
    fn transforms_give_the_covariances_of_the_definition() {
        let features = noise(3, 700, None, 1);
        let got = all_covariances(&features, 170);
        let at = |f: usize, q: usize, s: usize| f64::from(features.columns[f][q * 700 + s]);
        for (pair, i, j) in [(0, 0, 0), (2, 1, 0), (3, 0, 1), (10, 2, 2)] {
            for t in [0, 1, 99, 170] {
                let sum: f64 = (0..3)
                    .flat_map(|q| (0..700 - t).map(move |s| (q, s)))
                    .map(|(q, s)| at(i, q, s) * at(j, q, s + t))
                    .sum();
                let want = sum / (3 * (700 - t)) as f64;
                let found = f64::from(got[pair][t]);
                assert!((found - want).abs() < 1e-5, "{pair} {t}: {found} {want}");
            }
        }
    }

    #[test]
    fn an_echo_at_one_lag_is_found_and_noise_has_none() {
        for seed in 0..5 {
            let features = noise(10, 8000, Some((1237, 0.3)), seed);
            assert_eq!(last_echo(&features, 0.1, 1, 2000), Some(1237));
            assert_eq!(last_echo(&noise(10, 8000, None, seed), 0.1, 1, 2000), None);
        }
    }
}
