//! How long the frames of a series are. There are two views: long and short frames.
//!
//! The length of frames depends on samples as well as on time (README §4). A long frame has the power
//! of two nearest to 46 ms or 64 samples, whichever is longer, so that slow sensors have a spectrum
//! too. It has at most a quarter of the library's median trial. A short frame is a quarter of a long
//! one. The shape of the library sets the frames of its trials and of all queries.

use serde::{Deserialize, Serialize};

use super::places::Places;
use super::windowed_frames::{FEWEST, FrameView};
use crate::library::shape::LibraryShape;
use crate::scene::SourceSpec;

/// Duration of a long frame in seconds, if that is enough samples.
const FRAME_S: f64 = 0.0464;
/// Fewest samples in a long frame, if trials are long enough.
const LEAST_POINTS: f64 = 64.0;
/// A long frame is at most this share of the library's median trial.
const MOST_OF_TRIAL: f64 = 0.25;
/// A long frame has this many times as many samples as a short frame.
const SHORTER: usize = 4;
/// Most bands in a long frame and in a short frame.
const BANDS: [usize; 2] = [40, 24];
/// A band that covers at least this share of all frequencies counts as all of them.
const NEARLY_ALL: f64 = 0.9;
/// Highest frequency in Hz if no band is configured.
const UNSAID_HZ: f64 = 500.0;

/// How the series of one source are cut into frames and summed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SourceViews {
    /// Long frames first, then short frames.
    pub frames: [FrameView; 2],
    /// Whether moments are taken from the part of the series within the band: the band leaves out more
    /// than a few of the frequencies.
    pub passed: bool,
    /// How a short series is cut into places; none if it is limited to the band.
    pub places: Option<Places>,
}

impl SourceViews {
    /// The views of a recording, with its rate in Hz and its length in frames, in a library of this
    /// `shape`. If the shape lacks the source, the recording itself is used as the median trial.
    pub fn new(spec: &SourceSpec, series: (f64, usize), shape: &LibraryShape) -> Self {
        let (rate_hz, frames) = series;
        let known = shape.get(&spec.id);
        let (library_hz, median) =
            known.map_or((rate_hz, frames), |s| (s.rate_hz, s.median_frames));
        let wished = (FRAME_S * library_hz).max(LEAST_POINTS);
        let power_of_two = |points: f64| 1usize << points.log2().round().clamp(0.0, 24.0) as u32;
        let long = power_of_two(wished.min(MOST_OF_TRIAL * median as f64));
        let short = (long / SHORTER).max(FEWEST);
        let (low, high) = spec.domain.band_hz().unwrap_or((0.0, UNSAID_HZ));
        let band_hz = (low, high.min(0.5 * library_hz));
        let view = |points: usize, bands| {
            let of_library =
                FrameView::of_points(points, library_hz, spec.channels, band_hz, bands);
            if rate_hz == library_hz { of_library } else { of_library.at_rate(rate_hz) }
        };
        let passed = spec.domain.band_hz().is_some()
            && band_hz.1 - band_hz.0 < NEARLY_ALL * 0.5 * library_hz;
        Self {
            frames: [view(long.max(FEWEST), BANDS[0]), view(short, BANDS[1])],
            passed,
            places: if passed { None } else { Places::new(median, library_hz, rate_hz) },
        }
    }

    /// The rate in Hz of the series that moments are taken from.
    pub fn moments_hz(&self) -> f64 {
        let long = &self.frames[0];
        if !self.passed {
            return long.rate_hz;
        }
        long.rate_hz * long.passed_points() as f64 / long.points as f64
    }

    /// Whether the bands of both cover the same frequencies; their rates may differ.
    pub fn comparable(&self, other: &Self) -> bool {
        self.frames.iter().zip(&other.frames).all(|(a, b)| a.comparable(b))
    }

    /// Samples a channel in a block of moments: the step from one long frame to the next.
    pub fn block(&self) -> usize {
        let long = &self.frames[0];
        if self.passed { long.passed_points().div_ceil(2) } else { long.hop() }
    }

    pub fn channels(&self) -> usize {
        self.frames[0].channels
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::library::shape::SourceShape;
    use crate::scene::Scene;

    fn views(id: &str, rate_hz: f64, median_frames: usize, at_hz: f64) -> [FrameView; 2] {
        let scene = Scene::lmt108();
        let spec = scene.get(id).unwrap();
        let shape = SourceShape { rate_hz, channels: spec.channels, median_frames };
        let shape = LibraryShape { trials: 1, sources: [(spec.id.clone(), shape)].into() };
        SourceViews::new(spec, (at_hz, 100), &shape).frames
    }

    #[test]
    fn frames_follow_samples_where_the_clock_would_leave_none() {
        let points = |id, rate_hz, median| views(id, rate_hz, median, rate_hz).map(|v| v.points);
        assert_eq!(points("mi2", 44_100.0, 211_611), [2048, 512]);
        assert_eq!(points("ac", 100.0, 500), [64, 16]);
        assert_eq!(points("fr", 10.0, 50), [16, 4], "a quarter of the trial");
        assert_eq!(points("fr", 10.0, 3), [4, 4]);
        assert_eq!(views("fr", 35.0, 415, 35.0)[0].edges.last(), Some(&32), "to half the rate");
    }

    #[test]
    fn a_query_at_another_rate_has_frames_as_long_as_the_library() {
        let at = |hz| views("mi2", 44_100.0, 211_611, hz);
        assert!(at(48_000.0)[0].comparable(&at(44_100.0)[0]));
        assert_eq!(at(96_000.0)[0].points, 4096);
        let slow = views("ac", 100.0, 60, 10.0);
        assert_eq!(slow.each_ref().map(|view| view.points), [4, 4], "no frame is shorter");
        assert_eq!(slow[1].frames_in(9), 3);
        // Of a telephone, compared up to 4 kHz.
        let mut scene = Scene::lmt108();
        scene = scene.changed(|spec| spec.end_band_at(4000.0));
        let spec = scene.get("mi2").unwrap();
        for library_hz in [8000.0, 16_000.0, 44_100.0, 48_000.0] {
            let median_frames = (4.0 * library_hz) as usize;
            let shape = SourceShape { rate_hz: library_hz, channels: 1, median_frames };
            let shape = LibraryShape { trials: 1, sources: [(spec.id.clone(), shape)].into() };
            let at = |hz| SourceViews::new(spec, (hz, (4.0 * hz) as usize), &shape);
            for hz in [8000.0, 11_025.0, 16_000.0, 22_050.0, 44_100.0, 48_000.0, 96_000.0] {
                assert!(at(hz).comparable(&at(library_hz)), "{hz} in a library of {library_hz} Hz");
            }
        }
    }
}
