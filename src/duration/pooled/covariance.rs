//! Covariance of the features at two moments a lag apart, block by block: nearly all of the work.

use multiversion::multiversion;

use super::dot::dot;
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

/// The covariances at each lag, ⌈20/Q⌉ blocks of starts a trial.
pub fn covariances(features: &Features, lags: &[Lag]) -> Covariances {
    let count = features.columns.len();
    let blocks_a_trial = BLOCKS.div_ceil(features.trials);
    let mut grid = Grid::new(features);
    let lags = lags
        .iter()
        .map(|lag| {
            while grid.stride < lag.stride {
                grid.coarsen();
            }
            let lag_on_grid = lag.frames / grid.stride;
            let starts = grid.frames - lag_on_grid;
            let mut out = vec![0.0; features.trials * blocks_a_trial * count * count];
            for (b, block) in out.chunks_exact_mut(count * count).enumerate() {
                let (trial, part) = (b / blocks_a_trial, b % blocks_a_trial);
                let from = part * starts / blocks_a_trial;
                let to = (part + 1) * starts / blocks_a_trial;
                let columns: Vec<&[f32]> = grid.trial(trial).collect();
                add_products(&columns, from, to, lag_on_grid, block);
                let scale = 1.0 / (to - from).max(1) as f64;
                block.iter_mut().for_each(|sum| *sum *= scale);
            }
            out
        })
        .collect();
    Covariances { features: count, blocks: features.trials * blocks_a_trial, lags }
}

/// Every `stride`-th frame of each trial.
struct Grid {
    stride: usize,
    frames: usize,
    columns: Vec<Vec<f32>>,
}

impl Grid {
    fn new(features: &Features) -> Self {
        Self { stride: 1, frames: features.frames, columns: features.columns.clone() }
    }

    fn coarsen(&mut self) {
        for column in &mut self.columns {
            *column = (column.chunks_exact(self.frames))
                .flat_map(|trial| trial.iter().step_by(2))
                .copied()
                .collect();
        }
        self.stride *= 2;
        self.frames = self.frames.div_ceil(2);
    }

    fn trial(&self, trial: usize) -> impl Iterator<Item = &[f32]> {
        self.columns.iter().map(move |c| &c[trial * self.frames..(trial + 1) * self.frames])
    }
}

/// Adds Σ f(s)·f(s + lag)ᵀ over from ≤ s < to.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn add_products(columns: &[&[f32]], from: usize, to: usize, lag: usize, out: &mut [f64]) {
    let count = columns.len();
    for start in (from..to).step_by(TILE) {
        let end = to.min(start + TILE);
        for (i, a) in columns.iter().enumerate() {
            let a = &a[start..end];
            let row = &mut out[i * count..(i + 1) * count];
            for (sum, b) in row.iter_mut().zip(columns) {
                *sum += f64::from(dot(a, &b[start + lag..end + lag]));
            }
        }
    }
}

/// Covariance at lag 0, over all trials.
pub fn covariance_at_once(features: &Features) -> Vec<f64> {
    let columns: Vec<&[f32]> = features.columns.iter().map(Vec::as_slice).collect();
    let count = columns.len();
    let frames = features.trials * features.frames;
    let mut out = vec![0.0; count * count];
    add_products(&columns, 0, frames, 0, &mut out);
    out.iter_mut().for_each(|sum| *sum /= frames as f64);
    out
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
            let got = covariances(&features, &lags);
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
        }
    }
}
