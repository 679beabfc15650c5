//! The shrinkage discriminant: linear discriminant analysis on embeddings.
//!
//! With class means μ_c over all training vectors and the pooled scatter within classes W, the
//! metric is S = (1 − γ)·W + γ·(tr W/D)·I. The distances d_c = ‖u − m_c‖² are taken in the space
//! that the class means span after whitening by S: they order classes as the full Mahalanobis
//! distance does, and what is left out tells nothing between classes.

use ndarray::{Array1, Array2, ArrayView1, s};

use super::linear::{cholesky, orthonormal_rows, solve_lower, solve_lower_transposed};

/// γ: how much of the metric is a multiple of the identity. Anything from 0.01 to 0.3 does as well
/// on the real sounds; estimates that count windows as independent trials give far too little.
pub const SHRINKAGE: f64 = 0.1;

/// Variance within classes is taken to be at least this share of all variance: a detector that has
/// never erred in the library may err.
const LEAST_WITHIN: f64 = 1e-3;

/// Vectors that are summed in f32 before the sum goes to f64.
const ROWS_A_SUM: usize = 512;

/// Sums over some training vectors; they add and subtract.
#[derive(Clone, Debug)]
pub struct Scatter {
    /// Number of vectors of each class.
    counts: Vec<f64>,
    /// Sum of the vectors of each class, shape (C, D).
    sums: Array2<f64>,
    /// Σ z·zᵀ.
    gram: Array2<f64>,
}

impl Scatter {
    /// Sums over `vectors`, shape (n, D), each with its class below `classes`.
    pub fn new(vectors: &Array2<f32>, labels: &[usize], classes: usize) -> Self {
        let dims = vectors.ncols();
        let mut counts = vec![0.0; classes];
        let mut sums = Array2::zeros((classes, dims));
        for (vector, &class) in vectors.rows().into_iter().zip(labels) {
            counts[class] += 1.0;
            sums.row_mut(class).zip_mut_with(&vector, |sum, &x| *sum += f64::from(x));
        }
        let mut gram = Array2::zeros((dims, dims));
        for begin in (0..vectors.nrows()).step_by(ROWS_A_SUM) {
            let rows = vectors.slice(s![begin..(begin + ROWS_A_SUM).min(vectors.nrows()), ..]);
            gram.zip_mut_with(&rows.t().dot(&rows), |sum, &x| *sum += f64::from(x));
        }
        Self { counts, sums, gram }
    }

    /// Sums over no vectors.
    pub fn none(classes: usize, dims: usize) -> Self {
        let (sums, gram) = (Array2::zeros((classes, dims)), Array2::zeros((dims, dims)));
        Self { counts: vec![0.0; classes], sums, gram }
    }

    /// Adds the sums of other vectors.
    pub fn add(&mut self, other: &Self) {
        self.counts.iter_mut().zip(&other.counts).for_each(|(mine, other)| *mine += other);
        self.sums += &other.sums;
        self.gram += &other.gram;
    }

    /// Takes the sums of some of the vectors off again.
    pub fn without(&self, other: &Self) -> Self {
        let counts = self.counts.iter().zip(&other.counts).map(|(mine, other)| mine - other);
        Self {
            counts: counts.collect(),
            sums: &self.sums - &other.sums,
            gram: &self.gram - &other.gram,
        }
    }
}

/// A trained discriminant.
#[derive(Clone, Debug)]
pub struct Discriminant {
    /// Shape (r, D), r < C.
    projection: Array2<f32>,
    /// Projected origin of the class means.
    origin: Array1<f64>,
    /// m_c, shape (C, r).
    means: Array2<f64>,
    /// Whether a class had training vectors.
    present: Vec<bool>,
}

impl Discriminant {
    /// Trains on sums. Returns `None` where all vectors are equal, no class has two, or fewer than
    /// two classes have any.
    pub fn new(scatter: &Scatter, shrinkage: f64) -> Option<Self> {
        let dims = scatter.sums.ncols();
        let present: Vec<bool> = scatter.counts.iter().map(|&n| n > 0.5).collect();
        let classes = present.iter().filter(|&&p| p).count();
        let freedom = scatter.counts.iter().sum::<f64>() - classes as f64;
        if classes < 2 || freedom < 0.5 {
            return None;
        }
        let mut means = scatter.sums.clone();
        for (mut mean, &n) in means.rows_mut().into_iter().zip(&scatter.counts) {
            mean /= n.max(1.0);
        }
        let mut weighted = means.clone();
        for (mut mean, &n) in weighted.rows_mut().into_iter().zip(&scatter.counts) {
            mean *= n;
        }
        let mut metric = &scatter.gram - &weighted.t().dot(&means);
        let mean_square = scatter.gram.diag().sum() / scatter.counts.iter().sum::<f64>();
        let overall = scatter.sums.sum_axis(ndarray::Axis(0)) / scatter.counts.iter().sum::<f64>();
        let total = (mean_square - overall.dot(&overall)) / dims as f64;
        // The sums of squares are good to about 1e-6 of themselves: less is noise.
        if !(total > 1e-5 * mean_square / dims as f64) {
            return None;
        }
        let within = metric.diag().iter().map(|x| x.max(0.0)).sum::<f64>() / freedom / dims as f64;
        let trace = within.max(LEAST_WITHIN * total);
        metric *= (1.0 - shrinkage) / freedom;
        metric.diag_mut().map_inplace(|x| *x = x.max(0.0) + shrinkage * trace);
        let factor = cholesky(metric)?;

        let mut centre = Array1::zeros(dims);
        for (mean, _) in means.rows().into_iter().zip(&present).filter(|(_, p)| **p) {
            centre += &mean;
        }
        centre /= classes as f64;
        for (mut mean, &present) in means.rows_mut().into_iter().zip(&present) {
            if present { mean -= &centre } else { mean.fill(0.0) }
        }
        let mut white = means.t().to_owned();
        solve_lower(&factor, &mut white);
        let white = white.t().to_owned();
        let basis = orthonormal_rows(&white);
        let means = white.dot(&basis.t());
        let mut projection = basis.t().to_owned();
        solve_lower_transposed(&factor, &mut projection);
        let origin = projection.t().dot(&centre);
        let projection = projection.t().mapv(|x| x as f32).as_standard_layout().into_owned();
        let sound = projection.iter().all(|x| x.is_finite()) && means.iter().all(|x| x.is_finite());
        sound.then_some(Self { projection, origin, means, present })
    }

    /// d_c for each class; infinite for those without training vectors.
    pub fn distances(&self, vector: &[f32]) -> Vec<f64> {
        let projected = self.projection.dot(&ArrayView1::from(vector));
        let u: Vec<f64> =
            projected.iter().zip(&self.origin).map(|(&x, origin)| f64::from(x) - origin).collect();
        let distance = |(mean, &present): (ArrayView1<'_, f64>, &bool)| {
            if present {
                mean.iter().zip(&u).map(|(m, u)| (m - u).powi(2)).sum()
            } else {
                f64::INFINITY
            }
        };
        self.means.rows().into_iter().zip(&self.present).map(distance).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn data() -> (Array2<f32>, Vec<usize>) {
        let labels: Vec<usize> = (0..90).map(|i| i % 3).collect();
        let vectors = Array2::from_shape_fn((90, 8), |(i, j)| {
            let noise = ((i * 37 + j * 101) as f32 * 0.7).sin() * (1.0 + j as f32 * 0.3);
            noise + if j == i % 3 { 2.0 } else { 0.0 }
        });
        (vectors, labels)
    }

    #[test]
    fn differences_of_distances_are_those_of_the_full_mahalanobis_distance() {
        let (vectors, labels) = data();
        let trained = Discriminant::new(&Scatter::new(&vectors, &labels, 3), SHRINKAGE).unwrap();
        let z = vectors.mapv(f64::from);
        let mut means = Array2::<f64>::zeros((3, 8));
        for (row, &c) in z.rows().into_iter().zip(&labels) {
            means.row_mut(c).scaled_add(1.0 / 30.0, &row);
        }
        let mut w = Array2::<f64>::zeros((8, 8));
        for (row, &c) in z.rows().into_iter().zip(&labels) {
            let r = (&row - &means.row(c)).insert_axis(ndarray::Axis(1));
            w += &(r.dot(&r.t()) / 87.0);
        }
        let trace = w.diag().sum() / 8.0;
        let metric = w * 0.9 + Array2::<f64>::eye(8) * (0.1 * trace);
        let factor = cholesky(metric).unwrap();
        let full = |c: usize| {
            let mut d = (&z.row(5) - &means.row(c)).insert_axis(ndarray::Axis(1));
            solve_lower(&factor, &mut d);
            d.iter().map(|x| x * x).sum::<f64>()
        };
        let ours = trained.distances(vectors.row(5).as_slice().unwrap());
        for (a, b) in [(0, 1), (1, 2)] {
            assert!(((ours[a] - ours[b]) - (full(a) - full(b))).abs() < 1e-3);
        }
        assert!(ours[0] <= full(0) + 1e-3, "a projection shortens");
    }

    #[test]
    fn leaving_out_is_subtracting() {
        let (vectors, labels) = data();
        let all = Scatter::new(&vectors, &labels, 4);
        let part = Scatter::new(&vectors.slice(s![..30, ..]).to_owned(), &labels[..30], 4);
        let rest = Scatter::new(&vectors.slice(s![30.., ..]).to_owned(), &labels[30..], 4);
        let query: Vec<f32> = vectors.row(2).to_vec();
        let distances = |s: &Scatter| Discriminant::new(s, SHRINKAGE).unwrap().distances(&query);
        for (a, b) in distances(&all.without(&part)).iter().zip(distances(&rest)) {
            assert!((a - b).abs() < 1e-3 * (1.0 + b) || a == &b, "{a} vs {b}");
        }
        assert_eq!(distances(&all)[3], f64::INFINITY, "a class without vectors");
    }

    #[test]
    fn a_detector_that_never_errs_is_trusted_within_bounds_and_a_constant_is_not() {
        let labels = [0, 1, 0, 1, 0, 1];
        let switch = Array2::from_shape_fn((6, 3), |(i, j)| ((i % 2) + j) as f32);
        let trained = Discriminant::new(&Scatter::new(&switch, &labels, 2), SHRINKAGE).unwrap();
        let d = trained.distances(&[1.0, 2.0, 3.0]);
        assert!(d[1] < 1e-3 && d[0].is_finite() && d[0] > 1.0, "{d:?}");
        let constant = Array2::from_elem((6, 3), 0.7);
        assert!(Discriminant::new(&Scatter::new(&constant, &labels, 2), SHRINKAGE).is_none());
        let two = switch.slice(s![..2, ..]).to_owned();
        assert!(Discriminant::new(&Scatter::new(&two, &labels[..2], 2), SHRINKAGE).is_none());
    }
}
