//! The two-sample test in f64: Gaussian kernel sums, the biased estimate of the squared maximum mean
//! discrepancy (MMD), its threshold κ and its p-value. Tests compare the fast sums with this module.
//!
//! Samples of two trials drawn at the same positions are pairs, not independent draws. So a
//! permutation may only swap the two samples of a pair. Let hᵢⱼ = k(yᵢ,yⱼ) + k(zᵢ,zⱼ) − k(yᵢ,zⱼ) −
//! k(zᵢ,yⱼ), and let sᵢ be −1 if pair i is swapped, otherwise 1. Then n²·MMD²_b = Σᵢⱼ sᵢ sⱼ hᵢⱼ, a
//! quadratic form in random signs.

use ndarray::{Array2, ArrayView1, ArrayView2};
use rand::{Rng, RngExt};

use super::hsic::{kernel, quantile};

/// Σᵢⱼ exp(−‖aᵢ − bⱼ‖² / (2σ²)) over samples of shape (n, channels) and (m, channels).
pub fn kernel_sum(a: ArrayView2<'_, f64>, b: ArrayView2<'_, f64>, sigma: f64) -> f64 {
    debug_assert_eq!(a.ncols(), b.ncols());
    let gamma = -0.5 / (sigma * sigma);
    let of_row = |x| b.rows().into_iter().map(|y| kernel(x, y, gamma)).sum::<f64>();
    a.rows().into_iter().map(of_row).sum()
}

/// Kernel sums over all pairs of samples: y with y, z with z, and y with z.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct CrossSums {
    pub yy: f64,
    pub zz: f64,
    pub yz: f64,
}

/// MMD²_b (Eq. 5) from its kernel sums over n samples of y and m samples of z. The biased estimate is
/// a squared norm, so a value that is negative from rounding becomes 0.
pub(crate) fn mmd2_from_sums(sums: CrossSums, n: usize, m: usize) -> f64 {
    let (n, m) = (n as f64, m as f64);
    (sums.yy / (n * n) + sums.zz / (m * m) - 2.0 * sums.yz / (n * m)).max(0.0)
}

/// MMD²_b of Eq. 5 (Gretton et al. 2012), for samples of shape (n, channels) and (m, channels).
pub fn mmd2_biased(y: ArrayView2<'_, f64>, z: ArrayView2<'_, f64>, sigma: f64) -> f64 {
    let sums = CrossSums {
        yy: kernel_sum(y, y, sigma),
        zz: kernel_sum(z, z, sigma),
        yz: kernel_sum(y, z, sigma),
    };
    mmd2_from_sums(sums, y.nrows(), z.nrows())
}

#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub(crate) struct PairTest {
    /// MMD²_b of the pairs as given, without swaps.
    pub mmd2: f64,
    /// Threshold: the (1 − α) quantile of MMD²_b over random swaps.
    pub kappa: f64,
    /// Share of arrangements (all random ones and the given one) whose MMD²_b is at least `mmd2`.
    pub p_value: f64,
}

/// Tests whether paired samples y and z of shape (n, channels) have the same distribution. Swaps
/// the samples of random pairs `permutations` times. `alpha` is the significance level.
///
/// # Panics
/// If `y` and `z` differ in shape, or `permutations` is 0.
pub(crate) fn pair_test(
    y: ArrayView2<'_, f64>,
    z: ArrayView2<'_, f64>,
    sigma: f64,
    permutations: usize,
    alpha: f64,
    rng: &mut impl Rng,
) -> PairTest {
    assert_eq!(y.dim(), z.dim(), "pairs have two sides");
    assert!(permutations > 0, "at least one permutation");
    let n = y.nrows();
    let gamma = -0.5 / (sigma * sigma);
    let k = |a, b| kernel(a, b, gamma);
    let h = Array2::from_shape_fn((n, n), |(i, j)| {
        let ([yi, zi], [yj, zj]) = ([y.row(i), z.row(i)], [y.row(j), z.row(j)]);
        k(yi, yj) + k(zi, zj) - k(yi, zj) - k(zi, yj)
    });
    let form = |signs: Vec<f64>| {
        let of_row =
            |row: ArrayView1<'_, f64>| row.iter().zip(&signs).map(|(x, s)| x * s).sum::<f64>();
        let rows = h.rows().into_iter().zip(&signs).map(|(row, sign)| sign * of_row(row));
        (rows.sum::<f64>() / (n * n) as f64).max(0.0)
    };
    let mmd2 = form(vec![1.0; n]);
    let mut sign = |_| if rng.random::<bool>() { 1.0 } else { -1.0 };
    let swapped: Vec<f64> =
        (0..permutations).map(|_| form((0..n).map(&mut sign).collect())).collect();
    let reached = swapped.iter().filter(|&&x| x >= mmd2).count();
    PairTest {
        mmd2,
        kappa: quantile(swapped, alpha),
        p_value: (reached + 1) as f64 / (permutations + 1) as f64,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::seed::rng;

    fn normal(n: usize, shift: f64, key: &str) -> Array2<f64> {
        let mut rng = rng(7, &[key.as_bytes()]);
        // The sum of twelve uniform numbers is close enough to normal here.
        Array2::from_shape_fn((n, 1), |_| (0..12).map(|_| rng.random::<f64>()).sum::<f64>() + shift)
    }

    #[test]
    fn the_form_equals_the_mmd() {
        let (y, z) = (normal(40, 0.0, "y"), normal(40, 0.3, "z"));
        let test = pair_test(y.view(), z.view(), 0.8, 10, 0.05, &mut rng(1, &[]));
        assert!((test.mmd2 - mmd2_biased(y.view(), z.view(), 0.8)).abs() < 1e-14);
    }

    #[test]
    fn a_shift_is_found_and_no_shift_is_not() {
        let y = normal(100, 0.0, "y");
        let p = |z: Array2<f64>| {
            pair_test(y.view(), z.view(), 1.0, 199, 0.05, &mut rng(1, &[])).p_value
        };
        assert!(p(normal(100, 2.0, "z")) < 0.01);
        assert!(p(normal(100, 0.0, "z")) > 0.05);
    }

    #[test]
    fn level_holds_for_pairs_that_share_a_common_part() {
        // Both y and z are mostly `common`. A test that permutes across pairs would never reject.
        let rejected = (0..200)
            .filter(|i| {
                let common = normal(60, 0.0, &format!("common {i}"));
                let y = &common + &(normal(60, 0.0, &format!("y {i}")) * 0.3);
                let z = &common + &(normal(60, 0.0, &format!("z {i}")) * 0.3);
                let mut rng = rng(*i, &[]);
                pair_test(y.view(), z.view(), 1.0, 99, 0.05, &mut rng).p_value <= 0.05
            })
            .count();
        assert!((2..=22).contains(&rejected), "{rejected} of 200 at level 0.05");
    }
}
