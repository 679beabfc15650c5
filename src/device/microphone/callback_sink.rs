//! Where a sound system's callback leaves its samples.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::mono::{Pcm, Pick, mix};
use crate::ring::{SeriesSink, Waker};

/// Room for a callback of the usual size; a larger one is mixed part by part.
const PART: usize = 4096;

/// Takes samples from a callback: never waits, never allocates. What does not fit is counted as
/// lost, in its place.
pub struct CallbackSink {
    ring: SeriesSink,
    waker: Waker,
    pick: Pick,
    mono: Vec<f32>,
    broken: Broken,
}

/// Counts samples that were no numbers; clones share the count.
#[derive(Clone, Debug, Default)]
pub struct Broken(Arc<AtomicU64>);

impl Broken {
    /// Their number so far.
    pub fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

impl CallbackSink {
    /// Puts samples into `ring`, of one channel, and wakes `waker` each time.
    pub fn new(ring: SeriesSink, waker: Waker, pick: Pick) -> Self {
        Self { ring, waker, pick, mono: Vec::with_capacity(PART), broken: Broken::default() }
    }

    /// The samples that were no numbers, and became silence.
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
