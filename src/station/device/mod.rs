//! Devices produce streams of samples. They are the stylus, lines of numbers, microphones, cameras,
//! and played recordings.
//!
//! A [`Device`] declares its streams, runs on its own thread, and pushes samples into one ring
//! buffer per stream. Through its [`DeviceLink`], it reports its state, and the marks where scans
//! begin and end. Nothing downstream can tell a recording from a sensor.

#[doc(hidden)]
pub mod camera;
#[doc(hidden)]
pub mod lines;
#[doc(hidden)]
pub mod list;
#[doc(hidden)]
pub mod microphone;
mod replay;
#[doc(hidden)]
pub mod serial;
mod system;

pub use replay::{Replay, Speed};

use std::cell::{Cell, RefCell};
use std::fmt;
use std::time::{Duration, Instant};

use crossbeam_channel::{SendTimeoutError, Sender};

use crate::ring::{Sink, Stop, Stopped};
use crate::scene::{Phase, SourceId};
use crate::trial::{Doubt, TrialKey};

pub trait Device: Send {
    fn name(&self) -> &str;

    /// The streams that the device will push, in the order of the sinks of [`Device::run`]. Called
    /// once, before `run`. Names are unique among all devices of a session.
    fn streams(&self) -> Vec<StreamSpec>;

    /// Whether the device can wait until its data are read. A device that cannot wait loses data
    /// that do not fit into a ring. If all devices can wait, the session loses and drops nothing.
    fn waits(&self) -> bool {
        false
    }

    /// Pushes data until there are none left, or until `link` asks to stop (check about every 50
    /// ms). `sinks` holds one sink per stream. A driver that loses its hardware reports this state
    /// and tries again; it does not return.
    /// # Errors
    /// If the device cannot continue at all.
    fn run(&mut self, sinks: &mut [Sink], link: &DeviceLink) -> Result<(), DeviceError>;
}

#[derive(Clone, Debug, PartialEq)]
pub struct StreamSpec {
    pub id: SourceId,
    pub kind: StreamKind,
}

impl StreamSpec {
    pub fn series(id: &SourceId, channels: usize, rate_hz: f64) -> Self {
        Self { id: id.clone(), kind: StreamKind::Series { channels, rate_hz } }
    }

    pub fn images(id: &SourceId) -> Self {
        Self { id: id.clone(), kind: StreamKind::Images }
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum StreamKind {
    Series {
        channels: usize,
        /// nominal rate in Hz, for the size of the ring; a scan's marks give its actual rate
        rate_hz: f64,
    },
    Images,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum DeviceState {
    /// The device has not been found yet.
    Absent,
    Opening,
    Streaming,
    /// The device is connected, but delivers no data.
    Stalled,
    /// The device was connected, and is gone.
    Lost,
}

impl fmt::Display for DeviceState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Writes the state's name in JSON.
        serde::Serialize::serialize(self, f)
    }
}

#[derive(Debug)]
pub struct DeviceReport {
    /// Number of the device in its session, from 0.
    pub device: usize,
    pub kind: DeviceReportKind,
}

#[derive(Debug)]
pub enum DeviceReportKind {
    State {
        state: DeviceState,
        /// the reason for the state, and what to do
        detail: String,
    },
    Mark(Mark),
    /// The rate in Hz measured for all streams of the device; sent before the first frame.
    Rate(f64),
    /// The rate in Hz at which the device's lines come, if it is not the expected one; `None` once it
    /// is again.
    OffPace(Option<f64>),
    Warning(Warning),
    /// The result of the device's thread, which has ended; sent by the session.
    Ended(Result<(), DeviceError>),
}

/// The subject of a warning: something was lost, damaged or not understood, and work continues. A kind stays
/// the same between versions; `src/serve/remedies.md` has a row for each.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum WarningKind {
    /// A device did not stop in time.
    Abandoned,
    /// The crystal of a stylus has failed.
    Crystal,
    /// Data of a device were damaged, late or not understood.
    Damaged,
    /// Reference scans say that the station drifts.
    Drift,
    /// An order cannot be followed here.
    Ignored,
    /// A part of the recordings, or a device, is left out.
    LeftOut,
    /// The level of a sound is too low or too high.
    Level,
    /// The library cannot be read.
    LibraryUnread,
    /// The light of a camera cannot be switched.
    Light,
    /// A scan reached the longest time.
    LongestScan,
    /// A trial was not written.
    TrialUnwritten,
    /// The rate of a sensor is not the expected one.
    OffPace,
    /// A scan was cut off, and is not named.
    ScanCut,
    /// The begin or end of a scan does not fit the data.
    ScanMark,
    /// Two columns seem to have changed places.
    Swapped,
    /// A device cannot be opened, for another reason than before.
    Unopened,
    /// A scan was not named.
    Unnamed,
}

#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Warning {
    pub kind: WarningKind,
    /// The warning in words.
    pub text: String,
}

impl Warning {
    pub fn new(kind: WarningKind, text: impl Into<String>) -> Self {
        Self { kind, text: text.into() }
    }
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

#[derive(Debug)]
pub struct DeviceLink {
    device: usize,
    pub stop: Stop,
    reports: Sender<DeviceReport>,
    last: RefCell<Option<(DeviceState, String)>>,
    /// Whether the device was lost as soon as it was opened, so that opening it again is no news.
    flaps: Cell<bool>,
}

impl DeviceLink {
    pub fn new(device: usize, stop: Stop, reports: Sender<DeviceReport>) -> Self {
        Self { device, stop, reports, last: RefCell::new(None), flaps: Cell::new(false) }
    }

    pub fn stopped(&self) -> bool {
        self.stop.requested()
    }

    /// Sleeps until `instant`, or until a stop is requested. Returns false after a stop.
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

    /// Reports a state, unless the last report had the same state and detail.
    pub fn state(&self, state: DeviceState, detail: impl Into<String>) {
        if state == DeviceState::Opening && self.flaps.get() {
            return;
        }
        self.flaps.set(self.flaps.get() && state == DeviceState::Lost);
        let detail = detail.into();
        let now = Some((state, detail.clone()));
        if self.last.replace(now.clone()) != now {
            self.send(DeviceReportKind::State { state, detail });
        }
    }

    pub fn mark(&self, mark: Mark) {
        self.send(DeviceReportKind::Mark(mark));
    }

    /// Reports a problem that does not stop the device. Frequent problems must be summed up, since
    /// they may occur a thousand times a second.
    pub fn warn(&self, kind: WarningKind, text: impl Into<String>) {
        self.send(DeviceReportKind::Warning(Warning::new(kind, text)));
    }

    /// Reports the result of the device's thread, also after a stop.
    pub(crate) fn ended(&self, result: Result<(), DeviceError>) {
        let kind = DeviceReportKind::Ended(result);
        let _ = self.reports.send(DeviceReport { device: self.device, kind });
    }

    /// Sends a report that must arrive: waits for room in the channel until a stop is requested.
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

/// A position in the streams, where a scan or one of its sources begins or ends.
#[derive(Clone, Debug, PartialEq)]
pub enum Mark {
    Begin(Begin),
    Open(Open),
    Close {
        source: SourceId,
        /// index of the first frame after the source's last frame
        end: u64,
    },
    /// The scan goes on, but its result should not be trusted.
    Spoil(Doubt),
    /// The level of each channel of a source at rest, just before the scan, in dB.
    Rest {
        source: SourceId,
        levels_db: Vec<f64>,
    },
    /// From this scan time on, in seconds, the scan has another true label.
    Truth {
        from_s: f64,
        truth: TrialKey,
    },
    /// The marked part was no scan, so its data are dropped.
    GiveUp {
        why: String,
    },
    /// The scan has ended. Sources without an end of their own end with the last frame pushed.
    End {
        /// time at which the scan's last sample was taken
        at: Instant,
    },
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Begin {
    /// The true label of the scan, if known. It is reported with the answer, but never used for it.
    pub truth: Option<TrialKey>,
    pub synthetic: bool,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Open {
    pub cut: CutFrom,
    /// Index of the source's first frame, or of its picture.
    pub start: u64,
    /// Frames per second; of no meaning for pictures.
    pub rate_hz: f64,
}

/// A source of a scan, and the stream that contains the source. One stream may contain several
/// sources, such as the sound of a tap and the sound of a drag.
#[derive(Clone, Debug, PartialEq)]
pub struct CutFrom {
    pub source: SourceId,
    pub stream: SourceId,
    /// The part of the scan that belongs to the source: tap, drag or picture.
    pub phase: Phase,
    /// Number of the stream's channels, counted from the first, that the source has.
    pub channels: usize,
}

#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// A stop was requested while the device waited; not a failure.
    #[error(transparent)]
    Stopped(#[from] Stopped),
    #[error("{0}")]
    Failed(String),
}

/// Shortest time from a failed attempt to open hardware until the next attempt.
const RETRY: Duration = Duration::from_millis(300);

/// Longest time between two attempts to open hardware, if each attempt searches all hardware.
const LONGEST_RETRY: Duration = Duration::from_secs(5);

#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum OpenError {
    #[error("{0} is not there; plug it in, or look for its name with `surfaced devices`")]
    Absent(String),
    #[error("{0} is in use; end the program that has it")]
    Busy(String),
    #[error("permission denied on {device}; {hint}")]
    Denied { device: String, hint: String },
    /// The hardware is unsuitable, so another attempt is useless.
    #[error("{0}")]
    Unfit(String),
    #[error("{0}")]
    Failed(String),
}

/// The reason why hardware is not connected.
#[derive(Debug, thiserror::Error)]
enum Disconnected {
    #[error("{0}")]
    Lost(String),
    #[error(transparent)]
    NotOpened(#[from] OpenError),
}

/// Calls `connect`, which opens hardware and works with it, again and again until a stop. Waits
/// longer after each failure to open, up to `longest`, and also if the hardware is lost again as soon as it
/// is open. Fails if another attempt is useless.
fn keep_connected(
    link: &DeviceLink,
    longest: Duration,
    mut connect: impl FnMut() -> Result<(), Disconnected>,
) -> Result<(), DeviceError> {
    let (mut was_there, mut reported, mut wait) = (false, None, RETRY);
    while !link.stopped() {
        match connect() {
            Ok(()) => break,
            Err(Disconnected::Lost(why)) => {
                let at_once = link.flaps.get()
                    || matches!(*link.last.borrow(), Some((DeviceState::Opening, _)));
                (was_there, reported) = (true, None);
                wait = if at_once { longer(wait, LONGEST_RETRY) } else { RETRY };
                link.flaps.set(at_once);
                link.state(DeviceState::Lost, why);
                link.sleep_until(Instant::now() + wait);
            }
            Err(Disconnected::NotOpened(error @ OpenError::Unfit(_))) => {
                return Err(DeviceError::Failed(error.to_string()));
            }
            Err(Disconnected::NotOpened(error)) => {
                let state = if was_there { DeviceState::Lost } else { DeviceState::Absent };
                link.state(state, error.to_string());
                // Warns of a new reason, such as busy instead of absent, even if the state is the same.
                if reported.as_ref().is_some_and(|before| *before != error) {
                    link.warn(WarningKind::Unopened, error.to_string());
                }
                reported = Some(error);
                link.sleep_until(Instant::now() + wait);
                wait = longer(wait, longest);
            }
        }
    }
    Ok(())
}

fn longer(wait: Duration, longest: Duration) -> Duration {
    (2 * wait).min(longest)
}

#[cfg(test)]
#[path = "../../../tests/common/running.rs"]
mod running;

#[cfg(test)]
mod tests {
    use super::*;

    fn link() -> (DeviceLink, crossbeam_channel::Receiver<DeviceReport>) {
        let (send, reports) = crossbeam_channel::unbounded();
        (DeviceLink::new(0, Stop::default(), send), reports)
    }

    #[test]
    fn a_state_is_reported_once_a_change_of_it_or_of_its_reason() {
        let (link, reports) = link();
        link.state(DeviceState::Opening, "");
        link.state(DeviceState::Streaming, "");
        link.state(DeviceState::Streaming, "");
        assert_eq!(reports.len(), 2);
        link.state(DeviceState::Stalled, "no numbers come");
        link.state(DeviceState::Stalled, "no lines come");
        link.state(DeviceState::Stalled, "no lines come");
        assert_eq!(reports.len(), 4);
    }

    #[test]
    fn a_session_that_is_gone_stops_the_device() {
        let (link, reports) = link();
        drop(reports);
        link.mark(Mark::End { at: Instant::now() });
        assert!(link.stopped());
    }

    #[test]
    fn what_is_dear_to_open_is_tried_ever_more_rarely() {
        let waits = |longest| -> Vec<u128> {
            let waits = std::iter::successors(Some(RETRY), |wait| Some(longer(*wait, longest)));
            waits.take(6).map(|wait| wait.as_millis()).collect()
        };
        assert_eq!(waits(LONGEST_RETRY), [300, 600, 1200, 2400, 4800, 5000]);
        assert_eq!(waits(RETRY), [300; 6]);
    }

    #[test]
    fn a_peer_that_hangs_up_at_once_is_told_once_and_asked_more_rarely() {
        let (link, reports) = link();
        let (mut attempts, begin) = (0, Instant::now());
        let connect = || {
            attempts += 1;
            link.state(DeviceState::Opening, "it");
            if attempts == 3 {
                link.stop.request();
            }
            Err(Disconnected::Lost("it hung up".into()))
        };
        keep_connected(&link, RETRY, connect).unwrap();
        assert_eq!((attempts, reports.try_iter().count()), (3, 2));
        assert!(begin.elapsed() >= 5 * RETRY);
        link.state(DeviceState::Streaming, "");
        link.state(DeviceState::Opening, "it");
        assert_eq!(reports.try_iter().count(), 2, "data came, so a new connection is news");
    }

    #[test]
    fn equal_failures_to_open_make_one_report() {
        let (link, reports) = link();
        let mut attempts = 0;
        let connect = || {
            attempts += 1;
            if attempts == 3 {
                link.stop.request();
            }
            Err(OpenError::Absent("it".into()).into())
        };
        keep_connected(&link, RETRY, connect).unwrap();
        assert_eq!((attempts, reports.try_iter().count()), (3, 1));
    }
}
