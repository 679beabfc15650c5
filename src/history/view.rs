//! Trials small enough to draw: the extremes of each stretch of time, and the spectrum.

use serde::Serialize;

use super::bands::{Bands, bands};
use crate::jpeg;
use crate::scene::{Domain, Phase, Scene, SourceId, SourceSpec};
use crate::trial::{Image, Series, Signal, Trial};

/// Stretches that a series is drawn by.
const BINS: usize = 400;
/// Frames of a window of the spectrum.
const WINDOW: usize = 4096;
/// Quality of pictures, of 100.
const QUALITY: u8 = 80;
/// Samples a second from which a source can be listened to.
const AUDIBLE_HZ: f64 = 8000.0;

/// A trial, small enough to draw.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TrialView {
    /// The sources that are series, by name.
    pub series: Vec<SeriesView>,
    /// Those that are pictures.
    pub pictures: Vec<SourceId>,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SeriesView {
    pub source: SourceId,
    /// The part of the scan that it follows.
    pub phase: Phase,
    pub rate_hz: f64,
    pub duration_s: f64,
    pub audible: bool,
    /// Least sample of each stretch, a list a channel.
    pub min: Vec<Vec<f32>>,
    /// Greatest sample of each stretch, a list a channel.
    pub max: Vec<Vec<f32>>,
    /// The spectrum, where it is long enough.
    pub spectrum: Option<Bands>,
}

impl TrialView {
    pub fn of(trial: &Trial, scene: &Scene) -> Self {
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
                    // A stretch is never empty.
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
            spectrum: bands(series.samples(), channels, rate_hz, WINDOW),
        }
    }
}

/// A picture as JPEG; `None` if there is no memory for it.
pub fn jpeg(image: &Image) -> Option<Vec<u8>> {
    jpeg::encode(image, QUALITY).ok()
}

/// A number that is short when printed: about four digits, which is finer than any screen.
pub fn four_digits(x: f32) -> f32 {
    if x == 0.0 || !x.is_finite() {
        return 0.0;
    }
    let scale = 10f64.powi(3 - f64::from(x.abs()).log10().floor() as i32);
    (((f64::from(x) * scale).round() / scale) as f32).clamp(f32::MIN, f32::MAX)
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
}
