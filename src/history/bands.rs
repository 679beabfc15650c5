//! Spectra as people look at them: decibels in bands that grow with frequency.

use serde::Serialize;

use crate::spectrum::amplitude_spectrum;

const BANDS: usize = 96;
/// The level that silence is shown at, in dB.
const FLOOR_DB: f64 = -120.0;

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Bands {
    /// The lower edge of the first band, in Hz.
    pub from_hz: f64,
    /// The upper edge of the last band, in Hz; the edges between lie at equal ratios.
    pub to_hz: f64,
    /// Amplitude of each band in dB of one unit: the root of the summed squares over channels,
    /// without each channel's mean.
    pub db: Vec<f64>,
}

/// The spectrum of interleaved samples, averaged over windows of `window` frames side by side, or of
/// all of them where there are fewer. `None` for fewer than eight frames.
pub fn bands(samples: &[f32], channels: usize, rate_hz: f64, window: usize) -> Option<Bands> {
    let frames = window.min(samples.len() / channels.max(1));
    if frames < 8 {
        return None;
    }
    let bin_hz = rate_hz / frames as f64;
    let (from_hz, to_hz) = (bin_hz, rate_hz / 2.0);
    let mut power = vec![0.0; frames / 2 + 1];
    let windows = samples.chunks_exact(frames * channels);
    let count = windows.len() as f64;
    for window in windows {
        for channel in 0..channels {
            let samples = || window.iter().skip(channel).step_by(channels).map(|&x| f64::from(x));
            let mean = samples().sum::<f64>() / frames as f64;
            // Hann's window, at twice its height so that a tone keeps its amplitude.
            let turn = std::f64::consts::TAU / frames as f64;
            let windowed: Vec<f64> = samples()
                .enumerate()
                .map(|(i, x)| (x - mean) * (1.0 - (turn * i as f64).cos()))
                .collect();
            let amplitudes = amplitude_spectrum(windowed.into_iter(), rate_hz, (0.0, to_hz));
            power.iter_mut().zip(amplitudes).for_each(|(sum, a)| *sum += a * a / count);
        }
    }
    let edge = |band: usize| from_hz * (to_hz / from_hz).powf(band as f64 / BANDS as f64);
    let index = |hz: f64| ((hz / bin_hz).round() as usize).min(power.len() - 1);
    let db = (0..BANDS).map(|band| {
        let first = index(edge(band));
        // The lowest bands are narrower than a bin, and show the one they lie in.
        let end = index(edge(band + 1)).max(first + 1);
        let sum: f64 = power[first..end].iter().sum();
        let db = (10.0 * sum.log10()).max(FLOOR_DB);
        (10.0 * db).round() / 10.0
    });
    Some(Bands { from_hz, to_hz, db: db.collect() })
}

#[cfg(test)]
mod tests {
    use super::*;

    const FRAMES: usize = 4096;

    fn tone(frames: usize) -> Vec<f32> {
        let turn = std::f64::consts::TAU * 1000.0 / 10_000.0;
        (0..frames).map(|i| 5.0 + 0.1 * (turn * i as f64).sin() as f32).collect()
    }

    #[test]
    fn a_tone_stands_out_in_its_band_at_its_height() {
        for frames in [FRAMES, 3 * FRAMES + 7] {
            let Bands { from_hz, to_hz, db } = bands(&tone(frames), 1, 10_000.0, FRAMES).unwrap();
            let peak = (0..db.len()).max_by(|&a, &b| db[a].total_cmp(&db[b])).unwrap();
            let hz = from_hz * (to_hz / from_hz).powf((peak as f64 + 0.5) / db.len() as f64);
            assert!((hz / 1000.0).ln().abs() < 0.05, "{hz} Hz");
            // Hann spreads a tone over three bins, whose squares sum to 1.5 of the tone's.
            assert!((db[peak] - (-20.0 + 1.76)).abs() < 1.0, "{} dB", db[peak]);
            assert!(db[5] < -70.0, "the mean is not shown: {} dB", db[5]);
        }
    }

    #[test]
    fn silence_is_the_floor_and_too_few_frames_are_nothing() {
        let silent = bands(&[0.0; FRAMES], 1, 10_000.0, FRAMES).unwrap();
        assert!(silent.db.iter().all(|&db| db == FLOOR_DB));
        assert!(bands(&[0.0; 7], 1, 10_000.0, FRAMES).is_none());
    }
}
