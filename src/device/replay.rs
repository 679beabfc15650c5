//! Plays recorded trials as if their sensors were there: same rings, same marks, same pace.
//!
//! A trial is played picture first, then its taps, then its drags; the sources of one phase
//! progress together in time. A recording has its own marks of scans, which override detection.

use std::ops::RangeInclusive;
use std::panic::AssertUnwindSafe;
use std::str::FromStr;
use std::time::{Duration, Instant};

use crossbeam_channel::Receiver;

use super::{
    Begin, Device, DeviceError, DeviceLink, DeviceState, Mark, Open, StreamKind, StreamSpec,
};
use crate::library::{Entry, LibraryError};
use crate::ring::{Sink, Stopped};
use crate::scene::{Domain, Phase, Scene, SourceSpec};
use crate::trial::{Image, Series, Signal, Trial};

/// The rate that sizes the ring of a source whose rate the scene leaves open.
const ANY_RATE_HZ: f64 = 44_100.0;

/// Plays trials, one after the other.
#[derive(Debug)]
pub struct Replay {
    specs: Vec<SourceSpec>,
    entries: Vec<Entry>,
    speed: Speed,
    /// Length of signal pushed at a time, in seconds of the recording.
    chunk_s: f64,
    /// Silence after each trial, in seconds of the recording.
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

    /// Sets whether the trials were made by a generator.
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

    fn run(&mut self, sinks: &mut [Sink], link: &DeviceLink) -> Result<(), DeviceError> {
        self.check()?;
        link.state(DeviceState::Opening, "reading the first trial");
        let loaded = load_ahead(self.entries.clone())?;
        for entry in &self.entries {
            let trial = match next(&loaded, link)? {
                Ok(trial) => trial,
                Err(problem) => {
                    link.warn(format!("{} is left out: {problem}", entry.key));
                    continue;
                }
            };
            link.state(DeviceState::Streaming, "");
            Player { replay: self, sinks, link, due: Instant::now() }.play(trial)?;
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
    std::thread::Builder::new().name("replay-load".into()).spawn(work).map_err(|error| {
        DeviceError::Failed(format!("cannot start a thread to read trials: {error}"))
    })?;
    Ok(receiver)
}

fn panicked(entry: &Entry) -> LibraryError {
    let problem = "its decoder gave up; the file is damaged, record it again".into();
    LibraryError::File { path: entry.key.to_string().into(), problem }
}

/// The next trial, once it is read.
fn next(loaded: &Receiver<LoadedTrial>, link: &DeviceLink) -> Result<LoadedTrial, DeviceError> {
    use crossbeam_channel::RecvTimeoutError::{Disconnected, Timeout};
    loop {
        match loaded.recv_timeout(Duration::from_millis(20)) {
            Ok(trial) => return Ok(trial),
            Err(Timeout) if link.stopped() => return Err(Stopped.into()),
            Err(Timeout) => {}
            Err(Disconnected) => {
                return Err(DeviceError::Failed("the reader of trials ended early".into()));
            }
        }
    }
}

/// The allowed speeds.
const SPEEDS: RangeInclusive<f64> = 1e-3..=1e4;

/// The speed at which a recording is played.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Speed {
    /// This many times as fast as recorded, from 0.001 to 10 000; data that do not fit are lost.
    RealTime(f64),
    /// As fast as the session takes it; nothing is lost.
    Max,
}

impl FromStr for Speed {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.parse::<f64>() {
            _ if text == "max" => Ok(Self::Max),
            Ok(factor) if SPEEDS.contains(&factor) => Ok(Self::RealTime(factor)),
            _ => Err(format!(
                "`{text}` is not a speed; expected a number from {} to {}, or `max`",
                SPEEDS.start(),
                SPEEDS.end()
            )),
        }
    }
}

/// One trial on its way into the rings.
struct Player<'a> {
    replay: &'a Replay,
    sinks: &'a mut [Sink],
    link: &'a DeviceLink,
    /// When the part played so far is due to end, at the set speed.
    due: Instant,
}

/// A series on its way into its ring.
struct Track {
    /// Index of its source and its sink.
    index: usize,
    series: Series,
    /// Frames that were pushed.
    played: usize,
}

impl Player<'_> {
    /// Plays the trial, with its marks.
    ///
    /// # Errors
    /// If a stop was requested.
    pub fn play(mut self, mut trial: Trial) -> Result<(), DeviceError> {
        let begin = Begin { truth: Some(trial.key.clone()), synthetic: self.replay.synthetic };
        self.link.mark(Mark::Begin(begin));
        for phase in [Phase::Still, Phase::Tap, Phase::Drag] {
            let mut tracks = Vec::new();
            for index in 0..self.replay.specs.len() {
                let spec = &self.replay.specs[index];
                let signal = match spec.phase == phase {
                    true => trial.signals.remove(&spec.id),
                    false => None,
                };
                match (signal, &self.sinks[index]) {
                    (None, _) => {}
                    (Some(Signal::Image(image)), Sink::Images(_)) => {
                        self.picture(index, image)?;
                    }
                    (Some(Signal::Series(series)), Sink::Series(sink))
                        if series.channels() <= sink.channels() =>
                    {
                        tracks.push(Track { index, series, played: 0 });
                    }
                    (Some(other), _) => self.misfit(spec, &other, &trial),
                }
            }
            self.series(tracks)?;
        }
        self.link.mark(Mark::End { at: Instant::now() });
        if let Speed::RealTime(factor) = self.replay.speed {
            let pause = Duration::from_secs_f64(self.replay.pause_s / factor);
            if !self.link.sleep_until(self.due + pause) {
                return Err(Stopped.into());
            }
        }
        Ok(())
    }

    fn misfit(&self, spec: &SourceSpec, found: &Signal, trial: &Trial) {
        let found = match found {
            Signal::Image(_) => "a picture".into(),
            Signal::Series(series) => format!("a series of {} channels", series.channels()),
        };
        self.link.warn(format!(
            "{}: source {} is left out: it holds {found}, but the scene says {:?} with {} channels",
            trial.key, spec.id, spec.domain, spec.channels
        ));
    }

    fn open(&self, index: usize, start: u64, rate_hz: f64, channels: usize) {
        let spec = &self.replay.specs[index];
        let (source, stream) = (spec.id.clone(), spec.id.clone());
        let open = Open { source, stream, start, phase: spec.phase, rate_hz, channels };
        self.link.mark(Mark::Open(open));
    }

    fn close(&self, index: usize) {
        let source = self.replay.specs[index].id.clone();
        self.link.mark(Mark::Close { source, end: self.sinks[index].position() });
    }

    fn picture(&mut self, index: usize, image: Image) -> Result<(), DeviceError> {
        self.open(index, self.sinks[index].position(), 1.0, 3);
        if let Some(sink) = self.sinks[index].images() {
            if self.replay.speed == Speed::Max {
                sink.push_waiting(image.into(), self.link.stop())?;
            } else {
                sink.push(image.into());
            }
        }
        self.close(index);
        Ok(())
    }

    /// Plays series side by side.
    fn series(&mut self, mut tracks: Vec<Track>) -> Result<(), DeviceError> {
        for Track { index, series, .. } in &tracks {
            let start = self.sinks[*index].position();
            self.open(*index, start, series.rate_hz(), series.channels());
        }
        let from = self.due;
        let mut step = 0_u32;
        while !tracks.is_empty() {
            step += 1;
            let played_s = f64::from(step) * self.replay.chunk_s;
            if let Speed::RealTime(factor) = self.replay.speed {
                let longest =
                    tracks.iter().map(|track| track.series.duration_s()).fold(0.0, f64::max);
                self.due = from + Duration::from_secs_f64(played_s.min(longest) / factor);
                self.link.sleep_until(self.due);
            }
            if self.link.stopped() {
                return Err(Stopped.into());
            }
            let mut still = Vec::with_capacity(tracks.len());
            for mut track in tracks {
                let frames = track.series.frames();
                let until = ((played_s * track.series.rate_hz()) as usize).min(frames);
                if until > track.played {
                    self.push(&track, until)?;
                    track.played = until;
                }
                match until < frames {
                    true => still.push(track),
                    false => self.close(track.index),
                }
            }
            tracks = still;
        }
        Ok(())
    }

    fn push(&mut self, track: &Track, until: usize) -> Result<(), Stopped> {
        let channels = track.series.channels();
        let samples = &track.series.samples()[track.played * channels..until * channels];
        let Some(sink) = self.sinks[track.index].series() else { return Ok(()) };
        if channels == sink.channels() {
            return self.push_frames(track.index, samples);
        }
        // A stream is as wide as the scene says; a narrower recording fills its first channels.
        let mut wide = vec![0.0; (until - track.played) * sink.channels()];
        for (to, from) in wide.chunks_mut(sink.channels()).zip(samples.chunks(channels)) {
            to[..channels].copy_from_slice(from);
        }
        self.push_frames(track.index, &wide)
    }

    fn push_frames(&mut self, index: usize, samples: &[f32]) -> Result<(), Stopped> {
        let stop = self.link.stop();
        let Some(sink) = self.sinks[index].series() else { return Ok(()) };
        match self.replay.speed {
            Speed::Max => sink.push_waiting(samples, stop),
            Speed::RealTime(_) => {
                sink.push(samples);
                Ok(())
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
