//! One recorded interaction with one surface, with all its sources as they came from the sensors.

mod channel_flaws;
mod doubt;
mod fingerprints;
mod label;
mod level;
mod moment;

pub(crate) use channel_flaws::STEADY;
pub use channel_flaws::SeriesFlaws;
pub use doubt::Doubt;
pub(crate) use fingerprints::{Fingerprints, WINDOW, tells};
pub(crate) use level::{level_of, power};
#[doc(hidden)]
pub use {
    channel_flaws::{flaws_of, is_plain, usual_rests},
    doubt::lines,
    label::{checked_label, checked_session, normal},
    level::channel_levels_db,
    moment::{unix_ms, utc},
};

use std::collections::{BTreeMap, BTreeSet};

use image::RgbImage;
use image::imageops::rotate90;
use ndarray::{ArrayView2, ArrayViewMut2};
use serde::{Deserialize, Serialize};

use crate::scene::SourceId;
use crate::seed;

#[derive(Clone, Debug, PartialEq)]
pub struct Trial {
    pub key: TrialKey,
    /// The recorded signals. Some may be missing, since a comparison uses only those of both trials.
    pub signals: BTreeMap<SourceId, Signal>,
}

impl Trial {
    /// A trial of a single source, which is a series.
    pub fn of_series(key: TrialKey, source: SourceId, series: Series) -> Self {
        Self { key, signals: BTreeMap::from([(source, Signal::Series(series))]) }
    }

    /// This trial, with every series of a source that `is_drag` chooses cut to its first `seconds`. A tap is
    /// a transient and stays whole.
    pub fn first_seconds(mut self, seconds: f64, is_drag: impl Fn(&SourceId) -> bool) -> Self {
        for (id, signal) in &mut self.signals {
            if let (Signal::Series(series), true) = (signal, is_drag(id)) {
                let frames = (seconds * series.rate_hz()).round() as usize;
                *series = series.crop(0, frames);
            }
        }
        self
    }

    /// Length in seconds of the longest series among the sources that `of` chooses; `None` without any.
    pub fn longest_s(&self, of: impl Fn(&SourceId) -> bool) -> Option<f64> {
        let lengths = self.signals.iter().filter_map(|(id, signal)| match signal {
            Signal::Series(series) if of(id) => Some(series.duration_s()),
            _ => None,
        });
        lengths.max_by(f64::total_cmp)
    }
}

/// The user of a trial if the recording names no user.
pub const EXPERT: &str = "expert";

/// The surface of a trial if its label is unknown.
pub const UNLABELLED: &str = "unlabelled";

/// Names one trial. Keys are ordered, and ties of rankings broken, by surface, user, number and session.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct TrialKey {
    pub surface: String,
    /// The person who moved the stylus; [`EXPERT`] unless the recording says otherwise.
    pub user: String,
    /// Number of the repetition, counted from 1.
    pub number: u32,
    /// The sitting in which the trial was recorded: the same person, sensor, place and day. `None` if
    /// the recording names no session.
    pub session: Option<String>,
}

impl TrialKey {
    pub fn new(surface: impl Into<String>, user: impl Into<String>, number: u32) -> Self {
        Self { surface: surface.into(), user: user.into(), number, session: None }
    }

    pub fn with_session(self, session: Option<String>) -> Self {
        Self { session, ..self }
    }

    /// The trial's session: two people never share one.
    pub(crate) fn of_session(&self) -> (&str, Option<&str>) {
        (&self.user, self.session.as_deref())
    }

    /// The surface; `None` if it is [`UNLABELLED`].
    pub fn label(&self) -> Option<&str> {
        (self.surface != UNLABELLED).then_some(self.surface.as_str())
    }
}

/// Whether sessions tell more than trials: at least two surfaces have trials in at least two sessions
/// each, and some session has several trials. If not, the data count as one session.
pub(crate) fn sessions_count<'k>(keys: impl Iterator<Item = &'k TrialKey>) -> bool {
    let mut of_surface: BTreeMap<&str, BTreeSet<_>> = BTreeMap::new();
    let mut trials: BTreeMap<_, usize> = BTreeMap::new();
    for key in keys.filter(|key| key.session.is_some()) {
        of_surface.entry(&key.surface).or_default().insert(key.of_session());
        *trials.entry(key.of_session()).or_default() += 1;
    }
    of_surface.values().filter(|sessions| sessions.len() > 1).count() > 1
        && trials.values().any(|&count| count > 1)
}

impl std::fmt::Display for TrialKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} · {} · trial {}", self.surface, self.user, self.number)?;
        self.session.iter().try_for_each(|session| write!(f, " · session {session}"))
    }
}

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum SignalError {
    #[error("it holds no samples; record again, or remove the file")]
    Empty,
    #[error("{len} values do not divide into {channels} channels")]
    Ragged { len: usize, channels: usize },
    #[error("a sample rate of {0} Hz is not possible; expected a positive number")]
    Rate(f64),
    /// Channel and frame are counted from 1.
    #[error(
        "channel {channel} is {value} at sample {frame}; expected finite numbers \
         (a broken cable gives such values: check the connector)"
    )]
    NotFinite { channel: usize, frame: usize, value: f32 },
    #[error(
        "the image is {width}×{height} pixels; expected 320 wide and 480 high, or that turned by 90°"
    )]
    ImageSize { width: usize, height: usize },
}

#[derive(Clone, Debug, PartialEq)]
pub enum Signal {
    Series(Series),
    Image(Image),
}

impl Signal {
    /// Number of frames of a series; 0 for an image.
    pub fn frames(&self) -> usize {
        match self {
            Self::Image(_) => 0,
            Self::Series(series) => series.frames(),
        }
    }

    /// A hash of the raw data, the same on every machine.
    pub fn content_hash(&self) -> u64 {
        match self {
            Self::Image(image) => seed::stable_hash(&[image.rgb()]),
            Self::Series(series) => {
                let bytes = series.samples().iter().flat_map(|x| x.to_le_bytes());
                seed::stable_hash(&[&bytes.collect::<Vec<u8>>()])
            }
        }
    }
}

/// Samples in time, shape (frames, channels), all finite, at least one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    rate_hz: f64,
    channels: usize,
    /// All samples, interleaved frame by frame.
    samples: Vec<f32>,
}

impl Series {
    /// Most samples of one source of a trial, all channels together (six minutes of sound). A
    /// comparison takes about 100 bytes of memory for each sample.
    pub const MOST_SAMPLES: usize = 1 << 24;

    /// A series from interleaved samples.
    ///
    /// # Errors
    /// If there are no samples, if they do not fill whole frames, if one is not finite, or if the
    /// rate is not positive.
    pub fn new(rate_hz: f64, channels: usize, samples: Vec<f32>) -> Result<Self, SignalError> {
        if !(rate_hz.is_finite() && rate_hz > 0.0) {
            return Err(SignalError::Rate(rate_hz));
        }
        if samples.is_empty() || channels == 0 {
            return Err(SignalError::Empty);
        }
        if !samples.len().is_multiple_of(channels) {
            return Err(SignalError::Ragged { len: samples.len(), channels });
        }
        // Almost always all are finite, and a fold looks at several of them together.
        if !samples.iter().fold(true, |all, x| all & x.is_finite())
            && let Some(at) = samples.iter().position(|x| !x.is_finite())
        {
            let (frame, channel) = (at / channels + 1, at % channels + 1);
            return Err(SignalError::NotFinite { channel, frame, value: samples[at] });
        }
        Ok(Self { rate_hz, channels, samples })
    }

    pub fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    pub fn channels(&self) -> usize {
        self.channels
    }

    pub fn frames(&self) -> usize {
        self.samples.len() / self.channels
    }

    pub fn duration_s(&self) -> f64 {
        self.frames() as f64 / self.rate_hz
    }

    pub fn is_constant(&self) -> bool {
        self.samples.chunks(self.channels).all(|frame| *frame == self.samples[..self.channels])
    }

    pub fn samples(&self) -> &[f32] {
        &self.samples
    }

    /// The samples as an array of shape (frames, channels).
    pub fn view(&self) -> ArrayView2<'_, f32> {
        // The constructor checked that the samples fill whole frames.
        ArrayView2::from_shape((self.frames(), self.channels), &self.samples)
            .expect("samples fill whole frames")
    }

    pub fn view_mut(&mut self) -> ArrayViewMut2<'_, f32> {
        let shape = (self.frames(), self.channels);
        // The constructor checked that the samples fill whole frames.
        ArrayViewMut2::from_shape(shape, &mut self.samples).expect("samples fill whole frames")
    }

    /// One channel, in f64.
    pub fn channel(&self, channel: usize) -> impl ExactSizeIterator<Item = f64> + Clone + '_ {
        self.samples[channel..].iter().step_by(self.channels).map(|&x| f64::from(x))
    }

    /// A copy of frames `start..end`, both clamped to the series; at least one frame stays.
    pub fn crop(&self, start: usize, end: usize) -> Self {
        let start = start.min(self.frames() - 1);
        let end = end.clamp(start + 1, self.frames());
        let samples = self.samples[start * self.channels..end * self.channels].to_vec();
        Self { samples, ..*self }
    }
}

/// A picture of [`Image::ROWS`] × [`Image::COLS`] pixels, 8-bit RGB, upright.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    rgb: Vec<u8>,
}

impl Image {
    pub const ROWS: usize = 480;
    pub const COLS: usize = 320;

    /// An image from RGB bytes, row by row. A picture that lies on its side (480 wide, 320 high) is
    /// turned upright, by 90° clockwise.
    ///
    /// # Errors
    /// If the picture has any other size.
    pub fn new(width: usize, height: usize, rgb: Vec<u8>) -> Result<Self, SignalError> {
        if rgb.len() != width * height * 3 {
            return Err(SignalError::Ragged { len: rgb.len(), channels: 3 });
        }
        match (width, height) {
            (Self::COLS, Self::ROWS) => Ok(Self { rgb }),
            (Self::ROWS, Self::COLS) => {
                let lying = RgbImage::from_raw(Self::ROWS as u32, Self::COLS as u32, rgb);
                // The length of `rgb` was checked above.
                let lying = lying.expect("three bytes a pixel");
                Ok(Self { rgb: rotate90(&lying).into_raw() })
            }
            _ => Err(SignalError::ImageSize { width, height }),
        }
    }

    pub fn pixel(&self, row: usize, col: usize) -> [u8; 3] {
        let at = (row * Self::COLS + col) * 3;
        [self.rgb[at], self.rgb[at + 1], self.rgb[at + 2]]
    }

    /// All pixels, row by row, three bytes each.
    pub fn rgb(&self) -> &[u8] {
        &self.rgb
    }
}
