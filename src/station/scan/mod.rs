//! Makes scans out of streams, by emptying the rings and cutting out sources between their marks.
//!
//! A mark says where a scan or one of its sources begins or ends. A replayed recording sets marks
//! itself; for live devices, a detector sets them. A [`Session`] runs devices and one collector,
//! each on its own thread, and sends [`Event`]s. A [`Scan`] holds the data from the rings; its true
//! label is kept apart from these.

pub(crate) mod clock;
mod collect;
pub mod detect;
mod device_group;
mod event_queue;
mod marked_scan;
mod recent_frames;
mod scan_detector;
mod session;

pub use crate::device::CutFrom;
pub use marked_scan::{Fresh, Progress, Trace};
#[doc(hidden)]
pub use session::StreamMeter;
pub use session::{Session, SessionError};

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crate::device::{DeviceState, Warning};
use crate::ring::Counts;
use crate::scene::{Phase, SourceId};
use crate::trial::{Doubt, Trial, TrialKey};
use detect::{DetectorConfig, SensorKind};

/// The data of one interaction, as they came out of the rings.
#[derive(Clone, Debug)]
pub struct Scan {
    /// Number of the scan in its session, counted from 1.
    pub number: u32,
    /// The data. Their key holds no surface and no user, only the number of the scan.
    pub trial: Trial,
    /// The true label, if a recording has one. Reports use this label; recognition never does.
    pub truth: Option<TrialKey>,
    pub synthetic: bool,
    /// Duration in seconds of the longest source of the drag; without a drag, of the longest source.
    pub scan_s: f64,
    /// Frames (and pictures) lost within the scan, over all sources.
    pub lost_samples: u64,
    /// Why the scan should not be trusted; empty if nothing spoils it. A gap of at most 1 ms does
    /// not, since the frame before the gap is repeated to fill it.
    pub spoiled: Vec<Doubt>,
    /// For each series, the level of each channel just before the scan, in dB, as for a drag;
    /// nothing if it was not at rest, or if a recording sets the begin of its scans.
    pub rest: BTreeMap<SourceId, Vec<f64>>,
    pub ended_at: Instant,
}

impl Scan {
    /// A scan of these signals that has just ended and has lost nothing; its `scan_s` is 0.
    pub fn of_signals(number: u32, signals: BTreeMap<SourceId, crate::trial::Signal>) -> Self {
        Self {
            number,
            trial: Trial { key: TrialKey::new("", "", number), signals },
            truth: None,
            synthetic: false,
            scan_s: 0.0,
            lost_samples: 0,
            spoiled: Vec::new(),
            rest: BTreeMap::new(),
            ended_at: Instant::now(),
        }
    }
}

#[derive(Debug)]
pub enum Event {
    Scan(Box<Scan>),
    /// A scan has reached a part, such as the drag, or has ended; some of its data may still come.
    Phase {
        scan: u32,
        phase: Option<Phase>,
    },
    Progress(Box<Progress>),
    Trace(Trace),
    Device {
        device: String,
        state: DeviceState,
        /// the reason, and what to do
        detail: String,
    },
    Warning(Warning),
    /// The last event. All devices have ended, and all that they sent was processed.
    Finished(Totals),
}

#[derive(Clone, Debug, Default)]
pub struct Totals {
    pub scans: u32,
    pub streams: BTreeMap<SourceId, Counts>,
    pub failed: Vec<(String, String)>,
    /// Devices that did not stop in time and were abandoned.
    pub abandoned: Vec<String>,
    pub warnings: u32,
    /// Trials that could not be written to disk, and are lost. Counted by the station.
    pub lost_trials: u32,
    /// Events that were dropped because their reader was too slow or gone.
    pub dropped_events: u64,
}

impl Totals {
    pub fn lost(&self) -> u64 {
        self.streams.values().map(|counts| counts.lost).sum()
    }
}

#[derive(Clone, Debug)]
pub struct Options {
    /// Length of the ring of a series, in seconds at its nominal rate; at least one frame.
    pub ring_s: f64,
    pub ring_images: usize,
    /// Seconds of drag from one [`Progress`] to the next, such as `Some(0.05)`. Off by default.
    pub progress_every_s: Option<f64>,
    /// Seconds of real time from one [`Trace`] to the next. Off by default.
    pub trace_every_s: Option<f64>,
    /// The longest scan, in seconds. A scan of live devices ends after this time; a longer scan of
    /// a recording loses its beginning.
    pub longest_scan_s: f64,
    /// How long a scan waits for missing data after its end.
    pub deliver_limit: Duration,
    pub stop_limit: Duration,
    pub events: usize,
    /// Detects scans in streams that carry no marks. Off by default.
    pub detection: Option<Detection>,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            ring_s: 1.0,
            ring_images: 4,
            progress_every_s: None,
            trace_every_s: None,
            longest_scan_s: 120.0,
            deliver_limit: Duration::from_secs(2),
            stop_limit: Duration::from_secs(2),
            events: 64,
            detection: None,
        }
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct Detection {
    pub detector: DetectorConfig,
    /// Streams that show contact, one group per device, since streams of a group share a sample
    /// counter and a rate. The first group with data leads, so only its detections make scans.
    pub groups: Vec<Vec<(SourceId, SensorKind)>>,
    pub cuts: Vec<CutFrom>,
}

/// A command by a person or a program; a detector does not overrule it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScanCommand {
    /// Begins a drag now. If a detected scan is in progress, only a command can end it from now on.
    Begin,
    End,
}
