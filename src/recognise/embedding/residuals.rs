//! Training vectors minus the means of their labels, and their scatter.

use ndarray::Array2;

use super::linear::add_lower_gram;

/// Training vectors minus the means of their labels.
pub struct Residuals {
    /// Number of rows of each label.
    pub counts: Vec<f64>,
    /// Mean of each label, shape (labels, D).
    pub means: Array2<f64>,
    /// Rows minus the means of their labels, shape (n, D).
    pub rows: Array2<f32>,
}

impl Residuals {
    /// The residuals of `rows`, each with its label.
    pub fn new(rows: &Array2<f32>, labels: &[usize]) -> Self {
        let count = labels.iter().max().map_or(0, |last| last + 1);
        let mut counts = vec![0.0; count];
        let mut means = Array2::<f64>::zeros((count, rows.ncols()));
        for (row, &label) in rows.rows().into_iter().zip(labels) {
            counts[label] += 1.0;
            means.row_mut(label).zip_mut_with(&row, |sum, &x| *sum += f64::from(x));
        }
        for (mut mean, &n) in means.rows_mut().into_iter().zip(&counts) {
            mean /= f64::max(n, 1.0);
        }
        let mut residuals = rows.clone();
        for (mut row, &label) in residuals.rows_mut().into_iter().zip(labels) {
            row.zip_mut_with(&means.row(label), |x, mean| *x -= *mean as f32);
        }
        Self { counts, means, rows: residuals }
    }

    /// Σ r·rᵀ over the rows; only the lower triangle is filled.
    pub fn scatter(&self) -> Array2<f64> {
        let mut scatter = Array2::zeros((self.rows.ncols(), self.rows.ncols()));
        add_lower_gram(&mut scatter, &self.rows);
        scatter
    }
}
