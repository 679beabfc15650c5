//! The settings of a session, and how its scans are detected and cut.

use std::time::Duration;

use super::detect::{DetectorConfig, SensorKind};
use crate::scene::{Phase, SourceId};

/// The settings of a session.
#[derive(Clone, Debug)]
pub struct Options {
    /// Length of the ring of a series, in seconds at its nominal rate; at least one frame.
    pub ring_s: f64,
    /// Pictures that the ring of a camera holds.
    pub ring_images: usize,
    /// Seconds of drag from one [`Progress`](super::Progress) to the next; `Some(0.05)` makes 20 a
    /// second in real time. Off by default.
    pub progress_every_s: Option<f64>,
    /// Seconds of real time from one [`Trace`](super::Trace) to the next. Off by default.
    pub trace_every_s: Option<f64>,
    /// Seconds of each stream that are kept, so that marks can refer to past frames.
    pub lookback_s: f64,
    /// The longest scan, in seconds. A scan that was detected or begun by command ends then; a
    /// longer recorded one loses its beginning.
    pub longest_scan_s: f64,
    /// The time that a scan waits after its end for missing data.
    pub deliver_limit: Duration,
    /// The time that a stop waits for a device.
    pub stop_limit: Duration,
    /// Most events that wait for their reader.
    pub events: usize,
    /// The detection of scans in streams that carry no marks. Off by default.
    pub detection: Option<Detection>,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            ring_s: 1.0,
            ring_images: 4,
            progress_every_s: None,
            trace_every_s: None,
            lookback_s: 5.0,
            longest_scan_s: 120.0,
            deliver_limit: Duration::from_secs(2),
            stop_limit: Duration::from_secs(2),
            events: 64,
            detection: None,
        }
    }
}

/// The detection of scans, and the sources that are cut for them.
#[derive(Clone, Debug, PartialEq)]
pub struct Detection {
    /// Thresholds of taps and drags.
    pub detector: DetectorConfig,
    /// Streams that show contact, in one group for each device: they share a sample counter and a
    /// rate. The first group whose data arrive leads: its detections make the scans.
    pub groups: Vec<Vec<(SourceId, SensorKind)>>,
    /// The sources of a scan.
    pub cuts: Vec<CutFrom>,
}

/// A source of a scan, and the stream that it is cut from.
#[derive(Clone, Debug, PartialEq)]
pub struct CutFrom {
    /// The source.
    pub source: SourceId,
    /// Its stream.
    pub stream: SourceId,
    /// The part of the scan that the source covers.
    pub phase: Phase,
    /// The number of the stream's channels, from the first one, that belong to the source.
    pub channels: usize,
}

/// A command of a person or a program, which a detector does not overrule.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScanCommand {
    /// A drag begins now; if a detected scan is in progress, from now on only a command ends it.
    Begin,
    /// The scan in progress ends now.
    End,
}
