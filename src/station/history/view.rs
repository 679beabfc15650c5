//! Small views of trials for drawing: the extremes of a series in up to 400 intervals, and its spectrum.

use serde::Serialize;

use crate::scene::{Domain, Phase, Scene, SourceId, SourceSpec};
use crate::spectrum::amplitude_spectrum;
use crate::trial::{Series, Signal, Trial};

/// Most time intervals that a series is divided into for drawing.
const BINS: usize = 400;
/// Frames in each window of the spectrum.
pub const WINDOW: usize = 4096;
/// Lowest rate of a sound that can be listened to.
const AUDIBLE_HZ: f64 = 8000.0;

#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct TrialView {
    /// The views of all sources that are series, sorted by name.
    pub series: Vec<SeriesView>,
    pub pictures: Vec<SourceId>,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct SeriesView {
    pub source: SourceId,
    /// The part of the scan that the source records, the tap or the drag.
    pub phase: Phase,
    pub rate_hz: f64,
    pub duration_s: f64,
    pub audible: bool,
    /// Least sample in each time interval, one list per channel.
    pub min: Vec<Vec<f32>>,
    pub max: Vec<Vec<f32>>,
    /// The spectrum; `None` for a series that is too short.
    pub spectrum: Option<Bands>,
}

impl TrialView {
    pub(super) fn of(trial: &Trial, scene: &Scene) -> Self {
        let mut view = Self { series: Vec::new(), pictures: Vec::new() };
        for (id, signal) in &trial.signals {
            match signal {
                Signal::Series(series) => {
                    let spec = scene.get(id.as_str());
                    view.series.push(SeriesView::of(id, spec, series));
                }
                Signal::Image(_) => view.pictures.push(id.clone()),
            }
        }
        view
    }
}

impl SeriesView {
    fn of(source: &SourceId, spec: Option<&SourceSpec>, series: &Series) -> Self {
        let (channels, rate_hz) = (series.channels(), series.rate_hz());
        let is_sound = spec.is_some_and(|spec| matches!(spec.domain, Domain::Spectrum { .. }));
        let width = series.frames().div_ceil(BINS) * channels;
        let extremes = |pick: fn(f32, f32) -> f32| {
            let of_channel = |channel: usize| {
                let of_stretch = |stretch: &[f32]| {
                    let samples = stretch.iter().skip(channel).step_by(channels).copied();
                    // A time interval is never empty, so the default is not used.
                    four_digits(samples.reduce(pick).unwrap_or(0.0))
                };
                series.samples().chunks(width).map(of_stretch).collect()
            };
            (0..channels).map(of_channel).collect()
        };
        Self {
            source: source.clone(),
            phase: spec.map_or(Phase::Drag, |spec| spec.phase),
            rate_hz,
            duration_s: series.duration_s(),
            audible: rate_hz >= AUDIBLE_HZ && channels <= 2 && is_sound,
            min: extremes(f32::min),
            max: extremes(f32::max),
            spectrum: bands(series.samples(), channels, rate_hz),
        }
    }
}

/// Rounds to four digits, which are short to print and finer than any screen; 0 for NaN and infinity.
pub fn four_digits(x: f32) -> f32 {
    if x == 0.0 || !x.is_finite() {
        return 0.0;
    }
    let scale = 10f64.powi(3 - f64::from(x.abs()).log10().floor() as i32);
    (((f64::from(x) * scale).round() / scale) as f32).clamp(f32::MIN, f32::MAX)
}

const BANDS: usize = 96;
/// The level at which silence is drawn, in dB.
const FLOOR_DB: f64 = -120.0;

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Bands {
    /// The lower edge of the first band, in Hz.
    pub from_hz: f64,
    /// The upper edge of the last band, in Hz; the edges between lie at equal ratios.
    pub to_hz: f64,
    /// Amplitude of each band in dB relative to 1, from the sum of squares over all channels after
    /// the mean of each channel is subtracted.
    pub db: Vec<f64>,
}

/// The spectrum of interleaved samples, averaged over adjacent windows of [`WINDOW`] frames, or over
/// one window of all frames if there are fewer. `None` for fewer than eight frames.
pub fn bands(samples: &[f32], channels: usize, rate_hz: f64) -> Option<Bands> {
    let frames = WINDOW.min(samples.len() / channels.max(1));
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
            // Hann's window is used at twice its height, so that a tone keeps its amplitude.
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
        // The lowest bands are narrower than a bin, so each takes at least the bin in which it begins.
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
    use crate::trial::TrialKey;

    #[test]
    fn a_series_is_drawn_by_its_extremes() {
        let id = SourceId::new("ir").unwrap();
        let samples: Vec<f32> = (0..100_000).map(|i| if i == 60_000 { 9.0 } else { 1.0 }).collect();
        let series = Series::new(10_000.0, 1, samples).unwrap();
        let signals = [(id, Signal::Series(series))].into();
        let trial = Trial { key: TrialKey::new("", "", 1), signals };
        let view = TrialView::of(&trial, &Scene::lmt108());
        let ir = &view.series[0];
        assert_eq!((ir.min[0].len(), ir.max[0].len(), ir.duration_s), (BINS, BINS, 10.0));
        let peaks: Vec<_> = (0..BINS).filter(|&i| ir.max[0][i] == 9.0).collect();
        assert_eq!(peaks, [240]);
    }

    #[test]
    fn numbers_are_short_and_close() {
        for x in [0.0, 1.0, -0.012_345_678, 32_767.3, 1e-30, f32::MAX, f32::MIN_POSITIVE] {
            let short = four_digits(x);
            assert!((short - x).abs() <= x.abs() * 6e-4, "{x} became {short}");
            assert!(serde_json::to_string(&short).unwrap().len() <= 13, "{short}");
        }
        assert_eq!(four_digits(f32::NAN), 0.0);
    }

    fn tone(frames: usize) -> Vec<f32> {
        let turn = std::f64::consts::TAU * 1000.0 / 10_000.0;
        (0..frames).map(|i| 5.0 + 0.1 * (turn * i as f64).sin() as f32).collect()
    }

    #[test]
    fn a_tone_stands_out_in_its_band_at_its_height() {
        for frames in [WINDOW, 3 * WINDOW + 7] {
            let Bands { from_hz, to_hz, db } = bands(&tone(frames), 1, 10_000.0).unwrap();
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
        let silent = bands(&[0.0; WINDOW], 1, 10_000.0).unwrap();
        assert!(silent.db.iter().all(|&db| db == FLOOR_DB));
        assert!(bands(&[0.0; 7], 1, 10_000.0).is_none());
    }
}
