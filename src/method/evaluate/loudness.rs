//! The loudness and the band of a series.

use crate::spectrum::amplitude_spectrum;
use crate::trial::{Series, power};

/// Least root mean square, to keep the logarithm of silence finite; far below a 16-bit step.
const SILENCE: f64 = 1e-12;

/// Level of a series: ln of the root mean square over time and channels, after the mean of each
/// channel was subtracted.
pub(super) fn level_of(series: &Series) -> f64 {
    let power: f64 = (0..series.channels()).map(|channel| power(series.channel(channel))).sum();
    (power / series.channels() as f64).sqrt().max(SILENCE).ln()
}

/// Most frames that the edge of a band is measured on.
const MOST_FRAMES: usize = 1 << 16;

/// The frequency in Hz below which 95 % of the power of a series' first channel lies, without its mean.
/// 0 for a constant.
pub(super) fn edge_hz(series: &Series) -> f64 {
    let rate_hz = series.rate_hz();
    let first: Vec<f64> = series.channel(0).take(MOST_FRAMES).collect();
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

    fn series(channels: usize, samples: Vec<f32>) -> Series {
        Series::new(1024.0, channels, samples).unwrap()
    }

    #[test]
    fn a_level_is_that_of_the_root_mean_square_without_the_mean() {
        // One channel has level 0.3 and the other is silent, so the root mean square is 0.3/√2.
        let samples = [5.3, 0.0, 4.7, 0.0].repeat(500);
        assert!((level_of(&series(2, samples)).exp() - 0.3 / 2f64.sqrt()).abs() < 1e-6);
        assert_eq!(level_of(&series(2, vec![1.0; 8])), SILENCE.ln());
    }

    #[test]
    fn the_edge_of_a_band_is_that_of_its_fastest_strong_tone() {
        let wave = |hz: f64, i: usize| (i as f64 * hz * std::f64::consts::TAU / 1024.0).sin();
        let edge = |strength: f64| {
            let sample = |i| (3.0 + wave(50.0, i) + strength * wave(300.0, i)) as f32;
            edge_hz(&series(1, (0..2048).map(sample).collect()))
        };
        assert_eq!((edge(0.5), edge(0.1)), (300.0, 50.0));
        assert_eq!(edge_hz(&series(1, vec![2.0; 64])), 0.0);
    }
}
