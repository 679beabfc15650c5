//! Features of a series: moments and ratios in time, and a log-band spectrum.

use super::windowed_frames::{FrameView, points};
use crate::scene::Domain;
use crate::trial::Series;

/// For series of domain `spectrum`: frame duration in seconds, and number of bands.
const FAST: (f64, usize) = (0.0464, 40);
/// For series of domain `time`: frame duration in seconds, number of bands, highest frequency in Hz.
const SLOW: (f64, usize, f64) = (0.2, 16, 500.0);
/// Number of parts of a series. Their mean levels show its slow drift.
const PARTS: usize = 16;
/// Keeps logarithms finite; far below one step of a 24-bit converter.
const FLOOR: f64 = 1e-9;

/// The features of each channel in time, then the spectrum.
pub(crate) fn features(series: &Series, domain: &Domain) -> Vec<f64> {
    let mut features = Vec::new();
    for channel in 0..series.channels() {
        let values: Vec<f64> = series.channel(channel).collect();
        features.extend(moments(&values, series.rate_hz()));
    }
    let (frame_s, bands, band_hz) = match *domain {
        Domain::Spectrum { band_hz } => (FAST.0, FAST.1, band_hz),
        Domain::Time { .. } | Domain::Image => (SLOW.0, SLOW.1, (0.0, SLOW.2)),
    };
    let (rate_hz, channels) = (series.rate_hz(), series.channels());
    let view = FrameView::of_points(points(frame_s, rate_hz), rate_hz, channels, band_hz, bands);
    features.extend(levels(&view, series.samples()));
    features
}

/// Mean over frames of each log-band level, then the standard deviation of each level.
fn levels(view: &FrameView, samples: &[f32]) -> Vec<f64> {
    let (width, frames) = (view.width(), view.frames(samples));
    let n = (frames.len() / width) as f64;
    let (mut sum, mut squares) = (vec![0.0; width], vec![0.0; width]);
    for row in frames.chunks_exact(width) {
        for (i, &x) in row.iter().enumerate() {
            sum[i] += f64::from(x);
            squares[i] += f64::from(x).powi(2);
        }
    }
    let mean: Vec<f64> = sum.iter().map(|s| s / n).collect();
    let spread = squares.iter().zip(&mean).map(|(s, m)| (s / n - m * m).max(0.0).sqrt());
    mean.iter().copied().chain(spread).collect()
}

/// The features of one channel in time. Ratios and levels are logarithms, so that their distributions
/// have no long tails.
fn moments(values: &[f64], rate_hz: f64) -> [f64; 11] {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let of = |f: fn(f64) -> f64| values.iter().map(|x| f(x - mean)).sum::<f64>() / n;
    let deviation = of(|x| x * x).sqrt().max(FLOOR);
    let (third, fourth) = (of(|x| x * x * x), of(|x| x * x * x * x));
    let magnitude = of(f64::abs).max(FLOOR);
    let root = of(|x| x.abs().sqrt()).powi(2).max(FLOOR);
    let peak = values.iter().map(|x| (x - mean).abs()).fold(FLOOR, f64::max);
    let pairs = || values.windows(2).map(|w| (w[0] - mean, w[1] - mean));
    let crossings = pairs().filter(|(a, b)| (*a < 0.0) != (*b < 0.0)).count() as f64;
    let steps = (pairs().map(|(a, b)| (b - a).powi(2)).sum::<f64>() / n).sqrt();
    let part = values.len().div_ceil(PARTS).max(1);
    let level = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64 - mean;
    let parts: Vec<f64> = values.chunks(part).map(level).collect();
    let drift = (parts.iter().map(|x| x * x).sum::<f64>() / parts.len() as f64).sqrt();
    [
        mean,
        deviation.ln(),
        // Skewness, kurtosis, crest, shape, impulse and clearance factors.
        (third / deviation.powi(3)).cbrt(),
        (fourth / deviation.powi(4)).max(FLOOR).ln(),
        (peak / deviation).ln(),
        (deviation / magnitude).ln(),
        (peak / magnitude).ln(),
        (peak / root).ln(),
        // Mean crossings in Hz, size of steps over size of values, and drift over 16 parts.
        ((crossings + 1.0) * rate_hz / n).ln(),
        (steps / deviation).max(FLOOR).ln(),
        drift.max(FLOOR).ln(),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sine(amplitude: f64, offset: f64) -> Vec<f64> {
        (0..10_000).map(|i| offset + amplitude * (f64::from(i) * 0.1).sin()).collect()
    }

    #[test]
    fn a_sine_has_the_ratios_of_a_sine_at_any_amplitude() {
        for amplitude in [1e-3, 1.0, 1e3] {
            let m = moments(&sine(amplitude, 2.0), 1000.0);
            assert!((m[0] - 2.0).abs() < 0.01 * amplitude.max(1.0));
            assert!((m[3].exp() - 1.5).abs() < 0.01, "kurtosis");
            assert!((m[4].exp() - 2f64.sqrt()).abs() < 0.01, "crest");
            // 10 samples a radian at 1 kHz: 15.9 Hz, two crossings a period.
            assert!((m[8].exp() - 31.8).abs() < 0.5, "crossings");
        }
    }

    #[test]
    fn hostile_series_have_finite_features_of_one_length() {
        let time = |samples: Vec<f32>| {
            features(&Series::new(100.0, 1, samples).unwrap(), &Domain::Time { band_hz: None })
        };
        let usual = time((0..500).map(|i| (i as f32).sin()).collect());
        for samples in [vec![0.0; 500], vec![1.0], vec![1e30; 7], vec![-1e-30; 500]] {
            let features = time(samples);
            assert_eq!(features.len(), usual.len());
            assert!(features.iter().all(|x| x.is_finite()), "{features:?}");
        }
    }
}
