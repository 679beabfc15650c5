//! The loudness of a series.

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
}
