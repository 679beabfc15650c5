//! The microphone: 44.1 kHz and one channel, from any sound device.
//!
//! The sound system calls back on a thread of its own, which must never wait: it mixes to one
//! channel and puts that into a ring, in which losses keep their place. The device's thread
//! carries it on to the session, watches level and pace, and reopens the stream when it is
//! lost. What needs the sound system is behind [`Sound`]; the crate's feature `microphone` brings
//! the real one.

#[cfg(feature = "microphone")]
mod alsa;
mod callback_sink;
mod level;
mod mono;
mod pace;

use std::any::Any;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender};

#[cfg(feature = "microphone")]
pub use alsa::Alsa;

#[cfg(feature = "microphone")]
pub(crate) use alsa::microphones;
pub(crate) use callback_sink::CallbackSink;
pub(crate) use level::{Level, LevelWatch};
pub(crate) use mono::Pick;
pub(crate) use pace::Pace;

use super::open::{LONGEST_RETRY, OpenError, Retry};
use super::{Control, Device, DeviceError, DeviceState, StreamKind, StreamSpec};
use crate::ring::{Piece, SeriesSink, SeriesTap, Sink, Waker, series};
use crate::scene::SourceId;

/// The rate of every microphone in Hz, which is that of LMT108.
pub const RATE_HZ: u32 = 44_100;

/// Between the callback and the device's thread, in seconds: the longest that this thread may be
/// held up without a loss.
const BUFFER_S: f64 = 1.0;
/// How often the device's thread looks around, at least.
const LOOK: Duration = Duration::from_millis(20);
/// After a pause of this length, sound may be missing although nobody has said so: a sound server
/// that was held up passes over the time.
const PAUSE: Duration = Duration::from_millis(200);
/// How long after such a pause what was merely late has come.
const CATCH_UP: Duration = Duration::from_millis(250);
/// Less than this is a delay and no loss, in seconds.
const LEAST_MISSING_S: f64 = 0.05;
/// No sound for this long is a stall.
const STALLED: Duration = Duration::from_millis(700);
/// No sound for this long, and the stream is reopened.
const GIVE_UP: Duration = Duration::from_secs(4);

/// What goes wrong with a stream that runs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StreamError {
    /// Samples were lost before they could be read; the stream continues.
    Overrun,
    /// The stream has ended, or delivers nothing that can be used any more: why.
    Gone(String),
}

/// A sound system.
pub trait Sound: Send {
    /// For people: the microphone that it opens.
    fn device(&self) -> String;

    /// Opens the microphone at [`RATE_HZ`]. From then on `sink` is fed from a callback, and
    /// `errors` sent to (by `try_send`, as nothing may wait there), until what is returned is
    /// dropped.
    ///
    /// # Errors
    /// If the microphone cannot be opened.
    fn open(
        &mut self,
        sink: CallbackSink,
        errors: Sender<StreamError>,
    ) -> Result<Box<dyn Any>, OpenError>;
}

/// A microphone, as one stream of one channel in which full scale is ±1.
pub struct Microphone {
    stream: SourceId,
    pick: Pick,
    sound: Box<dyn Sound>,
    name: String,
}

/// What came before the next frames.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Before {
    Frames,
    /// Nothing, for a while; since when there are frames again.
    Pause(Instant),
    /// A loss, of which it is not known how large it was.
    Loss,
}

/// Why a stream that ran does so no more.
enum End {
    Stop,
    Lost(String),
    /// For good.
    Unfit(String),
}

/// What lasts from one opening to the next.
struct Listening<'a> {
    sink: &'a mut SeriesSink,
    control: &'a Control,
    pace: Pace,
    level: LevelWatch,
    begin: Instant,
    /// Whether sound has ever arrived.
    received: bool,
    /// Frames that were counted as lost by the clock, and may yet turn out to be only late.
    estimated: u64,
}

impl Microphone {
    /// The microphone that `sound` opens, as the stream `stream`.
    pub fn new(stream: SourceId, sound: Box<dyn Sound>) -> Self {
        let name = format!("microphone {}", sound.device());
        Self { stream, pick: Pick::Mean, sound, name }
    }

    /// Sets which channel is the microphone; the mean of all unless this is called.
    pub fn pick(mut self, pick: Pick) -> Self {
        self.pick = pick;
        self
    }
}

impl Device for Microphone {
    fn name(&self) -> &str {
        &self.name
    }

    fn streams(&self) -> Vec<StreamSpec> {
        let kind = StreamKind::Series { channels: 1, rate_hz: f64::from(RATE_HZ) };
        vec![StreamSpec { id: self.stream.clone(), kind }]
    }

    fn run(&mut self, sinks: &mut [Sink], control: &Control) -> Result<(), DeviceError> {
        let Some(sink) = sinks.first_mut().and_then(Sink::series) else {
            return Err(DeviceError::Failed("a microphone needs the ring of a series".into()));
        };
        control.state(DeviceState::Opening, "");
        let rate_hz = f64::from(RATE_HZ);
        let mut listening = Listening {
            sink,
            control,
            pace: Pace::new(rate_hz),
            level: LevelWatch::new(rate_hz),
            begin: Instant::now(),
            received: false,
            estimated: 0,
        };
        let mut retry = Retry::new(LONGEST_RETRY);
        while !control.stopped() {
            let (waker, woken) = Waker::new();
            let buffer = (BUFFER_S * rate_hz) as usize;
            let (enter, mut leave) = series(1, buffer, waker.clone());
            let (trouble, errors) = crossbeam_channel::bounded(16);
            let sink = CallbackSink::new(enter, waker, self.pick);
            let broken = sink.broken();
            let stream = match self.sound.open(sink, trouble) {
                Ok(stream) => stream,
                Err(error) => match retry.failed(error, listening.received, control)? {
                    true => continue,
                    false => break,
                },
            };
            retry.opened();
            let end = listening.follow(&mut leave, &woken, &errors);
            drop(stream);
            if broken.get() > 0 {
                let count = broken.get();
                control.warn(format!("{}: {count} samples were no numbers; silence", self.name));
            }
            match end {
                End::Stop => break,
                End::Unfit(why) => return Err(DeviceError::Failed(why)),
                End::Lost(why) => {
                    control.state(DeviceState::Lost, why);
                    control.sleep_until(Instant::now() + Duration::from_millis(250));
                }
            }
        }
        Ok(())
    }
}

impl Listening<'_> {
    /// Carries sound from the callback to the session until the stream ends.
    fn follow(
        &mut self,
        tap: &mut SeriesTap,
        woken: &Receiver<()>,
        errors: &Receiver<StreamError>,
    ) -> End {
        self.pace.reopened();
        let mut last = Instant::now();
        let mut before = if self.received { Before::Loss } else { Before::Frames };
        while !self.control.stopped() {
            let _ = woken.recv_timeout(LOOK);
            // Before the ring is looked at: what follows an overrun is in the ring after it.
            let trouble = errors.try_iter().fold(None, |worst, next| match (&worst, &next) {
                (Some(StreamError::Gone(_)), _) => worst,
                _ => Some(next),
            });
            if trouble == Some(StreamError::Overrun) {
                before = Before::Loss;
            }
            let waiting = tap.meter().counts().fill > 0;
            if before == Before::Frames && self.received && waiting && last.elapsed() > PAUSE {
                before = Before::Pause(Instant::now());
            }
            let catches_up = matches!(before, Before::Pause(end) if end.elapsed() < CATCH_UP);
            if !catches_up && self.carry(tap, &mut before) {
                last = Instant::now();
                self.received = true;
                self.control.state(DeviceState::Streaming, "");
            }
            if let Some(StreamError::Gone(why)) = trouble {
                return End::Lost(why);
            }
            if self.pace.unpaced(self.now_s(), self.sink.position()) {
                return End::Unfit(
                    "the microphone delivers much faster than in real time, as a device without \
                     hardware does; choose another one from `surfaced devices`"
                        .into(),
                );
            }
            if last.elapsed() > GIVE_UP {
                return End::Lost("no sound arrives; reopening it".into());
            }
            if last.elapsed() > STALLED {
                let why = "open, but no sound arrives; check that nothing has suspended it";
                self.control.state(DeviceState::Stalled, why);
            }
        }
        End::Stop
    }

    /// Moves all that has arrived; whether there was anything.
    fn carry(&mut self, tap: &mut SeriesTap, before: &mut Before) -> bool {
        let now_s = self.now_s();
        let (mut change, mut came) = (None, false);
        let Self { sink, pace, level, estimated, .. } = self;
        let least_missing = (LEAST_MISSING_S * f64::from(RATE_HZ)) as u64;
        let held = tap.meter().counts().fill;
        tap.drain(|piece| match piece {
            Piece::Missing(frames) => sink.skip(frames),
            Piece::Samples(samples) => {
                let least = match std::mem::replace(before, Before::Frames) {
                    Before::Frames => u64::MAX,
                    Before::Pause(_) => least_missing,
                    Before::Loss => 0,
                };
                // What is missing comes before the frames that followed it.
                let position = sink.position() + held.max(samples.len() as u64);
                let missing = pace.missing(now_s, position);
                let missing = if missing >= least { missing } else { 0 };
                sink.skip(missing);
                *estimated += missing;
                came = true;
                // What comes after it was counted as lost has its place no more.
                let early = pace.early(now_s, sink.position() + samples.len() as u64);
                let early = if early >= least_missing { early } else { 0 };
                let late = early.min(*estimated).min(samples.len() as u64);
                *estimated -= late;
                let samples = &samples[late as usize..];
                sink.push(samples);
                change = level.take(samples).or(change);
            }
        });
        if came {
            pace.arrived(now_s, sink.position());
        }
        match change {
            None => {}
            Some(Level::Normal) => self.control.warn("the microphone's level is normal again"),
            Some(Level::Silent) => self.control.warn(
                "the microphone is silent, without even a noise; check that it is plugged in, \
                 switched on and not muted",
            ),
            Some(Level::Clipped) => {
                self.control.warn("the microphone is clipped; lower its gain, or press less");
            }
        }
        came
    }

    fn now_s(&self) -> f64 {
        self.begin.elapsed().as_secs_f64()
    }
}

#[cfg(test)]
mod tests;
