//! The median heuristic for the kernel's length scale.

use ndarray::ArrayView2;

/// How many samples the median is taken over: the first ones, in the order drawn.
pub const MEDIAN_SUBSET: usize = 100;

/// Length scale σ of the Gaussian kernel from samples of shape (n, channels), by the paper's
/// Eq. 6: σ² = 0.5 · median of the squared distances between the first [`MEDIAN_SUBSET`] samples.
///
/// Distances of exactly zero are left out, as the authors' program does; where none remains (one
/// sample, constant data) σ is 1.
pub fn length_scale(samples: ArrayView2<'_, f64>) -> f64 {
    length_scale_of(samples, MEDIAN_SUBSET)
}

/// [`length_scale`] over the first `subset` samples.
pub fn length_scale_of(samples: ArrayView2<'_, f64>, subset: usize) -> f64 {
    let n = samples.nrows().min(subset);
    let mut squared = Vec::with_capacity(n * n.saturating_sub(1) / 2);
    for i in 0..n {
        for j in 0..i {
            let d: f64 =
                samples.row(i).iter().zip(samples.row(j)).map(|(a, b)| (a - b).powi(2)).sum();
            if d > 0.0 {
                squared.push(d);
            }
        }
    }
    median(&mut squared).map_or(1.0, |m| (0.5 * m).sqrt())
}

/// Median, the mean of the two middle values where their number is even.
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
