//! The level of a stream in multiples of its own noise floor, hop by hop.

use std::collections::VecDeque;

/// Length of a hop in seconds: the resolution of every onset and end.
pub const HOP_S: f64 = 0.005;
/// The floor is first taken from this many hops (0.3 s); until then, the level is 0.
const LEARN: u64 = 60;
/// Hops over which the floor is smoothed (0.1 s), so that one quiet hop is no floor.
const SMOOTH: f64 = 20.0;
/// Hops of a block (0.5 s) and blocks (10 s) of which the floor is the lowest.
const BLOCK: u64 = 100;
const BLOCKS: usize = 20;
/// Below this, vibration is the converter's own, in full scales: about 6 steps of 16 bits.
const LEAST_VIBRATION: f64 = 2e-4;
/// One multiple of force, in full scales.
const FORCE: f64 = 5e-3;
/// Vibration is what lies above this frequency in Hz; below are tilt and the hand.
const HIGH_PASS_HZ: f64 = 20.0;

/// What a stream measures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SensorKind {
    /// Force at rest is the lowest of late; a multiple is 0.5 % of full scale above that.
    Force,
    /// A multiple is the noise floor: the lowest RMS of late (minimum statistics: R. Martin,
    /// *Noise power spectral density estimation*, IEEE Trans. Speech and Audio Processing 9, 2001).
    Vibration,
}

/// The level of one stream.
#[derive(Debug)]
pub struct StreamLevel {
    kind: SensorKind,
    channels: usize,
    /// Frames of a hop.
    hop: f64,
    /// Share of the old mean that one frame leaves.
    keep: f64,
    /// The last finite sample of each channel.
    last: Vec<f64>,
    slow: Vec<f64>,
    sum: f64,
    frames: u64,
    hops: u64,
    smooth: f64,
    blocks: VecDeque<f64>,
    lowest: f64,
}

impl StreamLevel {
    /// The level of a stream of `channels` samples a frame, at this rate in Hz.
    pub fn new(kind: SensorKind, channels: usize, rate_hz: f64) -> Self {
        Self {
            kind,
            channels: channels.max(1),
            hop: (rate_hz * HOP_S).max(1.0),
            keep: (-std::f64::consts::TAU * HIGH_PASS_HZ / rate_hz).exp(),
            last: Vec::new(),
            slow: Vec::new(),
            sum: 0.0,
            frames: 0,
            hops: 0,
            smooth: 0.0,
            blocks: VecDeque::new(),
            lowest: f64::INFINITY,
        }
    }

    /// Takes interleaved frames and passes `on` the level of every hop that they complete. While
    /// `held`, as during a drag, the floor may sink but not rise. A sample that is not a finite
    /// number counts as the one before it.
    pub fn feed(&mut self, samples: &[f32], held: bool, mut on: impl FnMut(f64)) {
        for frame in samples.chunks_exact(self.channels) {
            self.last.resize(self.channels, 0.0);
            for (last, x) in self.last.iter_mut().zip(frame).filter(|(_, x)| x.is_finite()) {
                *last = f64::from(*x);
            }
            if self.slow.is_empty() {
                self.slow.clone_from(&self.last);
            }
            match self.kind {
                SensorKind::Force => self.sum += self.last.iter().sum::<f64>(),
                SensorKind::Vibration => {
                    for (slow, &x) in self.slow.iter_mut().zip(&self.last) {
                        *slow = self.keep * *slow + (1.0 - self.keep) * x;
                        self.sum += (x - *slow).powi(2);
                    }
                }
            }
            self.frames += 1;
            if self.frames as f64 >= (self.hops + 1) as f64 * self.hop {
                on(self.finish_hop(held));
            }
        }
    }

    /// Forgets the floor, which was taken for contact.
    pub fn relearn(&mut self) {
        self.blocks.clear();
        self.lowest = f64::INFINITY;
    }

    fn finish_hop(&mut self, held: bool) -> f64 {
        let mean = std::mem::take(&mut self.sum) / self.hop;
        self.hops += 1;
        // A plain mean to begin with, so that the first hop weighs no more than any other.
        self.smooth += (mean - self.smooth) / SMOOTH.min(self.hops as f64);
        if self.hops as f64 >= SMOOTH {
            self.lowest = self.lowest.min(self.smooth);
        }
        if self.hops.is_multiple_of(BLOCK) && !held && self.lowest.is_finite() {
            self.blocks.push_back(self.lowest);
            self.lowest = self.smooth;
            if self.blocks.len() > BLOCKS {
                self.blocks.pop_front();
            }
        }
        if self.hops < LEARN {
            return 0.0;
        }
        let floor = self.blocks.iter().copied().fold(self.lowest, f64::min);
        match self.kind {
            SensorKind::Force => (mean - floor) / FORCE,
            SensorKind::Vibration => mean.sqrt() / floor.sqrt().max(LEAST_VIBRATION),
        }
    }
}
