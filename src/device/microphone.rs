//! The microphone: one channel at 44.1 kHz, from any sound device.
//!
//! The sound system calls back on its own thread, which must never wait. This callback mixes the sound
//! to one channel and puts it into a ring, where lost samples keep their place. The device's thread
//! passes the sound on to the session, watches its level and rate, and reopens a lost stream. The
//! trait [`Sound`] hides the sound system; the feature `microphone` adds the implementation.

#[cfg(feature = "microphone")]
mod alsa;
mod level;
mod lost_sound;

use std::any::Any;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender};

#[cfg(feature = "microphone")]
pub use alsa::Alsa;

#[cfg(feature = "microphone")]
pub(crate) use alsa::microphones;
pub use level::RATE_HZ;
use level::SoundLevel;
use lost_sound::Listening;

use super::link::{Disconnected, LONGEST_RETRY, OpenError, keep_connected};
use super::{Device, DeviceError, DeviceLink, DeviceState, StreamKind, StreamSpec};
use crate::ring::{SeriesSink, SeriesTap, Sink, Waker, series};
use crate::scene::SourceId;

/// Length in seconds of the ring between the callback and the device's thread: the longest delay of
/// the thread without a loss. A delayed sound server sends less than this at once.
const BUFFER_S: f64 = 5.0;
/// Longest time that the device's thread waits for sound.
const LOOK: Duration = Duration::from_millis(20);
/// Seconds without sound after which the state is "stalled".
const STALLED_S: f64 = 0.7;
/// Seconds without sound after which the stream is reopened.
const GIVE_UP_S: f64 = 4.0;

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StreamError {
    /// Samples were lost before they were read; the stream goes on.
    Overrun,
    /// The stream has ended, or its data cannot be used; the text says why.
    Gone(String),
}

pub trait Sound: Send {
    fn device(&self) -> String;

    /// Opens the microphone at [`RATE_HZ`]. A callback feeds `sink` and sends errors to `errors`
    /// (by `try_send`, since it must not wait) until the returned value is dropped.
    fn open(
        &mut self,
        sink: CallbackSink,
        errors: Sender<StreamError>,
    ) -> Result<Box<dyn Any>, OpenError>;
}

/// A microphone as a device: one stream of one channel, with full scale ±1.
pub struct Microphone {
    stream: SourceId,
    pick: Pick,
    sound: Box<dyn Sound>,
    name: String,
}

impl Microphone {
    pub fn new(stream: SourceId, pick: Pick, sound: Box<dyn Sound>) -> Self {
        let name = format!("microphone {}", sound.device());
        Self { stream, pick, sound, name }
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
        keep_connected(link, LONGEST_RETRY, || {
            let (waker, woken) = Waker::new();
            let buffer = (BUFFER_S * f64::from(RATE_HZ)) as usize;
            let (enter, tap) = series(1, buffer, waker.clone());
            let (trouble, errors) = crossbeam_channel::bounded(16);
            let sink = CallbackSink::new(enter, waker, self.pick);
            let broken = sink.broken.clone();
            let open = self.sound.open(sink, trouble)?;
            let end = follow(tap, &woken, &errors, &mut listening, begin, link);
            drop(open);
            let count = broken.load(Ordering::Relaxed);
            if count > 0 {
                link.warn(format!("{count} samples were not numbers and became silence"));
            }
            end
        })
    }
}

/// Passes sound on to the session until a stop. Times are in seconds since `begin`.
fn follow(
    mut tap: SeriesTap,
    woken: &Receiver<()>,
    errors: &Receiver<StreamError>,
    listening: &mut Listening,
    begin: Instant,
    link: &DeviceLink,
) -> Result<(), Disconnected> {
    let now_s = || begin.elapsed().as_secs_f64();
    listening.opened(now_s());
    while !link.stopped() {
        let _ = woken.recv_timeout(LOOK);
        // Reads errors before the ring: an overrun is reported before the sound after it enters the
        // ring.
        let mut gone = None;
        for trouble in errors.try_iter() {
            match trouble {
                StreamError::Overrun => listening.overrun(),
                StreamError::Gone(why) => gone = gone.or(Some(why)),
            }
        }
        let carried = listening.look(&mut tap, gone.is_some(), now_s);
        if carried.sound {
            link.state(DeviceState::Streaming, "");
        }
        if let Some(level) = carried.level {
            link.warn(said_of(level));
        }
        if let Some(why) = gone {
            return Err(Disconnected::Lost(why));
        }
        if listening.unpaced(now_s()) {
            let why = "the microphone delivers much faster than in real time, as a device \
                       without hardware does; choose another one from `surfaced devices`";
            return Err(OpenError::Unfit(why.into()).into());
        }
        let silent_s = listening.silent_s(now_s());
        if silent_s > GIVE_UP_S {
            return Err(Disconnected::Lost("no sound arrives; reopening it".into()));
        }
        if silent_s > STALLED_S {
            let why = "open, but no sound arrives; check that nothing has suspended it";
            link.state(DeviceState::Stalled, why);
        }
    }
    Ok(())
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

/// Number of frames mixed at once. Few callbacks have more; these are mixed in parts.
const PART: usize = 4096;

/// Takes samples in a callback, without waiting or allocating. Samples that do not fit into the
/// ring count as lost, and keep their place.
pub struct CallbackSink {
    ring: SeriesSink,
    waker: Waker,
    pick: Pick,
    mono: Vec<f32>,
    /// Number of samples that were NaN or infinite, and were replaced by 0.
    broken: Arc<AtomicU64>,
}

impl CallbackSink {
    /// A sink that mixes samples to one channel, pushes them into `ring`, and wakes `waker`.
    pub fn new(ring: SeriesSink, waker: Waker, pick: Pick) -> Self {
        Self { ring, waker, pick, mono: Vec::with_capacity(PART), broken: Arc::default() }
    }

    /// Takes interleaved samples. `unit` scales a sample so that full scale is ±1 and silence is 0.
    pub fn take<T: Copy>(&mut self, interleaved: &[T], channels: usize, unit: fn(T) -> f32) {
        let channels = channels.max(1);
        for part in interleaved.chunks(PART * channels) {
            self.mono.clear();
            let broken = mix(part, channels, unit, self.pick, &mut self.mono);
            self.broken.fetch_add(broken, Ordering::Relaxed);
            self.ring.push(&self.mono);
        }
        self.waker.wake();
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pick {
    Mean,
    /// The channel with this number, from 0; the last channel if there are fewer.
    One(usize),
}

/// Mixes each whole frame of `channels` interleaved samples to one value, appended to `mono`.
/// Values that are not finite become 0; returns their number. Drops an incomplete frame. Allocates
/// only if `mono` has too little room.
fn mix<T: Copy>(
    interleaved: &[T],
    channels: usize,
    unit: fn(T) -> f32,
    pick: Pick,
    mono: &mut Vec<f32>,
) -> u64 {
    let mut broken = 0;
    for frame in interleaved.chunks_exact(channels) {
        let value = match pick {
            Pick::Mean => frame.iter().copied().map(unit).sum::<f32>() / channels as f32,
            Pick::One(channel) => unit(frame[channel.min(channels - 1)]),
        };
        broken += u64::from(!value.is_finite());
        mono.push(if value.is_finite() { value } else { 0.0 });
    }
    broken
}

#[cfg(test)]
mod tests;
