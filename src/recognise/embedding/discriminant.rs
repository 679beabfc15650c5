//! The shrinkage discriminant: linear discriminant analysis of embeddings. One is trained on all
//! trials, and one for each group on the trials outside the group.
//!
//! Each training vector has a label. A label below the number of classes is the class of a whole
//! trial; higher labels are for copies. The class mean m_c is over whole trials only. The scatter W
//! pools all vectors, each minus the mean of its label. The metric is S = (1 − γ)·W + γ·(tr W/D)·I.
//! The distances d_c = ‖u − m_c‖² are computed in the space that the class means span after whitening
//! by S. They order classes like the full Mahalanobis distance, since directions outside that space do
//! not separate classes.
//!
//! S = L·Lᵀ is factored once. Leaving out the rows of a group subtracts R_gᵀ·Q·R_g from W. R_g are the
//! group's rows minus the means of their labels. Q⁻¹ is I minus 1/n between rows of the same label
//! with n rows in all, since the means move, too. With V = L⁻¹·R_gᵀ, the inverse in white coordinates
//! is I + V·(Q⁻¹ − VᵀV)⁻¹·Vᵀ (Woodbury), which is cheap for a small group.

use ndarray::{Array1, Array2, ArrayView1, Axis, s};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::linear::{Residuals, cholesky, matrix, solve_lower, solve_lower_transposed};
use super::packed;

/// Variance within classes counts as at least this share of all variance, since a detector that has
/// never erred in the library may still err.
const LEAST_WITHIN: f64 = 1e-3;

/// A class mean counts as lying in the space of the other means if its squared distance to that space
/// is below this share of the largest squared length of a mean.
const INSIDE: f64 = 1e-10;

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Discriminant {
    /// Matrix from features to the whitened space of the class means; shape (r, D), r < C.
    #[serde(with = "packed::matrix")]
    projection: Array2<f32>,
    origin: Array1<f64>,
    /// Class means m_c in that space, shape (C, r).
    means: Array2<f64>,
    /// Whether a class had training vectors.
    present: Vec<bool>,
}

pub(crate) struct Vectors<'a> {
    pub rows: &'a Array2<f32>,
    /// Label of each row: the class of a whole trial, or `classes` and above for a copy.
    pub labels: &'a [usize],
    /// Group of each row. Groups are left out one at a time.
    pub groups: &'a [usize],
    pub classes: usize,
    pub group_count: usize,
}

/// The metric S of training vectors, factored.
struct Metric<'a> {
    vectors: &'a Vectors<'a>,
    residuals: Residuals,
    /// L in S = L·Lᵀ.
    factor: Array2<f64>,
    /// Weight of Σ r·rᵀ in S.
    weight: f64,
    freedom: f64,
}

impl Discriminant {
    /// Trains on all vectors, and on those outside each group. `dims` is D in tr W/D, the number of
    /// features; there are fewer columns if these are coordinates in a subspace. `shrinkage` is γ.
    ///
    /// Gives `None` if all vectors are equal, no label has two, or fewer than two classes occur.
    pub(crate) fn train(
        vectors: &Vectors<'_>,
        dims: usize,
        shrinkage: f64,
    ) -> (Option<Self>, Vec<Option<Self>>) {
        let Some(metric) = Metric::new(vectors, dims, shrinkage) else {
            return (None, vec![None; vectors.group_count]);
        };
        let without = (0..vectors.group_count).into_par_iter();
        (metric.all(), without.map(|group| metric.without(group)).collect())
    }

    /// Takes the class means in white coordinates, shape (D, C); their product with the inverse of the
    /// metric; the factor L; the centre of the means; and a factor for all distances. The means of
    /// classes without vectors are 0.
    fn of_white(
        (white, inverse): (&Array2<f64>, &Array2<f64>),
        factor: &Array2<f64>,
        centre: &Array1<f64>,
        present: Vec<bool>,
        scale: f64,
    ) -> Option<Self> {
        // Cholesky factor of the means' inner products; a mean that depends on others adds no column.
        let inner = white.t().dot(inverse);
        let largest = inner.diag().iter().copied().fold(0.0, f64::max);
        let classes = present.len();
        let mut means = Array2::<f64>::zeros((classes, classes));
        let mut independent: Vec<usize> = Vec::new();
        for class in 0..classes {
            for (column, &other) in independent.iter().enumerate() {
                let known = means.slice(s![class, ..column]).dot(&means.slice(s![other, ..column]));
                means[[class, column]] = (inner[[class, other]] - known) / means[[other, column]];
            }
            let own = means.row(class);
            let rest = inner[[class, class]] - own.dot(&own);
            if rest > INSIDE * largest {
                means[[class, independent.len()]] = rest.sqrt();
                independent.push(class);
            }
        }
        let space = independent.len();
        let means = means.slice_move(s![.., ..space]);
        let mut back = inverse.select(Axis(1), &independent);
        solve_lower_transposed(factor, &mut back);
        let mut projection = back.reversed_axes().as_standard_layout().into_owned();
        solve_lower(&means.select(Axis(0), &independent), &mut projection);
        let scale = scale.sqrt();
        let origin = projection.dot(centre) * scale;
        let (projection, means) = (projection.mapv(|x| (x * scale) as f32), means * scale);
        let sound = projection.iter().all(|x| x.is_finite()) && means.iter().all(|x| x.is_finite());
        sound.then_some(Self { projection, origin, means, present })
    }

    /// A discriminant with plain Euclidean distances to the class means of whole trials.
    pub(crate) fn of_means(vectors: &Vectors<'_>) -> Self {
        let Residuals { counts, means, .. } = Residuals::new(vectors.rows, vectors.labels);
        let means = means.slice_move(s![..vectors.classes, ..]);
        let present = counts[..vectors.classes].iter().map(|&n| n > 0.5).collect();
        let dims = means.ncols();
        Self { projection: Array2::eye(dims), origin: Array1::zeros(dims), means, present }
    }

    pub(crate) fn is_of(&self, classes: usize, dims: usize) -> bool {
        let space = self.origin.len();
        self.present.len() == classes
            && self.means.dim() == (classes, space)
            && self.projection.dim() == (space, dims)
    }

    pub(crate) fn knows(&self, class: usize) -> bool {
        self.present[class]
    }

    /// The same discriminant for vectors of `dims` columns. Its own columns are the given `columns`; all
    /// others have no weight.
    pub(crate) fn spread(self, columns: &[usize], dims: usize) -> Self {
        if columns.len() == dims {
            return self;
        }
        let mut projection = Array2::zeros((self.projection.nrows(), dims));
        for (narrow, &column) in self.projection.columns().into_iter().zip(columns) {
            projection.column_mut(column).assign(&narrow);
        }
        Self { projection, ..self }
    }

    /// u: the projection of a vector into the space of the class means.
    fn project(&self, vector: ArrayView1<'_, f32>) -> Vec<f64> {
        self.less_origin(self.projection.dot(&vector).view())
    }

    fn less_origin(&self, projected: ArrayView1<'_, f32>) -> Vec<f64> {
        projected.iter().zip(&self.origin).map(|(&x, origin)| f64::from(x) - origin).collect()
    }

    /// w_c, shape (C, D), and b_c such that u·m_c = w_c·x − b_c, where the vector x projects to u.
    pub(crate) fn weights(&self) -> (Array2<f32>, Array1<f64>) {
        let of_class = self.means.mapv(|x| x as f32).dot(&self.projection);
        (of_class, self.means.dot(&self.origin))
    }

    /// Squared distance d_c to each class mean; infinite for classes without training vectors.
    pub(crate) fn distances(&self, vector: ArrayView1<'_, f32>) -> Vec<f64> {
        self.distances_in_space(&self.project(vector))
    }

    /// The distances d_c of several vectors of D features, by one matrix product.
    pub(crate) fn distances_of_each(&self, vectors: &[Vec<f32>]) -> Vec<Vec<f64>> {
        if vectors.is_empty() {
            return Vec::new();
        }
        let projected = matrix(vectors).dot(&self.projection.t());
        let of_row = |u| self.distances_in_space(&self.less_origin(u));
        projected.rows().into_iter().map(of_row).collect()
    }

    /// The squared distances d_c of u, a vector already projected.
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

impl<'a> Metric<'a> {
    fn new(vectors: &'a Vectors<'a>, dims: usize, shrinkage: f64) -> Option<Self> {
        let residuals = Residuals::new(vectors.rows, vectors.labels);
        let there = || residuals.counts.iter().filter(|n| **n > 0.5);
        let freedom: f64 = there().map(|n| n - 1.0).sum();
        let known = residuals.counts.iter().take(vectors.classes).filter(|n| **n > 0.5).count();
        if known < 2 || freedom < 0.5 {
            return None;
        }
        let n = vectors.rows.nrows() as f64;
        let square: f64 = vectors.rows.iter().map(|x| f64::from(*x).powi(2)).sum();
        let sum = |column: ArrayView1<'_, f32>| column.iter().map(|x| f64::from(*x)).sum::<f64>();
        let overall: f64 = vectors.rows.columns().into_iter().map(|c| (sum(c) / n).powi(2)).sum();
        let total = (square / n - overall) / dims as f64;
        // The sums of squares have a relative error of about 1e-6; a smaller variance is only noise.
        if total.is_nan() || total <= 1e-5 * square / n / dims as f64 {
            return None;
        }
        let mut factor = residuals.scatter();
        let within = factor.diag().sum() / freedom / dims as f64;
        let weight = (1.0 - shrinkage) / freedom;
        factor *= weight;
        let ridge = shrinkage * within.max(LEAST_WITHIN * total);
        factor.diag_mut().map_inplace(|x| *x += ridge);
        Some(Self { factor: cholesky(factor)?, vectors, residuals, weight, freedom })
    }

    /// The class means of whole trials, minus `centre`, as columns in white coordinates.
    fn white(&self, centre: &Array1<f64>, present: &[bool]) -> Array2<f64> {
        let mut white = self.residuals.means.slice(s![..present.len(), ..]).to_owned();
        for (mut mean, &present) in white.rows_mut().into_iter().zip(present) {
            if present { mean -= centre } else { mean.fill(0.0) }
        }
        let mut white = white.reversed_axes().as_standard_layout().into_owned();
        solve_lower(&self.factor, &mut white);
        white
    }

    fn all(&self) -> Option<Discriminant> {
        let classes = self.vectors.classes;
        let present: Vec<bool> =
            self.residuals.counts[..classes].iter().map(|n| *n > 0.5).collect();
        let centre = self.centre(&present);
        let white = self.white(&centre, &present);
        Discriminant::of_white((&white, &white), &self.factor, &centre, present, 1.0)
    }

    fn centre(&self, present: &[bool]) -> Array1<f64> {
        let known: Vec<usize> = (0..present.len()).filter(|&c| present[c]).collect();
        self.residuals.means.select(Axis(0), &known).sum_axis(Axis(0)) / known.len().max(1) as f64
    }

    fn without(&self, group: usize) -> Option<Discriminant> {
        let Vectors { labels, groups, classes, .. } = *self.vectors;
        let rows: Vec<usize> = (0..labels.len()).filter(|&row| groups[row] == group).collect();
        let mut left = self.residuals.counts.clone();
        rows.iter().for_each(|&row| left[labels[row]] -= 1.0);
        let freedom: f64 = left.iter().filter(|n| **n > 0.5).map(|n| n - 1.0).sum();
        let present: Vec<bool> = left[..classes].iter().map(|n| *n > 0.5).collect();
        let known = present.iter().filter(|p| **p).count();
        if known < 2 || freedom < 0.5 {
            return None;
        }
        let selected = self.residuals.rows.select(Axis(0), &rows).mapv(f64::from);
        let mut moved = selected.reversed_axes().as_standard_layout().into_owned();
        solve_lower(&self.factor, &mut moved);
        // Q⁻¹ divided by the weight, minus VᵀV.
        let mut rest = moved.t().dot(&moved);
        rest.map_inplace(|x| *x = -*x);
        for (i, &a) in rows.iter().enumerate() {
            rest[[i, i]] += 1.0 / self.weight;
            for (j, &b) in rows.iter().enumerate() {
                if labels[a] == labels[b] && left[labels[a]] > 0.5 {
                    rest[[i, j]] -= 1.0 / (self.residuals.counts[labels[a]] * self.weight);
                }
            }
        }
        let rest = cholesky(rest)?;
        // The class means move when the group's whole trials are left out.
        let mut centre = self.centre(&present);
        let mut white = self.white(&centre, &present);
        let mut move_by = Array2::<f64>::zeros((rows.len(), classes));
        for (i, &row) in rows.iter().enumerate().filter(|(_, row)| labels[**row] < classes) {
            if present[labels[row]] {
                move_by[[i, labels[row]]] = -1.0 / left[labels[row]];
            }
        }
        let of_centre = move_by.sum_axis(Axis(1)) / known as f64;
        for (mut column, _) in move_by.columns_mut().into_iter().zip(&present).filter(|p| *p.1) {
            column -= &of_centre;
        }
        white += &moved.dot(&move_by);
        for (&row, &by) in rows.iter().zip(&of_centre) {
            let residual = self.residuals.rows.row(row);
            centre.zip_mut_with(&residual, |x, r| *x += by * f64::from(*r));
        }
        let mut along = moved.t().dot(&white);
        solve_lower(&rest, &mut along);
        solve_lower_transposed(&rest, &mut along);
        let inverse = &white + &moved.dot(&along);
        let scale = freedom / self.freedom;
        Discriminant::of_white((&white, &inverse), &self.factor, &centre, present, scale)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHRINKAGE: f64 = 0.03;

    fn data() -> (Array2<f32>, Vec<usize>) {
        let labels: Vec<usize> = (0..90).map(|i| i % 3).collect();
        let vectors = Array2::from_shape_fn((90, 8), |(i, j)| {
            let noise = ((i * 37 + j * 101) as f32 * 0.7).sin() * (1.0 + j as f32 * 0.3);
            noise + if j == i % 3 { 2.0 } else { 0.0 }
        });
        (vectors, labels)
    }

    /// Like `data`, but every third vector of a class has the label of a copy.
    fn data_with_copies() -> (Array2<f32>, Vec<usize>) {
        let (rows, labels) = data();
        let label = |(i, class): (usize, &usize)| if i / 3 % 3 == 2 { class + 3 } else { *class };
        let labels = labels.iter().enumerate().map(label).collect();
        (rows, labels)
    }

    fn vectors<'a>(rows: &'a Array2<f32>, labels: &'a [usize], classes: usize) -> Vectors<'a> {
        Vectors { rows, labels, groups: &[], classes, group_count: 0 }
    }

    fn trained(rows: &Array2<f32>, labels: &[usize], classes: usize) -> Option<Discriminant> {
        Discriminant::train(&vectors(rows, labels, classes), rows.ncols(), SHRINKAGE).0
    }

    /// Mahalanobis distances of a vector to the first `classes` means, by the definition: with the
    /// scatter of the `kept` rows and the ridge of all rows.
    fn by_definition(
        (rows, labels): (&Array2<f32>, &[usize]),
        kept: &[usize],
        classes: usize,
        vector: ArrayView1<'_, f32>,
    ) -> Vec<f64> {
        let z = rows.mapv(f64::from);
        let scatter = |kept: &[usize]| {
            let mut means = Array2::<f64>::zeros((2 * classes, z.ncols()));
            let mut freedom = 0.0;
            let mut w = Array2::<f64>::zeros((z.ncols(), z.ncols()));
            for label in 0..2 * classes {
                let members: Vec<usize> =
                    kept.iter().copied().filter(|&i| labels[i] == label).collect();
                let Some(mean) = z.select(Axis(0), &members).mean_axis(Axis(0)) else { continue };
                for &i in &members {
                    let r = (&z.row(i) - &mean).insert_axis(Axis(1));
                    w += &r.dot(&r.t());
                }
                freedom += members.len() as f64 - 1.0;
                means.row_mut(label).assign(&mean);
            }
            (w, freedom, means)
        };
        let all: Vec<usize> = (0..labels.len()).collect();
        let (w_all, freedom_all, _) = scatter(&all);
        let (w, freedom, means) = scatter(kept);
        let ridge = SHRINKAGE * w_all.diag().sum() / z.ncols() as f64;
        let metric = w * ((1.0 - SHRINKAGE) / freedom)
            + Array2::<f64>::eye(z.ncols()) * (ridge / freedom_all * (freedom_all / freedom));
        let factor = cholesky(metric).unwrap();
        let distance = |class: usize| {
            let mut d = (&vector.mapv(f64::from) - &means.row(class)).insert_axis(Axis(1));
            solve_lower(&factor, &mut d);
            d.iter().map(|x| x * x).sum::<f64>()
        };
        (0..classes).map(distance).collect()
    }

    fn differ_alike(ours: &[f64], full: &[f64]) {
        for (a, b) in [(0, 1), (1, 2)] {
            let (ours, full) = (ours[a] - ours[b], full[a] - full[b]);
            assert!((ours - full).abs() < 1e-3 * (1.0 + full.abs()), "{ours} vs {full}");
        }
    }

    #[test]
    fn differences_of_distances_are_those_of_the_full_mahalanobis_distance() {
        let (rows, labels) = data_with_copies();
        let all: Vec<usize> = (0..90).collect();
        let ours = trained(&rows, &labels, 3).unwrap().distances(rows.row(5));
        let full = by_definition((&rows, &labels), &all, 3, rows.row(5));
        differ_alike(&ours, &full);
        assert!(ours[0] <= full[0] + 1e-3, "a projection shortens");
    }

    #[test]
    fn leaving_a_group_out_is_training_without_it() {
        let (rows, labels) = data_with_copies();
        let groups: Vec<usize> = (0..90).map(|i| (i / 9).min(4)).collect();
        let of = Vectors { groups: &groups, group_count: 5, ..vectors(&rows, &labels, 3) };
        let (all, without) = Discriminant::train(&of, 8, SHRINKAGE);
        assert!(all.is_some() && without.len() == 5);
        for (group, without) in without.into_iter().enumerate() {
            let kept: Vec<usize> = (0..90).filter(|&i| groups[i] != group).collect();
            for query in [3, 40, 80] {
                let ours = without.as_ref().unwrap().distances(rows.row(query));
                let full = by_definition((&rows, &labels), &kept, 3, rows.row(query));
                differ_alike(&ours, &full);
            }
        }
    }

    #[test]
    fn a_class_that_is_only_in_one_group_is_unknown_without_it() {
        let (rows, labels) = data();
        let groups: Vec<usize> = labels.iter().map(|&class| usize::from(class == 2)).collect();
        let of = Vectors { groups: &groups, group_count: 2, ..vectors(&rows, &labels, 3) };
        let (_, without) = Discriminant::train(&of, 8, SHRINKAGE);
        let left = without[1].as_ref().unwrap();
        assert!(left.knows(0) && left.knows(1) && !left.knows(2));
        assert_eq!(left.distances(rows.row(2))[2], f64::INFINITY);
        assert!(without[0].is_none(), "one class is nothing to choose between");
    }

    #[test]
    fn columns_that_are_left_out_count_for_nothing() {
        let (vectors, labels) = data();
        let columns = [0, 1, 2, 5];
        let some = vectors.select(Axis(1), &columns);
        let wide = trained(&some, &labels, 3).unwrap().spread(&columns, 8);
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
    fn inner_products_with_the_class_means_make_the_distance() {
        let (vectors, labels) = data();
        let trained = trained(&vectors, &labels, 3).unwrap();
        let z = vectors.row(4);
        let (weights, offsets) = trained.weights();
        let distances = trained.distances(z);
        let u: f64 = trained.project(z).iter().map(|x| x * x).sum();
        for (class, distance) in distances.iter().enumerate() {
            let inner = f64::from(weights.row(class).dot(&z)) - offsets[class];
            let mean: f64 = trained.means.row(class).iter().map(|x| x * x).sum();
            assert!((distance - (u + mean - 2.0 * inner)).abs() < 1e-2);
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
