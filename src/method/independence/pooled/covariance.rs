//! Covariance of features at two times a lag apart, in blocks: nearly all the work of `pooled`.

use std::ops::Range;

use multiversion::multiversion;
use ndarray::{Array2, Array3, ArrayViewMut2, Axis};

use super::features::Features;
use super::lags::Lag;

/// Number of f32 in one register of AVX-512, in two of AVX2, or in four of NEON.
const LANES: usize = 16;
type F32Lanes = [f32; LANES];

/// Number of rows of the product matrix that are computed at once.
const ROWS: usize = 2;
/// Number of columns that are computed at once. More would not fit the registers of AVX2 and NEON.
const COLUMNS: usize = 3;

/// Number of frames processed at once, so few that their features stay in the first-level cache.
const TILE: usize = 512;
/// Fewest blocks (parts of trials), counted over all trials.
const BLOCKS: usize = 20;

/// For each lag t, means of f(s)·f(s + t)ᵀ over the starts s of each block, for F features f. Entry
/// (b, i, j) is that of block b, with feature i the earlier. There are 20 blocks and one lag at least.
pub(super) type Covariances = Vec<Array3<f64>>;

/// Sum over the lags up to `longest` of weight · (mean covariance over blocks), shape F × F.
pub(super) fn weighted_sum(
    covariances: &Covariances,
    lags: &[Lag],
    longest: f64,
    weight: impl Fn(&Lag) -> f64,
) -> Array2<f64> {
    let (blocks, features, _) = covariances[0].dim();
    let mut sum = Array2::zeros((features, features));
    let within = lags.iter().take_while(|lag| lag.frames as f64 <= longest);
    for (lag, of_lag) in within.zip(covariances) {
        sum.scaled_add(weight(lag) / blocks as f64, &of_lag.sum_axis(Axis(0)));
    }
    sum
}

/// Covariance of features at lag 0, over all Q trials, and at each lag, in ⌈20/Q⌉ blocks a trial.
pub(super) fn covariances(features: &Features, lags: &[Lag]) -> (Array2<f64>, Covariances) {
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
        means.resize(first + lags.len(), Array3::zeros((blocks, count, count)));
        for block in 0..blocks {
            let (trial, part) = (block / parts, block % parts);
            let of_lags = lags.iter().zip(&mut means[first..]).map(|(lag, means)| {
                let lag = lag.frames / grid.stride;
                let starts = grid.frames - lag;
                let starts = part * starts / parts..(part + 1) * starts / parts;
                Block { lag, starts, mean: means.index_axis_mut(Axis(0), block) }
            });
            grid.fill(trial, &mut of_lags.collect::<Vec<_>>());
        }
    }
    (at_once, means)
}

/// The starts of one block at one lag, and a place for their mean covariance.
struct Block<'a> {
    lag: usize,
    /// Indices of the block's starts in the trial's [`Grid`].
    starts: Range<usize>,
    /// Receives the mean of f(s)·f(s + lag)ᵀ; must hold zeros before.
    mean: ArrayViewMut2<'a, f64>,
}

/// Every `stride`-th frame of each trial, padded with [`LANES`] zeros that [`dots`] may read.
struct Grid {
    stride: usize,
    frames: usize,
    columns: Vec<Vec<f32>>,
}

impl Grid {
    fn new(features: &Features) -> Self {
        let padded = |column: &Vec<f32>| [column.as_slice(), &[0.0; LANES]].concat();
        let columns = features.columns.iter().map(padded).collect();
        Self { stride: 1, frames: features.frames, columns }
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

    fn at_once(&self, trials: usize) -> Array2<f64> {
        let mut mean = Array2::zeros((self.columns.len(), self.columns.len()));
        let starts = 0..trials * self.frames;
        self.fill(0, &mut [Block { lag: 0, starts, mean: mean.view_mut() }]);
        mean
    }

    /// Fills blocks of one trial, each of another lag, all for a few frames while these are in the cache.
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
            *mean *= scale;
        }
    }
}

/// Adds Σ f(earlier + s)·f(later + s)ᵀ over s < frames to `out`; `lanes` is scratch space.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn add_products(
    columns: &[Vec<f32>],
    (earlier, later): (usize, usize),
    frames: usize,
    lanes: &mut [F32Lanes],
    out: &mut ArrayViewMut2<'_, f64>,
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

/// Computes the product sums of all features with `B` features, from feature `first` on.
#[allow(clippy::manual_memcpy)] // A call of `copy_from_slice` is not always inlined here.
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
            for j in 0..B {
                lanes[at + j] = products[j];
            }
        }
    }
    for x in rest {
        let [products] = dots([&x[earlier..]], b, frames);
        let at = (count - 1) * count + first;
        for j in 0..B {
            lanes[at + j] = products[j];
        }
    }
}

/// The number of values in a sum, at least one.
#[derive(Clone, Copy)]
struct Length {
    /// Number of whole registers before the last register.
    last: usize,
    /// For each value of the last register, 1 if it counts and 0 if not.
    counts: F32Lanes,
}

impl Length {
    #[inline(always)]
    fn of(values: usize) -> Self {
        let last = (values - 1) / LANES;
        let mut counts = [0.0; LANES];
        counts[..values - last * LANES].fill(1.0);
        Self { last, counts }
    }
}

/// Σ a·b, lane by lane, for each slice in `a` and each in `b`, so that a value loaded once serves
/// several products. Reads whole registers, so no slice may end before the last one, but values beyond
/// the length do not count.
#[inline(always)]
fn dots<const A: usize, const B: usize>(
    a: [&[f32]; A],
    b: [&[f32]; B],
    Length { last, counts }: &Length,
) -> [[F32Lanes; B]; A] {
    let (last, a, b) = (*last, registers(a), registers(b));
    let mut sums = [[[0.0f32; LANES]; B]; A];
    for at in 0..last {
        for i in 0..A {
            for j in 0..B {
                sums[i][j] = plus_product(sums[i][j], &a[i][at], &b[j][at]);
            }
        }
    }
    for i in 0..A {
        let counted = plus_product([0.0; LANES], &a[i][last], counts);
        for j in 0..B {
            sums[i][j] = plus_product(sums[i][j], &counted, &b[j][last]);
        }
    }
    sums
}

// The inner loops use an index: `map` on arrays is not always inlined into a function with a
// `target_feature`, such as AVX2, that the rest of the program lacks.

#[inline(always)]
fn registers<const N: usize>(columns: [&[f32]; N]) -> [&[F32Lanes]; N] {
    let mut registers: [&[F32Lanes]; N] = [&[]; N];
    for i in 0..N {
        registers[i] = columns[i].as_chunks().0;
    }
    registers
}

/// Multiplies and adds with two roundings, not fused, so that every machine gives the same bits.
#[inline(always)]
fn plus_product(mut sum: F32Lanes, a: &F32Lanes, b: &F32Lanes) -> F32Lanes {
    for lane in 0..LANES {
        sum[lane] += a[lane] * b[lane];
    }
    sum
}

/// The sum of the lanes, by halves, so that each step is one addition of registers.
#[inline(always)]
fn total(sum: &F32Lanes) -> f32 {
    let (mut eight, mut four) = ([0.0; 8], [0.0; 4]);
    for lane in 0..8 {
        eight[lane] = sum[lane] + sum[lane + 8];
    }
    for lane in 0..4 {
        four[lane] = eight[lane] + eight[lane + 4];
    }
    (four[0] + four[2]) + (four[1] + four[3])
}

// Slow changes move a trial's mean. Subtracting that mean therefore lowers the covariance at every lag
// by the mean's variance V, and makes long correlations look short.

/// Variance of the trial mean, F × F:
///
/// V = [Γ(0) + Σ_{t≤M} w·(1 − t/L)·(G(t) + G(t)ᵀ)] / (L − 1 − 2·Σ_{t≤M} w·(1 − t/L)),
///
/// where G is the mean covariance at lag t of the features, which are centred in each trial, and w is
/// the number of lags that t represents. The denominator is smaller than L because G = Γ − V.
pub(super) fn mean_variance(
    at_once: &Array2<f64>,
    covariances: &Covariances,
    lags: &[Lag],
    frames: usize,
    longest: f64,
) -> Array2<f64> {
    let length = frames as f64;
    let weight = |lag: &Lag| lag.weight * (1.0 - lag.frames as f64 / length);
    let taken: f64 = lags.iter().take_while(|lag| lag.frames as f64 <= longest).map(weight).sum();
    let one_way = weighted_sum(covariances, lags, longest, weight);
    (at_once + &one_way + one_way.t()) / (length - 1.0 - 2.0 * taken)
}

/// Correlations without centring: (C + V)/√((1 + Vᵢᵢ)(1 + Vⱼⱼ)) for V = `mean_variance`.
pub(super) fn corrected(covariances: &Covariances, mean_variance: &Array2<f64>) -> Covariances {
    let scale = mean_variance.diag().mapv(|v| (1.0 + v).sqrt().recip());
    let scale = &scale.view().insert_axis(Axis(1)) * &scale;
    covariances.iter().map(|of_lag| (of_lag + mean_variance) * &scale).collect()
}

#[cfg(test)]
mod tests {
    use super::super::features::{Samples, features};
    use super::super::lags::lags;
    use super::*;

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
            let channel = |_| crate::independence::simulate::ar1(trials * frames, 3.0, &mut rng);
            let channels = (0..channels).map(channel).collect();
            let features = features(&Samples { trials, frames, channels });
            let lags = lags(trials, frames).all;
            let (at_once, got) = covariances(&features, &lags);
            let (blocks, f, _) = got[0].dim();
            assert!(blocks >= BLOCKS && blocks.is_multiple_of(trials));
            for (lag, values) in lags.iter().zip(&got).step_by(7) {
                for block in [0, blocks - 1] {
                    for (i, j) in [(0, 0), (f - 1, 0), (1, f - 1)] {
                        let want = plain(&features, *lag, block, i, j);
                        let got = values[[block, i, j]];
                        assert!((got - want).abs() < 1e-5, "{lag:?} {block} {i} {j}: {got} {want}");
                    }
                }
            }
            let product = |(x, y): (&f32, &f32)| f64::from(*x) * f64::from(*y);
            for (i, j) in [(0, 0), (f - 1, 0), (1, f - 1)] {
                let (x, y) = (&features.columns[i], &features.columns[j]);
                let want = x.iter().zip(y).map(product).sum::<f64>() / x.len() as f64;
                assert!((at_once[[i, j]] - want).abs() < 1e-5, "{i} {j}");
            }
        }
    }

    /// Covariance of a centred AR(1) process of correlation time τ, and the variance V of a trial
    /// mean.
    fn centred_ar1(tau: f64, frames: usize, lags: &[Lag]) -> (Covariances, f64) {
        let length = frames as f64;
        let rho = |t: f64| (-t / tau).exp();
        let v = (1..frames).map(|t| 2.0 * (1.0 - t as f64 / length) * rho(t as f64)).sum::<f64>();
        let v = (1.0 + v) / length;
        let value = |lag: &Lag| (rho(lag.frames as f64) - v) / (1.0 - v);
        (lags.iter().map(|lag| Array3::from_elem((1, 1, 1), value(lag))).collect(), v)
    }

    #[test]
    fn the_correlation_of_a_slow_process_is_restored() {
        let (frames, tau) = (20_000, 600.0);
        let lags = super::super::lags::lags(1, frames).all;
        let (centred, v) = centred_ar1(tau, frames, &lags);
        assert!(v > 0.05);
        let got = mean_variance(&Array2::eye(1), &centred, &lags, frames, 5000.0);
        let restored = corrected(&centred, &got);
        for (lag, value) in lags.iter().zip(&restored) {
            let want = (-(lag.frames as f64) / tau).exp();
            assert!((value[[0, 0, 0]] - want).abs() < 0.01, "{}: {value} {want}", lag.frames);
        }
    }

    fn column(seed: usize) -> Vec<f32> {
        (0..200).map(|i| ((i * 37 + seed * 101) % 89) as f32 / 89.0 - 0.5).collect()
    }

    #[test]
    fn products_made_at_once_are_those_made_one_by_one_and_end_where_they_should() {
        let columns = [0, 1, 2, 3, 4].map(column);
        let [a, b, c, d, e] = columns.each_ref().map(Vec::as_slice);
        for length in [1, 2, 15, 16, 17, 31, 32, 64, 90, 176] {
            let got = dots([a, b], [&c[7..], &d[7..], &e[7..]], &Length::of(length));
            for (x, row) in [a, b].iter().zip(&got) {
                for (y, lanes) in [c, d, e].iter().zip(row) {
                    let product = |(x, y): (&f32, &f32)| f64::from(*x) * f64::from(*y);
                    let want: f64 = x[..length].iter().zip(&y[7..]).map(product).sum();
                    assert!((f64::from(total(lanes)) - want).abs() < 1e-4, "{length}");
                }
            }
        }
    }
}
