//! Types for following a scan in progress: the best guess so far, and whether it is settled.
//!
//! The guess is renewed at fixed steps of scan time, called looks. Scan time is counted in samples,
//! not read from a clock. The answer therefore depends neither on the block size in which samples
//! arrive nor on the playback speed.

use super::decide::conformal::Rejection;
use crate::scene::SourceId;

/// The next frames of one source of a scan.
#[derive(Clone, Copy, Debug)]
pub struct FreshFrames<'a> {
    pub source: &'a SourceId,
    pub rate_hz: f64,
    pub channels: usize,
    /// Interleaved samples that directly follow those given before.
    pub samples: &'a [f32],
}

#[derive(Clone, Debug, PartialEq)]
pub struct FollowOptions {
    /// Accepted loss of accuracy, as a fraction of all scans, when a scan is answered once its guess
    /// is settled instead of at its end.
    pub loss: f64,
    /// Threshold at which a scan is called unknown. An unknown scan is never settled.
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
    pub p_value: Option<f64>,
    /// The settled answer, if any: its surface, and the scan time at which it was settled.
    pub settled: Option<(String, f64)>,
}
