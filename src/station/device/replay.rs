//! Plays recorded trials as if their sensors were connected: with the same rings, marks and pace.
//!
//! Plays the pictures of a trial first, then its taps, then its drags. Sources of one phase play at
//! the same time. Each trial is marked as one scan, without a scan detector; or the drags follow each
//! other without a pause, as one scan.

use std::ops::RangeInclusive;
use std::panic::AssertUnwindSafe;
use std::str::FromStr;
use std::time::{Duration, Instant};

use crossbeam_channel::Receiver;

use super::{
    Begin, CutFrom, Device, DeviceError, DeviceLink, DeviceState, Mark, Open, StreamSpec,
    WarningKind,
};
use crate::library::Entry;
use crate::ring::{RingSink, Sink, Stop, Stopped};
use crate::scene::{Domain, Phase, Scene, SourceSpec};
use crate::trial::{Image, Series, Signal, Trial};

/// Rate in Hz for which a source's ring is sized if the scene gives no rate.
const ANY_RATE_HZ: f64 = 44_100.0;

#[derive(Debug)]
pub struct Replay {
    /// Each of these sources gets one stream; other sources of trials are left out.
    pub specs: Vec<SourceSpec>,
    /// Played in this order. Each trial is read from disk while the previous trial plays.
    pub entries: Vec<Entry>,
    pub speed: Speed,
    /// A recording is pushed in parts of this length, in seconds.
    pub chunk_s: f64,
    /// Rest between two trials in real time, in seconds, so that people can read an answer.
    pub rest_s: f64,
    /// Whether the drags are joined to one scan, without pictures and taps. All sources of a trial are
    /// cut to the shortest of them. A trial with other sources or rates than the one before it begins
    /// another scan.
    pub is_joined: bool,
    pub synthetic: bool,
}

impl Replay {
    /// Plays `entries` as fast as the session takes the data, with the sources of `scene`.
    pub fn new(scene: &Scene, entries: Vec<Entry>) -> Self {
        Self {
            specs: scene.sources().cloned().collect(),
            entries,
            speed: Speed::Max,
            chunk_s: 0.01,
            rest_s: 0.0,
            is_joined: false,
            synthetic: false,
        }
    }
}

impl Device for Replay {
    fn name(&self) -> &str {
        "replay"
    }

    fn streams(&self) -> Vec<StreamSpec> {
        let stream = |spec: &SourceSpec| match spec.domain {
            Domain::Image => StreamSpec::images(&spec.id),
            _ => {
                let rate_hz = spec.rate_hz.unwrap_or(ANY_RATE_HZ);
                StreamSpec::series(&spec.id, spec.channels, rate_hz)
            }
        };
        self.specs.iter().map(stream).collect()
    }

    fn waits(&self) -> bool {
        self.speed == Speed::Max
    }

    fn run(&mut self, sinks: &mut [Sink], link: &DeviceLink) -> Result<(), DeviceError> {
        if let Speed::RealTime(factor) = self.speed
            && !SPEEDS.contains(&factor)
        {
            return Err(DeviceError::Failed(not_a_speed(&factor.to_string())));
        }
        link.state(DeviceState::Opening, "reading the first trial");
        let loaded = load_ahead(self.entries.clone(), self.speed)?;
        let mut player = Player { replay: self, sinks, link, due: Instant::now(), joined: None };
        for entry in &self.entries {
            let trial = match next(&loaded, link)? {
                Ok(trial) => trial,
                Err(problem) => {
                    let text = format!("{} is left out: {problem}", entry.key);
                    link.warn(WarningKind::LeftOut, text);
                    continue;
                }
            };
            link.state(DeviceState::Streaming, "");
            player.due = Instant::now();
            if self.is_joined {
                player.join(trial)?;
                continue;
            }
            player.play(trial)?;
            if let Speed::RealTime(factor) = self.speed {
                link.sleep_until(Instant::now() + Duration::from_secs_f64(self.rest_s / factor));
            }
        }
        if player.joined.is_some() {
            link.mark(Mark::End { at: Instant::now() });
        }
        Ok(())
    }
}

type LoadedTrial = Result<Trial, String>;

/// Reads trials on a new thread, one ahead. The thread ends once the receiver is dropped.
fn load_ahead(entries: Vec<Entry>, speed: Speed) -> Result<Receiver<LoadedTrial>, DeviceError> {
    let (sender, receiver) = crossbeam_channel::bounded(0);
    // When a trial begins, the one before is named, as at a station, which reads no trials then.
    let pause_s = if let Speed::RealTime(factor) = speed { 0.1 / factor } else { 0.0 };
    let work = move || {
        for entry in entries {
            // A decoder may panic on a damaged file; the replay goes on with the next trial.
            let loaded = std::panic::catch_unwind(AssertUnwindSafe(|| entry.load()));
            let trial = match loaded {
                Ok(trial) => trial.map_err(|error| error.to_string()),
                Err(_) => Err("its decoder gave up; the file is damaged, record it again".into()),
            };
            if sender.send(trial).is_err() {
                return;
            }
            std::thread::sleep(Duration::from_secs_f64(pause_s));
        }
    };
    std::thread::Builder::new().name("replay-load".into()).spawn(work).map_err(|error| {
        DeviceError::Failed(format!("cannot start a thread to read trials: {error}"))
    })?;
    Ok(receiver)
}

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

const SPEEDS: RangeInclusive<f64> = 1e-3..=1e4;

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Speed {
    /// Factor on the recorded speed, from 0.001 to 10 000; data that do not fit a ring are lost.
    RealTime(f64),
    /// As fast as the session takes the data, so that nothing is lost.
    Max,
}

impl Speed {
    fn push<T: Clone>(
        self,
        sink: &mut RingSink<T>,
        samples: &[T],
        stop: &Stop,
    ) -> Result<(), Stopped> {
        match self {
            Self::Max => sink.push_waiting(samples, stop)?,
            Self::RealTime(_) => drop(sink.push(samples)),
        }
        Ok(())
    }
}

impl FromStr for Speed {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.parse::<f64>() {
            _ if text == "max" => Ok(Self::Max),
            Ok(factor) if SPEEDS.contains(&factor) => Ok(Self::RealTime(factor)),
            _ => Err(not_a_speed(text)),
        }
    }
}

fn not_a_speed(text: &str) -> String {
    let (slowest, fastest) = (SPEEDS.start(), SPEEDS.end());
    format!("`{text}` is not a speed; expected a number from {slowest} to {fastest}, or `max`")
}

struct Player<'a> {
    replay: &'a Replay,
    sinks: &'a mut [Sink],
    link: &'a DeviceLink,
    /// Time at which the part pushed last should end, at the set speed.
    due: Instant,
    joined: Option<JoinedDrags>,
}

struct Track {
    /// Index of the source, and of the sink that gets its samples.
    index: usize,
    series: Series,
    played: usize,
    /// Number of frames to play.
    frames: usize,
}

/// A scan of joined drags: index, rate in Hz and channels of each source, and the seconds played.
struct JoinedDrags {
    forms: Vec<(usize, f64, usize)>,
    played_s: f64,
}

impl Player<'_> {
    /// Plays the trial, with its marks, until a stop is requested.
    fn play(&mut self, mut trial: Trial) -> Result<(), DeviceError> {
        self.begin(&trial);
        for phase in [Phase::Still, Phase::Tap, Phase::Drag] {
            let tracks = self.tracks(phase, &mut trial)?;
            self.open_all(&tracks);
            self.series(tracks)?;
        }
        self.link.mark(Mark::End { at: Instant::now() });
        Ok(())
    }

    /// Plays the drag of the trial as the continuation of a scan, if its sources fit.
    fn join(&mut self, mut trial: Trial) -> Result<(), DeviceError> {
        let mut tracks = self.tracks(Phase::Drag, &mut trial)?;
        let durations = tracks.iter().map(|track| track.series.duration_s());
        let Some(shortest_s) = durations.reduce(f64::min) else { return Ok(()) };
        let form = |track: &Track| (track.index, track.series.rate_hz(), track.series.channels());
        let forms: Vec<_> = tracks.iter().map(form).collect();
        let begun = self.joined.take();
        let goes_on = begun.as_ref().is_some_and(|scan| scan.forms == forms);
        let from_s = begun.as_ref().filter(|_| goes_on).map_or(0.0, |scan| scan.played_s);
        let until_s = from_s + shortest_s;
        for track in &mut tracks {
            // Counted from the begin of the scan, so that the rounding of many trials does not add up.
            let at = |seconds: f64| (seconds * track.series.rate_hz()).round() as usize;
            track.frames = (at(until_s) - at(from_s)).min(track.frames);
        }
        if goes_on {
            self.link.mark(Mark::Truth { from_s, truth: trial.key });
        } else {
            if begun.is_some() {
                self.link.mark(Mark::End { at: Instant::now() });
            }
            self.begin(&trial);
            self.open_all(&tracks);
        }
        self.joined = Some(JoinedDrags { forms, played_s: until_s });
        self.series(tracks)
    }

    fn begin(&self, trial: &Trial) {
        let begin = Begin { truth: Some(trial.key.clone()), synthetic: self.replay.synthetic };
        self.link.mark(Mark::Begin(begin));
    }

    /// Plays the pictures of a phase, and gives its series.
    fn tracks(&mut self, phase: Phase, trial: &mut Trial) -> Result<Vec<Track>, DeviceError> {
        let mut tracks = Vec::new();
        let specs = self.replay.specs.iter().enumerate();
        for (index, spec) in specs.filter(|(_, spec)| spec.phase == phase) {
            match (trial.signals.remove(&spec.id), &self.sinks[index]) {
                (None, _) => {}
                (Some(Signal::Image(image)), Sink::Images(_)) => self.picture(index, image)?,
                (Some(Signal::Series(series)), Sink::Series(sink))
                    if series.channels() <= sink.channels() =>
                {
                    let frames = series.frames();
                    tracks.push(Track { index, series, played: 0, frames });
                }
                (Some(other), _) => self.misfit(spec, &other, trial),
            }
        }
        Ok(tracks)
    }

    fn misfit(&self, spec: &SourceSpec, found: &Signal, trial: &Trial) {
        let found = match found {
            Signal::Image(_) => "a picture".into(),
            Signal::Series(series) => format!("a series of {} channels", series.channels()),
        };
        let text = format!(
            "{}: source {} is left out: it holds {found}, but the scene says {:?} with {} channels",
            trial.key, spec.id, spec.domain, spec.channels
        );
        self.link.warn(WarningKind::LeftOut, text);
    }

    fn open(&self, index: usize, start: u64, rate_hz: f64, channels: usize) {
        let spec = &self.replay.specs[index];
        let (source, stream, phase) = (spec.id.clone(), spec.id.clone(), spec.phase);
        let cut = CutFrom { source, stream, phase, channels };
        self.link.mark(Mark::Open(Open { cut, start, rate_hz }));
    }

    fn close(&self, index: usize) {
        let source = self.replay.specs[index].id.clone();
        self.link.mark(Mark::Close { source, end: self.sinks[index].position() });
    }

    fn picture(&mut self, index: usize, image: Image) -> Result<(), DeviceError> {
        self.open(index, self.sinks[index].position(), 1.0, 3);
        if let Some(sink) = self.sinks[index].images() {
            self.replay.speed.push(sink, &[image.into()], &self.link.stop)?;
        }
        self.close(index);
        Ok(())
    }

    fn open_all(&self, tracks: &[Track]) {
        for Track { index, series, .. } in tracks {
            let start = self.sinks[*index].position();
            self.open(*index, start, series.rate_hz(), series.channels());
        }
    }

    fn series(&mut self, mut tracks: Vec<Track>) -> Result<(), DeviceError> {
        let from = self.due;
        let mut step = 0_u32;
        while !tracks.is_empty() {
            step += 1;
            let played_s = f64::from(step) * self.replay.chunk_s.max(1e-6);
            if let Speed::RealTime(factor) = self.replay.speed {
                let longest =
                    tracks.iter().map(|track| track.series.duration_s()).fold(0.0, f64::max);
                self.due = from + Duration::from_secs_f64(played_s.min(longest) / factor);
                self.link.sleep_until(self.due);
            }
            if self.link.stopped() {
                return Err(Stopped.into());
            }
            for track in &mut tracks {
                let until = ((played_s * track.series.rate_hz()) as usize).min(track.frames);
                if until > track.played {
                    self.push(track, until)?;
                    track.played = until;
                }
                // The sources of joined drags end with the scan.
                if until == track.frames && !self.replay.is_joined {
                    self.close(track.index);
                }
            }
            tracks.retain(|track| track.played < track.frames);
        }
        Ok(())
    }

    fn push(&mut self, track: &Track, until: usize) -> Result<(), Stopped> {
        let channels = track.series.channels();
        let mut samples = &track.series.samples()[track.played * channels..until * channels];
        let Some(sink) = self.sinks[track.index].series() else { return Ok(()) };
        let mut wide = Vec::new();
        if channels != sink.channels() {
            // The scene sets the stream's channels; a narrower recording fills the first ones.
            wide.resize((until - track.played) * sink.channels(), 0.0);
            for (to, from) in wide.chunks_mut(sink.channels()).zip(samples.chunks(channels)) {
                to[..channels].copy_from_slice(from);
            }
            samples = &wide;
        }
        self.replay.speed.push(sink, samples, &self.link.stop)
    }
}
