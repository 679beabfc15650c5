//! The link of a device to its session: the request to stop, and reports of states, marks and
//! warnings.

use std::cell::RefCell;
use std::fmt;
use std::time::{Duration, Instant};

use crossbeam_channel::{SendTimeoutError, Sender};

use crate::ring::{Stop, Stopped};
use crate::scene::{Phase, SourceId};
use crate::trial::TrialKey;

/// The state of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum DeviceState {
    /// Not found so far.
    Absent,
    /// Found, and being set up.
    Opening,
    /// Its data arrive.
    Streaming,
    /// There, but its data do not arrive.
    Stalled,
    /// It was there, and is gone.
    Lost,
}

impl fmt::Display for DeviceState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Absent => "absent",
            Self::Opening => "opening",
            Self::Streaming => "streaming",
            Self::Stalled => "stalled",
            Self::Lost => "lost",
        })
    }
}

/// A report of a device to its session.
#[derive(Debug)]
pub struct DeviceReport {
    /// Number of the device, counted from 0 in the order in which the session got them.
    pub device: usize,
    /// The report.
    pub kind: DeviceReportKind,
}

/// The kinds of report.
#[derive(Debug)]
pub enum DeviceReportKind {
    /// It has changed its state.
    State {
        /// its new state
        state: DeviceState,
        /// the reason, and what to do
        detail: String,
    },
    /// A mark of a scan.
    Mark(Mark),
    /// The rate of its streams in Hz, where it had to be measured; before the first frame.
    Rate(f64),
    /// A warning: something was wrong, and the device continues.
    Warning(String),
    /// Its thread has ended; sent by the session.
    Ended(Result<(), DeviceError>),
}

/// The link of a device to its session.
#[derive(Debug)]
pub struct DeviceLink {
    device: usize,
    stop: Stop,
    reports: Sender<DeviceReport>,
    last: RefCell<Option<DeviceState>>,
}

impl DeviceLink {
    /// A link for device number `device`.
    pub fn new(device: usize, stop: Stop, reports: Sender<DeviceReport>) -> Self {
        Self { device, stop, reports, last: RefCell::new(None) }
    }

    /// Whether a stop was requested.
    pub fn stopped(&self) -> bool {
        self.stop.requested()
    }

    /// The request to stop, for functions that wait.
    pub fn stop(&self) -> &Stop {
        &self.stop
    }

    /// Sleeps until `instant`, or until a stop is requested. False if it is time to stop.
    pub fn sleep_until(&self, instant: Instant) -> bool {
        const LOOK: Duration = Duration::from_millis(20);
        while !self.stopped() {
            let left = instant.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return true;
            }
            std::thread::sleep(left.min(LOOK));
        }
        false
    }

    /// Reports a state; only changes are sent.
    pub fn state(&self, state: DeviceState, detail: impl Into<String>) {
        if self.last.replace(Some(state)) != Some(state) {
            self.send(DeviceReportKind::State { state, detail: detail.into() });
        }
    }

    /// Reports a mark.
    pub fn mark(&self, mark: Mark) {
        self.send(DeviceReportKind::Mark(mark));
    }

    /// Reports something that was wrong but does not end the device. A device must sum up problems
    /// that may occur a thousand times a second.
    pub fn warn(&self, text: impl Into<String>) {
        self.send(DeviceReportKind::Warning(text.into()));
    }

    /// Reports the rate of all its streams, in Hz, which it had to measure.
    pub fn rate(&self, rate_hz: f64) {
        self.send(DeviceReportKind::Rate(rate_hz));
    }

    /// Sends what must arrive, waiting for room unless it is time to stop.
    fn send(&self, kind: DeviceReportKind) {
        let mut report = DeviceReport { device: self.device, kind };
        loop {
            match self.reports.send_timeout(report, Duration::from_millis(20)) {
                Ok(()) => return,
                Err(SendTimeoutError::Timeout(back)) if !self.stopped() => report = back,
                Err(SendTimeoutError::Timeout(_)) => return,
                Err(SendTimeoutError::Disconnected(_)) => return self.stop.request(),
            }
        }
    }
}

/// A mark in the streams: where a scan or one of its sources begins or ends.
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
    /// The scan has ended; sources that are still open end with the frames pushed so far.
    End {
        /// when its last sample was taken
        at: Instant,
    },
}

/// The begin of a scan.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Begin {
    /// The true label of the scan, where it is known. It is reported beside the answer and never
    /// used for it.
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
    /// The number of the stream's channels, from the first one, that belong to the source.
    pub channels: usize,
}

/// Errors that end a device.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The messages say it.
pub enum DeviceError {
    /// A stop was requested while it waited; this is no failure.
    #[error(transparent)]
    Stopped(#[from] Stopped),
    #[error("{0}")]
    Failed(String),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_state_is_reported_once_a_change() {
        let (sender, reports) = crossbeam_channel::bounded(8);
        let link = DeviceLink::new(0, Stop::default(), sender);
        link.state(DeviceState::Opening, "");
        link.state(DeviceState::Streaming, "");
        link.state(DeviceState::Streaming, "");
        assert_eq!(reports.len(), 2);
    }

    #[test]
    fn a_session_that_is_gone_stops_the_device() {
        let (sender, reports) = crossbeam_channel::bounded(8);
        drop(reports);
        let link = DeviceLink::new(0, Stop::default(), sender);
        link.mark(Mark::End { at: Instant::now() });
        assert!(link.stopped());
    }
}
