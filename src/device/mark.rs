//! Marks: where in the streams a scan and each of its sources begin and end.
//!
//! A recording carries its marks; live, a detector or a command sets them. They travel beside the
//! rings and name frames by their index in a stream, so it does not matter which arrives first.
//! The order of the marks of a scan is: begin, then open and close for each source, then end.

use std::time::Instant;

use crate::scene::{Phase, SourceId};
use crate::trial::TrialKey;

/// One mark.
#[derive(Clone, Debug, PartialEq)]
pub enum Mark {
    /// A scan begins.
    Begin(Begin),
    /// A source of the scan begins.
    Open(Open),
    /// A source of the scan has ended.
    Close {
        /// the source
        source: SourceId,
        /// index of the first frame after it
        end: u64,
    },
    /// The scan continues, but should not be trusted.
    Spoil {
        /// for people
        why: String,
    },
    /// This is no scan; forget it.
    GiveUp {
        /// for people
        why: String,
    },
    /// The scan has ended; its sources that are still open end with what was pushed so far.
    End {
        /// when its last sample was taken
        at: Instant,
    },
}

/// The begin of a scan.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Begin {
    /// What the scan really is, where that is known: reported beside the answer, never used for it.
    pub truth: Option<TrialKey>,
    /// Made by a generator, not measured.
    pub synthetic: bool,
}

/// The begin of a source.
#[derive(Clone, Debug, PartialEq)]
pub struct Open {
    /// The source: one stream may serve several, such as the sound of a tap and of a drag.
    pub source: SourceId,
    /// The stream that it is cut from.
    pub stream: SourceId,
    /// Index of its first frame, or of its picture.
    pub start: u64,
    /// The part of the scan that it belongs to.
    pub phase: Phase,
    /// Frames a second; of no meaning for pictures.
    pub rate_hz: f64,
    /// How many of the stream's channels are the source's: the first ones.
    pub channels: usize,
}
