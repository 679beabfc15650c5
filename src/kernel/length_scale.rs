//! The median heuristic for the kernel's length scale.

use multiversion::multiversion;
use ndarray::ArrayView2;

/// Number of samples whose distances enter the median: the first ones, in the order drawn.
pub const MEDIAN_SUBSET: usize = 100;

/// Length scale σ of the Gaussian kernel from samples of shape (n, channels), by the paper's
/// Eq. 6: σ² = 0.5 · median of the squared distances between the first 100 samples.
///
/// Distances of exactly zero are left out, as in the authors' program. If no distance remains (one
/// sample, constant data), σ is 1.
pub fn length_scale(samples: ArrayView2<'_, f64>) -> f64 {
    length_scale_of(samples, MEDIAN_SUBSET)
}

/// [`length_scale`] over the first `subset` samples.
pub fn length_scale_of(samples: ArrayView2<'_, f64>, subset: usize) -> f64 {
    let n = samples.nrows().min(subset);
    let channels: Vec<Vec<f64>> =
        samples.columns().into_iter().map(|c| c.iter().take(n).copied().collect()).collect();
    let mut squared = squared_distances(&channels, n);
    squared.retain(|&d| d > 0.0);
    median(&mut squared).map_or(1.0, |m| (0.5 * m).sqrt())
}

/// Squared distances between all pairs of the first `n` points; `channels` holds one row a channel.
#[multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn squared_distances(channels: &[Vec<f64>], n: usize) -> Vec<f64> {
    let mut squared = vec![0.0; n * n.saturating_sub(1) / 2];
    for channel in channels {
        let mut rest = squared.as_mut_slice();
        for i in 1..n {
            let (row, after) = rest.split_at_mut(i);
            let at = channel[i];
            for (sum, other) in row.iter_mut().zip(&channel[..i]) {
                *sum += (at - other) * (at - other);
            }
            rest = after;
        }
    }
    squared
}

/// The median; of an even number of values, the mean of the two middle ones.
fn median(values: &mut [f64]) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let (middle, odd) = (values.len() / 2, values.len() % 2 == 1);
    let (below, &mut upper, _) = values.select_nth_unstable_by(middle, f64::total_cmp);
    if odd {
        return Some(upper);
    }
    let lower = below.iter().copied().max_by(f64::total_cmp)?;
    Some(0.5 * (lower + upper))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;

    #[test]
    fn constant_data_have_length_scale_one() {
        assert_eq!(length_scale(array![[3.0], [3.0], [3.0]].view()), 1.0);
    }

    #[test]
    fn zero_distances_do_not_count() {
        // Distances² 0, 4, 4: the median of what is left is 4.
        assert_eq!(length_scale(array![[1.0], [1.0], [3.0]].view()), 2f64.sqrt());
    }

    #[test]
    fn an_even_number_of_distances_takes_the_mean_of_the_middle_two() {
        // Points 0, 1, 3, 7: distances² 1, 4, 9, 16, 36, 49; median (9 + 16) / 2.
        let sigma = length_scale(array![[0.0], [1.0], [3.0], [7.0]].view());
        assert!((sigma * sigma - 6.25).abs() < 1e-12);
    }
}
