//! The microphone: 44.1 kHz and one channel, from any sound device.
//!
//! The sound system calls back on its own thread, which must never wait: it mixes to one channel
//! and puts that into a ring, where lost samples keep their place. The device's thread carries the
//! sound on to the session, watches level and pace, and reopens the stream when it is lost. The
//! trait [`Sound`] hides the sound system, whose implementation comes with the crate's feature
//! `microphone`.

#[cfg(feature = "microphone")]
mod alsa;
mod callback_sink;
mod level;
mod lost_sound;
mod pace;

use std::any::Any;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender};

#[cfg(feature = "microphone")]
pub use alsa::Alsa;

#[cfg(feature = "microphone")]
pub(crate) use alsa::microphones;
pub(crate) use callback_sink::{CallbackSink, Pick};
pub(crate) use level::{LevelWatch, SoundLevel};

use lost_sound::Listening;

use super::open::{LONGEST_RETRY, OpenError, Retry};
use super::{Device, DeviceError, DeviceLink, DeviceState, StreamKind, StreamSpec};
use crate::ring::{SeriesTap, Sink, Waker, series};
use crate::scene::SourceId;

/// The rate of every microphone in Hz, which is that of LMT108.
pub const RATE_HZ: u32 = 44_100;

/// Length of the ring between the callback and the device's thread, in seconds: this thread may be
/// held up for so long without a loss. A sound server that was held up sends less at once.
const BUFFER_S: f64 = 5.0;
/// The longest time that the device's thread waits for sound.
const LOOK: Duration = Duration::from_millis(20);
/// No sound for this long is a stall, in seconds.
const STALLED_S: f64 = 0.7;
/// After this long without sound, in seconds, the stream is reopened.
const GIVE_UP_S: f64 = 4.0;

/// Errors of a stream that is open.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StreamError {
    /// Samples were lost before they could be read; the stream continues.
    Overrun,
    /// The stream has ended, or its data can no longer be used: the reason.
    Gone(String),
}

pub trait Sound: Send {
    /// The name of the microphone that it opens.
    fn device(&self) -> String;

    /// Opens the microphone at [`RATE_HZ`]. Until the returned value is dropped, a callback feeds
    /// `sink` and sends to `errors` (by `try_send`, since it must not wait).
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

/// The reason why a stream has ended.
enum StreamEnd {
    Stop,
    Lost(String),
    /// It ended, and reopening it is useless: the reason.
    Unfit(String),
}

/// A stream that is open, as the device's thread sees it.
struct OpenStream {
    tap: SeriesTap,
    woken: Receiver<()>,
    errors: Receiver<StreamError>,
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

    fn run(&mut self, sinks: &mut [Sink], link: &DeviceLink) -> Result<(), DeviceError> {
        let Some(sink) = sinks.first_mut().and_then(Sink::series) else {
            return Err(DeviceError::Failed("a microphone needs the ring of a series".into()));
        };
        link.state(DeviceState::Opening, "");
        let (begin, mut listening) = (Instant::now(), Listening::new(sink));
        let mut retry = Retry::new(LONGEST_RETRY);
        while !link.stopped() {
            let (waker, woken) = Waker::new();
            let buffer = (BUFFER_S * f64::from(RATE_HZ)) as usize;
            let (enter, tap) = series(1, buffer, waker.clone());
            let (trouble, errors) = crossbeam_channel::bounded(16);
            let sink = CallbackSink::new(enter, waker, self.pick);
            let broken = sink.broken();
            let open = match self.sound.open(sink, trouble) {
                Ok(open) => open,
                Err(error) => match retry.failed(error, listening.received(), link)? {
                    true => continue,
                    false => break,
                },
            };
            retry.opened();
            let end = OpenStream { tap, woken, errors }.follow(&mut listening, begin, link);
            drop(open);
            if broken.get() > 0 {
                let count = broken.get();
                link.warn(format!("{count} samples were not numbers and became silence"));
            }
            match end {
                StreamEnd::Stop => break,
                StreamEnd::Unfit(why) => return Err(DeviceError::Failed(why)),
                StreamEnd::Lost(why) => {
                    link.state(DeviceState::Lost, why);
                    link.sleep_until(Instant::now() + Duration::from_millis(250));
                }
            }
        }
        Ok(())
    }
}

impl OpenStream {
    /// Carries its sound to the session until it ends. Times are in seconds since `begin`.
    fn follow(
        &mut self,
        listening: &mut Listening,
        begin: Instant,
        link: &DeviceLink,
    ) -> StreamEnd {
        let now_s = || begin.elapsed().as_secs_f64();
        listening.opened(now_s());
        while !link.stopped() {
            let _ = self.woken.recv_timeout(LOOK);
            // Before the ring is read, since sound that follows an overrun enters it after the
            // report.
            let mut gone = None;
            for trouble in self.errors.try_iter() {
                match trouble {
                    StreamError::Overrun => listening.overrun(),
                    StreamError::Gone(why) => gone = gone.or(Some(why)),
                }
            }
            let carried = listening.look(&mut self.tap, gone.is_some(), now_s);
            if carried.sound {
                link.state(DeviceState::Streaming, "");
            }
            if let Some(level) = carried.level {
                link.warn(said_of(level));
            }
            if let Some(why) = gone {
                return StreamEnd::Lost(why);
            }
            if listening.unpaced(now_s()) {
                return StreamEnd::Unfit(
                    "the microphone delivers much faster than in real time, as a device without \
                     hardware does; choose another one from `surfaced devices`"
                        .into(),
                );
            }
            let silent_s = listening.silent_s(now_s());
            if silent_s > GIVE_UP_S {
                return StreamEnd::Lost("no sound arrives; reopening it".into());
            }
            if silent_s > STALLED_S {
                let why = "open, but no sound arrives; check that nothing has suspended it";
                link.state(DeviceState::Stalled, why);
            }
        }
        StreamEnd::Stop
    }
}

fn said_of(level: SoundLevel) -> &'static str {
    match level {
        SoundLevel::Normal => "the microphone's level is normal again",
        SoundLevel::Silent => {
            "the microphone delivers pure silence; check that it is plugged in, switched on and not \
             muted"
        }
        SoundLevel::Clipped => "the microphone is clipped; lower its gain, or press less",
    }
}

#[cfg(test)]
mod tests;
