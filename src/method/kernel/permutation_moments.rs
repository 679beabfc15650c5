//! Exact mean, variance and skewness of Σ Aᵢⱼ·B_π(i)π(j) over all permutations π.
//!
//! For centred kernel matrices A and B, this sum is n²·HSIC_b after a permutation of one side. The
//! moments are from F. Kazi-Aoual, S. Hitier, R. Sabatier, J.-D. Lebreton, "Refined approximations
//! to permutation tests for multivariate inference", Computational Statistics & Data Analysis 20
//! (1995) 643–656. J. Josse, J. Pagès, F. Husson, "Testing the significance of the RV coefficient",
//! same journal 53 (2008) 82–91, print them in the form used here. A test compares them with sums
//! over all permutations of 6 and of 7 indices.
//!
//! The permutation distribution is approximated by a Pearson III distribution with these moments: a
//! gamma distribution, shifted and scaled. For skewness g > 0 the shape is k = 4/g², and the
//! standardised quantile is K(g) = (G⁻¹(1 − α; k) − k)/√k. G is the gamma distribution of scale 1 (N.
//! L. Johnson, S. Kotz, N. Balakrishnan, Continuous Univariate Distributions 1, 1994, chapter 17). K
//! is smooth in g; K(0) is the normal quantile. For negative skewness, K₁₋α(−g) = −K_α(g).

use ndarray::Array2;
use statrs::distribution::{ContinuousCDF, Normal};
use statrs::function::gamma::{gamma_lr, ln_gamma};

/// Sums over a symmetric matrix W whose rows sum to zero; they determine the permutation moments.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct CentredMoments {
    /// tr W
    pub t: f64,
    /// tr W²
    pub t2: f64,
    /// tr W³
    pub t3: f64,
    /// Σ wᵢᵢ²
    pub s2: f64,
    /// Σ wᵢᵢ³
    pub s3: f64,
    /// Σᵢⱼ wᵢⱼ³
    pub u: f64,
    /// Σ wᵢᵢ·(W²)ᵢᵢ
    pub r: f64,
    /// Σᵢⱼ wᵢᵢ·wᵢⱼ·wⱼⱼ
    pub b: f64,
}

impl CentredMoments {
    /// Computes the sums over a symmetric matrix of shape (n, n) with rows that sum to zero. O(n³).
    pub(super) fn of(w: &Array2<f64>) -> Self {
        let square = w.dot(w);
        let diagonal = w.diag();
        Self {
            t: diagonal.sum(),
            t2: square.diag().sum(),
            t3: (w * &square).sum(),
            s2: diagonal.dot(&diagonal),
            s3: diagonal.iter().map(|d| d.powi(3)).sum(),
            u: w.iter().map(|x| x.powi(3)).sum(),
            r: diagonal.dot(&square.diag()),
            b: diagonal.dot(&w.dot(&diagonal)),
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Moments {
    pub mean: f64,
    pub variance: f64,
    /// Third central moment, divided by the variance to the power 3/2.
    pub skewness: f64,
}

/// Moments of Σ Aᵢⱼ·B_π(i)π(j) over all permutations of n indices, for centred matrices A and B.
///
/// The exact third moment divides by n − 5. For n ≤ 5, the skewness is therefore that of the gamma
/// distribution with the same mean and variance.
#[inline]
pub(super) fn permutation_moments(n: usize, a: &CentredMoments, b: &CentredMoments) -> Moments {
    debug_assert!(n > 3);
    let m = n as f64;
    let mean = a.t * b.t / (m - 1.0);
    // Kazi-Aoual et al. (1995), as printed by Josse et al. (2008), Eq. 5.
    let spread = |w: &CentredMoments| (m - 1.0) * w.t2 - w.t * w.t;
    let level = |w: &CentredMoments| m * (m + 1.0) * w.s2 - (m - 1.0) * (w.t * w.t + 2.0 * w.t2);
    let variance = 2.0 * spread(a) * spread(b) / ((m - 1.0).powi(2) * (m + 1.0) * (m - 2.0))
        + level(a) * level(b) / ((m + 1.0) * m * (m - 1.0) * (m - 2.0) * (m - 3.0));
    let variance = variance.max(0.0);
    let sd = variance.sqrt();
    if n < 6 {
        let skewness = if mean > 0.0 { 2.0 * sd / mean } else { 0.0 };
        return Moments { mean, variance, skewness };
    }
    let third = third_moment(m, a, b) - 3.0 * mean * variance - mean.powi(3);
    let skewness = if variance > 0.0 { third / (variance * sd) } else { 0.0 };
    Moments { mean, variance, skewness }
}

/// E[(Σ Aᵢⱼ·B_π(i)π(j))³], Kazi-Aoual et al. (1995), theorem 3.3.
#[inline]
fn third_moment(n: f64, p: &CentredMoments, q: &CentredMoments) -> f64 {
    let (n2, n3, n4) = (n * n, n * n * n, n * n * n * n);
    let (pt3, qt3) = (p.t.powi(3), q.t.powi(3));
    let (ptt, qtt) = (p.t * p.t2, q.t * q.t2);
    let (pts, qts) = (p.t * p.s2, q.t * q.s2);
    let total = n2 * (n + 1.0) * (n2 + 15.0 * n - 4.0) * p.s3 * q.s3
        + 4.0 * (n4 - 8.0 * n3 + 19.0 * n2 - 4.0 * n - 16.0) * p.u * q.u
        + 24.0 * (n2 - n - 4.0) * (p.u * q.b + p.b * q.u)
        + 6.0 * (n4 - 8.0 * n3 + 21.0 * n2 - 6.0 * n - 24.0) * p.b * q.b
        + 12.0 * (n4 - n3 - 8.0 * n2 + 36.0 * n - 48.0) * p.r * q.r
        + 12.0 * (n3 - 2.0 * n2 + 9.0 * n - 12.0) * (pts * q.r + p.r * qts)
        + 3.0 * (n4 - 4.0 * n3 - 2.0 * n2 + 9.0 * n - 12.0) * pts * qts
        + 24.0
            * ((n3 - 3.0 * n2 - 2.0 * n + 8.0) * (p.r * q.u + p.u * q.r)
                + (n3 - 2.0 * n2 - 3.0 * n + 12.0) * (p.r * q.b + p.b * q.r))
        + 12.0 * (n2 - n + 4.0) * (pts * q.u + p.u * qts)
        + 6.0 * (2.0 * n3 - 7.0 * n2 - 3.0 * n + 12.0) * (pts * q.b + p.b * qts)
        - 2.0
            * n
            * (n - 1.0)
            * (n2 - n + 4.0)
            * ((2.0 * p.u + 3.0 * p.b) * q.s3 + (2.0 * q.u + 3.0 * q.b) * p.s3)
        - 3.0
            * n
            * (n - 1.0).powi(2)
            * (n + 4.0)
            * ((pts + 4.0 * p.r) * q.s3 + (qts + 4.0 * q.r) * p.s3)
        + 2.0
            * n
            * (n - 1.0)
            * (n - 2.0)
            * ((pt3 + 6.0 * ptt + 8.0 * p.t3) * q.s3 + (qt3 + 6.0 * qtt + 8.0 * q.t3) * p.s3)
        + pt3 * ((n3 - 9.0 * n2 + 23.0 * n - 14.0) * qt3 + 6.0 * (n - 4.0) * qtt + 8.0 * q.t3)
        + 6.0
            * ptt
            * ((n - 4.0) * qt3 + (n3 - 9.0 * n2 + 24.0 * n - 14.0) * qtt + 4.0 * (n - 3.0) * q.t3)
        + 8.0 * p.t3 * (qt3 + 3.0 * (n - 3.0) * qtt + (n3 - 9.0 * n2 + 26.0 * n - 22.0) * q.t3)
        - 16.0 * (pt3 * q.u + p.u * qt3)
        - 6.0 * (ptt * q.u + p.u * qtt) * (2.0 * n2 - 10.0 * n + 16.0)
        - 8.0 * (p.t3 * q.u + p.u * q.t3) * (3.0 * n2 - 15.0 * n + 16.0)
        - (pt3 * q.b + p.b * qt3) * (6.0 * n2 - 30.0 * n + 24.0)
        - 6.0 * (ptt * q.b + p.b * qtt) * (4.0 * n2 - 20.0 * n + 24.0)
        - 8.0 * (p.t3 * q.b + p.b * q.t3) * (3.0 * n2 - 15.0 * n + 24.0)
        - (n - 2.0)
            * (24.0 * (pt3 * q.r + p.r * qt3)
                + 6.0 * (ptt * q.r + p.r * qtt) * (2.0 * n2 - 10.0 * n + 24.0)
                + 8.0 * (p.t3 * q.r + p.r * q.t3) * (3.0 * n2 - 15.0 * n + 24.0)
                + (3.0 * n2 - 15.0 * n + 6.0) * (pt3 * qts + pts * qt3)
                + 6.0 * (ptt * qts + qtt * pts) * (n2 - 5.0 * n + 6.0)
                + 48.0 * (p.t3 * qts + q.t3 * pts));
    total / (n * (n - 1.0) * (n - 2.0) * (n - 3.0) * (n - 4.0) * (n - 5.0))
}

/// Below this skewness, the quantile comes from the Cornish–Fisher expansion, and the tail from the
/// normal distribution.
const NEARLY_NORMAL: f64 = 0.02;

/// The (1 − α) quantile of the Pearson III distribution with these moments, and P(X ≥ `observed`).
pub(super) fn pearson3_test(moments: &Moments, observed: f64, alpha: f64) -> (f64, f64) {
    let sd = moments.variance.sqrt();
    let kappa = moments.mean + sd * quantile(moments.skewness, alpha);
    if sd <= 0.0 {
        return (kappa, 1.0);
    }
    (kappa, tail((observed - moments.mean) / sd, moments.skewness))
}

/// P(X ≥ z) for a standardised Pearson III variable.
fn tail(z: f64, skewness: f64) -> f64 {
    if skewness < 0.0 {
        return 1.0 - tail(-z, -skewness);
    }
    if skewness < NEARLY_NORMAL {
        return 1.0 - Normal::standard().cdf(z);
    }
    let k = 4.0 / (skewness * skewness);
    let x = k + z * k.sqrt();
    if x <= 0.0 { 1.0 } else { 1.0 - gamma_lr(k, x) }
}

/// The (1 − α) quantile of a standardised Pearson III variable.
fn quantile(skewness: f64, alpha: f64) -> f64 {
    if skewness < 0.0 {
        return -quantile(-skewness, 1.0 - alpha);
    }
    let z = Normal::standard().inverse_cdf(1.0 - alpha);
    let g = skewness;
    // Cornish–Fisher expansion in powers of g (Johnson et al. 1994, Eq. 17.30, from the
    // Wilson–Hilferty cube and its corrections).
    let expansion = z + (z * z - 1.0) * g / 6.0 + (z.powi(3) - 7.0 * z) * g * g / 144.0
        - (3.0 * z.powi(4) + 7.0 * z * z - 16.0) * g.powi(3) / 6480.0;
    if g < NEARLY_NORMAL {
        return expansion;
    }
    // Newton's method on the logarithm keeps the gamma variable positive.
    let k = 4.0 / (g * g);
    let wilson_hilferty = (1.0 - g * g / 36.0 + g / 6.0 * z).max(0.05);
    let mut log_x = (k * wilson_hilferty.powi(3)).ln();
    for _ in 0..60 {
        let x = log_x.exp();
        let log_density = k * log_x - x - ln_gamma(k);
        let step = (gamma_lr(k, x) - (1.0 - alpha)) / log_density.exp();
        log_x -= step.clamp(-0.5, 0.5);
        if step.abs() < 1e-13 {
            break;
        }
    }
    (log_x.exp() - k) / k.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::hsic::{centred, kernel_matrix};
    use rand::Rng;

    /// Visits every order of the indices from `first` on.
    fn for_each_order(order: &mut [usize], first: usize, visit: &mut impl FnMut(&[usize])) {
        if first == order.len() {
            return visit(order);
        }
        for at in first..order.len() {
            order.swap(first, at);
            for_each_order(order, first + 1, visit);
            order.swap(first, at);
        }
    }

    #[test]
    fn the_moments_are_those_of_all_permutations() {
        let mut rng = crate::seed::rng(1, &[b"moments"]);
        for (n, case) in [(6, 0), (6, 1), (7, 2), (7, 3)] {
            let mut side = |channels: usize| {
                let x = Array2::from_shape_fn((n, channels), |_| {
                    let u = f64::from(rng.next_u32()) / f64::from(u32::MAX);
                    u * u * 3.0
                });
                centred(kernel_matrix(x.view(), 0.8))
            };
            let (a, b) = (side(1), side(1 + case % 2));
            let (mut count, mut sums) = (0.0, [0.0; 3]);
            let order = &mut (0..n).collect::<Vec<_>>();
            for_each_order(order, 0, &mut |p| {
                let v: f64 = a.indexed_iter().map(|((i, j), w)| w * b[[p[i], p[j]]]).sum();
                count += 1.0;
                sums[0] += v;
                sums[1] += v * v;
                sums[2] += v * v * v;
            });
            let [mean, second, third] = sums.map(|s| s / count);
            let variance = second - mean * mean;
            let skewness = (third - 3.0 * mean * variance - mean.powi(3)) / variance.powf(1.5);
            let got = permutation_moments(n, &CentredMoments::of(&a), &CentredMoments::of(&b));
            assert!((got.mean / mean - 1.0).abs() < 1e-12);
            assert!((got.variance / variance - 1.0).abs() < 1e-9);
            assert!((got.skewness - skewness).abs() < 1e-6, "{} {skewness}", got.skewness);
        }
    }

    #[test]
    fn a_skewness_of_two_is_the_exponential_distribution() {
        let exact = -(0.05f64).ln() - 1.0;
        assert!((quantile(2.0, 0.05) - exact).abs() < 1e-9);
        assert!((tail(exact, 2.0) - 0.05).abs() < 1e-9);
    }

    #[test]
    fn negative_skewness_mirrors() {
        assert!((quantile(-0.7, 0.05) + quantile(0.7, 0.95)).abs() < 1e-12);
    }
}
