//! The level of a channel: its root mean square, without its mean, in dB relative to 1.

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
}
