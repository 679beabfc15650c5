//! Covariance of the features at two moments a lag apart, block by block: nearly all of the work.

use std::ops::Range;

use multiversion::multiversion;

use super::dot::{COLUMNS, F32Lanes, LANES, Length, ROWS, dots, total};
use super::features::Features;
use super::lags::Lag;

/// Frames that are gone through at once, all features of which stay in the first cache.
const TILE: usize = 512;
/// Fewest blocks that the trials are cut into together.
const BLOCKS: usize = 20;

/// Means of f(s)·f(s + t)ᵀ over the starts s of each block, for each lag t.
#[derive(Clone, Debug)]
pub struct Covariances {
    /// Number of features.
    pub features: usize,
    /// Number of blocks, at least 20.
    pub blocks: usize,
    /// For each lag: entry (i, j) of block b at (b·F + i)·F + j, i the earlier one's feature.
    pub lags: Vec<Vec<f64>>,
}

/// The covariance at lag 0 over all trials, F × F, and the covariances at each lag, ⌈20/Q⌉ blocks of
/// starts a trial.
pub fn covariances(features: &Features, lags: &[Lag]) -> (Vec<f64>, Covariances) {
    let count = features.columns.len();
    let parts = BLOCKS.div_ceil(features.trials);
    let blocks = features.trials * parts;
    let mut grid = Grid::new(features);
    let at_once = grid.at_once(features.trials);
    let mut means = Vec::with_capacity(lags.len());
    for lags in lags.chunk_by(|a, b| a.stride == b.stride) {
        while grid.stride < lags[0].stride {
            grid.coarsen();
        }
        let first = means.len();
        means.resize(first + lags.len(), vec![0.0; blocks * count * count]);
        for block in 0..blocks {
            let (trial, part) = (block / parts, block % parts);
            let entries = block * count * count..(block + 1) * count * count;
            let of_lags = lags.iter().zip(&mut means[first..]).map(|(lag, means)| {
                let lag = lag.frames / grid.stride;
                let starts = grid.frames - lag;
                let starts = part * starts / parts..(part + 1) * starts / parts;
                Block { lag, starts, mean: &mut means[entries.clone()] }
            });
            grid.fill(trial, &mut of_lags.collect::<Vec<_>>());
        }
    }
    (at_once, Covariances { features: count, blocks, lags: means })
}

/// One block at one lag.
struct Block<'a> {
    lag: usize,
    /// Of its trial.
    starts: Range<usize>,
    /// Where the mean of f(s)·f(s + lag)ᵀ goes; zeros before.
    mean: &'a mut [f64],
}

/// Every `stride`-th frame of each trial. Zeros at the end fill a register, as [`dots`] may read on.
struct Grid {
    stride: usize,
    frames: usize,
    columns: Vec<Vec<f32>>,
}

impl Grid {
    fn new(features: &Features) -> Self {
        let padded = |column: &Vec<f32>| [column.as_slice(), &[0.0; LANES]].concat();
        Self {
            stride: 1,
            frames: features.frames,
            columns: features.columns.iter().map(padded).collect(),
        }
    }

    fn coarsen(&mut self) {
        for column in &mut self.columns {
            let frames = column.len() - LANES;
            *column = (column[..frames].chunks_exact(self.frames))
                .flat_map(|trial| trial.iter().step_by(2))
                .chain(&[0.0; LANES])
                .copied()
                .collect();
        }
        self.stride *= 2;
        self.frames = self.frames.div_ceil(2);
    }

    /// Covariance at lag 0, over all trials.
    fn at_once(&self, trials: usize) -> Vec<f64> {
        let mut mean = vec![0.0; self.columns.len() * self.columns.len()];
        let starts = 0..trials * self.frames;
        self.fill(0, &mut [Block { lag: 0, starts, mean: &mut mean }]);
        mean
    }

    /// Fills blocks of one trial, a lag each: some frames at all lags and then the next ones, while
    /// they are in the cache.
    fn fill(&self, trial: usize, blocks: &mut [Block]) {
        let longest = blocks.iter().map(|block| block.starts.len()).max().unwrap_or(0);
        let mut lanes = vec![[0.0; LANES]; self.columns.len() * self.columns.len()];
        for from in (0..longest).step_by(TILE) {
            for Block { lag, starts, mean } in &mut *blocks {
                let frames = starts.len().min(from + TILE).saturating_sub(from);
                let earlier = trial * self.frames + starts.start + from;
                let at = (earlier, earlier + *lag);
                add_products(&self.columns, at, frames, &mut lanes, mean);
            }
        }
        for Block { starts, mean, .. } in blocks {
            let scale = 1.0 / starts.len().max(1) as f64;
            mean.iter_mut().for_each(|sum| *sum *= scale);
        }
    }
}

/// Adds Σ f(earlier + s)·f(later + s)ᵀ over s < frames; `lanes` is for the sums on the way.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn add_products(
    columns: &[Vec<f32>],
    (earlier, later): (usize, usize),
    frames: usize,
    lanes: &mut [F32Lanes],
    out: &mut [f64],
) {
    if frames == 0 {
        return;
    }
    let frames = &Length::of(frames);
    for first in (0..columns.len()).step_by(COLUMNS) {
        match &columns[first..] {
            [x, y, z, ..] => {
                let b = [&x[later..], &y[later..], &z[later..]];
                rows(columns, earlier, first, b, frames, lanes);
            }
            [x, y] => rows(columns, earlier, first, [&x[later..], &y[later..]], frames, lanes),
            [x] => rows(columns, earlier, first, [&x[later..]], frames, lanes),
            [] => {}
        }
    }
    for (sum, lanes) in out.iter_mut().zip(&*lanes) {
        *sum += f64::from(total(lanes));
    }
}

/// The sums of some columns, from column `first` on.
#[inline(always)]
fn rows<const B: usize>(
    columns: &[Vec<f32>],
    earlier: usize,
    first: usize,
    b: [&[f32]; B],
    frames: &Length,
    lanes: &mut [F32Lanes],
) {
    let count = columns.len();
    let (pairs, rest) = columns.as_chunks::<ROWS>();
    for (pair, [x, y]) in pairs.iter().enumerate() {
        let products = dots([&x[earlier..], &y[earlier..]], b, frames);
        for (i, products) in products.iter().enumerate() {
            let at = (pair * ROWS + i) * count + first;
            lanes[at..at + B].copy_from_slice(products);
        }
    }
    for x in rest {
        let [products] = dots([&x[earlier..]], b, frames);
        let at = (count - 1) * count + first;
        lanes[at..at + B].copy_from_slice(&products);
    }
}

#[cfg(test)]
mod tests {
    use super::super::features::features;
    use super::super::lags::lags;
    use super::super::samples::Samples;
    use super::*;

    /// One block's entry by its definition.
    fn plain(features: &Features, lag: Lag, block: usize, i: usize, j: usize) -> f64 {
        let parts = BLOCKS.div_ceil(features.trials);
        let (trial, part) = (block / parts, block % parts);
        let at = |f: usize, s: usize| f64::from(features.columns[f][trial * features.frames + s]);
        let starts = (features.frames.div_ceil(lag.stride)) - lag.frames / lag.stride;
        let (from, to) = (part * starts / parts, (part + 1) * starts / parts);
        let sum: f64 =
            (from..to).map(|s| at(i, s * lag.stride) * at(j, s * lag.stride + lag.frames)).sum();
        sum / (to - from) as f64
    }

    #[test]
    fn tiles_lanes_and_grids_give_what_the_definition_gives() {
        let mut rng = crate::seed::rng(1, &[b"covariance"]);
        for (trials, frames, channels) in [(3, 9001, 2), (21, 203, 1), (10, 12_000, 1)] {
            let channel = |_| crate::duration::simulate::ar1(trials * frames, 3.0, &mut rng);
            let channels = (0..channels).map(channel).collect();
            let features = features(&Samples { trials, frames, channels });
            let lags = lags(trials, frames).all;
            let (at_once, got) = covariances(&features, &lags);
            assert!(got.blocks >= BLOCKS && got.blocks.is_multiple_of(trials));
            let f = got.features;
            for (lag, values) in lags.iter().zip(&got.lags).step_by(7) {
                for block in [0, got.blocks - 1] {
                    for (i, j) in [(0, 0), (f - 1, 0), (1, f - 1)] {
                        let want = plain(&features, *lag, block, i, j);
                        let got = values[(block * f + i) * f + j];
                        assert!((got - want).abs() < 1e-5, "{lag:?} {block} {i} {j}: {got} {want}");
                    }
                }
            }
            let product = |(x, y): (&f32, &f32)| f64::from(*x) * f64::from(*y);
            for (i, j) in [(0, 0), (f - 1, 0), (1, f - 1)] {
                let (x, y) = (&features.columns[i], &features.columns[j]);
                let want = x.iter().zip(y).map(product).sum::<f64>() / x.len() as f64;
                assert!((at_once[i * f + j] - want).abs() < 1e-5, "{i} {j}");
            }
        }
    }
}
