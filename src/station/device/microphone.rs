//! The microphone: one channel at 44.1 kHz, from any sound device.
//!
//! The sound system calls back on its own thread, which must never wait. This callback mixes the sound
//! to one channel and puts it into a ring, where lost samples keep their place. The device's thread
//! passes the sound on to the session, watches its level and rate, and reopens a lost stream. The
//! trait [`Sound`] hides the sound system; the feature `microphone` adds the implementation.

#[cfg(feature = "microphone")]
mod alsa;
mod lost_sound;

use std::any::Any;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender};

#[cfg(feature = "microphone")]
pub use alsa::{Alsa, microphones};
use lost_sound::Listening;

use super::{
    Device, DeviceError, DeviceLink, DeviceState, Disconnected, LONGEST_RETRY, OpenError,
    StreamSpec, WarningKind, keep_connected,
};
use crate::ring::{SeriesSink, SeriesTap, Sink, Waker, series};
use crate::scene::SourceId;

/// Rate of every microphone in Hz, the same as in the dataset LMT108.
pub const RATE_HZ: u32 = 44_100;
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
    pub fn new(stream: SourceId, id: &str, pick: Pick, sound: Box<dyn Sound>) -> Self {
        Self { stream, pick, sound, name: format!("microphone {id}") }
    }
}

impl Device for Microphone {
    fn name(&self) -> &str {
        &self.name
    }

    fn streams(&self) -> Vec<StreamSpec> {
        vec![StreamSpec::series(&self.stream, 1, f64::from(RATE_HZ))]
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
                let text = format!("{count} samples were not numbers and became silence");
                link.warn(WarningKind::Damaged, text);
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
        // Reads errors before the ring, since an overrun is reported before the sound after it.
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
            link.warn(WarningKind::Level, said_of(level));
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

/// Takes samples in a callback, without waiting or allocating. Lost samples keep their place.
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

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum SoundLevel {
    #[default]
    Normal,
    /// Pure silence, without the noise that every working microphone has.
    Silent,
    /// Sound that exceeds the converter's range.
    Clipped,
}

/// Samples in a window of 0.4 s. A change of level is reported at the end of a window.
const WINDOW: usize = RATE_HZ as usize * 2 / 5;
/// One step of a 16-bit converter with full scale ±1. Sound with no larger range is silence.
const LAST_BIT: f32 = 1.0 / 32_768.0;
/// Size from which on a sample is at a limit of the converter (127/128 for 8 bits).
const LIMIT: f32 = 0.99;
/// Number of consecutive samples at a limit from which on sound counts as clipped.
const RUN: usize = 3;

#[derive(Clone, Debug, Default)]
struct LevelWatch {
    /// Number of samples in the present window, and the lowest and highest of them.
    seen: usize,
    range: Option<(f32, f32)>,
    run: usize,
    clipped: bool,
    level: SoundLevel,
}

impl LevelWatch {
    fn take(&mut self, samples: &[f32]) -> Option<SoundLevel> {
        let before = self.level;
        for &x in samples {
            let (low, high) = self.range.unwrap_or((x, x));
            self.range = Some((low.min(x), high.max(x)));
            self.run = if x.abs() >= LIMIT { self.run + 1 } else { 0 };
            self.clipped |= self.run >= RUN;
            self.seen += 1;
            if self.seen == WINDOW {
                self.level = match self.range.take() {
                    _ if std::mem::take(&mut self.clipped) => SoundLevel::Clipped,
                    Some((low, high)) if high - low <= LAST_BIT => SoundLevel::Silent,
                    _ => SoundLevel::Normal,
                };
                self.seen = 0;
            }
        }
        (self.level != before).then_some(self.level)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE: usize = RATE_HZ as usize;

    fn mono(interleaved: &[f32], channels: usize, pick: Pick) -> (Vec<f32>, u64) {
        let mut mono = Vec::new();
        let broken = mix(interleaved, channels, |x| x, pick, &mut mono);
        (mono, broken)
    }

    #[test]
    fn channels_are_averaged_or_one_is_picked() {
        let frames = [0.5_f32, -0.1, 0.2, 0.4, 0.0, -0.4];
        for (channels, expected) in [(1, 6), (2, 3), (3, 2), (4, 1), (6, 1)] {
            assert_eq!(mono(&frames, channels, Pick::Mean).0.len(), expected);
        }
        assert_eq!(mono(&frames, 3, Pick::Mean).0, [0.2, 0.0]);
        for (pick, expected) in [(0, [0.5, 0.4]), (1, [-0.1, 0.0]), (2, [0.2, -0.4])] {
            assert_eq!(mono(&frames, 3, Pick::One(pick)).0, expected);
        }
    }

    #[test]
    fn what_is_no_number_becomes_silence_and_is_counted() {
        let frames = [f32::NAN, 0.5, f32::INFINITY];
        assert_eq!(mono(&frames, 1, Pick::Mean), (vec![0.0, 0.5, 0.0], 2));
    }

    fn noise(seconds: f64) -> Vec<f32> {
        (0..(seconds * RATE as f64) as usize)
            .map(|i| (i as f32 * 1.7).sin() * 3.0 * LAST_BIT)
            .collect()
    }

    #[test]
    fn a_level_is_reported_once_a_change_and_within_a_second() {
        let loud = (0..2 * RATE).map(|i| (2.0 * (i as f32 * 0.02).sin()).clamp(-1.0, 1.0));
        let mut spikes = noise(2.0);
        spikes.iter_mut().step_by(50).for_each(|x| *x = 1.0);
        let sounds = [
            (noise(3.0), SoundLevel::Normal),
            // Constant samples are silence, even if they are not 0.
            (vec![0.25; 5 * RATE], SoundLevel::Silent),
            (noise(3.0), SoundLevel::Normal),
            (loud.collect(), SoundLevel::Clipped),
            // A single sample at the limit is no clipping.
            (spikes, SoundLevel::Normal),
        ];
        for block in [1, 7, RATE / 100, 2 * RATE] {
            let (mut watch, mut before) = (LevelWatch::default(), SoundLevel::Normal);
            for (samples, level) in &sounds {
                let parts = samples.chunks(block).enumerate();
                let changes: Vec<_> = parts
                    .filter_map(|(i, part)| Some(((i + 1) * block, watch.take(part)?)))
                    .collect();
                assert_eq!(changes.len(), usize::from(*level != before), "{changes:?}");
                assert!(changes.iter().all(|(at, new)| *at <= RATE.max(block) && new == level));
                before = *level;
            }
        }
    }
}
