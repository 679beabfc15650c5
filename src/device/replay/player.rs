//! Plays one trial into the rings: its picture, then its taps, then its drags.

use std::time::{Duration, Instant};

use super::speed::Speed;
use crate::device::{Begin, Control, DeviceError, Mark, Open};
use crate::ring::{SeriesSink, Sink, Stopped};
use crate::scene::{Phase, SourceSpec};
use crate::trial::{Image, Series, Signal, Trial};

/// One trial on its way into the rings.
pub(super) struct Player<'a> {
    pub specs: &'a [SourceSpec],
    pub speed: Speed,
    /// Pushed at a time, in seconds of the recording.
    pub chunk_s: f64,
    /// Silence after the trial, in seconds of the recording.
    pub pause_s: f64,
    pub synthetic: bool,
    pub sinks: &'a mut [Sink],
    pub control: &'a Control,
    /// When, at the set speed, what was played so far ends.
    pub due: Instant,
}

/// A series on its way.
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
        let begin = Begin { truth: Some(trial.key.clone()), synthetic: self.synthetic };
        self.control.mark(Mark::Begin(begin));
        for phase in [Phase::Still, Phase::Tap, Phase::Drag] {
            let mut tracks = Vec::new();
            for index in 0..self.specs.len() {
                let spec = &self.specs[index];
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
        self.control.mark(Mark::End { at: Instant::now() });
        if let Speed::RealTime(factor) = self.speed {
            let pause = Duration::from_secs_f64(self.pause_s / factor);
            if !self.control.sleep_until(self.due + pause) {
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
        self.control.warn(format!(
            "{}: source {} is left out: it holds {found}, but the scene says {:?} with {} channels",
            trial.key, spec.id, spec.domain, spec.channels
        ));
    }

    fn open(&self, index: usize, start: u64, rate_hz: f64, channels: usize) {
        let spec = &self.specs[index];
        let (source, stream) = (spec.id.clone(), spec.id.clone());
        let open = Open { source, stream, start, phase: spec.phase, rate_hz, channels };
        self.control.mark(Mark::Open(open));
    }

    fn close(&self, index: usize) {
        let source = self.specs[index].id.clone();
        self.control.mark(Mark::Close { source, end: self.sinks[index].position() });
    }

    fn picture(&mut self, index: usize, image: Image) -> Result<(), DeviceError> {
        self.open(index, self.sinks[index].position(), 1.0, 3);
        if let Some(sink) = self.sinks[index].images() {
            if self.speed == Speed::Max {
                sink.push_waiting(image.into(), self.control.stop())?;
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
            let played_s = f64::from(step) * self.chunk_s;
            if let Speed::RealTime(factor) = self.speed {
                let longest =
                    tracks.iter().map(|track| track.series.duration_s()).fold(0.0, f64::max);
                self.due = from + Duration::from_secs_f64(played_s.min(longest) / factor);
                self.control.sleep_until(self.due);
            }
            if self.control.stopped() {
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
        let stop = self.control.stop();
        let Some(sink) = self.sinks[index].series() else { return Ok(()) };
        let sink: &mut SeriesSink = sink;
        match self.speed {
            Speed::Max => sink.push_waiting(samples, stop),
            Speed::RealTime(_) => {
                sink.push(samples);
                Ok(())
            }
        }
    }
}
