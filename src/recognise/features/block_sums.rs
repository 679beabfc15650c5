//! Sums over the blocks of a series, from which the statistics of any run of blocks follow
//! ([`super::window_sums`]).
//!
//! A block is half a long frame. What is kept of each adds up, so that a window of a trial, and a
//! scan that grows, cost additions alone. All powers are of x minus a reference near the first
//! block's mean, so that an offset costs no digits.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::block_layout::{LAGS, Of, place, products, width};
use super::window_sums::WindowSums;

/// The blocks of a series that grows at its end.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BlockSums {
    channels: usize,
    /// Samples a block.
    block: usize,
    /// One value a channel.
    reference: Vec<f32>,
    /// Blocks one after the other; the last may be shorter.
    sums: Vec<f32>,
}

impl BlockSums {
    /// The blocks of `block` samples of a recording, interleaved samples.
    pub fn new(channels: usize, block: usize, samples: &[f32]) -> Self {
        let mut growing = GrowingBlocks::new(channels, block);
        let mut sums = Vec::new();
        growing.extend(samples, |of_block| sums.extend_from_slice(of_block));
        sums.extend(growing.open());
        Self { channels, block, reference: growing.reference(), sums }
    }

    /// What powers are taken from, channel by channel.
    pub fn reference(&self) -> &[f32] {
        &self.reference
    }

    /// Samples a block.
    pub fn block(&self) -> usize {
        self.block
    }

    /// Number of blocks.
    pub fn blocks(&self) -> usize {
        self.sums.len() / width(self.channels)
    }

    /// Whether no channel ever moves.
    pub fn is_constant(&self) -> bool {
        self.window(0..self.blocks()).is_constant()
    }

    /// What a run of blocks adds up to.
    pub fn window(&self, blocks: Range<usize>) -> WindowSums {
        let mut sums = WindowSums::new(self.channels);
        self.add_to(&mut sums, blocks);
        sums
    }

    /// Adds a run of blocks to those before it.
    pub fn add_to(&self, sums: &mut WindowSums, blocks: Range<usize>) {
        let width = width(self.channels);
        for of_block in self.sums[blocks.start * width..blocks.end * width].chunks_exact(width) {
            sums.add(of_block);
        }
    }
}

/// Blocks in the making.
#[derive(Clone, Debug)]
pub struct GrowingBlocks {
    channels: usize,
    block: usize,
    /// Known once a block is complete.
    reference: Option<Vec<f32>>,
    /// The last samples of earlier blocks, as many as the longest lag or fewer.
    before: Vec<f32>,
    /// Samples of the block that is not complete yet.
    pending: Vec<f32>,
}

impl GrowingBlocks {
    /// Before the first sample.
    pub fn new(channels: usize, block: usize) -> Self {
        Self { channels, block, reference: None, before: Vec::new(), pending: Vec::new() }
    }

    /// Takes the next samples, interleaved; `each` gets the sums of each block that they complete.
    pub fn extend(&mut self, samples: &[f32], mut each: impl FnMut(&[f32])) {
        self.pending.extend_from_slice(samples);
        let size = self.block * self.channels;
        let whole = self.pending.len() / size * size;
        let pending = std::mem::take(&mut self.pending);
        for block in pending[..whole].chunks_exact(size) {
            let reference =
                self.reference.get_or_insert_with(|| means(block, self.channels)).clone();
            each(&block_sums(block, &self.before, &reference, self.channels));
            let kept = block.len().min((LAGS - 1) * self.channels);
            self.before.extend_from_slice(&block[block.len() - kept..]);
            let surplus = self.before.len().saturating_sub((LAGS - 1) * self.channels);
            self.before.drain(..surplus);
        }
        self.pending = pending[whole..].to_vec();
    }

    /// The sums of the block that is not complete; empty if it has no sample.
    pub fn open(&self) -> Vec<f32> {
        if self.pending.is_empty() {
            return Vec::new();
        }
        block_sums(&self.pending, &self.before, &self.reference(), self.channels)
    }

    /// What powers are taken from: the means of the first block, as far as it came.
    pub fn reference(&self) -> Vec<f32> {
        self.reference.clone().unwrap_or_else(|| means(&self.pending, self.channels))
    }
}

fn means(samples: &[f32], channels: usize) -> Vec<f32> {
    let frames = (samples.len() / channels).max(1) as f64;
    let mean = |c: usize| {
        let sum: f64 = samples.iter().skip(c).step_by(channels).map(|&x| f64::from(x)).sum();
        (sum / frames) as f32
    };
    (0..channels).map(mean).collect()
}

fn block_sums(samples: &[f32], before: &[f32], reference: &[f32], channels: usize) -> Vec<f32> {
    let mut sums = vec![0.0; width(channels)];
    let frames = samples.len() / channels;
    sums[0] = frames as f32;
    let past = before.len() / channels;
    let centred = |samples: &[f32], c: usize| -> Vec<f32> {
        let of_channel = samples.iter().skip(c).step_by(channels);
        of_channel.map(|x| x - reference[c]).collect()
    };
    // Each channel with the samples before it, so that products reach back.
    let all: Vec<Vec<f32>> =
        (0..channels).map(|c| [centred(before, c), centred(samples, c)].concat()).collect();
    for (c, of_channel) in all.iter().enumerate() {
        let [sum, cubes, fourths, magnitude, root, crossings] = powers(&of_channel[past..]);
        let of_block = &of_channel[past..];
        let extreme = |f: fn(f32, f32) -> f32| of_block.iter().copied().reduce(f).unwrap_or(0.0);
        for (of, value) in [
            (Of::Sum, sum),
            (Of::Cubes, cubes),
            (Of::Fourths, fourths),
            (Of::SquaredLevel, sum * sum / frames.max(1) as f64),
            (Of::Magnitude, magnitude),
            (Of::Root, root),
            (Of::Crossings, crossings),
            (Of::Least, f64::from(extreme(f32::min))),
            (Of::Greatest, f64::from(extreme(f32::max))),
        ] {
            sums[place(of, c)] = value as f32;
        }
    }
    for lag in 0..LAGS {
        let at = products(channels, lag);
        // The first samples of a recording have none before them.
        let from = past.max(lag);
        for (i, now) in all.iter().enumerate() {
            for (j, earlier) in all.iter().enumerate() {
                if from < now.len() {
                    let end = earlier.len() - lag;
                    sums[at + i * channels + j] =
                        dot(&now[from..], &earlier[from - lag..end]) as f32;
                }
            }
        }
    }
    // Powers of samples far beyond full scale must not become infinite.
    sums.iter_mut().for_each(|x| *x = x.clamp(-f32::MAX, f32::MAX));
    sums
}

/// Lanes of the sums below: additions need not wait for each other.
const LANES: usize = 8;

fn dot(a: &[f32], b: &[f32]) -> f64 {
    let mut lanes = [0f64; LANES];
    for (a, b) in a.chunks(LANES).zip(b.chunks(LANES)) {
        for ((lane, &a), &b) in lanes.iter_mut().zip(a).zip(b) {
            *lane += f64::from(a) * f64::from(b);
        }
    }
    lanes.iter().sum()
}

/// Σ x, Σ x³, Σ x⁴, Σ |x − m|, Σ √|x − m| and the crossings of m, the mean.
fn powers(x: &[f32]) -> [f64; 6] {
    let (mut sum, mut cubes, mut fourths) = ([0f64; LANES], [0f64; LANES], [0f64; LANES]);
    for chunk in x.chunks(LANES) {
        for (lane, &x) in chunk.iter().enumerate() {
            let x = f64::from(x);
            sum[lane] += x;
            cubes[lane] += x * x * x;
            fourths[lane] += x * x * x * x;
        }
    }
    let total = sum.iter().sum::<f64>();
    let mean = (total / x.len().max(1) as f64) as f32;
    let (mut magnitude, mut root) = ([0f32; LANES], [0f32; LANES]);
    for chunk in x.chunks(LANES) {
        for (lane, &x) in chunk.iter().enumerate() {
            let distance = (x - mean).abs();
            magnitude[lane] += distance;
            root[lane] += distance.sqrt();
        }
    }
    let crossings = x.windows(2).filter(|w| (w[0] < mean) != (w[1] < mean)).count();
    let add = |lanes: [f32; LANES]| lanes.iter().map(|&x| f64::from(x)).sum::<f64>();
    [total, cubes.iter().sum(), fourths.iter().sum(), add(magnitude), add(root), crossings as f64]
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Channels that swing about 0, 3, 6 …
    pub fn series(frames: usize, channels: usize) -> Vec<f32> {
        let value = |i: usize| {
            let (t, c) = ((i / channels) as f32, (i % channels) as f32);
            0.4 * (t * (0.31 + 0.2 * c)).sin() + 0.1 * ((t * t + c) * 0.77).cos() + 3.0 * c
        };
        (0..frames * channels).map(value).collect()
    }

    #[test]
    fn a_series_in_pieces_has_the_sums_of_the_series_at_once() {
        let samples = series(1000, 3);
        let whole = BlockSums::new(3, 48, &samples);
        let mut growing = GrowingBlocks::new(3, 48);
        let mut sums = Vec::new();
        for piece in samples.chunks(3 * 7) {
            growing.extend(piece, |of_block| sums.extend_from_slice(of_block));
        }
        sums.extend(growing.open());
        assert_eq!((sums, growing.reference()), (whole.sums, whole.reference));
    }
}
