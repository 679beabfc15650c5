//! The loudness and the band of a series.

use crate::spectrum::amplitude_spectrum;

/// Least root mean square, to keep the logarithm of silence finite; far below a 16-bit step.
const SILENCE: f64 = 1e-12;

/// Level of a series: ln of the root mean square over time and channels, after the mean of each
/// channel was subtracted.
pub(super) fn level_of(samples: &[f32], channels: usize) -> f64 {
    let power: f64 = (0..channels)
        .map(|channel| {
            let of_channel = || samples[channel..].iter().step_by(channels).map(|&x| f64::from(x));
            let n = of_channel().count() as f64;
            let mean = of_channel().sum::<f64>() / n;
            of_channel().map(|x| (x - mean).powi(2)).sum::<f64>() / n
        })
        .sum();
    (power / channels as f64).sqrt().max(SILENCE).ln()
}

/// Most frames that the edge of a band is measured on.
const MOST_FRAMES: usize = 1 << 16;

/// The frequency in Hz below which 95 % of the power of a series' first channel lies, without its mean.
/// 0 for a constant.
pub(super) fn edge_hz(samples: &[f32], channels: usize, rate_hz: f64) -> f64 {
    let first: Vec<f64> =
        samples.iter().step_by(channels).take(MOST_FRAMES).map(|&x| f64::from(x)).collect();
    let mean = first.iter().sum::<f64>() / first.len() as f64;
    let power = amplitude_spectrum(first.iter().map(|x| x - mean), rate_hz, (0.0, rate_hz / 2.0));
    let power: Vec<f64> = power.into_iter().map(|x| x * x).collect();
    let mut left = 0.05 * power.iter().sum::<f64>();
    let above = power.iter().rev().take_while(|&&x| {
        left -= x;
        left >= 0.0
    });
    let edge = power.len().saturating_sub(1 + above.count());
    if left < 0.0 { edge as f64 * rate_hz / first.len().next_power_of_two() as f64 } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_level_is_that_of_the_root_mean_square_without_the_mean() {
        let samples: Vec<f32> =
            (0..1000).flat_map(|i| [5.0 + if i % 2 == 0 { 0.3 } else { -0.3 }, 0.0]).collect();
        // One channel has level 0.3 and the other is silent, so the root mean square is 0.3/√2.
        assert!((level_of(&samples, 2).exp() - 0.3 / 2f64.sqrt()).abs() < 1e-6);
        assert_eq!(level_of(&[1.0; 8], 2), SILENCE.ln());
    }

    #[test]
    fn the_edge_of_a_band_is_that_of_its_fastest_strong_tone() {
        let wave = |hz: f64, i: usize| (i as f64 * hz * std::f64::consts::TAU / 1024.0).sin();
        let samples = |strength: f64| -> Vec<f32> {
            (0..2048).map(|i| (3.0 + wave(50.0, i) + strength * wave(300.0, i)) as f32).collect()
        };
        assert_eq!(edge_hz(&samples(0.5), 1, 1024.0), 300.0);
        assert_eq!(edge_hz(&samples(0.1), 1, 1024.0), 50.0);
        assert_eq!(edge_hz(&[2.0; 64], 1, 1024.0), 0.0);
    }
}
