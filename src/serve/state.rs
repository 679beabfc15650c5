//! The state of the station as one document, updated by each event.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::SystemTime;

use serde::Serialize;

use crate::device::{DeviceState, Warning, WarningKind};
use crate::outputs::message::DEVICES;
use crate::scene::Phase;
use crate::station::{Answer, AnswerState, Enrolling, Guess, LibraryState, StationEvent, damage};
use crate::trial;

const MOST_WARNINGS: usize = 50;

pub(crate) fn unix_ms() -> u64 {
    trial::unix_ms(SystemTime::now())
}

#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub(crate) struct Advice {
    #[serde(rename = "do")]
    pub what: AdviceKind,
    /// How many seconds longer the drag should last; `None` if that is not known.
    pub more_s: Option<f64>,
    /// The device to plug in; `None` if no device is missing.
    pub device: Option<String>,
    pub text: String,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum AdviceKind {
    /// No data arrives.
    #[default]
    Wait,
    /// The library has too few surfaces to name a scan.
    Enroll,
    Tap,
    Drag,
    /// The scan is long enough.
    Lift,
    Ended,
}

fn say(what: AdviceKind, text: &str) -> Advice {
    Advice { what, more_s: None, device: None, text: text.into() }
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct DeviceView {
    pub device: String,
    pub state: DeviceState,
    /// The reason for the state of the device, and what to do.
    pub detail: String,
    pub since_unix_ms: u64,
    /// Whether the device was lost, and has not sent data since.
    #[serde(skip)]
    is_lost: bool,
    /// How often the device came back after it was lost.
    #[serde(skip)]
    pub reconnects: u64,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct WarningView {
    pub unix_ms: u64,
    #[serde(flatten)]
    pub warning: Warning,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub(crate) struct SessionCounts {
    /// Number of scans that were named or called unknown.
    pub scans: u64,
    pub unknown: u64,
    /// Number of these scans that have the nearest surface as name, with reasons for doubt.
    pub unsure: u64,
    /// Number of these scans named by the nearest surface because unknown ones are not detected.
    pub nearest: u64,
    pub unnamed: u64,
    pub spoiled: u64,
    /// Number of answered scans that are spoiled, or that have damaged sources.
    pub damaged: u64,
    pub enrolled: u64,
    pub lost_samples: u64,
    pub warnings: u64,
}

#[derive(Clone, Debug, Default, Serialize)]
pub(crate) struct State {
    pub api: u32,
    pub version: &'static str,
    pub started_unix_ms: u64,
    pub scan: Option<u32>,
    pub phase: Option<Phase>,
    pub advice: Advice,
    pub guess: Option<Guess>,
    pub answer: Option<Arc<Answer>>,
    pub devices: Vec<DeviceView>,
    pub library: Option<LibraryState>,
    pub reading: bool,
    pub enrolling: Option<Enrolling>,
    pub counts: SessionCounts,
    /// The last warnings, the newest first.
    pub warnings: VecDeque<WarningView>,
    pub finished: bool,
}

impl State {
    pub(crate) fn new() -> Self {
        let (api, version) = (1, env!("CARGO_PKG_VERSION"));
        let mut state = Self { api, version, started_unix_ms: unix_ms(), ..Self::default() };
        state.advice = state.advise();
        state
    }

    /// The parts that are not ready yet, so that scans cannot be named.
    pub(crate) fn lacking(&self) -> Vec<&'static str> {
        let library = self.library.as_ref().is_some_and(|library| library.problem.is_none());
        let streams = |device: &DeviceView| device.state == DeviceState::Streaming;
        let devices = !self.devices.is_empty() && self.devices.iter().all(streams);
        let parts = [("ended", !self.finished), ("library", library), ("devices", devices)];
        parts.iter().filter(|(_, ready)| !ready).map(|(part, _)| *part).collect()
    }

    pub(crate) fn take(&mut self, notice: &StationEvent) {
        match notice {
            StationEvent::Device { device, state, detail } => self.device(device, *state, detail),
            StationEvent::Phase { scan, phase } => {
                let now = phase.map(|_| *scan);
                // A guess is kept only while the scan that it is about is in progress.
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
                (self.library, self.reading) = (Some(library.clone()), false);
            }
            StationEvent::Warning(warning) => self.warned(warning),
            StationEvent::Unnamed(answer) => {
                self.counts.unnamed += 1;
                self.warned(&Warning::new(WarningKind::Unnamed, answer.not_named()));
            }
            StationEvent::Finished(_) => {
                (self.finished, self.reading) = (true, false);
                (self.scan, self.phase, self.guess, self.enrolling) = (None, None, None, None);
            }
            _ => {}
        }
        self.advice = self.advise();
    }

    fn device(&mut self, name: &str, state: DeviceState, detail: &str) {
        let (detail, since_unix_ms) = (detail.to_string(), unix_ms());
        let is_lost = state == DeviceState::Lost;
        if let Some(device) = self.devices.iter_mut().find(|device| device.device == name) {
            device.is_lost |= is_lost;
            if state == DeviceState::Streaming {
                device.reconnects += u64::from(std::mem::take(&mut device.is_lost));
            }
            (device.state, device.detail, device.since_unix_ms) = (state, detail, since_unix_ms);
        } else if self.devices.len() < DEVICES {
            let device = name.to_string();
            let view = DeviceView { device, state, detail, since_unix_ms, is_lost, reconnects: 0 };
            self.devices.push(view);
            self.devices.sort_by(|a, b| a.device.cmp(&b.device));
        }
    }

    fn answered(&mut self, answer: &Arc<Answer>) {
        let counts = &mut self.counts;
        counts.scans += 1;
        match answer.state {
            AnswerState::Named | AnswerState::Unnamed => {}
            AnswerState::Nearest => counts.nearest += 1,
            AnswerState::Unsure => counts.unsure += 1,
            AnswerState::Unknown => counts.unknown += 1,
        }
        counts.spoiled += u64::from(answer.spoiled().next().is_some());
        counts.damaged += u64::from(!damage(&answer.doubts).is_empty());
        counts.lost_samples += answer.lost_samples;
        self.answer = Some(answer.clone());
    }

    fn warned(&mut self, warning: &Warning) {
        self.counts.warnings += 1;
        self.warnings.push_front(WarningView { unix_ms: unix_ms(), warning: warning.clone() });
        self.warnings.truncate(MOST_WARNINGS);
    }

    fn advise(&self) -> Advice {
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
        // An absent device is only reported if no other device streams, since it may not be needed.
        let gone = |device: &&DeviceView| match device.state {
            DeviceState::Lost => true,
            DeviceState::Absent => !streams,
            _ => false,
        };
        // Of several, the last by name is chosen, since a missing stylus sorts last.
        if let Some(DeviceView { device, .. }) = self.devices.iter().rfind(gone) {
            // The name may consist of a kind and a port, but only the kind is shown.
            let mut name = device.split(' ').next().unwrap_or(device).chars();
            let first =
                name.next().map_or_else(String::new, |first| first.to_uppercase().collect());
            let text = format!("{first}{} disconnected: plug it in", name.as_str());
            return Advice { device: Some(device.clone()), ..say(AdviceKind::Wait, &text) };
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
        let Some(guess) = &self.guess else { return say(AdviceKind::Drag, "drag") };
        if guess.enough {
            return say(AdviceKind::Lift, "lift");
        }
        let Some(more_s) = guess.more_s() else { return say(AdviceKind::Drag, "drag") };
        // The time is rounded up to tenths, so that it is long enough. The 1e-6 keeps rounding errors from
        // turning 1.2 s into 1.3 s.
        let more_s = ((more_s * 10.0 - 1e-6).ceil() / 10.0).max(0.1);
        Advice { more_s: Some(more_s), ..say(AdviceKind::Drag, &format!("{more_s:.1} s more")) }
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
            scan: 1,
            scan_s: 0.85,
            settled,
            needed_s,
            enough,
            ..Guess::default()
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
        is("stylus /dev/ttyUSB0", DeviceState::Opening);
        assert_eq!(is("stylus /dev/ttyUSB0", DeviceState::Streaming).device, None);
        is("stylus /dev/ttyUSB0", DeviceState::Streaming);
        let reconnects: Vec<u64> = state.devices.iter().map(|view| view.reconnects).collect();
        assert_eq!(reconnects, [0, 0, 1], "the stylus is the last by name");
    }

    #[test]
    fn a_guess_lasts_as_long_as_its_scan() {
        let mut state = State::new();
        let phase = |scan, phase| StationEvent::Phase { scan, phase };
        let guess = |scan| StationEvent::Guess(Guess { scan, ..Guess::default() });
        state.take(&phase(1, Some(Phase::Drag)));
        state.take(&guess(1));
        assert_eq!(state.guess.as_ref().map(|guess| guess.scan), Some(1));
        state.take(&phase(1, None));
        assert_eq!(state.guess, None);
        // A late guess of scan 1 is ignored, even if the next scan has begun.
        state.take(&guess(1));
        assert_eq!(state.guess, None);
        state.take(&phase(2, Some(Phase::Tap)));
        state.take(&guess(1));
        assert_eq!(state.guess, None);
    }
}
