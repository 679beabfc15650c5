//! The state of the station as one document, brought up to date event by event.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::SystemTime;

use serde::Serialize;

use crate::device::DeviceState;
use crate::record;
use crate::scene::{Phase, SourceId};
use crate::station::{Answer, AnswerState, Enrolling, Guess, LibraryState, StationEvent};

/// Warnings that are kept.
const WARNINGS: usize = 50;
/// Devices that are listed; names come from the hardware, and could be many.
const DEVICES: usize = 64;

/// The present time, in milliseconds since 1970.
pub fn unix_ms() -> u64 {
    record::unix_ms(SystemTime::now())
}

/// Advice for the operator.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Advice {
    /// The advice, for programs.
    #[serde(rename = "do")]
    pub what: AdviceKind,
    /// Seconds that the drag should still last, if known.
    pub more_s: Option<f64>,
    /// The device to plug in, if one is disconnected.
    pub device: Option<String>,
    /// The advice in a few words.
    pub text: String,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum AdviceKind {
    /// No data arrive.
    Wait,
    /// The library cannot name anything yet.
    Enroll,
    /// Begin a scan.
    Tap,
    /// Go on dragging.
    Drag,
    /// The scan is long enough.
    Lift,
    /// The station has ended.
    Ended,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DeviceView {
    /// Its name.
    pub device: String,
    /// Its state.
    pub state: DeviceState,
    /// The reason, and what to do.
    pub detail: String,
    /// When this state began.
    pub since_unix_ms: u64,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LibraryView {
    pub name: String,
    /// Its surfaces, sorted.
    pub surfaces: Vec<SurfaceView>,
    pub sources: Vec<SourceId>,
    /// Made by a generator, not measured.
    pub synthetic: bool,
    /// The reason why scans cannot be named with it, if they cannot.
    pub problem: Option<String>,
    /// Remarks on what its answers rest on, a line each.
    pub remarks: Vec<String>,
}

/// A surface of the library.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SurfaceView {
    /// The label.
    pub surface: String,
    /// How many trials it has.
    pub trials: usize,
}

impl From<&LibraryState> for LibraryView {
    fn from(library: &LibraryState) -> Self {
        let LibraryState { name, surfaces, sources, synthetic, problem, remarks } = library.clone();
        let view = |(surface, trials)| SurfaceView { surface, trials };
        let surfaces = surfaces.into_iter().map(view).collect();
        Self { name, surfaces, sources, synthetic, problem, remarks }
    }
}

/// A warning, and when it came.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct WarningView {
    /// Milliseconds since 1970.
    pub unix_ms: u64,
    /// The warning.
    pub text: String,
}

/// Counts of the session so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct SessionCounts {
    /// Scans that were named, or found to be unknown.
    pub scans: u64,
    /// Of these scans, those that are none of the library's surfaces.
    pub unknown: u64,
    /// Of these scans, those named by the nearest surface, with reasons for doubt.
    pub unsure: u64,
    /// Of these scans, those named by the nearest surface, without a threshold for unknown ones.
    pub nearest: u64,
    /// Scans that could not be named.
    pub unnamed: u64,
    /// Answered scans that should not be trusted.
    pub spoiled: u64,
    /// Answered scans that are spoiled, or whose sources are damaged.
    pub damaged: u64,
    /// Scans that were kept for the library.
    pub enrolled: u64,
    /// Frames and pictures that were lost within scans.
    pub lost_samples: u64,
    pub warnings: u64,
}

/// All that is known.
#[derive(Clone, Debug, Serialize)]
pub struct State {
    /// Version of this interface.
    pub api: u32,
    /// Version of the program.
    pub version: &'static str,
    /// When the server was started.
    pub started_unix_ms: u64,
    /// Number of the scan in progress.
    pub scan: Option<u32>,
    /// The part that this scan has reached.
    pub phase: Option<Phase>,
    /// The advice for now.
    pub advice: Advice,
    /// What the scan in progress seems to be so far.
    pub guess: Option<Guess>,
    /// The last scan that was named.
    pub answer: Option<Arc<Answer>>,
    /// All devices, by name.
    pub devices: Vec<DeviceView>,
    /// The library, as soon as there is one.
    pub library: Option<LibraryView>,
    /// Whether the library is being read.
    pub reading: bool,
    /// The enrolment that the next scan is for, if any.
    pub enrolling: Option<Enrolling>,
    /// Counts of the session so far.
    pub counts: SessionCounts,
    /// The last warnings, the newest first.
    pub warnings: VecDeque<WarningView>,
    /// Whether the station has ended.
    pub finished: bool,
    /// How often each device came back.
    #[serde(skip)]
    pub reconnects: BTreeMap<String, u64>,
}

impl State {
    /// The state before the first event.
    pub fn new() -> Self {
        let advice =
            Advice { what: AdviceKind::Wait, more_s: None, device: None, text: "wait".into() };
        let mut state = Self {
            api: 1,
            version: env!("CARGO_PKG_VERSION"),
            started_unix_ms: unix_ms(),
            scan: None,
            phase: None,
            advice,
            guess: None,
            answer: None,
            devices: Vec::new(),
            library: None,
            reading: false,
            enrolling: None,
            counts: SessionCounts::default(),
            warnings: VecDeque::new(),
            finished: false,
            reconnects: BTreeMap::new(),
        };
        state.advice = state.advise();
        state
    }

    /// Takes in an event of the station; traces and meters are ignored.
    pub fn take(&mut self, notice: &StationEvent) {
        match notice {
            StationEvent::Device { device, state, detail } => self.device(device, *state, detail),
            StationEvent::Phase { scan, phase } => {
                let now = phase.map(|_| *scan);
                // A guess stays only while its own scan goes on.
                self.guess = self.guess.take().filter(|guess| now == Some(guess.scan));
                (self.scan, self.phase) = (now, *phase);
            }
            StationEvent::Guess(guess) if self.scan == Some(guess.scan) => {
                self.guess = Some(guess.clone());
            }
            StationEvent::Answer(answer) => self.answered(answer),
            StationEvent::Enrolled(enrolled) => {
                self.counts.enrolled += u64::from(enrolled.trial.is_some());
            }
            StationEvent::Enrolling(enrolling) => self.enrolling.clone_from(enrolling),
            StationEvent::Reading => self.reading = true,
            StationEvent::Library(library) => {
                (self.library, self.reading) = (Some(library.into()), false);
            }
            StationEvent::Warning(text) => self.warned(text),
            StationEvent::Unnamed(unnamed) => {
                self.counts.unnamed += 1;
                self.warned(&unnamed.text);
            }
            StationEvent::Finished(_) => {
                (self.finished, self.reading) = (true, false);
                (self.scan, self.phase, self.guess, self.enrolling) = (None, None, None, None);
            }
            StationEvent::Guess(_)
            | StationEvent::Trace(_)
            | StationEvent::Scan(_)
            | StationEvent::Streams(_)
            | StationEvent::Ending(_)
            | StationEvent::Alive => {}
        }
        self.advice = self.advise();
    }

    fn device(&mut self, name: &str, state: DeviceState, detail: &str) {
        let detail = detail.to_string();
        let since_unix_ms = unix_ms();
        if let Some(device) = self.devices.iter_mut().find(|device| device.device == name) {
            if device.state == DeviceState::Lost && state == DeviceState::Streaming {
                *self.reconnects.entry(name.into()).or_default() += 1;
            }
            (device.state, device.detail, device.since_unix_ms) = (state, detail, since_unix_ms);
        } else if self.devices.len() < DEVICES {
            self.devices.push(DeviceView { device: name.into(), state, detail, since_unix_ms });
            self.devices.sort_by(|a, b| a.device.cmp(&b.device));
        }
    }

    fn answered(&mut self, answer: &Arc<Answer>) {
        self.counts.scans += 1;
        let counts = &mut self.counts;
        match answer.state {
            AnswerState::Named | AnswerState::Unnamed => {}
            AnswerState::Nearest => counts.nearest += 1,
            AnswerState::Unsure => counts.unsure += 1,
            AnswerState::Unknown => counts.unknown += 1,
        }
        self.counts.spoiled += u64::from(!answer.spoiled.is_empty());
        self.counts.damaged += u64::from(!answer.damage.is_empty());
        self.counts.lost_samples += answer.lost_samples;
        self.answer = Some(answer.clone());
    }

    fn warned(&mut self, text: &str) {
        self.counts.warnings += 1;
        self.warnings.push_front(WarningView { unix_ms: unix_ms(), text: text.into() });
        self.warnings.truncate(WARNINGS);
    }

    fn advise(&self) -> Advice {
        let say = |what, text: &str| Advice { what, more_s: None, device: None, text: text.into() };
        if self.finished {
            return say(AdviceKind::Ended, "the station has ended");
        }
        match self.phase {
            Some(Phase::Drag) => return self.advise_drag(),
            Some(_) => return say(AdviceKind::Drag, "drag"),
            None => {}
        }
        if self.reading && self.library.is_none() {
            return say(AdviceKind::Wait, "reading the library");
        }
        let streams = self.devices.iter().any(|device| device.state == DeviceState::Streaming);
        // A device that never came is missed only if no other one streams.
        let gone = |device: &&DeviceView| match device.state {
            DeviceState::Lost => true,
            DeviceState::Absent => !streams,
            _ => false,
        };
        // The last by name, which is the stylus if it is missing.
        if let Some(DeviceView { device, .. }) = self.devices.iter().rfind(gone) {
            // The name may be a kind and a port: takes the kind.
            let mut name = device.split(' ').next().unwrap_or(device).chars();
            let first =
                name.next().map_or_else(String::new, |first| first.to_uppercase().collect());
            let text = format!("{first}{} disconnected: plug it in", name.as_str());
            let device = Some(device.clone());
            return Advice { what: AdviceKind::Wait, more_s: None, device, text };
        }
        if !streams {
            return say(AdviceKind::Wait, "wait for the devices");
        }
        let cannot = self.library.as_ref().is_some_and(|library| library.problem.is_some());
        if cannot && self.enrolling.is_none() {
            return say(AdviceKind::Enroll, "enrol a surface");
        }
        say(AdviceKind::Tap, "tap")
    }

    fn advise_drag(&self) -> Advice {
        let drag = |more_s, text| Advice { what: AdviceKind::Drag, more_s, device: None, text };
        let Some(guess) = &self.guess else { return drag(None, "drag".into()) };
        if guess.enough {
            let text = "lift".into();
            return Advice { what: AdviceKind::Lift, more_s: None, device: None, text };
        }
        match guess.needed_s.map(|needed_s| needed_s - guess.scan_s) {
            Some(more_s) => {
                // Rounded up to tenths, so that the advised time is enough; 1e-6 keeps an error of
                // rounding from turning 1.2 s into 1.3 s.
                let more_s = ((more_s * 10.0 - 1e-6).ceil() / 10.0).max(0.1);
                drag(Some(more_s), format!("{more_s:.1} s more"))
            }
            None => drag(None, "drag".into()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn advice(guess: Guess) -> Advice {
        let mut state = State::new();
        state.take(&StationEvent::Phase { scan: 1, phase: Some(Phase::Drag) });
        state.take(&StationEvent::Guess(guess));
        state.advice
    }

    #[test]
    fn lift_is_advised_only_once_the_drag_is_enough() {
        let guess = |settled, needed_s, enough| Guess {
            settled,
            needed_s,
            enough,
            ..Guess::nothing(1, 0.85)
        };
        let counting = advice(guess(false, Some(1.0), false));
        assert_eq!((counting.what, counting.text.as_str()), (AdviceKind::Drag, "0.2 s more"));
        assert_eq!(advice(guess(true, None, false)).what, AdviceKind::Drag, "no rule to rely on");
        assert_eq!(advice(guess(true, Some(3.0), true)).what, AdviceKind::Lift);
        assert_eq!(advice(guess(false, None, false)).text, "drag");
    }

    #[test]
    fn a_device_that_was_lost_is_to_be_plugged_in_whatever_else_streams() {
        let mut state = State::new();
        let mut is = |device: &str, is| {
            let (device, detail) = (device.into(), String::new());
            state.take(&StationEvent::Device { device, state: is, detail });
            state.advice.clone()
        };
        assert_eq!(is("camera", DeviceState::Absent).device.as_deref(), Some("camera"));
        assert_eq!(is("stylus /dev/ttyUSB0", DeviceState::Streaming).what, AdviceKind::Tap);
        is("microphone", DeviceState::Streaming);
        let lost = is("stylus /dev/ttyUSB0", DeviceState::Lost);
        assert_eq!(lost.what, AdviceKind::Wait);
        assert_eq!(lost.device.as_deref(), Some("stylus /dev/ttyUSB0"));
        assert_eq!(lost.text, "Stylus disconnected: plug it in");
        assert_eq!(is("stylus /dev/ttyUSB0", DeviceState::Streaming).device, None);
    }

    #[test]
    fn a_guess_lasts_as_long_as_its_scan() {
        let mut state = State::new();
        let phase = |scan, phase| StationEvent::Phase { scan, phase };
        let guess = |scan| StationEvent::Guess(Guess::nothing(scan, 0.5));
        state.take(&phase(1, Some(Phase::Drag)));
        state.take(&guess(1));
        assert_eq!(state.guess.as_ref().map(|guess| guess.scan), Some(1));
        state.take(&phase(1, None));
        assert_eq!(state.guess, None);
        // A late guess of scan 1 is ignored, even once the next scan has begun.
        state.take(&guess(1));
        assert_eq!(state.guess, None);
        state.take(&phase(2, Some(Phase::Tap)));
        state.take(&guess(1));
        assert_eq!(state.guess, None);
    }
}
