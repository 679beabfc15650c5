//! What a station reports, and the commands that it takes.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::recogniser::Recogniser;
use crate::device::DeviceState;
use crate::library::Entry;
use crate::recognise::RankedSurface;
use crate::scan::{Scan, StreamMeter, Totals, Trace};
use crate::scene::{Phase, SourceId};

/// A scan that has ended, and its name: one line of JSON.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Answer {
    /// Names the answer for good: when it was given (UTC), and the number of its scan.
    pub id: String,
    /// Where the page shows it, on whatever address it is served.
    pub link: String,
    /// When it was given, in milliseconds since 1970.
    pub unix_ms: u64,
    /// Number of the scan in its session, counted from 1.
    pub scan: u32,
    /// Whether the name stands.
    pub state: AnswerState,
    /// For people: why it does not, a line each; empty for [`AnswerState::Named`].
    pub reasons: Vec<String>,
    /// The surface; `None` when it is none of the library's.
    pub surface: Option<String>,
    /// What it truly was, where a recording says so; likewise the next two.
    pub truth: Option<String>,
    /// The person who dragged.
    pub user: Option<String>,
    /// Number of the trial.
    pub trial: Option<u32>,
    /// Made by a generator, not measured.
    pub synthetic: bool,
    /// All surfaces of the library, the most alike first.
    pub ranked: Vec<RankedSurface>,
    /// ln of the ratio of the second score to the first.
    pub margin: f64,
    /// Probability of the first surface, by a method that gives one.
    pub confidence: Option<f64>,
    /// Share of left-out library trials that fit their surface no better than this one fits the
    /// first (a conformal p-value), where the library is large enough.
    pub fit: Option<f64>,
    /// From the end of the scan to its answer, in milliseconds.
    pub latency_ms: f64,
    /// How long the scan lasted, in seconds.
    pub scan_s: f64,
    /// The scan time after which the answer was settled, in seconds; `None` if it never was, or
    /// the scan was not followed.
    pub settled_s: Option<f64>,
    /// Frames (and pictures) lost within the scan.
    pub lost_samples: u64,
    /// The sources that were compared.
    pub sources: Vec<SourceId>,
    /// For people: why the scan should not be trusted, a line each.
    pub spoiled: Vec<String>,
    /// How long the drag should have lasted, in seconds, where that is known.
    pub needed_s: Option<f64>,
    /// What is not perfect about the scan.
    pub remarks: Vec<Remark>,
}

/// Whether the name of an answer stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AnswerState {
    /// It does.
    Named,
    /// It is the nearest surface of the library; there is no threshold that tells unknown ones.
    Nearest,
    /// It is the nearest surface, and there are reasons for doubt.
    Unsure,
    /// The scan fits no surface of the library.
    Unknown,
}

impl AnswerState {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Named, Self::Nearest, Self::Unsure, Self::Unknown];

    /// The name as text, the same everywhere.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Named => "named",
            Self::Nearest => "nearest",
            Self::Unsure => "unsure",
            Self::Unknown => "unknown",
        }
    }
}

/// A scan that was named, whole, and what named it.
pub struct AnsweredScan {
    /// The scan.
    pub scan: Box<Scan>,
    /// Its answer.
    pub answer: Arc<Answer>,
    /// The library that it was compared with.
    pub by: Arc<Recogniser>,
}

impl fmt::Debug for AnsweredScan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("AnsweredScan").field(&self.answer.id).finish()
    }
}

/// Something that is not perfect about a scan; in JSON, its text.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(into = "String")]
pub struct Remark {
    /// What it is about.
    pub kind: RemarkKind,
    /// The source that it is about, if it is about one.
    pub source: Option<SourceId>,
    /// For people.
    pub text: String,
}

/// The kinds of remark about a scan.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum RemarkKind {
    /// A channel has a flaw.
    Flaw,
    /// The drag is shorter than the library asks for.
    Short,
}

impl From<Remark> for String {
    fn from(remark: Remark) -> Self {
        remark.text
    }
}

/// A surface and its probability.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SurfaceProbability {
    /// The label.
    pub surface: String,
    /// From 0 to 1.
    pub probability: f64,
}

/// What the scan in progress looks like so far.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Guess {
    /// Number of the scan.
    pub scan: u32,
    /// Seconds of drag so far.
    pub scan_s: f64,
    /// The most probable surfaces, at most five; empty as long as there is nothing to say.
    pub named: Vec<SurfaceProbability>,
    /// The answer will not change any more, to the stated error.
    pub settled: bool,
    /// How long the drag should last, in seconds, where that is known: to be named, or, where it is
    /// to be kept, to be a good trial.
    pub needed_s: Option<f64>,
    /// The drag may end: it is as long as it should be, or its answer is settled by a rule that the
    /// library has enough trials to support.
    pub enough: bool,
}

impl Guess {
    /// A scan of which nothing can be said yet.
    pub fn nothing(scan: u32, scan_s: f64) -> Self {
        Self { scan, scan_s, named: Vec::new(), settled: false, needed_s: None, enough: false }
    }
}

/// The library that scans are compared with.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct LibraryState {
    /// Its name, or its folder's.
    pub name: String,
    /// Its surfaces, sorted, with the number of trials of each.
    pub surfaces: Vec<(String, usize)>,
    /// Its sources.
    pub sources: Vec<SourceId>,
    /// Made by a generator, not measured.
    pub synthetic: bool,
    /// For people: why scans cannot be named with it, if they cannot.
    pub problem: Option<String>,
    /// For people: what answers rest on, a line each.
    pub remarks: Vec<String>,
}

impl LibraryState {
    /// The state of a library of these trials.
    pub fn of(name: &str, entries: &[Entry], synthetic: bool) -> Self {
        let (mut surfaces, mut sources) = (BTreeMap::new(), BTreeSet::new());
        for entry in entries {
            *surfaces.entry(entry.key.surface.clone()).or_insert(0) += 1;
            sources.extend(entry.sources.iter().cloned());
        }
        Self {
            name: name.to_string(),
            surfaces: surfaces.into_iter().collect(),
            sources: sources.into_iter().collect(),
            synthetic,
            problem: None,
            remarks: Vec::new(),
        }
    }
}

/// What became of a scan that was to be kept as a trial of a library.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Enrolled {
    /// Number of the scan.
    pub scan: u32,
    /// The surface.
    pub surface: String,
    /// The person who dragged.
    pub user: String,
    /// What became of it.
    pub outcome: EnrolledOutcome,
    /// Number of the trial, if it was kept.
    pub trial: Option<u32>,
    /// Its folder, if it was kept.
    pub folder: Option<PathBuf>,
    /// For people: why it was not kept, or what is not perfect about it, a line each.
    pub remarks: Vec<String>,
    /// The surface that the library before it would have named it, if any.
    pub nearest: Option<String>,
    /// How many trials its order still wants; 0 once that order has ended.
    pub wanted: u32,
}

/// What the next scan is to become.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Enrolling {
    /// The surface.
    pub surface: String,
    /// The person who drags.
    pub user: String,
    /// How many scans are to come; `None` for every scan until the station ends.
    pub wanted: Option<u32>,
}

/// What became of a scan that was to be kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum EnrolledOutcome {
    /// It is a trial of the library.
    Kept,
    /// It is no good trial.
    Refused,
    /// It could not be written, stays in memory, and is tried again.
    Waiting,
    /// It could not be written, and is gone.
    Lost,
}

/// What happens in a station.
#[derive(Clone, Debug)]
pub enum StationEvent {
    /// The session has begun, and this is what its streams carry, now and at any time; the first
    /// event.
    Streams(Vec<StreamMeter>),
    /// A device has changed its state.
    Device {
        /// its name
        device: String,
        /// how it is now
        state: DeviceState,
        /// for people: why, and what to do
        detail: String,
    },
    /// What is new in the streams.
    Trace(Arc<Trace>),
    /// A scan has begun, or has come to another part.
    Phase {
        /// number of the scan
        scan: u32,
        /// the part; `None` when it is over
        phase: Option<Phase>,
    },
    /// News of the scan in progress.
    Guess(Guess),
    /// A scan was named.
    Answer(Arc<Answer>),
    /// The scan itself; follows its answer.
    Scan(Arc<AnsweredScan>),
    /// A scan was kept for a library, or was not.
    Enrolled(Enrolled),
    /// What the next scan is to become has changed; `None` if it is only named.
    Enrolling(Option<Enrolling>),
    /// The library is being read; scans wait for it.
    Reading,
    /// Scans are compared with this library from now on.
    Library(LibraryState),
    /// For people: something was lost, damaged or not understood, and work continues.
    Warning(String),
    /// For people: a scan holds too little to be named: it is silent, or shorter than a frame.
    TooLittle(String),
    /// The station's loop turns; the answer to [`Command::Ping`].
    Alive,
    /// The station has ended; the last event.
    Finished(Arc<Totals>),
}

impl Answer {
    /// How much longer the drag should have been, in seconds, if so.
    pub fn more_s(&self) -> Option<f64> {
        self.needed_s.map(|needed_s| needed_s - self.scan_s).filter(|more_s| *more_s > 0.0)
    }
}

/// A command to a station.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Command {
    /// Begin a scan now, regardless of the detector.
    Start,
    /// End the scan in progress.
    Stop,
    /// Keep the next `trials` good scans as trials of `surface`, from the next scan to begin on, in
    /// the place of the order before.
    Enroll {
        /// the label
        surface: String,
        /// the person who drags
        user: String,
        /// how many
        trials: u32,
    },
    /// End the order in force from the next scan to begin on, but for the station's own.
    EndEnroll,
    /// Answer with [`StationEvent::Alive`].
    Ping,
    /// Read the library and the plan again, without dropping a sample.
    Reload,
    /// End the scan in progress, name it, and stop the station. Within 5 s: what is not named by
    /// then is reported.
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
