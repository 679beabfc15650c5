//! Types for following a scan in progress: the best guess so far, and whether it is settled.
//!
//! The guess is renewed at fixed steps of scan time, called looks. Scan time is counted in samples,
//! never read from a clock, so neither the block size in which samples arrive nor the playback
//! speed changes the answer.

use super::decide::conformal::Rejection;
use crate::scene::SourceId;

/// Scan time between two looks (renewals of the guess), in seconds.
pub const LOOK_S: f64 = 0.1;

/// The next frames of one source of a scan.
#[derive(Clone, Copy, Debug)]
pub struct FreshFrames<'a> {
    /// The source.
    pub source: &'a SourceId,
    /// Frames a second.
    pub rate_hz: f64,
    /// Samples in a frame, one a channel.
    pub channels: usize,
    /// Interleaved samples, following on from those given before.
    pub samples: &'a [f32],
}

/// How scans are followed.
#[derive(Clone, Debug, PartialEq)]
pub struct FollowOptions {
    /// How much accuracy may be lost by answering as soon as the guess is settled instead of at the
    /// end of the scan: a fraction of all scans.
    pub loss: f64,
    /// Threshold at which a scan is called unknown; such a guess is never settled.
    pub rejection: Option<Rejection>,
}

impl Default for FollowOptions {
    fn default() -> Self {
        Self { loss: 0.01, rejection: None }
    }
}

/// The best guess at the surface of a scan in progress.
#[derive(Clone, Debug, PartialEq)]
pub struct GuessSoFar {
    /// Scan time at which the guess was made, in seconds.
    pub scan_s: f64,
    /// Up to five surfaces with their probabilities, the most probable first.
    pub named: Vec<(String, f64)>,
    /// As [`super::Ranking::p_value`].
    pub p_value: Option<f64>,
    /// The settled answer, if any: its surface, and the scan time at which it was settled.
    pub settled: Option<(String, f64)>,
}
