//! Makes scans out of streams: empties the rings and cuts out sources between their marks.
//!
//! A mark says where a scan or one of its sources begins or ends; a replayed recording sets marks
//! itself, for live devices a detector does. A [`Session`] runs devices and one collector, each on
//! its own thread, and sends [`Event`]s. A [`Scan`] holds only data from the rings; its true label
//! is kept separately.

pub(crate) mod clock;
mod collect;
pub mod detect;
mod event_queue;
mod group;
mod marked_scan;
mod options;
mod progress;
mod scan_detector;
mod session;
mod stream;
mod timeline;

pub use options::{CutFrom, Detection, Options, ScanCommand};
pub use progress::{Fresh, Progress, Trace};
pub(crate) use session::StreamMeter;
pub use session::{Session, SessionError};

use std::collections::BTreeMap;
use std::time::Instant;

use crate::device::DeviceState;
use crate::ring::Counts;
use crate::scene::{Phase, SourceId};
use crate::trial::{Trial, TrialKey};

/// One interaction, as it came out of the rings.
#[derive(Clone, Debug)]
pub struct Scan {
    /// Number of the scan in its session, counted from 1.
    pub number: u32,
    /// The data. Its key is neutral: no surface, no user, and the number of the scan.
    pub trial: Trial,
    /// The true label, where a recording has it: for reports, not for recognition.
    pub truth: Option<TrialKey>,
    /// Whether a generator made the data.
    pub synthetic: bool,
    /// Duration in seconds of the longest source of the drag, or, if there was no drag, of all.
    pub scan_s: f64,
    /// Frames (and pictures) lost within the scan, over all sources.
    pub lost_samples: u64,
    /// Frames (or pictures) lost of each source.
    pub lost_by_source: BTreeMap<SourceId, u64>,
    /// Reasons why the scan should not be trusted, a line each; empty if there are none. A gap of
    /// at most 1 ms is filled by repeating the frame before it, and is no such reason.
    pub spoiled: Vec<String>,
    /// The time of its last sample.
    pub ended_at: Instant,
}

impl Scan {
    /// A scan of these signals, nothing lost, that has just ended; its duration is left at 0.
    pub fn of_signals(number: u32, signals: BTreeMap<SourceId, crate::trial::Signal>) -> Self {
        Self {
            number,
            trial: Trial { key: TrialKey::new("", "", number), signals },
            truth: None,
            synthetic: false,
            scan_s: 0.0,
            lost_samples: 0,
            lost_by_source: BTreeMap::new(),
            spoiled: Vec::new(),
            ended_at: Instant::now(),
        }
    }
}

/// Events of a session.
#[derive(Debug)]
pub enum Event {
    /// A scan is complete.
    Scan(Box<Scan>),
    /// A scan has reached a part, such as the drag, or has ended; its data may still be under way.
    Phase {
        /// number of the scan
        scan: u32,
        /// the part; `None` when it is over
        phase: Option<Phase>,
    },
    /// New data of the scan in progress.
    Progress(Progress),
    /// New data of the streams, during scans and between them.
    Trace(Trace),
    /// A device has changed its state.
    Device {
        /// its name
        device: String,
        /// its new state
        state: DeviceState,
        /// the reason, and what to do
        detail: String,
    },
    /// A warning: something was lost, damaged or not understood, and work continues.
    Warning(String),
    /// All devices have ended and all that they sent was processed; the last event.
    Finished(Totals),
}

/// Totals over a session.
#[derive(Clone, Debug, Default)]
pub struct Totals {
    /// Scans that were sent.
    pub scans: u32,
    /// Counts of each stream.
    pub streams: BTreeMap<SourceId, Counts>,
    /// Devices that failed or panicked, and why.
    pub failed: Vec<(String, String)>,
    /// Devices that did not stop in time and were abandoned.
    pub abandoned: Vec<String>,
    /// Warnings that were sent.
    pub warnings: u32,
    /// Snapshots (progress, traces) not sent to a busy reader; the next one held their data.
    pub late_snapshots: u64,
    /// Other events that were dropped because their reader did not keep up or was gone.
    pub dropped_events: u64,
}

impl Totals {
    /// Frames lost over all streams, within scans or between them.
    pub fn lost(&self) -> u64 {
        self.streams.values().map(|counts| counts.lost).sum()
    }
}
