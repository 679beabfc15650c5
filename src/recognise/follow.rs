//! Following a scan in progress: what it looks like so far, and whether that will change.
//!
//! Scan time comes from the samples, never from a clock, and looks are taken at whole steps of it,
//! so that neither the size of the pieces in which samples come nor the speed at which they are
//! played changes what is said.

use super::decide::conformal::Rejection;
use crate::scene::SourceId;

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
    /// The threshold for no surface of the library; an answer beyond it is never settled.
    pub rejection: Option<Rejection>,
}

impl Default for FollowOptions {
    fn default() -> Self {
        Self { loss: 0.01, rejection: None }
    }
}

/// The guess at a scan in progress.
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
