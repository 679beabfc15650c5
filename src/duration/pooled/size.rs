//! Size of the dependence at a lag: the squared Hilbert–Schmidt norm of the cross-covariance (HSIC of
//! a kernel of finite rank), without the bias that comes from squaring noise.

use std::ops::Range;

use super::covariance::Covariances;
use super::features::Features;
use super::lags::{Bin, Lag};

/// Size of the dependence over the lags of one bin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Size {
    /// Unbiased estimate of ‖C‖², for the covariance C of the features; noise can make it negative.
    pub value: f64,
    /// Standard error of `value`, by the block jackknife (B. Efron, "The jackknife, the bootstrap and
    /// other resampling plans", SIAM 1982, chapter 3).
    pub error: f64,
    /// Largest standard error of an entry of the covariance C.
    pub entry_error: f64,
}

/// ‖C‖² for a Gaussian process with correlation ρ: the k-th Hermite feature has correlation ρᵏ.
pub fn of_correlation(rho: f64) -> f64 {
    let square = rho * rho;
    square + square * square + square * square * square
}

/// The correlation of a Gaussian process with ‖C‖² = `size`; 0 for a negative size.
pub fn as_correlation(size: f64) -> f64 {
    let (mut low, mut high) = (0.0, 1.0);
    while high - low > 1e-9 {
        let middle = 0.5 * (low + high);
        if of_correlation(middle) < size {
            low = middle;
        } else {
            high = middle;
        }
    }
    high
}

/// Size of the dependence in a bin, of the channel with features `later` on the channel `earlier`:
/// U = (‖Σ_b C_b‖² − Σ_b ‖C_b‖²)/(B(B − 1)) for covariances C_b of B blocks, averaged over lags.
pub fn size(
    covariances: &Covariances,
    bin: &Bin,
    earlier: &Range<usize>,
    later: &Range<usize>,
) -> Size {
    let (count, blocks) = (covariances.features, covariances.blocks);
    let n = blocks as f64;
    let share = 1.0 / bin.lags.len() as f64;
    let entries = earlier.len() * later.len();
    let mut value = 0.0;
    // For each block: U without this block, and the means of its covariances over the bin's lags.
    let mut without = vec![0.0; blocks];
    let mut of_block = vec![0.0; blocks * entries];
    // The covariances at one lag, block after block, and their sums over the blocks.
    let mut of_lag = Vec::with_capacity(blocks * entries);
    let mut total = vec![0.0; entries];
    for lag in &covariances.lags[bin.lags.clone()] {
        of_lag.clear();
        for block in lag.chunks_exact(count * count) {
            for row in block.chunks_exact(count).take(earlier.end).skip(earlier.start) {
                of_lag.extend_from_slice(&row[later.clone()]);
            }
        }
        total.fill(0.0);
        for block in of_lag.chunks_exact(entries) {
            total.iter_mut().zip(block).for_each(|(total, c)| *total += c);
        }
        of_block.iter_mut().zip(&of_lag).for_each(|(mean, c)| *mean += share * c);
        let squares: f64 = of_lag.chunks_exact(entries).map(square).sum();
        let whole = square(&total);
        value += share * (whole - squares) / (n * (n - 1.0));
        for (without, block) in without.iter_mut().zip(of_lag.chunks_exact(entries)) {
            let product: f64 = total.iter().zip(block).map(|(total, c)| total * c).sum();
            // Numerator of U without block b: ‖Σ − C_b‖² − (Σ‖C‖² − ‖C_b‖²)
            let rest = whole - 2.0 * product - squares + 2.0 * square(block);
            *without += share * rest / ((n - 1.0) * (n - 2.0));
        }
    }
    let of_entry = |e: usize| of_block.iter().skip(e).step_by(entries).copied();
    let entry_error = (0..entries).map(|e| deviation(of_entry(e)) / n.sqrt()).fold(0.0, f64::max);
    let error = deviation(without.iter().copied()) * (n - 1.0) / n.sqrt();
    Size { value, error, entry_error }
}

fn square(entries: &[f64]) -> f64 {
    entries.iter().map(|c| c * c).sum()
}

/// Sample standard deviation.
fn deviation(values: impl ExactSizeIterator<Item = f64> + Clone) -> f64 {
    let n = values.len() as f64;
    let mean = values.clone().sum::<f64>() / n;
    (values.map(|x| (x - mean).powi(2)).sum::<f64>() / (n - 1.0)).sqrt()
}

/// Largest variance inflation over all channels, at least 1: (variance of a mean of many samples)/(the
/// same for independent samples). It is 2τ for an Ornstein–Uhlenbeck process.
///
/// For one channel it is the largest eigenvalue of I + Σ_{t≤M} w·(Γ(t) + Γ(t)ᵀ), where Γ is the
/// corrected covariance of the channel's features, and w is the number of lags that t stands for.
pub fn inflation(
    covariances: &Covariances,
    features: &Features,
    lags: &[Lag],
    longest: f64,
) -> f64 {
    let count = covariances.features;
    let sum = covariances.weighted_sum(lags, longest, |lag| lag.weight);
    (features.channels.iter())
        .map(|channel| {
            let size = channel.len();
            let matrix: Vec<f64> = (0..size * size)
                .map(|at| {
                    let (i, j) = (channel.start + at / size, channel.start + at % size);
                    f64::from(u8::from(i == j)) + sum[i * count + j] + sum[j * count + i]
                })
                .collect();
            largest_eigenvalue(&matrix, size)
        })
        .fold(1.0, f64::max)
}

/// Largest eigenvalue of a small symmetric matrix, by power iteration. The matrix norm is added to all
/// eigenvalues, so that the largest is also the largest in magnitude.
fn largest_eigenvalue(matrix: &[f64], size: usize) -> f64 {
    let shift = matrix.iter().map(|x| x * x).sum::<f64>().sqrt();
    let mut vector: Vec<f64> = (0..size).map(|i| 1.0 + 0.1 * i as f64).collect();
    let mut value = 0.0;
    for _ in 0..500 {
        let next: Vec<f64> = (0..size)
            .map(|i| {
                let row = &matrix[i * size..(i + 1) * size];
                shift * vector[i] + row.iter().zip(&vector).map(|(a, b)| a * b).sum::<f64>()
            })
            .collect();
        let norm = next.iter().map(|x| x * x).sum::<f64>().sqrt();
        if norm == 0.0 {
            return 0.0;
        }
        value = norm - shift;
        vector = next.into_iter().map(|x| x / norm).collect();
    }
    value
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::duration::simulate::normal;

    /// Blocks of a 2 × 2 covariance: `truth` plus noise.
    fn blocks(truth: [f64; 4], noise: f64, count: usize, seed: u64) -> Covariances {
        let mut rng = crate::seed::rng(seed, &[b"size"]);
        let lag = (0..count).flat_map(|_| truth.map(|c| c + noise * normal(&mut rng))).collect();
        Covariances { features: 2, blocks: count, lags: vec![lag] }
    }

    fn size_of(covariances: &Covariances) -> Size {
        let bin = &super::super::lags::lags(1, 4).bins[0];
        size(covariances, bin, &(0..2), &(0..2))
    }

    #[test]
    fn the_size_is_the_mean_product_of_two_different_blocks() {
        let c = blocks([0.3, 0.1, 0.0, 0.2], 0.2, 20, 1);
        let got = size_of(&c);
        let (mut sum, mut pairs) = (0.0, 0.0);
        let block = |b: usize| &c.lags[0][4 * b..4 * b + 4];
        for a in 0..20 {
            for b in (0..20).filter(|&b| b != a) {
                sum += block(a).iter().zip(block(b)).map(|(x, y)| x * y).sum::<f64>();
                pairs += 1.0;
            }
        }
        assert!((got.value - sum / pairs).abs() < 1e-12);
    }

    #[test]
    fn noise_has_no_size_and_the_error_covers_the_truth() {
        let mut zero = 0.0;
        let mut covered = 0;
        for seed in 0..400 {
            zero += size_of(&blocks([0.0; 4], 0.3, 20, seed)).value;
            let got = size_of(&blocks([0.2, 0.0, 0.0, 0.1], 0.1, 20, seed));
            covered += usize::from((got.value - 0.05).abs() < 2.0 * got.error);
        }
        assert!((zero / 400.0).abs() < 0.003, "{zero}");
        assert!((360..=396).contains(&covered), "{covered}");
    }

    #[test]
    fn correlation_and_size_are_inverse() {
        assert!((of_correlation(0.1) - 0.010_101).abs() < 1e-12);
        for rho in [0.01, 0.1, 0.5, 0.9] {
            assert!((as_correlation(of_correlation(rho)) - rho).abs() < 1e-8);
        }
        assert!(as_correlation(-1.0) < 1e-8);
    }

    #[test]
    fn the_largest_eigenvalue_is_found_also_beside_a_larger_negative_one() {
        assert!((largest_eigenvalue(&[2.0, 1.0, 1.0, 2.0], 2) - 3.0).abs() < 1e-9);
        assert!((largest_eigenvalue(&[1.0, 0.0, 0.0, -9.0], 2) - 1.0).abs() < 1e-9);
        assert_eq!(largest_eigenvalue(&[4.0], 1), 4.0);
    }
}
