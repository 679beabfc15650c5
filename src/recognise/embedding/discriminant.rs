//! The shrinkage discriminant: linear discriminant analysis on embeddings.
//!
//! Training vectors have labels: label c is a whole trial of class c, the labels from the number of
//! classes on are of excerpts. The class means m_c are those of whole trials; the scatter W pools
//! all vectors, by their weights, about the means of their labels. The metric is S = (1 − γ)·W + γ·(tr W/D)·I. The
//! distances d_c = ‖u − m_c‖² are taken in the space that the class means span after whitening by S:
//! they order classes as the full Mahalanobis distance does, and what is left out does not separate
//! classes.

use ndarray::{Array1, Array2, ArrayView1, Axis, s};
use serde::{Deserialize, Serialize};

use super::evidence_weights::EvidenceWeights;
use super::linear::{
    cholesky, orthonormal_rows, solve_lower, solve_lower_transposed, subtract_lower_product,
};
use super::scatter::Scatter;

/// γ: how much of the metric is a multiple of the identity (method §9).
pub const SHRINKAGE: f64 = 0.03;

/// Variance within classes is taken to be at least this share of all variance: a detector that has
/// never erred in the library may err.
const LEAST_WITHIN: f64 = 1e-3;

/// A trained discriminant.
#[derive(Clone, Debug, Serialize, Deserialize)]
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
    /// Trains on sums over whole trials and excerpts of `classes`. `dims` is the number of features
    /// that the identity stands for: more than the columns where these are coordinates of a space
    /// within.
    ///
    /// Returns `None` where all vectors are equal, no label has two, or fewer than two classes have
    /// any.
    pub fn new(scatter: Scatter, classes: usize, dims: usize) -> Option<Self> {
        let present: Vec<bool> = scatter.counts[..classes].iter().map(|&n| n > 0.5).collect();
        let known = present.iter().filter(|&&p| p).count();
        let there = || scatter.weighted_counts().filter(|(_, n)| *n > 0.5);
        let vectors: f64 = there().map(|(weight, n)| weight * n).sum();
        let freedom: f64 = there().map(|(weight, n)| weight * (n - 1.0)).sum();
        if known < 2 || there().all(|(_, n)| n < 1.5) {
            return None;
        }
        let mut weighted = scatter.sums.clone();
        for (mut sum, &weight) in weighted.rows_mut().into_iter().zip(&scatter.weights) {
            sum *= weight;
        }
        let mut means = scatter.sums.clone();
        for (mut mean, &n) in means.rows_mut().into_iter().zip(&scatter.counts) {
            mean /= n.max(1.0);
        }
        let mean_square = scatter.gram.diag().sum() / vectors;
        let overall = weighted.sum_axis(Axis(0)) / vectors;
        let total = (mean_square - overall.dot(&overall)) / dims as f64;
        // The sums of squares are good to about 1e-6 of themselves: less is noise.
        if total.is_nan() || total <= 1e-5 * mean_square / dims as f64 {
            return None;
        }
        // The lower triangle alone, as `cholesky` reads no more.
        let mut metric = scatter.gram;
        subtract_lower_product(&weighted.t(), &means.view(), &mut metric.view_mut());
        let within = metric.diag().iter().map(|x| x.max(0.0)).sum::<f64>() / freedom / dims as f64;
        let trace = within.max(LEAST_WITHIN * total);
        metric *= (1.0 - SHRINKAGE) / freedom;
        metric.diag_mut().map_inplace(|x| *x = x.max(0.0) + SHRINKAGE * trace);
        let mut means = means.slice_move(s![..classes, ..]);
        let factor = cholesky(metric)?;

        let mut centre = Array1::zeros(means.ncols());
        for (mean, _) in means.rows().into_iter().zip(&present).filter(|(_, p)| **p) {
            centre += &mean;
        }
        centre /= known as f64;
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

    /// Distances in the features' own units, to the means of the first `classes` labels.
    pub fn of_means(scatter: &Scatter, classes: usize) -> Self {
        let mut means = scatter.sums.slice(s![..classes, ..]).to_owned();
        for (mut mean, &n) in means.rows_mut().into_iter().zip(&scatter.counts) {
            mean /= n.max(1.0);
        }
        let present = scatter.counts[..classes].iter().map(|&n| n > 0.5).collect();
        let dims = means.ncols();
        Self { projection: Array2::eye(dims), origin: Array1::zeros(dims), means, present }
    }

    /// Whether it has this number of classes and of features.
    pub fn is_of(&self, classes: usize, dims: usize) -> bool {
        let space = self.origin.len();
        self.present.len() == classes
            && self.means.dim() == (classes, space)
            && self.projection.dim() == (space, dims)
    }

    /// Whether a class had training vectors.
    pub fn knows(&self, class: usize) -> bool {
        self.present[class]
    }

    /// The same with another projection onto the space of the class means.
    pub fn map_projection(self, change: impl FnOnce(Array2<f32>) -> Array2<f32>) -> Self {
        Self { projection: change(self.projection), ..self }
    }

    /// The same for vectors of `dims` features, of which these are the `columns`; the others count
    /// for nothing.
    pub fn spread(self, columns: &[usize], dims: usize) -> Self {
        self.map_projection(|projection| {
            if columns.len() == dims {
                return projection;
            }
            let mut wide = Array2::zeros((projection.nrows(), dims));
            for (narrow, &column) in projection.columns().into_iter().zip(columns) {
                wide.column_mut(column).assign(&narrow);
            }
            wide
        })
    }

    /// u, a vector in the space of the class means: what distances are taken of.
    pub fn project(&self, vector: ArrayView1<'_, f32>) -> Vec<f64> {
        let projected = self.projection.dot(&vector);
        projected.iter().zip(&self.origin).map(|(&x, origin)| f64::from(x) - origin).collect()
    }

    /// m_c in the features' own space, shape (C, D), and what u·m_c has besides.
    pub fn weights(&self) -> EvidenceWeights {
        EvidenceWeights {
            of_class: self.means.mapv(|x| x as f32).dot(&self.projection),
            offset: self.means.dot(&self.origin),
        }
    }

    /// d_c for each class; infinite for those without training vectors.
    pub fn distances(&self, vector: ArrayView1<'_, f32>) -> Vec<f64> {
        self.distances_in_space(&self.project(vector))
    }

    /// The same of several vectors of D features, with one product of matrices.
    pub fn distances_of_each(&self, vectors: &[Vec<f32>]) -> Vec<Vec<f64>> {
        let mut rows = Array2::zeros((vectors.len(), self.projection.ncols()));
        for (mut row, vector) in rows.rows_mut().into_iter().zip(vectors) {
            row.assign(&ArrayView1::from(vector));
        }
        let less_origin = |(&x, origin): (&f32, &f64)| f64::from(x) - origin;
        let projected = rows.dot(&self.projection.t());
        let projected = projected.rows().into_iter();
        let projected = projected.map(|u| u.iter().zip(&self.origin).map(less_origin).collect());
        projected.map(|u: Vec<f64>| self.distances_in_space(&u)).collect()
    }

    /// d_c of a vector in the space of the class means.
    fn distances_in_space(&self, u: &[f64]) -> Vec<f64> {
        let distance = |(mean, &present): (ArrayView1<'_, f64>, &bool)| {
            if present {
                mean.iter().zip(u).map(|(m, u)| (m - u).powi(2)).sum()
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

    fn trained(vectors: &Array2<f32>, labels: &[usize], classes: usize) -> Option<Discriminant> {
        Discriminant::new(
            Scatter::new(vectors, labels, vec![1.0; 2 * classes]),
            classes,
            vectors.ncols(),
        )
    }

    #[test]
    fn differences_of_distances_are_those_of_the_full_mahalanobis_distance() {
        let (vectors, labels) = data();
        // Every third round is of excerpts, whose means are their own.
        let labels: Vec<usize> = labels
            .iter()
            .enumerate()
            .map(|(i, c)| if i / 3 % 3 == 2 { c + 3 } else { *c })
            .collect();
        let trained = trained(&vectors, &labels, 3).unwrap();
        let z = vectors.mapv(f64::from);
        let mut means = Array2::<f64>::zeros((6, 8));
        for label in 0..6 {
            let members: Vec<usize> = (0..90).filter(|&i| labels[i] == label).collect();
            let mean = z.select(Axis(0), &members).mean_axis(Axis(0)).unwrap();
            means.row_mut(label).assign(&mean);
        }
        let mut w = Array2::<f64>::zeros((8, 8));
        for (row, &label) in z.rows().into_iter().zip(&labels) {
            let r = (&row - &means.row(label)).insert_axis(Axis(1));
            w += &(r.dot(&r.t()) / 84.0);
        }
        let trace = w.diag().sum() / 8.0;
        let metric = w * (1.0 - SHRINKAGE) + Array2::<f64>::eye(8) * (SHRINKAGE * trace);
        let factor = cholesky(metric).unwrap();
        let full = |c: usize| {
            let mut d = (&z.row(5) - &means.row(c)).insert_axis(Axis(1));
            solve_lower(&factor, &mut d);
            d.iter().map(|x| x * x).sum::<f64>()
        };
        let ours = trained.distances(vectors.row(5));
        for (a, b) in [(0, 1), (1, 2)] {
            let (ours, full) = (ours[a] - ours[b], full(a) - full(b));
            assert!((ours - full).abs() < 1e-3 * (1.0 + full.abs()), "{ours} vs {full}");
        }
        assert!(ours[0] <= full(0) + 1e-3, "a projection shortens");
    }

    #[test]
    fn leaving_out_is_subtracting() {
        let (vectors, labels) = data();
        let some = |from: usize, to: usize| vectors.slice(s![from..to, ..]).to_owned();
        // The last class's label is of excerpts here.
        let weights = vec![1.0, 1.0, 0.3, 1.0, 1.0, 1.0, 1.0, 1.0];
        let sums = |from: usize, to: usize| {
            Scatter::new(&some(from, to), &labels[from..to], weights.clone())
        };
        let mut all = sums(0, 90);
        let distances = |s: Scatter| Discriminant::new(s, 4, 8).unwrap().distances(vectors.row(2));
        assert_eq!(distances(all.clone())[3], f64::INFINITY, "a class without vectors");
        all.subtract(&some(0, 30), &labels[..30]);
        for (a, b) in distances(all).iter().zip(distances(sums(30, 90))) {
            assert!((a - b).abs() < 1e-3 * (1.0 + b) || a == &b, "{a} vs {b}");
        }
    }

    #[test]
    fn an_excerpt_of_weight_two_counts_as_two() {
        let (mut vectors, labels) = data();
        let of_excerpts = |i: usize| i / 3 % 3 == 2;
        // Excerpts vary more, so that their weight matters.
        (0..90).filter(|&i| of_excerpts(i)).for_each(|i| vectors[[i, 0]] *= 3.0);
        let label = |i: usize| if of_excerpts(i) { labels[i] + 3 } else { labels[i] };
        let twice: Vec<usize> =
            (0..90).flat_map(|i| vec![i; 1 + usize::from(of_excerpts(i))]).collect();
        let distances = |rows: &[usize], weight: f64| {
            let labels: Vec<usize> = rows.iter().map(|&i| label(i)).collect();
            let weights = [[1.0; 3], [weight; 3]].concat();
            let scatter = Scatter::new(&vectors.select(Axis(0), rows), &labels, weights);
            Discriminant::new(scatter, 3, 8).unwrap().distances(vectors.row(5))
        };
        // One degree of freedom less for each mean, which scales all distances alike.
        let all: Vec<usize> = (0..90).collect();
        let (weighted, repeated) = (distances(&all, 2.0), distances(&twice, 1.0));
        for (a, b) in weighted.iter().zip(&repeated) {
            assert!((a / weighted[0] - b / repeated[0]).abs() < 1e-3, "{weighted:?} {repeated:?}");
        }
        let lighter = distances(&all, 1.0);
        assert!((weighted[1] / weighted[0] - lighter[1] / lighter[0]).abs() > 1e-2, "{lighter:?}");
    }

    #[test]
    fn columns_that_are_left_out_count_for_nothing() {
        let (vectors, labels) = data();
        let columns = [0, 1, 2, 5];
        let some = Scatter::new(&vectors, &labels, vec![1.0; 6]).select(&columns);
        let wide = Discriminant::new(some, 3, 4).unwrap().spread(&columns, 8);
        let mut changed = vectors.row(7).to_owned();
        changed[6] = 1e6;
        assert_eq!(wide.distances(vectors.row(7)), wide.distances(changed.view()));
        let narrow = trained(&vectors.select(Axis(1), &columns), &labels, 3).unwrap();
        let own = vectors.row(7).select(Axis(0), &columns);
        for (a, b) in wide.distances(vectors.row(7)).iter().zip(narrow.distances(own.view())) {
            assert!((a - b).abs() < 1e-3 * (1.0 + b));
        }
    }

    #[test]
    fn terms_of_all_stretches_make_the_distance() {
        let (vectors, labels) = data();
        let trained = trained(&vectors, &labels, 3).unwrap();
        let (z, stretches) = (vectors.row(4), [0..3, 3..8]);
        let weights = trained.weights();
        let distances = trained.distances(z);
        let u: f64 = trained.project(z).iter().map(|x| x * x).sum();
        for (class, distance) in distances.iter().enumerate() {
            let terms: f64 = weights.terms(class, z, &stretches).iter().sum();
            let mean: f64 = trained.means.row(class).iter().map(|x| x * x).sum();
            assert!((distance - (u + mean - 2.0 * terms)).abs() < 1e-2);
        }
    }

    #[test]
    fn a_detector_that_never_errs_is_trusted_within_bounds_and_a_constant_is_not() {
        let labels = [0, 1, 0, 1, 0, 1];
        let switch = Array2::from_shape_fn((6, 3), |(i, j)| ((i % 2) + j) as f32);
        let d = trained(&switch, &labels, 2).unwrap().distances(ArrayView1::from(&[1.0, 2.0, 3.0]));
        assert!(d[1] < 1e-3 && d[0].is_finite() && d[0] > 1.0, "{d:?}");
        assert!(trained(&Array2::from_elem((6, 3), 0.7), &labels, 2).is_none());
        let two = switch.slice(s![..2, ..]).to_owned();
        assert!(trained(&two, &labels[..2], 2).is_none());
    }
}
