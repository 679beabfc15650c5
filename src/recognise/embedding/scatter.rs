//! Sums over training vectors: counts, sums and products, from which discriminants are made.

use ndarray::{Array2, Axis, s};
use rayon::prelude::*;

/// Vectors that are summed in f32 before the sum goes to f64.
const ROWS_A_SUM: usize = 512;

/// Columns of a matrix of sums that one thread works out at a time.
const COLUMNS_A_SUM: usize = 256;

/// Sums over some training vectors; they add and subtract.
#[derive(Clone, Debug)]
pub struct Scatter {
    /// How much a vector of each label weighs.
    pub(super) weights: Vec<f64>,
    /// Number of vectors of each label.
    pub(super) counts: Vec<f64>,
    /// Sum of the vectors of each label, shape (labels, D).
    pub(super) sums: Array2<f64>,
    /// Σ w·z·zᵀ; the lower triangle alone.
    pub(super) gram: Array2<f64>,
}

impl Scatter {
    /// Sums over `vectors`, shape (n, D), each with its label, for which there is a weight.
    pub fn new(vectors: &Array2<f32>, labels: &[usize], weights: Vec<f64>) -> Self {
        let (count, dims) = (weights.len(), vectors.ncols());
        let mut scatter = Self {
            weights,
            counts: vec![0.0; count],
            sums: Array2::zeros((count, dims)),
            gram: Array2::zeros((dims, dims)),
        };
        scatter.add(vectors, labels, 1.0);
        scatter
    }

    /// Takes the sums of some of the vectors off again.
    pub fn subtract(&mut self, vectors: &Array2<f32>, labels: &[usize]) {
        self.add(vectors, labels, -1.0);
    }

    fn add(&mut self, vectors: &Array2<f32>, labels: &[usize], sign: f64) {
        for (vector, &class) in vectors.rows().into_iter().zip(labels) {
            self.counts[class] += sign;
            let mut sum = self.sums.row_mut(class);
            sum.zip_mut_with(&vector, |sum, &x| *sum += sign * f64::from(x));
        }
        match labels.iter().any(|&label| self.weights[label] != 1.0) {
            false => add_lower_gram(&mut self.gram, vectors, sign),
            true => {
                let mut weighted = vectors.clone();
                for (mut vector, &label) in weighted.rows_mut().into_iter().zip(labels) {
                    vector *= self.weights[label].sqrt() as f32;
                }
                add_lower_gram(&mut self.gram, &weighted, sign);
            }
        }
    }

    /// Each label's weight, and how many vectors it has.
    pub(super) fn weighted_counts(&self) -> impl Iterator<Item = (f64, f64)> {
        self.weights.iter().copied().zip(self.counts.iter().copied())
    }

    /// The sums of some columns, in rising order.
    pub fn select(&self, columns: &[usize]) -> Self {
        if columns.len() == self.sums.ncols() {
            return self.clone();
        }
        Self {
            weights: self.weights.clone(),
            counts: self.counts.clone(),
            sums: self.sums.select(Axis(1), columns),
            gram: self.gram.select(Axis(0), columns).select(Axis(1), columns),
        }
    }
}

/// Adds `sign`·Σ z·zᵀ of the rows to the lower triangle of a matrix of shape (D, D). What stands
/// above the diagonal means nothing.
fn add_lower_gram(gram: &mut Array2<f64>, vectors: &Array2<f32>, sign: f64) {
    let n = vectors.nrows();
    let blocks: Vec<_> = gram.axis_chunks_iter_mut(Axis(1), COLUMNS_A_SUM).enumerate().collect();
    blocks.into_par_iter().for_each(|(block, mut columns)| {
        let from = block * COLUMNS_A_SUM;
        let to = from + columns.ncols();
        let mut below = columns.slice_mut(s![from.., ..]);
        for begin in (0..n).step_by(ROWS_A_SUM) {
            let rows = vectors.slice(s![begin..(begin + ROWS_A_SUM).min(n), from..]);
            let product = rows.t().dot(&rows.slice(s![.., ..to - from]));
            below.zip_mut_with(&product, |sum, &x| *sum += sign * f64::from(x));
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lower_triangle_of_the_sums_is_that_of_the_product() {
        let (n, dims) = (ROWS_A_SUM + 60, COLUMNS_A_SUM + 30);
        let value = |(i, j)| (((i * 31 + j * 17) % 97) as f32 - 48.0) / 16.0;
        let vectors = Array2::from_shape_fn((n, dims), value);
        let wide = vectors.mapv(f64::from);
        let full = wide.t().dot(&wide);
        let mut lower = Array2::zeros((dims, dims));
        add_lower_gram(&mut lower, &vectors, 1.0);
        for ((i, j), expected) in full.indexed_iter().filter(|((i, j), _)| j <= i) {
            assert!((lower[[i, j]] - expected).abs() < 1e-5 * full[[i, i]], "{i}, {j}");
        }
    }
}
