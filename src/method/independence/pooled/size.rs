//! Size of the dependence at a lag: the squared Hilbert–Schmidt norm of the cross-covariance (HSIC of
//! a kernel of finite rank), without the bias that comes from squaring noise.

use std::ops::Range;

use ndarray::{Array1, Array2, Array3, Axis, s};

use super::covariance::{Covariances, weighted_sum};
use super::features::Features;
use super::lags::{Bin, Lag};

/// Size of the dependence over the lags of one bin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Size {
    /// Unbiased estimate of ‖C‖², for the covariance C of the features; noise can make it negative.
    pub value: f64,
    /// Standard error of `value`, by the block jackknife (B. Efron, "The jackknife, the bootstrap and
    /// other resampling plans", SIAM 1982, chapter 3).
    pub error: f64,
    /// Largest standard error of an entry of the covariance C.
    pub entry_error: f64,
}

/// ‖C‖² for a Gaussian process with correlation ρ: the k-th Hermite feature has correlation ρᵏ.
pub(super) fn of_correlation(rho: f64) -> f64 {
    let square = rho * rho;
    square + square * square + square * square * square
}

/// The correlation of a Gaussian process with ‖C‖² = `size`; 0 for a negative size.
pub(super) fn as_correlation(size: f64) -> f64 {
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
pub(super) fn size(
    covariances: &Covariances,
    bin: &Bin,
    earlier: &Range<usize>,
    later: &Range<usize>,
) -> Size {
    let blocks = covariances[0].len_of(Axis(0));
    let (n, share) = (blocks as f64, 1.0 / bin.lags.len() as f64);
    let mut value = 0.0;
    // For each block: U without this block, and the means of its covariances over the bin's lags.
    let mut without = Array1::zeros(blocks);
    let mut of_block = Array3::zeros((blocks, earlier.len(), later.len()));
    for lag in &covariances[bin.lags.clone()] {
        let of_lag = lag.slice(s![.., earlier.clone(), later.clone()]);
        of_block.scaled_add(share, &of_lag);
        let total = of_lag.sum_axis(Axis(0));
        let products = by_block(&of_lag * &total);
        let squares = by_block(&of_lag * &of_lag);
        let difference = total.pow2().sum() - squares.sum();
        value += share * difference / (n * (n - 1.0));
        // Numerator of U without block b: ‖Σ − C_b‖² − (Σ‖C‖² − ‖C_b‖²)
        let rest = 2.0 * (squares - products) + difference;
        without.scaled_add(share / ((n - 1.0) * (n - 2.0)), &rest);
    }
    let entry_error = of_block.std_axis(Axis(0), 1.0).fold(0.0, |a, b| f64::max(a, *b)) / n.sqrt();
    let error = without.std(1.0) * (n - 1.0) / n.sqrt();
    Size { value, error, entry_error }
}

/// The sum of the entries of each block.
fn by_block(blocks: Array3<f64>) -> Array1<f64> {
    blocks.sum_axis(Axis(2)).sum_axis(Axis(1))
}

/// Largest variance inflation over all channels, at least 1: (variance of a mean of many samples)/(the
/// same for independent samples). It is 2τ for an Ornstein–Uhlenbeck process.
///
/// For one channel it is the largest eigenvalue of I + Σ_{t≤M} w·(Γ(t) + Γ(t)ᵀ), where Γ is the
/// corrected covariance of the channel's features, and w is the number of lags that t stands for.
pub(super) fn inflation(
    covariances: &Covariances,
    features: &Features,
    lags: &[Lag],
    longest: f64,
) -> f64 {
    let sum = weighted_sum(covariances, lags, longest, |lag| lag.weight);
    let both_ways = &sum + &sum.t();
    let of_channel = |channel: &Range<usize>| {
        let of_channel = both_ways.slice(s![channel.clone(), channel.clone()]);
        largest_eigenvalue(&(Array2::eye(channel.len()) + of_channel))
    };
    features.channels.iter().map(of_channel).fold(1.0, f64::max)
}

/// Largest eigenvalue of a small symmetric matrix, by power iteration. The matrix norm is added to all
/// eigenvalues, so that the largest is also the largest in magnitude.
fn largest_eigenvalue(matrix: &Array2<f64>) -> f64 {
    let shift = matrix.pow2().sum().sqrt();
    let mut vector = Array1::from_shape_fn(matrix.nrows(), |i| 1.0 + 0.1 * i as f64);
    let mut value = 0.0;
    for _ in 0..500 {
        let next = shift * &vector + matrix.dot(&vector);
        let norm = next.dot(&next).sqrt();
        if norm == 0.0 {
            return 0.0;
        }
        value = norm - shift;
        vector = next / norm;
    }
    value
}

#[cfg(test)]
mod tests {
    use ndarray::array;

    use super::*;
    use crate::independence::simulate::normal;

    /// Blocks of a 2 × 2 covariance: `truth` plus noise.
    fn blocks(truth: [f64; 4], noise: f64, count: usize, seed: u64) -> Covariances {
        let mut rng = crate::seed::rng(seed, &[b"size"]);
        let lag = (0..count).flat_map(|_| truth.map(|c| c + noise * normal(&mut rng))).collect();
        vec![Array3::from_shape_vec((count, 2, 2), lag).unwrap()]
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
        let block = |b: usize| c[0].index_axis(Axis(0), b);
        for a in 0..20 {
            for b in (0..20).filter(|&b| b != a) {
                sum += (&block(a) * &block(b)).sum();
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
        assert!((largest_eigenvalue(&array![[2.0, 1.0], [1.0, 2.0]]) - 3.0).abs() < 1e-9);
        assert!((largest_eigenvalue(&array![[1.0, 0.0], [0.0, -9.0]]) - 1.0).abs() < 1e-9);
        assert_eq!(largest_eigenvalue(&array![[4.0]]), 4.0);
    }
}
