//! Plays recorded trials as if their sensors were there: same rings, same marks, same pace.
//!
//! A trial is played picture first, then its taps, then its drags; the sources of one phase
//! progress together in time. A recording carries its marks, and these override any detection.

mod player;
mod speed;

use std::panic::AssertUnwindSafe;
use std::time::{Duration, Instant};

use crossbeam_channel::Receiver;

use self::player::Player;
use self::speed::SPEEDS;
pub use self::speed::Speed;
use super::{Control, Device, DeviceError, DeviceState, StreamKind, StreamSpec};
use crate::library::{Entry, LibraryError};
use crate::ring::{Sink, Stopped};
use crate::scene::{Domain, Scene, SourceSpec};
use crate::trial::Trial;

/// Sizes the ring of a source whose rate the scene leaves open.
const ANY_RATE_HZ: f64 = 44_100.0;

/// Plays trials, one after the other.
#[derive(Debug)]
pub struct Replay {
    specs: Vec<SourceSpec>,
    entries: Vec<Entry>,
    speed: Speed,
    chunk_s: f64,
    pause_s: f64,
    synthetic: bool,
}

impl Replay {
    /// Plays `entries` in their order, as fast as they are taken: one stream for each source of
    /// `scene`, in the order of their names; sources that the scene does not have are left out.
    /// A trial is read while the one before it plays.
    pub fn new(scene: &Scene, entries: Vec<Entry>) -> Self {
        Self {
            specs: scene.sources().cloned().collect(),
            entries,
            speed: Speed::Max,
            chunk_s: 0.01,
            pause_s: 0.0,
            synthetic: false,
        }
    }

    /// Sets the speed.
    pub fn speed(mut self, speed: Speed) -> Self {
        self.speed = speed;
        self
    }

    /// Sets how much is pushed at a time, in seconds of the recording.
    pub fn chunk_s(mut self, seconds: f64) -> Self {
        self.chunk_s = seconds;
        self
    }

    /// Sets the silence after each trial, in seconds of the recording; none at [`Speed::Max`].
    pub fn pause_s(mut self, seconds: f64) -> Self {
        self.pause_s = seconds;
        self
    }

    /// Says that the trials were made by a generator.
    pub fn synthetic(mut self, synthetic: bool) -> Self {
        self.synthetic = synthetic;
        self
    }

    fn check(&self) -> Result<(), DeviceError> {
        let fail = |what: &str, value: f64| {
            Err(DeviceError::Failed(format!("{what} = {value}; expected a positive number")))
        };
        if let Speed::RealTime(x) = self.speed
            && !SPEEDS.contains(&x)
        {
            let (slowest, fastest) = (SPEEDS.start(), SPEEDS.end());
            let problem = format!("speed = {x}; expected a number from {slowest} to {fastest}");
            return Err(DeviceError::Failed(problem));
        }
        if !(self.chunk_s.is_finite() && self.chunk_s > 0.0) {
            return fail("chunk_s", self.chunk_s);
        }
        if !(self.pause_s.is_finite() && self.pause_s >= 0.0) {
            return fail("pause_s", self.pause_s);
        }
        Ok(())
    }
}

impl Device for Replay {
    fn name(&self) -> &str {
        "replay"
    }

    fn streams(&self) -> Vec<StreamSpec> {
        let kind = |spec: &SourceSpec| match spec.domain {
            Domain::Image => StreamKind::Images,
            _ => StreamKind::Series {
                channels: spec.channels,
                rate_hz: spec.rate_hz.unwrap_or(ANY_RATE_HZ),
            },
        };
        self.specs.iter().map(|spec| StreamSpec { id: spec.id.clone(), kind: kind(spec) }).collect()
    }

    fn waits(&self) -> bool {
        self.speed == Speed::Max
    }

    fn run(&mut self, sinks: &mut [Sink], control: &Control) -> Result<(), DeviceError> {
        self.check()?;
        control.state(DeviceState::Opening, "reading the first trial");
        let loaded = load_ahead(self.entries.clone())?;
        for entry in &self.entries {
            let trial = match next(&loaded, control)? {
                Ok(trial) => trial,
                Err(problem) => {
                    control.warn(format!("{} is left out: {problem}", entry.key));
                    continue;
                }
            };
            control.state(DeviceState::Streaming, "");
            let player = Player {
                specs: &self.specs,
                speed: self.speed,
                chunk_s: self.chunk_s,
                pause_s: self.pause_s,
                synthetic: self.synthetic,
                sinks,
                control,
                due: Instant::now(),
            };
            player.play(trial)?;
        }
        Ok(())
    }
}

type LoadedTrial = Result<Trial, String>;

/// Reads one entry ahead. The thread ends by itself once its receiver is gone.
fn load_ahead(entries: Vec<Entry>) -> Result<Receiver<LoadedTrial>, DeviceError> {
    let (sender, receiver) = crossbeam_channel::bounded(0);
    let work = move || {
        for entry in entries {
            // A decoder that panics on a damaged file must not take the other trials with it.
            let trial = std::panic::catch_unwind(AssertUnwindSafe(|| entry.load()))
                .unwrap_or_else(|_| Err(panicked(&entry)))
                .map_err(|error| error.to_string());
            if sender.send(trial).is_err() {
                return;
            }
        }
    };
    std::thread::Builder::new()
        .name("replay-load".into())
        .spawn(work)
        .map_err(|error| DeviceError::Failed(format!("no thread to read trials: {error}")))?;
    Ok(receiver)
}

fn panicked(entry: &Entry) -> LibraryError {
    let problem = "its decoder gave up; the file is damaged, record it again".into();
    LibraryError::File { path: entry.key.to_string().into(), problem }
}

/// The next trial, once it is read.
fn next(loaded: &Receiver<LoadedTrial>, control: &Control) -> Result<LoadedTrial, DeviceError> {
    use crossbeam_channel::RecvTimeoutError::{Disconnected, Timeout};
    loop {
        match loaded.recv_timeout(Duration::from_millis(20)) {
            Ok(trial) => return Ok(trial),
            Err(Timeout) if control.stopped() => return Err(Stopped.into()),
            Err(Timeout) => {}
            Err(Disconnected) => {
                return Err(DeviceError::Failed("the reader of trials ended early".into()));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_speed_is_a_number_within_reason_or_max() {
        assert_eq!("max".parse(), Ok(Speed::Max));
        assert_eq!("2.5".parse(), Ok(Speed::RealTime(2.5)));
        for text in ["0", "-1", "1e-300", "1e300", "nan", "inf", "fast", ""] {
            assert!(text.parse::<Speed>().unwrap_err().contains("expected"), "{text}");
        }
    }

    #[test]
    fn every_source_of_the_scene_has_a_stream() {
        let replay = Replay::new(&Scene::lmt108(), Vec::new());
        let streams = replay.streams();
        assert_eq!(streams.len(), 8);
        assert!(matches!(streams[1].kind, StreamKind::Images));
        assert!(matches!(streams[0].kind, StreamKind::Series { channels: 3, .. }));
    }
}
