//! Levels: the root mean square of a channel, or of all channels of a series, without the mean of each.

use super::Series;

/// The mean square of some values, without their mean.
pub(crate) fn power(values: impl ExactSizeIterator<Item = f64> + Clone) -> f64 {
    let count = values.len() as f64;
    let mean = values.clone().sum::<f64>() / count;
    values.map(|x| (x - mean).powi(2)).sum::<f64>() / count
}

/// The level at which silence stands, in dB; far below a step of 16 bits.
const SILENCE_DB: f64 = -200.0;

/// The level of each channel of interleaved samples, in dB, rounded to 0.01 dB; empty without samples.
pub fn channel_levels_db(samples: &[f32], channels: usize) -> Vec<f64> {
    if samples.len() < channels.max(1) {
        return Vec::new();
    }
    let of = |channel: usize| {
        let power = power(samples[channel..].iter().step_by(channels).map(|&x| f64::from(x)));
        ((1000.0 * power.log10()).round() / 100.0).max(SILENCE_DB)
    };
    (0..channels).map(of).collect()
}

/// Least root mean square, to keep the logarithm of silence finite; far below a 16-bit step.
const LEAST: f64 = 1e-12;

/// Level of a series: ln of the root mean square over time and channels, after the mean of each
/// channel was subtracted.
pub(crate) fn level_of(series: &Series) -> f64 {
    let power: f64 = (0..series.channels()).map(|channel| power(series.channel(channel))).sum();
    (power / series.channels() as f64).sqrt().max(LEAST).ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_level_is_that_of_each_channel_without_its_mean() {
        let samples: Vec<f32> =
            (0..1000).flat_map(|i| [5.0 + if i % 2 == 0 { 0.1 } else { -0.1 }, 7.0]).collect();
        assert_eq!(channel_levels_db(&samples, 2), [-20.0, SILENCE_DB]);
        let louder: Vec<f32> = samples.iter().map(|x| 1.1 * x).collect();
        assert_eq!(channel_levels_db(&louder, 2)[0], -19.17, "10 % more gain are 0.83 dB");
        assert!(channel_levels_db(&[], 2).is_empty());
    }

    #[test]
    fn the_level_of_a_series_is_over_all_of_its_channels() {
        // One channel has level 0.3 and the other is silent, so the root mean square is 0.3/√2.
        let level = |samples: Vec<f32>| level_of(&Series::new(1024.0, 2, samples).unwrap());
        assert!((level([5.3, 0.0, 4.7, 0.0].repeat(500)).exp() - 0.3 / 2f64.sqrt()).abs() < 1e-6);
        assert_eq!(level(vec![1.0; 8]), LEAST.ln());
    }
}
