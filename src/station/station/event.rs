//! The events of a station, and its commands.

use std::convert::Infallible;
use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam_channel::Receiver;
use serde::Serialize;

use super::account;
use super::answer::{Answer, AnswerState};
use super::recogniser::{LibraryState, Recogniser};
use crate::device::{DeviceState, Warning};
use crate::scan::{Scan, StreamMeter, Totals, Trace};
use crate::scene::Phase;
use crate::trial::Doubt;

/// Another surface was found than before, or the first one of a scan.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Change {
    /// When it was found, in milliseconds since 1970 (UTC).
    pub unix_ms: u64,
    pub scan: u32,
    /// When it was found, in seconds since the begin of the scan.
    pub at_s: f64,
    /// Since when the surface has been there, as far as known when it was found, in seconds since the begin of
    /// the scan.
    pub since_s: f64,
    /// The surface before; `None` at the begin of a scan.
    pub from: Option<FoundSurface>,
    pub to: FoundSurface,
    /// Probability of the new surface, if it is one of the library's; `None` if it is unknown.
    pub confidence: Option<f64>,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FoundSurface {
    /// Named, nearest or unknown.
    pub state: AnswerState,
    /// `None` if it is unknown.
    pub surface: Option<String>,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SurfaceProbability {
    pub surface: String,
    pub probability: f64,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Guess {
    pub scan: u32,
    pub scan_s: f64,
    /// The state of the answer if the scan ended now; `None` until unknown surfaces can be recognised.
    pub state: Option<AnswerState>,
    /// The most probable surfaces, at most five; empty while the scan cannot be compared yet.
    pub named: Vec<SurfaceProbability>,
    /// The faults of sensors so far; in JSON also as lines, `damage`.
    #[serde(flatten, serialize_with = "account::of_guess")]
    pub doubts: Vec<Doubt>,
    /// Whether a longer drag would give the same answer, except for a stated loss of accuracy.
    pub settled: bool,
    /// How long the drag should last, in seconds; `None` if that is not known.
    pub needed_s: Option<f64>,
    /// When the present surface was found, in seconds since the begin of the scan, if surfaces are named
    /// without begin and end; `None` otherwise, and until then. JSON then lacks it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub since_s: Option<f64>,
    /// Whether the drag may end, since it has lasted `needed_s`, or since its answer is settled by a
    /// rule that rests on enough trials.
    pub enough: bool,
}

impl Guess {
    /// How many seconds the drag must still last; `None` if that is not known, or it may end.
    pub fn more_s(&self) -> Option<f64> {
        let more_s = self.needed_s.map(|needed_s| needed_s - self.scan_s);
        more_s.filter(|more_s| !self.enough && *more_s > 0.0)
    }
}

/// The outcome of a scan that was to be kept as a trial of a library.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Enrolled {
    pub scan: u32,
    pub surface: String,
    pub user: String,
    /// Session of the new trial; `None` if it has none, or the scan was not kept.
    pub session: Option<String>,
    pub outcome: EnrolledOutcome,
    /// Number of the new trial; `None` if the scan was not kept.
    pub trial: Option<u32>,
    pub folder: Option<PathBuf>,
    /// Why the scan was not kept, or what is known against a kept scan; in JSON also as lines, `remarks`.
    #[serde(flatten, serialize_with = "account::of_enrolled")]
    pub doubts: Vec<Doubt>,
    /// The surface that the library named for this scan before the trial was added, if any.
    pub nearest: Option<String>,
    /// The probability of that name, as stated then; `None` if none was stated.
    pub probability: Option<f64>,
    /// Number of trials of `surface` that the library had then; `None` if it gave no answer.
    pub known: Option<usize>,
    /// Number of trials that the order still lacks; 0 if it has ended, `None` if it has no limit.
    pub wanted: Option<u32>,
}

/// The order for the next scan: surface and user of its trial, and the progress of the order.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Enrolling {
    pub surface: String,
    pub user: String,
    /// The number of scans still to come; `None` if every scan is kept until the station ends.
    pub wanted: Option<u32>,
    /// The number of trials that were ordered; `None` if every scan is kept.
    pub trials: Option<u32>,
    pub kept: u32,
    /// How many of the kept trials a library gave an answer to before they were added, among those of a
    /// surface that it had.
    pub asked: u32,
    /// How many of these it named right.
    pub right: u32,
    pub refused: Option<RefusedScan>,
    /// Who gave the order; `None` if nobody gave a name.
    pub ordered_by: Option<String>,
}

/// A scan that was refused as a trial. It can be kept anyway until the next scan is judged.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RefusedScan {
    pub scan: u32,
    /// Why it was refused; in JSON also as lines, `reasons`.
    #[serde(flatten, serialize_with = "account::of_refused")]
    pub doubts: Vec<Doubt>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum EnrolledOutcome {
    Kept,
    Refused,
    /// The scan could not be written yet; it stays in memory, and writing is tried again.
    #[default]
    Waiting,
    Lost,
}

#[derive(Clone, Debug)]
pub enum StationEvent {
    /// The session has begun; this is the first event. The meters may be read at any time.
    Streams(Vec<StreamMeter>),
    Device {
        device: String,
        state: DeviceState,
        /// the reason for the device's state, and what to do about it
        detail: String,
    },
    Trace(Arc<Trace>),
    /// A scan has begun, has entered its next phase (such as the drag), or has ended.
    Phase {
        scan: u32,
        /// the phase; `None` if the scan has ended
        phase: Option<Phase>,
    },
    Guess(Guess),
    /// The surface has changed. Sent only if surfaces are named without begin and end.
    Change(Arc<Change>),
    Answer(Arc<Answer>),
    /// A scan could not be named; the answer has the state [`AnswerState::Unnamed`].
    Unnamed(Arc<Answer>),
    /// A scan with its signals, sent after the scan's `Answer` or `Unnamed` event.
    Scan(Arc<AnsweredScan>),
    Enrolled(Enrolled),
    /// The order for the next scan has changed; `None` if the next scan will only be named.
    Enrolling(Option<Enrolling>),
    /// The library is being read. Scans wait if no older library is in use.
    Reading,
    /// From now on, scans are compared with this library.
    Library(LibraryState),
    Warning(Warning),
    /// The answer to [`Command::Ping`], which proves that the station's loop is running.
    Alive,
    /// [`Command::Quit`] was given. Listeners may work until the moment that this event holds.
    Ending(Instant),
    /// The station has ended; this is the last event.
    Finished(Arc<Totals>),
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Command {
    /// Begin a scan now, regardless of the detector.
    Start,
    Stop,
    /// Keep the next `trials` good scans as trials of `surface`, from the scan that begins next. This
    /// order replaces the previous one.
    Enroll {
        surface: String,
        user: String,
        trials: u32,
        /// Who gives this order; `None` if nobody gave a name.
        ordered_by: Option<String>,
    },
    /// Keep the scan with this number as a trial anyway. It must be the scan refused last.
    KeepRefused(u32),
    /// End the current order from the next scan on, unless it is the station's own order.
    EndEnroll,
    /// Answer with [`StationEvent::Alive`].
    Ping,
    /// Read the library and the plan again, without dropping a sample.
    Reload,
    /// End and name the scan in progress, and stop within 5 s; a warning tells of unnamed scans.
    Quit,
}

/// Receives the events of a station. It runs on the station's thread, and so must not wait.
pub trait Listener {
    fn on_event(&mut self, event: &StationEvent);
}

impl<L: Listener + ?Sized> Listener for &mut L {
    fn on_event(&mut self, event: &StationEvent) {
        (**self).on_event(event);
    }
}

pub struct AnsweredScan {
    pub scan: Box<Scan>,
    pub answer: Arc<Answer>,
    /// The recogniser that named the scan; `None` for [`AnswerState::Unnamed`].
    pub by: Option<Arc<Recogniser>>,
}

impl fmt::Debug for AnsweredScan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("AnsweredScan").field(&self.answer.id).finish()
    }
}

/// Waits for the end of a listener's thread once the station has finished. All listeners share the
/// deadline in [`StationEvent::Ending`], however many listeners there are.
#[derive(Debug)]
pub struct End {
    ended: Receiver<Infallible>,
    until: Option<Instant>,
}

impl End {
    /// Watches a thread that holds the sender of `ended` until its work is done.
    pub fn of(ended: Receiver<Infallible>) -> Self {
        Self { ended, until: None }
    }

    /// Whether this is the last event, after which the thread should end.
    pub fn is_here(&mut self, event: &StationEvent) -> bool {
        if let StationEvent::Ending(until) = event {
            self.until = Some(*until);
        }
        matches!(event, StationEvent::Finished(_))
    }

    /// Waits until the thread has ended, but no longer than `patience` or the moment given by
    /// [`StationEvent::Ending`]; false if the thread is still working.
    pub fn wait(&self, patience: Duration) -> bool {
        let patient = Instant::now().checked_add(patience);
        let until = self.until.into_iter().chain(patient).min();
        let ended = match until {
            Some(until) => self.ended.recv_deadline(until).map_err(|error| error.is_disconnected()),
            None => self.ended.recv().map_err(|_| true),
        };
        ended == Err(true)
    }
}
