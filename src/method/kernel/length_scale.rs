//! The median heuristic for the kernel's length scale.

use multiversion::multiversion;
use ndarray::ArrayView2;

/// Number of samples between which distances are computed for the median: the first ones drawn.
pub(super) const MEDIAN_SUBSET: usize = 100;

/// Length scale σ of the Gaussian kernel from samples of shape (n, channels), by the paper's
/// Eq. 6: σ² = 0.5 · median of the squared distances between the first 100 samples.
///
/// Distances of exactly zero are left out, as in the authors' program. If no distance remains (one
/// sample, or constant data), σ is 1.
pub fn length_scale(samples: ArrayView2<'_, f64>) -> f64 {
    length_scale_of(samples, MEDIAN_SUBSET)
}

/// Like [`length_scale`], but from the first `subset` samples instead of the first 100.
pub(super) fn length_scale_of(samples: ArrayView2<'_, f64>, subset: usize) -> f64 {
    let n = samples.nrows().min(subset);
    let channels: Vec<Vec<f64>> =
        samples.columns().into_iter().map(|c| c.iter().take(n).copied().collect()).collect();
    let mut squared = squared_distances(&channels, n);
    squared.retain(|&d| d > 0.0);
    median(&mut squared).map_or(1.0, |m| (0.5 * m).sqrt())
}

/// Squared distances between all pairs of the first `n` points; `channels` has one list a channel.
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
            let others = &channel[..i];
            for j in 0..i {
                row[j] += (at - others[j]) * (at - others[j]);
            }
            rest = after;
        }
    }
    squared
}

/// The median; for an even number of values, the mean of the two middle values.
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
    use ndarray::{Array1, Axis};

    #[test]
    fn the_median_is_of_distances_that_are_not_zero() {
        for (points, squared) in [
            // Constant data.
            (vec![3.0, 3.0, 3.0], 1.0),
            // Squared distances 0, 4, 4: without 0, the median is 4.
            (vec![1.0, 1.0, 3.0], 2.0),
            // Squared distances 1, 4, 9, 16, 36, 49: the mean of the two middle values is 12.5.
            (vec![0.0, 1.0, 3.0, 7.0], 6.25),
        ] {
            let points = Array1::from(points).insert_axis(Axis(1));
            assert!((length_scale(points.view()).powi(2) - squared).abs() < 1e-12, "{points}");
        }
    }
}
