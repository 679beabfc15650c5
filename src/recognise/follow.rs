//! Following a scan in progress: what it looks like so far, and whether that will change.
//!
//! Scan time comes from the samples, never from a clock, and looks are taken at whole steps of it,
//! so that neither the size of the pieces in which samples come nor the speed at which they are
//! played changes what is said.

use super::decide::conformal::Rejection;
use super::decide::settle::Settling;
use super::error::RecogniseError;
use super::rank::Ranking;
use crate::scene::SourceId;
use crate::trial::{Flaw, Image, Trial};

/// Scan time between two looks, in seconds.
pub const LOOK_S: f64 = 0.1;

/// The next frames of one source of a scan.
#[derive(Clone, Copy, Debug)]
pub struct FreshFrames<'a> {
    /// The source.
    pub source: &'a SourceId,
    /// Frames a second.
    pub rate_hz: f64,
    /// Samples a frame.
    pub channels: usize,
    /// Interleaved samples, those after the ones that were given before.
    pub samples: &'a [f32],
}

/// How scans are followed.
#[derive(Clone, Debug, PartialEq)]
pub struct FollowOptions {
    /// Accuracy that answers may lose, when given as soon as they are settled, against the whole
    /// scan: a fraction of all scans.
    pub loss: f64,
    /// What counts as no surface of the library; an answer that does is never settled.
    pub rejection: Option<Rejection>,
}

impl Default for FollowOptions {
    fn default() -> Self {
        Self { loss: 0.01, rejection: None }
    }
}

/// What a scan looks like so far.
#[derive(Clone, Debug, PartialEq)]
pub struct GuessSoFar {
    /// Scan time of the look, in seconds.
    pub scan_s: f64,
    /// The most probable surfaces and their probabilities, at most five, the first one first.
    pub named: Vec<(String, f64)>,
    /// As [`super::Ranking::p_value`].
    pub p_value: Option<f64>,
    /// Since when the answer is settled, if it is: the surface, and the scan time of that look.
    pub settled: Option<(String, f64)>,
}

/// Follows one scan after the other.
pub trait Follow: Send {
    /// Forgets the scan so far: another one begins.
    fn begin(&mut self);

    /// Takes the next frames of a source. Sources that the scene does not know are passed over,
    /// and so are those with samples that are not numbers, until the next scan begins.
    ///
    /// # Errors
    /// If the frames do not fit the scene or those before them.
    fn add(&mut self, fresh: FreshFrames<'_>) -> Result<(), RecogniseError>;

    /// Takes a picture.
    ///
    /// # Errors
    /// If the source is not of pictures.
    fn add_picture(&mut self, source: &SourceId, picture: &Image) -> Result<(), RecogniseError>;

    /// Looks at the scan at each whole step of [`LOOK_S`] up to `scan_s` seconds of drag that was
    /// not yet looked at, as far as the frames of that time have come. Gives the last of these
    /// looks, or nothing where none was due or nothing can be said yet.
    ///
    /// # Errors
    /// If what came cannot be compared with the library.
    fn look(&mut self, scan_s: f64) -> Result<Option<GuessSoFar>, RecogniseError>;

    /// The ranking of a scan that has ended and is `trial`, as [`super::Model::rank`] would give it
    /// without its flawed sources ([`super::without_flawed`]): only what was not followed yet is
    /// worked on. `None` where what was followed is not a beginning of the trial, or the trial
    /// cannot be named.
    fn finish(&mut self, trial: &Trial) -> Option<Ranking>;

    /// The flaws of a source in the scan so far ([`crate::trial::flaws`]); of the whole scan, once
    /// it is finished. `None` where the source was not followed.
    fn flaws(&self, source: &SourceId) -> Option<Vec<Flaw>>;

    /// When answers count as settled, and how that was found.
    fn settling(&self) -> &Settling;
}
