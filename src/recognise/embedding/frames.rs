//! A trial prepared for the method `embedding`: for each series, log-band frames in two views (long
//! and short frames) and moments; for each picture, tiles. Library trials also have these of their
//! augmented copies.
//!
//! The length of frames depends on samples as well as on time (method §9): a long frame has the
//! power of two nearest to 46 ms or 64 samples, whichever is longer, so that slow sensors have a
//! spectrum, too, but at most a quarter of the library's median trial; a short frame has a quarter
//! of that. The shape of the library gives the frames of its trials and of all queries.

use std::collections::BTreeMap;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::copies::{self, copies};
use super::moments::{GrowingMoments, Moments};
use super::packed;
use super::tiles::PictureTiles;
use crate::recognise::checks::check_signal;
use crate::recognise::error::RecogniseError;
use crate::recognise::features::windowed_frames::{FrameView, ViewFrames};
use crate::recognise::follow::LOOK_S;
use crate::recognise::shape::LibraryShape;
use crate::scene::{Phase, Scene, SourceId, SourceSpec};
use crate::trial::{Series, Signal, Trial, TrialKey};

/// Duration of a long frame in seconds, where that is enough samples.
const FRAME_S: f64 = 0.0464;
/// Fewest samples of a long frame, where trials are long enough.
const LEAST_POINTS: f64 = 64.0;
/// A long frame is at most this share of the library's median trial.
const MOST_OF_TRIAL: f64 = 0.25;
/// How many times longer a long frame is than a short one.
const SHORTER: usize = 4;
/// Fewest samples of any frame.
const FEWEST: usize = 4;
/// Most bands of a long frame and of a short one.
const BANDS: [usize; 2] = [40, 24];
/// Highest frequency where no band is configured, in Hz.
const UNSAID_HZ: f64 = 500.0;

/// How the series of one source are cut into frames: long frames first, then short ones.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SourceViews(pub [FrameView; 2]);

impl SourceViews {
    /// The views of a recording with a rate in Hz and a length in frames, in a library of this
    /// `shape`. If the shape lacks the source, the recording stands for the library's trials.
    pub fn new(spec: &SourceSpec, series: (f64, usize), shape: &LibraryShape) -> Self {
        let (rate_hz, frames) = series;
        let known = shape.get(&spec.id);
        let (library_hz, median) =
            known.map_or((rate_hz, frames), |s| (s.rate_hz, s.median_frames));
        let wished = (FRAME_S * library_hz).max(LEAST_POINTS);
        let power_of_two = |points: f64| 1usize << points.log2().round().clamp(0.0, 24.0) as u32;
        let long = power_of_two(wished.min(MOST_OF_TRIAL * median as f64));
        let short = (long / SHORTER).max(FEWEST);
        // At another rate, frames last as long as in the library, rounded to a power of two.
        let at_rate =
            |points: usize| power_of_two(points as f64 * rate_hz / library_hz).max(FEWEST);
        let (low, high) = spec.domain.band_hz().unwrap_or((0.0, UNSAID_HZ));
        let band_hz = (low, high.min(0.5 * library_hz));
        let view = |points: usize, bands| {
            FrameView::of_points(at_rate(points), rate_hz, spec.channels, band_hz, bands)
        };
        Self([view(long.max(FEWEST), BANDS[0]), view(short, BANDS[1])])
    }

    /// Whether the bands of both cover the same frequencies, even at different rates.
    pub fn comparable(&self, other: &Self) -> bool {
        self.0.iter().zip(&other.0).all(|(a, b)| a.comparable(b))
    }

    /// Samples a channel in a block of moments: the step from one long frame to the next.
    pub fn block(&self) -> usize {
        self.0[0].hop()
    }
}

/// Log-band frames in fixed point with steps of 2⁻⁹ of a natural logarithm: finer than any estimate
/// of power, and half the memory.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PackedFrames {
    #[serde(with = "packed::list")]
    values: Vec<i16>,
}

/// Steps of a fixed-point value in one unit of ln power.
const STEPS: f32 = 512.0;

impl PackedFrames {
    /// Packs the values of some frames.
    pub fn new(values: &[f32]) -> Self {
        let pack = |x: &f32| (x * STEPS).round().clamp(f32::from(i16::MIN), f32::from(i16::MAX));
        Self { values: values.iter().map(|x| pack(x) as i16).collect() }
    }

    /// All values, as ln power.
    pub fn values(&self) -> Vec<f32> {
        self.values.iter().map(|&x| f32::from(x) / STEPS).collect()
    }

    /// Writes the frames `within`, each of `width` values, to `out`, as ln power.
    pub fn unpack(&self, width: usize, within: std::ops::Range<usize>, out: &mut Vec<f32>) {
        out.clear();
        let values = &self.values[within.start * width..within.end * width];
        out.extend(values.iter().map(|&x| f32::from(x) / STEPS));
    }

    /// Number of frames of `width` values.
    pub fn frames(&self, width: usize) -> usize {
        self.values.len() / width
    }
}

/// A piece of a series: the whole series, or a copy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Piece {
    /// Frames of each view; at least one.
    pub frames: [PackedFrames; 2],
    /// Moments of its samples.
    pub moments: Moments,
}

impl Piece {
    fn new(views: &SourceViews, samples: &[f32]) -> Self {
        let frames =
            |view: &FrameView| PackedFrames::new(&ViewFrames::new(view.clone(), samples).values);
        Self {
            frames: views.0.each_ref().map(frames),
            moments: Moments::new(views.0[0].channels, views.block(), samples),
        }
    }
}

/// A series of a trial.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SeriesFrames {
    /// How it was cut into frames.
    pub views: SourceViews,
    /// Its length in samples.
    pub samples: usize,
    /// The whole series.
    pub whole: Piece,
    /// Its copies; a query has none.
    pub copies: Vec<Piece>,
    /// Its beginnings, one for each [`LOOK_S`]; only for drags, and only in a library.
    pub looks: Vec<Beginning>,
}

/// The beginning of a series; its frames are the first ones of the whole series.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Beginning {
    /// Moments of its samples.
    pub moments: Moments,
    /// One zero-padded frame for each view with longer frames than this beginning; else empty.
    pub padded: [PackedFrames; 2],
}

impl SeriesFrames {
    /// Cuts a recording into frames.
    pub fn new(views: SourceViews, series: &Series) -> Self {
        let whole = Piece::new(&views, series.samples());
        Self { whole, samples: series.frames(), views, copies: Vec::new(), looks: Vec::new() }
    }

    /// Cuts a recording of a library, and its copies, into frames.
    fn of_library(views: SourceViews, series: &Series, spec: &SourceSpec, from: Drawn<'_>) -> Self {
        let channels = series.channels();
        let source = (from.key, from.seed, spec.id.as_str());
        let copy = |copy: &copies::Copy| {
            Piece::new(&views, &copies::samples(copy, source, channels, series.samples()))
        };
        let copies = copies(from.key, from.seed).iter().map(copy).collect();
        let mut looks = Vec::new();
        if spec.phase == Phase::Drag {
            let mut growing = GrowingMoments::new(channels, views.block());
            let end = |look: usize| samples_by(look as f64 * LOOK_S, series.rate_hz());
            for look in (1..).take_while(|look| end(*look) <= series.frames()) {
                let fresh = end(look - 1) * channels..end(look) * channels;
                growing.extend(&series.samples()[fresh]);
                let so_far = &series.samples()[..end(look) * channels];
                let padded = |view: &FrameView| {
                    let is_short = end(look) < view.points;
                    let frames = is_short.then(|| ViewFrames::new(view.clone(), so_far));
                    frames.map_or_else(Default::default, |f| PackedFrames::new(&f.values))
                };
                let padded = views.0.each_ref().map(padded);
                looks.push(Beginning { moments: growing.so_far(), padded });
            }
        }
        Self { copies, looks, ..Self::new(views, series) }
    }

    /// Sample rate in Hz.
    pub fn rate_hz(&self) -> f64 {
        self.views.0[0].rate_hz
    }

    /// Whether it is as long as a short frame.
    pub fn is_a_frame_long(&self) -> bool {
        self.samples >= self.views.0[1].points
    }

    /// Length in seconds.
    pub fn duration_s(&self) -> f64 {
        self.samples as f64 / self.rate_hz()
    }
}

/// Number of samples a channel within the first `seconds`.
pub fn samples_by(seconds: f64, rate_hz: f64) -> usize {
    (seconds * rate_hz - 1e-6).ceil().max(0.0) as usize
}

/// The key and seed by which the copies of a library trial are drawn.
#[derive(Clone, Copy)]
struct Drawn<'a> {
    key: &'a TrialKey,
    seed: u64,
}

/// One source of a trial.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum SourceFrames {
    /// A series.
    Series(SeriesFrames),
    /// A picture.
    Picture(PictureTiles),
}

impl SourceFrames {
    /// The series, if it is one.
    pub fn series(&self) -> Option<&SeriesFrames> {
        if let Self::Series(series) = self { Some(series) } else { None }
    }

    /// The picture, if it is one.
    pub fn picture(&self) -> Option<&PictureTiles> {
        if let Self::Picture(tiles) = self { Some(tiles) } else { None }
    }
}

/// A trial, ready for `embedding`.
#[derive(Clone, Debug, PartialEq)]
pub struct TrialFrames {
    /// The trial's key.
    pub key: TrialKey,
    /// Its sources that the scene describes.
    pub sources: BTreeMap<SourceId, SourceFrames>,
}

impl TrialFrames {
    /// Frees the copies.
    pub(super) fn forget_copies(&mut self) {
        for source in self.sources.values_mut() {
            if let SourceFrames::Series(series) = source {
                series.copies = Vec::new();
            }
        }
    }

    /// Cuts those sources of a trial that the scene describes into frames, as in a library of this
    /// shape. A trial of the library itself has a `seed`, by which its copies are drawn; a query
    /// has none.
    ///
    /// # Errors
    /// If a source is of another kind, or has another number of channels, than the scene says.
    pub fn new(
        key: &TrialKey,
        trial: &Trial,
        scene: &Scene,
        shape: &LibraryShape,
        seed: Option<u64>,
    ) -> Result<Self, RecogniseError> {
        let known = trial.signals.iter().filter_map(|(id, s)| Some((scene.get(id.as_str())?, s)));
        let known: Vec<(&SourceSpec, &Signal)> = known.collect();
        let framed = |(spec, signal): (&SourceSpec, &Signal)| {
            check_signal(spec, signal, key)?;
            let source = match signal {
                Signal::Image(image) => SourceFrames::Picture(PictureTiles::new(image)),
                Signal::Series(series) => {
                    let views = SourceViews::new(spec, (series.rate_hz(), series.frames()), shape);
                    SourceFrames::Series(match seed {
                        Some(seed) => {
                            SeriesFrames::of_library(views, series, spec, Drawn { key, seed })
                        }
                        None => SeriesFrames::new(views, series),
                    })
                }
            };
            Ok((spec.id.clone(), source))
        };
        let sources = known.into_par_iter().map(framed).collect::<Result<_, RecogniseError>>()?;
        Ok(Self { key: key.clone(), sources })
    }

    /// Hash of how the sources of a scene are cut into frames and copied in a library of this
    /// shape: trials with the same hash can be compared.
    pub fn framing_key(scene: &Scene, shape: &LibraryShape, seed: u64) -> u64 {
        let views = scene.sources().map(|spec| {
            let of_shape = |s: crate::recognise::shape::SourceShape| (s.rate_hz, s.median_frames);
            shape
                .get(&spec.id)
                .map(|s| (&spec.id, spec.phase, SourceViews::new(spec, of_shape(s), shape)))
        });
        let views: Vec<_> = views.collect();
        crate::seed::stable_hash(&[format!("{views:?}").as_bytes(), &seed.to_le_bytes()])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recognise::shape::SourceShape;
    use crate::scene::Scene;

    fn views(id: &str, rate_hz: f64, median_frames: usize, at_hz: f64) -> [FrameView; 2] {
        let scene = Scene::lmt108();
        let spec = scene.get(id).unwrap();
        let shape = SourceShape { rate_hz, channels: spec.channels, median_frames };
        let shape = LibraryShape::from_iter([(spec.id.clone(), shape)]);
        SourceViews::new(spec, (at_hz, 100), &shape).0
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
    }

    #[test]
    fn fixed_point_is_finer_than_a_hundredth() {
        let values = [-32.236, 0.001, 7.5, 88.7];
        let (packed, mut out) = (PackedFrames::new(&values), Vec::new());
        packed.unpack(2, 0..2, &mut out);
        for (a, b) in values.iter().zip(&out).take(3) {
            assert!((a - b).abs() <= 0.5 / STEPS);
        }
        assert!(out[3] > 63.9, "beyond any sound, and held there");
        let bytes = postcard::to_allocvec(&packed).unwrap();
        assert_eq!(postcard::from_bytes::<PackedFrames>(&bytes).unwrap(), packed);
    }
}
