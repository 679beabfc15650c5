//! The events of a station, and its commands.

use std::convert::Infallible;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam_channel::Receiver;
use serde::Serialize;

use super::answer::{Answer, AnswerState, AnsweredScan, Damage, Unnamed};
use super::recogniser::LibraryState;
use crate::device::DeviceState;
use crate::scan::{StreamMeter, Totals, Trace};
use crate::scene::Phase;

/// A surface and its probability.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SurfaceProbability {
    /// The label.
    pub surface: String,
    /// From 0 to 1.
    pub probability: f64,
}

/// An early answer for the scan in progress.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Guess {
    /// Number of the scan.
    pub scan: u32,
    /// Seconds of drag so far.
    pub scan_s: f64,
    /// The state of the answer if the scan ended now; `None` as long as it cannot be told whether
    /// the surface is unknown.
    pub state: Option<AnswerState>,
    /// The most probable surfaces, at most five; empty as long as there is nothing to say.
    pub named: Vec<SurfaceProbability>,
    /// Damage of its sources so far.
    pub damage: Vec<Damage>,
    /// Whether the answer is settled: a longer drag gives the same, up to a stated loss of
    /// accuracy.
    pub settled: bool,
    /// How long the drag should last, in seconds, where that is known: to be named, or, where it is
    /// to be kept, to be a good trial.
    pub needed_s: Option<f64>,
    /// Whether the drag may end: it is as long as it should be, or its answer is settled by a rule
    /// that the library has enough trials to support.
    pub enough: bool,
}

impl Guess {
    /// A scan of which nothing can be said yet.
    pub fn nothing(scan: u32, scan_s: f64) -> Self {
        let (named, damage) = (Vec::new(), Vec::new());
        let (state, settled, needed_s, enough) = (None, false, None, false);
        Self { scan, scan_s, state, named, damage, settled, needed_s, enough }
    }
}

/// The outcome of a scan that was to be kept as a trial of a library.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Enrolled {
    /// Number of the scan.
    pub scan: u32,
    /// The surface.
    pub surface: String,
    /// The person who dragged.
    pub user: String,
    /// The outcome.
    pub outcome: EnrolledOutcome,
    /// Number of the trial, if it was kept.
    pub trial: Option<u32>,
    /// Its folder, if it was kept.
    pub folder: Option<PathBuf>,
    /// Reasons why it was not kept, or its imperfections, a line each.
    pub remarks: Vec<String>,
    /// The surface that the library without this trial would have named, if any.
    pub nearest: Option<String>,
    /// Number of trials that its order still wants; 0 once that order has ended.
    pub wanted: u32,
}

/// The surface and person under which the next scan will be kept.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Enrolling {
    /// The surface.
    pub surface: String,
    /// The person who drags.
    pub user: String,
    /// The number of scans to come; `None` for every scan until the station ends.
    pub wanted: Option<u32>,
    /// The number of trials that were ordered; `None` for every scan.
    pub trials: Option<u32>,
    /// The number of trials that were kept.
    pub kept: u32,
    /// The last scan, if it was refused.
    pub refused: Option<RefusedScan>,
}

/// A scan that is not good enough for a trial, and can be kept anyway until the next one.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct RefusedScan {
    /// Its number.
    pub scan: u32,
    /// Reasons, a line each.
    pub reasons: Vec<String>,
}

/// Outcomes of a scan that was to be kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum EnrolledOutcome {
    /// It is a trial of the library.
    Kept,
    /// It is not good enough for a trial.
    Refused,
    /// It could not be written, stays in memory, and is tried again.
    Waiting,
    /// It could not be written, and is gone.
    Lost,
}

/// Events of a station.
#[derive(Clone, Debug)]
pub enum StationEvent {
    /// The first event: the session has begun. The meters of its streams can be read at any time.
    Streams(Vec<StreamMeter>),
    /// A device has changed its state.
    Device {
        /// its name
        device: String,
        /// its new state
        state: DeviceState,
        /// the reason, and what to do
        detail: String,
    },
    /// New data of the streams.
    Trace(Arc<Trace>),
    /// A scan has begun, or has entered another part (such as the drag), or is over.
    Phase {
        /// number of the scan
        scan: u32,
        /// the part; `None` when it is over
        phase: Option<Phase>,
    },
    /// An early answer for the scan in progress.
    Guess(Guess),
    /// A scan was named.
    Answer(Arc<Answer>),
    /// A scan that could not be named.
    Unnamed(Unnamed),
    /// The scan itself, sent after its `Answer` or `Unnamed` event.
    Scan(Arc<AnsweredScan>),
    /// The outcome of a scan that was to be kept as a trial.
    Enrolled(Enrolled),
    /// The order for the next scan has changed; `None` if the scan will only be named.
    Enrolling(Option<Enrolling>),
    /// The library is being read; scans wait for it.
    Reading,
    /// Scans are compared with this library from now on.
    Library(LibraryState),
    /// A warning: something was lost, damaged or not understood, and work continues.
    Warning(String),
    /// The station's loop is running; the answer to [`Command::Ping`].
    Alive,
    /// [`Command::Quit`] was given: listeners may work until this moment.
    Ending(Instant),
    /// The station has ended; the last event.
    Finished(Arc<Totals>),
}

impl StationEvent {
    /// The text of a warning, if this is one.
    pub fn warning(&self) -> Option<&str> {
        match self {
            Self::Warning(text) | Self::Unnamed(Unnamed { text, .. }) => Some(text),
            _ => None,
        }
    }
}

/// A command to a station.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Command {
    /// Begin a scan now, regardless of the detector.
    Start,
    /// End the scan in progress.
    Stop,
    /// Keep the next `trials` good scans as trials of `surface`, starting with the next scan to
    /// begin; replaces the order before.
    Enroll {
        /// the label
        surface: String,
        /// the person who drags
        user: String,
        /// how many
        trials: u32,
    },
    /// Keep this scan, which was refused last, as a trial anyway.
    KeepRefused(u32),
    /// End the order in force from the next scan on, unless it is the station's own.
    EndEnroll,
    /// Answer with [`StationEvent::Alive`].
    Ping,
    /// Read the library and the plan again, without dropping a sample.
    Reload,
    /// End the scan in progress, name it, and stop the station, within 5 s. A scan that is not
    /// named by then is reported.
    Quit,
}

/// Takes the events of a station. Called on the station's own thread: must not wait.
pub trait Listener {
    /// Takes an event.
    fn on_event(&mut self, event: &StationEvent);
}

impl<L: Listener + ?Sized> Listener for &mut L {
    fn on_event(&mut self, event: &StationEvent) {
        (**self).on_event(event);
    }
}

impl<L: Listener + ?Sized> Listener for Box<L> {
    fn on_event(&mut self, event: &StationEvent) {
        (**self).on_event(event);
    }
}

/// Waits for the end of a listener's thread once the station has finished. All listeners share one
/// deadline, however many there are.
#[derive(Debug)]
pub struct End {
    ended: Receiver<Infallible>,
    until: Option<Instant>,
}

impl End {
    /// For a thread that holds the sender of `ended` as long as it works.
    pub(crate) fn of(ended: Receiver<Infallible>) -> Self {
        Self { ended, until: None }
    }

    /// Whether nothing follows this event, so that the thread is to end now.
    pub(crate) fn is_here(&mut self, event: &StationEvent) -> bool {
        if let StationEvent::Ending(until) = event {
            self.until = Some(*until);
        }
        matches!(event, StationEvent::Finished(_))
    }

    /// Waits for the thread, at most for `patience` and until the moment of
    /// [`StationEvent::Ending`]; false if it still works.
    pub(crate) fn wait(&self, patience: Duration) -> bool {
        let patient = Instant::now().checked_add(patience);
        let until = self.until.into_iter().chain(patient).min();
        let ended = match until {
            Some(until) => self.ended.recv_deadline(until).map_err(|error| error.is_disconnected()),
            None => self.ended.recv().map_err(|_| true),
        };
        ended == Err(true)
    }
}
