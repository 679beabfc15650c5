//! Kernel sums and the biased estimate of the squared maximum mean discrepancy.
//!
//! This is the one place where Gaussian kernels are summed; a faster engine replaces it here.

use ndarray::ArrayView2;

/// Σᵢⱼ exp(−‖aᵢ − bⱼ‖² / (2σ²)) over samples of shape (n, channels) and (m, channels).
pub fn kernel_sum(a: ArrayView2<'_, f64>, b: ArrayView2<'_, f64>, sigma: f64) -> f64 {
    debug_assert_eq!(a.ncols(), b.ncols());
    let gamma = -0.5 / (sigma * sigma);
    a.rows()
        .into_iter()
        .map(|x| {
            b.rows()
                .into_iter()
                .map(|y| {
                    let d2: f64 = x.iter().zip(y).map(|(p, q)| (p - q) * (p - q)).sum();
                    (gamma * d2).exp()
                })
                .sum::<f64>()
        })
        .sum()
}

/// The three kernel sums that make an MMD.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CrossSums {
    /// Σ k(yᵢ, yⱼ)
    pub yy: f64,
    /// Σ k(zᵢ, zⱼ)
    pub zz: f64,
    /// Σ k(yᵢ, zⱼ)
    pub yz: f64,
}

/// MMD²_b (Eq. 5) from its kernel sums over n samples of y and m of z. Never negative: rounding
/// below zero is cut off, since the biased estimate is a squared norm.
pub fn mmd2_from_sums(sums: CrossSums, n: usize, m: usize) -> f64 {
    let (n, m) = (n as f64, m as f64);
    (sums.yy / (n * n) + sums.zz / (m * m) - 2.0 * sums.yz / (n * m)).max(0.0)
}

/// The biased estimate MMD²_b of Eq. 5 (Gretton et al. 2012), for samples of shape (n, channels)
/// and (m, channels).
pub fn mmd2_biased(y: ArrayView2<'_, f64>, z: ArrayView2<'_, f64>, sigma: f64) -> f64 {
    let sums = CrossSums {
        yy: kernel_sum(y, y, sigma),
        zz: kernel_sum(z, z, sigma),
        yz: kernel_sum(y, z, sigma),
    };
    mmd2_from_sums(sums, y.nrows(), z.nrows())
}
