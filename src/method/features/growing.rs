//! A series as it grows: cut into frames and summed, in pieces of any size. Whole recordings, copies,
//! beginnings and scans in progress all go this way, so that they cannot differ.

use serde::{Deserialize, Serialize};

use super::moments::{GrowingMoments, Moments, joined};
use super::packed::PackedFrames;
use super::passed::{self, Passed};
use super::places::GrowingPlaces;
use super::views::SourceViews;

/// The frames and moments of a whole series, of a copy, or of a beginning. A series shorter than a frame
/// of a view has one zero-padded frame of that view.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Piece {
    pub frames: [PackedFrames; 2],
    pub moments: Moments,
    /// The mean of each place that was reached, shape (places, channels); see [`super::places`].
    pub places: Vec<f32>,
}

impl Piece {
    pub(super) fn new(views: &SourceViews, samples: &[f32]) -> Self {
        let mut growing = Growing::new(views);
        let frames = growing.add(samples);
        growing.ended(frames)
    }
}

#[derive(Clone, Debug)]
pub(crate) struct Growing {
    views: SourceViews,
    /// For each view, the samples that later frames need; all samples, until one frame is complete.
    pending: [Vec<f32>; 2],
    /// For each view, whether a frame is complete.
    begun: [bool; 2],
    moments: GrowingMoments,
    /// The series that moments are taken from, where it is limited to the band.
    passed: Option<Passed>,
    places: Option<GrowingPlaces>,
}

impl Growing {
    pub(crate) fn new(views: &SourceViews) -> Self {
        Self {
            pending: Default::default(),
            begun: [false; 2],
            moments: GrowingMoments::new(views.channels(), views.block()),
            passed: views.passed.then(|| Passed::new(&views.frames[0])),
            places: views.places.map(GrowingPlaces::new),
            views: views.clone(),
        }
    }

    /// Adds interleaved samples. Gives the frames of each view that they complete.
    pub(crate) fn add(&mut self, samples: &[f32]) -> [PackedFrames; 2] {
        if self.passed.is_none() {
            self.moments.extend(samples);
        }
        if let Some(places) = &mut self.places {
            places.extend(samples, self.views.channels());
        }
        std::array::from_fn(|number| {
            let (view, pending) = (&self.views.frames[number], &mut self.pending[number]);
            let all = joined(pending, samples);
            let fresh = match &mut self.passed {
                Some(passed) if number == 0 => {
                    let (fresh, parts) = view.whole_frames_and_passed(&all);
                    self.moments.extend(&passed.add(&parts));
                    fresh
                }
                _ => view.whole_frames(&all),
            };
            self.begun[number] |= !fresh.is_empty();
            let done = view.hop() * view.channels * (fresh.len() / view.width());
            *pending = all[done..].to_vec();
            PackedFrames::new(&fresh)
        })
    }

    /// The whole series if it ends here; `frames` are those that were completed.
    pub(super) fn ended(&self, mut frames: [PackedFrames; 2]) -> Piece {
        let Piece { frames: padded, moments, places } = self.end();
        frames.iter_mut().zip(&padded).for_each(|(frames, padded)| frames.extend(padded));
        Piece { frames, moments, places }
    }

    /// The padded frames and the moments of a series that ends here, without its complete frames.
    pub(crate) fn end(&self) -> Piece {
        let padded = |number: usize| match self.begun[number] {
            true => PackedFrames::default(),
            false => PackedFrames::new(&self.views.frames[number].frames(&self.pending[number])),
        };
        let mut moments = self.moments.clone();
        if let Some(passed) = &self.passed {
            moments.extend(&match self.begun[0] {
                true => passed.edge(),
                false => passed::short(&self.views.frames[0], &self.pending[0]),
            });
        }
        let places = self.places.as_ref().map(GrowingPlaces::means).unwrap_or_default();
        Piece { frames: [0, 1].map(padded), moments: moments.ended(), places }
    }
}
