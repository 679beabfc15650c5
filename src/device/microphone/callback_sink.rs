//! Takes samples of any format from a sound system's callback, and mixes them to one channel.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::ring::{SeriesSink, Waker};

/// Frames mixed at a time: enough for a usual callback; a larger one is mixed part by part.
const PART: usize = 4096;

/// Takes samples from a callback: never waits, never allocates. Samples that do not fit are counted
/// as lost, in their place.
pub struct CallbackSink {
    ring: SeriesSink,
    waker: Waker,
    pick: Pick,
    mono: Vec<f32>,
    broken: Broken,
}

/// Counts samples that were not numbers; clones share the count.
#[derive(Clone, Debug, Default)]
pub struct Broken(Arc<AtomicU64>);

impl Broken {
    pub fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

impl CallbackSink {
    /// Puts samples into `ring`, of one channel, and wakes `waker` each time.
    pub fn new(ring: SeriesSink, waker: Waker, pick: Pick) -> Self {
        Self { ring, waker, pick, mono: Vec::with_capacity(PART), broken: Broken::default() }
    }

    /// The count of samples that were not numbers and became silence.
    pub fn broken(&self) -> Broken {
        self.broken.clone()
    }

    /// Takes interleaved samples of `channels` channels.
    pub fn take<T: Pcm>(&mut self, interleaved: &[T], channels: usize) {
        let channels = channels.max(1);
        for part in interleaved.chunks(PART * channels) {
            self.mono.clear();
            let broken = mix(part, channels, self.pick, &mut self.mono);
            if broken > 0 {
                self.broken.0.fetch_add(broken, Ordering::Relaxed);
            }
            self.ring.push(&self.mono);
        }
        self.waker.wake();
    }
}

/// A number as a sound device delivers it.
pub trait Pcm: Copy {
    /// The value where full scale is ±1; silence is 0.
    fn unit(self) -> f32;
}

macro_rules! pcm {
    ($($type:ty, $x:ident => $unit:expr;)*) => {
        $(impl Pcm for $type {
            fn unit(self) -> f32 {
                let $x = self;
                $unit
            }
        })*
    };
}

pcm! {
    i8, x => f32::from(x) / 128.0;
    i16, x => f32::from(x) / 32_768.0;
    i32, x => (f64::from(x) / 2_147_483_648.0) as f32;
    u8, x => (f32::from(x) - 128.0) / 128.0;
    u16, x => (f32::from(x) - 32_768.0) / 32_768.0;
    u32, x => ((f64::from(x) - 2_147_483_648.0) / 2_147_483_648.0) as f32;
    f32, x => x;
    f64, x => x as f32;
}

/// Which channel of a device is the microphone.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Pick {
    /// The mean of all channels.
    #[default]
    Mean,
    /// One channel, counted from 0; the last one if there are fewer.
    One(usize),
}

/// Appends one value for each whole frame of `channels` interleaved samples to `mono`, and gives
/// how many of them were not finite: these became 0. A frame that is cut short is left out.
/// Allocates only if `mono` lacks the room.
pub fn mix<T: Pcm>(interleaved: &[T], channels: usize, pick: Pick, mono: &mut Vec<f32>) -> u64 {
    let channels = channels.max(1);
    let mut broken = 0;
    for frame in interleaved.chunks_exact(channels) {
        let value = match pick {
            Pick::Mean => frame.iter().map(|x| x.unit()).sum::<f32>() / channels as f32,
            Pick::One(channel) => frame[channel.min(channels - 1)].unit(),
        };
        broken += u64::from(!value.is_finite());
        mono.push(if value.is_finite() { value } else { 0.0 });
    }
    broken
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mean<T: Pcm>(interleaved: &[T], channels: usize) -> Vec<f32> {
        let mut mono = Vec::new();
        mix(interleaved, channels, Pick::Mean, &mut mono);
        mono
    }

    #[test]
    fn every_format_has_silence_at_0_and_full_scale_at_1() {
        assert_eq!(mean(&[i8::MIN, 0, 64], 1), [-1.0, 0.0, 0.5]);
        assert_eq!(mean(&[i16::MIN, 0, 16_384], 1), [-1.0, 0.0, 0.5]);
        assert_eq!(mean(&[i32::MIN, 0, 1 << 30], 1), [-1.0, 0.0, 0.5]);
        assert_eq!(mean(&[0_u8, 128, 192], 1), [-1.0, 0.0, 0.5]);
        assert_eq!(mean(&[0_u16, 32_768, 49_152], 1), [-1.0, 0.0, 0.5]);
        assert_eq!(mean(&[0_u32, 1 << 31, 3 << 30], 1), [-1.0, 0.0, 0.5]);
        assert_eq!(mean(&[-1.0_f32, 0.0, 0.5], 1), [-1.0, 0.0, 0.5]);
        assert_eq!(mean(&[-1.0_f64, 0.0, 0.5], 1), [-1.0, 0.0, 0.5]);
    }

    #[test]
    fn channels_are_averaged_or_one_is_picked() {
        let frames = [0.5_f32, -0.1, 0.2, 0.4, 0.0, -0.4];
        for (channels, expected) in [(1, 6), (2, 3), (3, 2), (4, 1), (6, 1)] {
            assert_eq!(mean(&frames, channels).len(), expected);
        }
        assert_eq!(mean(&frames, 3), [0.2, 0.0]);
        for (pick, expected) in [(0, [0.5, 0.4]), (1, [-0.1, 0.0]), (2, [0.2, -0.4])] {
            let mut mono = Vec::new();
            mix(&frames, 3, Pick::One(pick), &mut mono);
            assert_eq!(mono, expected);
        }
    }

    #[test]
    fn what_is_no_number_becomes_silence_and_is_counted() {
        let mut mono = Vec::new();
        let broken = mix(&[f32::NAN, 0.5, f32::INFINITY], 1, Pick::Mean, &mut mono);
        assert_eq!((mono, broken), (vec![0.0, 0.5, 0.0], 2));
    }
}
