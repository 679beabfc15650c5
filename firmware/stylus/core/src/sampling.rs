//! The sampling interrupt's side: takes one sample per tick, and counts what is lost.

use core::sync::atomic::{AtomicBool, AtomicU16, AtomicU32, AtomicUsize, Ordering};

use surfaced_wire::STYLUS_CHANNELS;

/// One sample: its tick, and a value for each channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sample {
    /// Ticks since sampling started, modulo 2³².
    pub tick: u32,
    /// Acceleration X, Y, Z, FSR 1, FSR 2, infrared, metal.
    pub values: [i16; STYLUS_CHANNELS],
}

struct Cell {
    tick: AtomicU32,
    values: [AtomicU16; STYLUS_CHANNELS],
}

/// Carries samples from an interrupt to the main loop: one producer, one consumer.
pub struct SampleRing<const N: usize> {
    cells: [Cell; N],
    written: AtomicUsize,
    read: AtomicUsize,
}

impl<const N: usize> Default for SampleRing<N> {
    fn default() -> Self {
        Self::new()
    }
}

impl<const N: usize> SampleRing<N> {
    /// An empty ring; N is a power of two.
    #[must_use]
    pub const fn new() -> Self {
        const { assert!(N.is_power_of_two()) };
        let cells = [const {
            Cell { tick: AtomicU32::new(0), values: [const { AtomicU16::new(0) }; STYLUS_CHANNELS] }
        }; N];
        Self { cells, written: AtomicUsize::new(0), read: AtomicUsize::new(0) }
    }

    /// Number of samples that still fit.
    pub fn free(&self) -> usize {
        let written = self.written.load(Ordering::Acquire);
        N - written.wrapping_sub(self.read.load(Ordering::Acquire))
    }

    /// Puts in a sample; returns `false` if it does not fit. Producer only.
    pub fn push(&self, sample: Sample) -> bool {
        if self.free() == 0 {
            return false;
        }
        let written = self.written.load(Ordering::Relaxed);
        let cell = &self.cells[written % N];
        cell.tick.store(sample.tick, Ordering::Relaxed);
        for (slot, value) in cell.values.iter().zip(sample.values) {
            slot.store(value.cast_unsigned(), Ordering::Relaxed);
        }
        self.written.store(written.wrapping_add(1), Ordering::Release);
        true
    }

    /// Takes the oldest sample; `None` if the ring is empty. Consumer only.
    pub fn pop(&self) -> Option<Sample> {
        let read = self.read.load(Ordering::Relaxed);
        if self.written.load(Ordering::Acquire) == read {
            return None;
        }
        let cell = &self.cells[read % N];
        let values = core::array::from_fn(|c| cell.values[c].load(Ordering::Relaxed).cast_signed());
        let tick = cell.tick.load(Ordering::Relaxed);
        self.read.store(read.wrapping_add(1), Ordering::Release);
        Some(Sample { tick, values })
    }
}

/// 25.6 ms of samples at 10 kHz (eight frames): longer than anything holds up the main loop.
const ROOM: usize = 256;

/// State that the sampling interrupt and the main loop share.
pub struct Sampling {
    pub(crate) ring: SampleRing<ROOM>,
    on: AtomicBool,
    tick: AtomicU32,
    overruns: AtomicU32,
    dropped: AtomicU32,
}

impl Default for Sampling {
    fn default() -> Self {
        Self::new()
    }
}

impl Sampling {
    /// Starts with sampling switched off.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            ring: SampleRing::new(),
            on: AtomicBool::new(false),
            tick: AtomicU32::new(0),
            overruns: AtomicU32::new(0),
            dropped: AtomicU32::new(0),
        }
    }

    /// Called by the sampling interrupt. `elapsed` is the number of ticks since the last call: 1 if
    /// no tick was missed. `read` measures now; it returns `None` if it cannot measure.
    pub fn tick(&self, elapsed: u32, read: impl FnOnce() -> Option<[i16; STYLUS_CHANNELS]>) {
        if !self.on.load(Ordering::Acquire) {
            return;
        }
        let missed = elapsed.saturating_sub(1);
        let tick = self.tick.load(Ordering::Relaxed).wrapping_add(missed);
        self.tick.store(tick.wrapping_add(1), Ordering::Relaxed);
        add(&self.overruns, missed);
        match read() {
            None => add(&self.overruns, 1),
            Some(values) => {
                if !self.ring.push(Sample { tick, values }) {
                    add(&self.dropped, 1);
                }
            }
        }
    }

    /// Whether another sample fits before the main loop takes one.
    pub fn has_room(&self) -> bool {
        self.ring.free() > 0
    }

    /// Whether sampling is on.
    pub fn is_on(&self) -> bool {
        self.on.load(Ordering::Acquire)
    }

    /// Stops sampling; samples in the ring stay there.
    pub fn stop(&self) {
        self.on.store(false, Ordering::Release);
    }

    /// Sets all counts to 0 and starts sampling. Only after [`stop`](Self::stop), so that no
    /// interrupt counts at the same time.
    pub(crate) fn start(&self) {
        while self.ring.pop().is_some() {}
        for count in [&self.tick, &self.overruns, &self.dropped] {
            count.store(0, Ordering::Relaxed);
        }
        self.on.store(true, Ordering::Release);
    }

    /// Number of ticks since the start without a measurement.
    pub fn overruns(&self) -> u32 {
        self.overruns.load(Ordering::Relaxed)
    }

    /// Number of samples since the start that did not fit into the ring.
    pub fn dropped(&self) -> u32 {
        self.dropped.load(Ordering::Relaxed)
    }
}

/// Adds, but saturates: a count that wraps to 0 would deny its losses.
fn add(count: &AtomicU32, n: u32) {
    let sum = count.load(Ordering::Relaxed).saturating_add(n);
    count.store(sum, Ordering::Relaxed);
}
