//! The Hilbert–Schmidt independence criterion (HSIC) of paired samples, and the threshold that
//! separates dependence from chance.
//!
//! HSIC_b = tr(KHLH)/n² (Gretton et al. 2007, "A kernel statistical test of independence", Eq. 4; the
//! paper's Eq. 9). K and L are the Gaussian kernel matrices of the two sides, each with its own median
//! length scale. H = I − 11ᵀ/n is the centring matrix.

use ndarray::{Array2, ArrayView1, ArrayView2, CowArray, Ix2};
use rand::seq::SliceRandom;

use super::length_scale::length_scale_of;
use super::permutation_moments::{CentredMoments, pearson3_test, permutation_moments};

/// Fewest pairs for a test of independence. Four pairs have only 4! = 24 permutations; the smallest
/// p-value would be 1/24, barely significant at 5 %.
pub(crate) const FEWEST_PAIRS: usize = 5;

/// Why a test of independence is not possible.
#[derive(Debug, thiserror::Error, PartialEq)]
#[allow(missing_docs)] // The messages are the documentation.
pub enum HsicError {
    #[error("{x} samples on one side and {y} on the other; expected pairs")]
    Unpaired { x: usize, y: usize },
    #[error("{0} pairs of samples; expected at least {FEWEST_PAIRS}")]
    TooFew(usize),
    /// Sides, channels and samples are counted from 1.
    #[error(
        "channel {channel} of side {side} is {value} at sample {sample}; expected finite numbers"
    )]
    NotFinite { side: usize, channel: usize, sample: usize, value: f64 },
    #[error(
        "side {0} is constant: its samples are all alike, so nothing can be said about dependence"
    )]
    Constant(usize),
    #[error("a significance level of {0} is not possible; expected a number between 0 and 0.5")]
    Alpha(f64),
    #[error(
        "{permutations} permutations cannot resolve a level of {alpha}; expected at least {least}"
    )]
    Permutations { permutations: usize, alpha: f64, least: usize },
}

/// How to find κ, the value of HSIC above which samples count as dependent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Threshold {
    /// From this number of random permutations of one side of the pairs, as in the paper.
    Permutations(usize),
    /// From a Pearson III (shifted gamma) distribution with the exact mean, variance and skewness of
    /// the permutation distribution. It needs no permutations and has no Monte Carlo error.
    Gamma,
}

/// Number of permutations that the paper uses.
pub const PERMUTATIONS: usize = 100;

/// The result of one test of independence.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Dependence {
    /// Number of pairs.
    pub n: usize,
    /// Length scale of the kernel on the first side of the pairs.
    pub sigma_x: f64,
    /// Length scale of the kernel on the second side of the pairs.
    pub sigma_y: f64,
    /// HSIC_b; a value that is negative from rounding becomes 0.
    pub hsic: f64,
    /// Threshold at the requested significance level; a larger HSIC_b means dependence.
    pub kappa: f64,
    /// Probability of an HSIC_b at least this large if the sides are independent. From S
    /// permutations it is (1 + k)/(1 + S), where k of them give an HSIC_b at least as large.
    pub p_value: f64,
}

/// exp(γ·‖a − b‖²) of two samples a and b.
pub(super) fn kernel(a: ArrayView1<'_, f64>, b: ArrayView1<'_, f64>, gamma: f64) -> f64 {
    let squared: f64 = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum();
    (gamma * squared).exp()
}

/// Gaussian kernel matrix, shape (n, n), of samples of shape (n, channels).
pub fn kernel_matrix(samples: ArrayView2<'_, f64>, sigma: f64) -> Array2<f64> {
    let gamma = -0.5 / (sigma * sigma);
    let n = samples.nrows();
    let mut k = Array2::ones((n, n));
    for i in 0..n {
        for j in 0..i {
            let value = kernel(samples.row(i), samples.row(j), gamma);
            k[[i, j]] = value;
            k[[j, i]] = value;
        }
    }
    k
}

/// HKH for a symmetric matrix K of shape (n, n): subtracts the means of its rows and columns.
pub fn centred(mut k: Array2<f64>) -> Array2<f64> {
    let n = k.nrows() as f64;
    let means: Vec<f64> = k.rows().into_iter().map(|row| row.sum() / n).collect();
    let mean = means.iter().sum::<f64>() / n;
    for ((i, j), value) in k.indexed_iter_mut() {
        *value += mean - means[i] - means[j];
    }
    k
}

/// The (1 − α) quantile of `values`: the value of rank round((1 − α)·count), as in the authors'
/// program.
///
/// # Panics
/// If `values` is empty.
pub fn quantile(mut values: Vec<f64>, alpha: f64) -> f64 {
    let count = values.len();
    let rank = (((1.0 - alpha) * count as f64).round() as usize).clamp(1, count);
    *values.select_nth_unstable_by(rank - 1, f64::total_cmp).1
}

/// Neighbouring samples resemble each other from this correlation on, if they are enough to show it.
const ALIKE: f64 = 0.3;

/// The largest correlation of a channel with itself one sample later, for samples of shape (n, channels), if
/// neighbours resemble each other. Such samples are not independent, and a test that exchanges them as if they
/// were finds too much.
pub fn neighbours_alike(samples: ArrayView2<'_, f64>) -> Option<f64> {
    let of = |channel: ArrayView1<'_, f64>| {
        let mean = channel.sum() / channel.len() as f64;
        let squares: f64 = channel.iter().map(|x| (x - mean) * (x - mean)).sum();
        let pairs = channel.iter().zip(channel.iter().skip(1));
        pairs.map(|(a, b)| (a - mean) * (b - mean)).sum::<f64>() / squares
    };
    let most = samples.columns().into_iter().map(of).fold(0.0, f64::max);
    (most > ALIKE.max(3.0 / (samples.nrows() as f64).sqrt())).then_some(most)
}

/// Tests whether paired samples of shape (n, channels) depend on each other.
///
/// Length scales are medians over all samples. `alpha` is the significance level of κ.
///
/// # Errors
/// If the sides differ in length, hold fewer than five samples, are constant or not finite; if `alpha`
/// is not within (0, 0.5]; if there are fewer than 1/α permutations.
pub fn test_independence(
    x: ArrayView2<'_, f64>,
    y: ArrayView2<'_, f64>,
    alpha: f64,
    threshold: Threshold,
    rng: &mut impl rand::Rng,
) -> Result<Dependence, HsicError> {
    check_level(alpha, threshold)?;
    check_samples(x, y)?;
    let (sigma_x, sigma_y) = (length_scale_of(x, x.nrows()), length_scale_of(y, y.nrows()));
    let n = x.nrows();
    let n2 = (n * n) as f64;
    let k = centred(kernel_matrix(x, sigma_x));
    let l = kernel_matrix(y, sigma_y);
    let hsic = ((&k * &l).sum() / n2).max(0.0);
    let (kappa, p_value) = match threshold {
        Threshold::Permutations(count) => {
            let null = permuted(&k, &l, count, rng);
            // The factor allows for rounding: a permutation that changes nothing must count.
            let as_large = null.iter().filter(|&&v| v >= hsic * (1.0 - 1e-12)).count();
            (quantile(null, alpha), (1 + as_large) as f64 / (1 + count) as f64)
        }
        Threshold::Gamma => {
            let moments =
                permutation_moments(n, &CentredMoments::of(&k), &CentredMoments::of(&centred(l)));
            let (kappa, p) = pearson3_test(&moments, hsic * n2, alpha);
            (kappa / n2, p)
        }
    };
    Ok(Dependence { n, sigma_x, sigma_y, hsic, kappa, p_value })
}

/// HSIC_b of `count` random permutations. Takes the centred kernel matrix of one side, and the plain
/// kernel matrix of the side to permute. O(n²) each: tr(KHL_πH) = Σ (HKH)ᵢⱼ·L_π(i)π(j).
pub fn permuted(
    k_centred: &Array2<f64>,
    l: &Array2<f64>,
    count: usize,
    rng: &mut impl rand::Rng,
) -> Vec<f64> {
    let n = l.nrows();
    let n2 = (n * n) as f64;
    let (k, l) = (k_centred.as_standard_layout(), l.as_standard_layout());
    let (k, l) = (slices(&k), slices(&l));
    let mut order: Vec<usize> = (0..n).collect();
    let permute = |_| {
        order.shuffle(rng);
        let mut sum = 0.0;
        for (i, k) in k.iter().enumerate() {
            let row = l[order[i]];
            let off: f64 = k.iter().zip(&order[..i]).map(|(k, &j)| k * row[j]).sum();
            sum += k[i] * row[order[i]] + 2.0 * off;
        }
        sum / n2
    };
    (0..count).map(permute).collect()
}

/// The rows of a matrix in standard (row-major) layout.
fn slices<'a>(matrix: &'a CowArray<'_, f64, Ix2>) -> Vec<&'a [f64]> {
    let row = |row: ArrayView1<'a, f64>| row.to_slice().expect("a row of the standard layout");
    matrix.rows().into_iter().map(row).collect()
}

pub(crate) fn check_level(alpha: f64, threshold: Threshold) -> Result<(), HsicError> {
    if !(alpha > 0.0 && alpha <= 0.5) {
        return Err(HsicError::Alpha(alpha));
    }
    let least = (1.0 / alpha).ceil() as usize;
    match threshold {
        Threshold::Permutations(permutations) if permutations < least => {
            Err(HsicError::Permutations { permutations, alpha, least })
        }
        _ => Ok(()),
    }
}

fn check_samples(x: ArrayView2<'_, f64>, y: ArrayView2<'_, f64>) -> Result<(), HsicError> {
    if x.nrows() != y.nrows() {
        return Err(HsicError::Unpaired { x: x.nrows(), y: y.nrows() });
    }
    if x.nrows() < FEWEST_PAIRS {
        return Err(HsicError::TooFew(x.nrows()));
    }
    for (side, samples) in [(1, x), (2, y)] {
        if let Some(((row, column), &value)) =
            samples.indexed_iter().find(|(_, value)| !value.is_finite())
        {
            let (channel, sample) = (column + 1, row + 1);
            return Err(HsicError::NotFinite { side, channel, sample, value });
        }
        if samples.rows().into_iter().all(|row| row == samples.row(0)) {
            return Err(HsicError::Constant(side));
        }
    }
    Ok(())
}
