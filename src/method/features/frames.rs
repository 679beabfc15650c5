//! A trial prepared for the method `embedding`. Each series has log-band frames in two views (`views`) and
//! moments; each picture has tiles. Each series of a library trial also has augmented copies.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::copies::{self, Copy, copies};
use super::growing::{Growing, Piece};
use super::packed::PackedFrames;
use super::sources::{SourceError, of_known_sources};
use super::tiles::PictureTiles;
use super::views::SourceViews;
use crate::library::shape::{LibraryShape, SourceShape};
use crate::scene::{Phase, Scene, SourceId, SourceSpec};
use crate::trial::{Fingerprints, Series, SeriesFlaws, Signal, Trial, TrialKey};

/// Scan time from one look (renewal of the guess) to the next, in seconds.
pub const LOOK_S: f64 = 0.1;

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SeriesFrames {
    pub views: SourceViews,
    /// Length of the series in samples a channel.
    pub samples: usize,
    /// For each channel, the largest share of the samples that rests at one value; none for a query.
    pub rests: Vec<f32>,
    pub whole: Piece,
    /// Augmented copies of the series; a query has none.
    pub copies: Vec<Piece>,
    /// Beginnings of the series, one for each [`LOOK_S`]; only for drags of a library's followed trials. A
    /// beginning lacks its complete frames, since they are the first frames of the whole series.
    pub looks: Vec<Piece>,
}

impl SeriesFrames {
    pub fn new(views: SourceViews, series: &Series) -> Self {
        let whole = Piece::new(&views, series.samples());
        let (rests, copies, looks) = (Vec::new(), Vec::new(), Vec::new());
        Self { whole, samples: series.frames(), rests, views, copies, looks }
    }

    /// Cuts a recording of a library, and the given copies of it, into frames. The trial's digest and the
    /// seed determine their noise.
    fn of_library(
        views: SourceViews,
        series: &Series,
        spec: &SourceSpec,
        (copies, digest, seed): (&[Copy], u64, u64),
        is_followed: bool,
    ) -> Self {
        let (channels, samples) = (series.channels(), series.samples());
        let source = (digest, seed, spec.id.as_str());
        let deviations = match copies {
            [] => Vec::new(),
            _ => copies::deviations(channels, samples),
        };
        let copy =
            |copy: &Copy| Piece::new(&views, &copies::samples(copy, source, &deviations, samples));
        let copies = copies.iter().map(copy).collect();
        let (mut growing, mut taken, mut looks) = (Growing::new(&views), 0, Vec::new());
        let mut frames: [PackedFrames; 2] = Default::default();
        let mut grow = |growing: &mut Growing, end: usize| {
            let fresh = growing.add(&samples[taken * channels..end * channels]);
            frames.iter_mut().zip(&fresh).for_each(|(frames, fresh)| frames.extend(fresh));
            taken = end;
        };
        if spec.phase == Phase::Drag && is_followed {
            let end = |look: usize| samples_by(look as f64 * LOOK_S, series.rate_hz());
            for end in (1..).map(end).take_while(|end| *end <= series.frames()) {
                grow(&mut growing, end);
                looks.push(growing.end());
            }
        }
        grow(&mut growing, series.frames());
        let whole = growing.ended(frames);
        let rests = SeriesFlaws::of(series).rests();
        Self { whole, samples: series.frames(), rests, views, copies, looks }
    }

    pub fn rate_hz(&self) -> f64 {
        self.views.frames[0].rate_hz
    }

    pub fn duration_s(&self) -> f64 {
        self.samples as f64 / self.rate_hz()
    }
}

/// Number of samples a channel within the first `seconds` seconds.
pub(crate) fn samples_by(seconds: f64, rate_hz: f64) -> usize {
    (seconds * rate_hz - 1e-6).ceil().max(0.0) as usize
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum SourceFrames {
    Series(Box<SeriesFrames>),
    Picture(PictureTiles),
}

impl SourceFrames {
    pub fn series(&self) -> Option<&SeriesFrames> {
        if let Self::Series(series) = self { Some(series) } else { None }
    }
}

/// About as many trials of a library are followed from look to look. They are enough to show that early
/// answers lose at most 1 %: if none of 200 is lost, the upper 90 % bound is 0.7 %.
pub(crate) const FOLLOWED: usize = 200;

/// Windows that tell of a series whether it shares samples with another.
const MOST_WINDOWS: usize = 64;

/// Hash of a signal, and sorted hashes of windows; none of those that can be equal by chance.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Prints(pub Option<u64>, pub Vec<u64>);

impl Prints {
    fn of(signal: &Signal) -> Self {
        let Fingerprints { whole, windows } = Fingerprints::of(signal, MOST_WINDOWS);
        let windows = windows.into_iter().filter(|_| whole.is_some());
        Self(whole, windows.map(|(hash, _)| hash).collect())
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct TrialFrames {
    pub key: TrialKey,
    /// Hash of the samples, whatever the trial is called. It orders a library's trials; 0 for a query.
    pub digest: u64,
    /// Whether the trial is followed, so that its series have looks; a query is not.
    pub is_followed: bool,
    /// The copies of the trial, in the order of `SeriesFrames::copies`; a query has none.
    pub copies: Vec<Copy>,
    /// For each source, what tells whether it shares samples with another trial of the library; a query has
    /// none.
    pub prints: BTreeMap<SourceId, Prints>,
    /// The sources of the trial that the scene describes.
    pub sources: BTreeMap<SourceId, SourceFrames>,
}

impl TrialFrames {
    pub(crate) fn forget_copies(&mut self) {
        for source in self.sources.values_mut() {
            if let SourceFrames::Series(series) = source {
                series.copies = Vec::new();
            }
        }
    }

    /// Cuts the sources of a trial that the scene describes into frames, as in a library of this
    /// shape. For a trial of the library, `seed` determines the copies; for a query, it is `None`.
    ///
    /// # Errors
    /// If a source has another kind or another number of channels than the scene says.
    pub fn new(
        key: &TrialKey,
        trial: &Trial,
        scene: &Scene,
        shape: &LibraryShape,
        seed: Option<u64>,
    ) -> Result<Self, SourceError> {
        // Only copies and the order of a library need it.
        let digest = seed.map_or(0, |_| digest(trial));
        let copies = seed.map_or_else(Vec::new, |seed| copies(digest, seed, shape));
        // Those of the smallest digests are, so that names do not matter.
        let followed_up_to = shape.share(FOLLOWED) * u64::MAX as f64;
        let is_followed = seed.is_some() && digest as f64 <= followed_up_to;
        let prints = match seed {
            Some(_) => of_known_sources(key, trial, scene, |_, signal| Prints::of(signal))?,
            None => BTreeMap::new(),
        };
        let sources = of_known_sources(key, trial, scene, |spec, signal| match signal {
            Signal::Image(image) => SourceFrames::Picture(PictureTiles::new(image)),
            Signal::Series(series) => {
                let views = SourceViews::new(spec, (series.rate_hz(), series.frames()), shape);
                SourceFrames::Series(Box::new(match seed {
                    Some(seed) => {
                        let copies = (&copies[..], digest, seed);
                        SeriesFrames::of_library(views, series, spec, copies, is_followed)
                    }
                    None => SeriesFrames::new(views, series),
                }))
            }
        })?;
        Ok(Self { key: key.clone(), digest, is_followed, copies, prints, sources })
    }

    /// Hash of how the sources of a scene are cut into frames and copied in a library of this shape.
    /// Trials with the same hash can be compared.
    pub fn framing_key(scene: &Scene, shape: &LibraryShape, seed: u64) -> u64 {
        let view = |spec: &SourceSpec| {
            let SourceShape { rate_hz, median_frames, .. } = shape.get(&spec.id)?;
            let views = SourceViews::new(spec, (rate_hz, median_frames), shape);
            Some((spec.id.clone(), spec.phase, views))
        };
        let views: Vec<_> = scene.sources().map(view).collect();
        let text = format!("{views:?} {:?} {}", copies::count(shape), shape.share(FOLLOWED));
        crate::seed::stable_hash(&[text.as_bytes(), &seed.to_le_bytes()])
    }
}

/// Hash of the sources of a trial and their samples, the same on every machine.
fn digest(trial: &Trial) -> u64 {
    let of_source = |(id, signal): (&SourceId, &Signal)| {
        let mut sum = crc32fast::Hasher::new();
        match signal {
            Signal::Image(image) => sum.update(image.rgb()),
            Signal::Series(series) => {
                for samples in series.samples().chunks(1024) {
                    sum.update(
                        samples.iter().map(|x| x.to_le_bytes()).collect::<Vec<_>>().as_flattened(),
                    );
                }
            }
        }
        let (sum, frames) = (sum.finalize(), signal.frames() as u64);
        [id.as_str().as_bytes(), &sum.to_le_bytes(), &frames.to_le_bytes()].concat()
    };
    crate::seed::stable_hash(&[&trial.signals.iter().flat_map(of_source).collect::<Vec<u8>>()])
}
