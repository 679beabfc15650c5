//! The shrinkage discriminant of one member: linear discriminant analysis of a subspace of the features.
//! One is trained on all trials, and one for each group on the trials outside the group.
//!
//! The training vectors of a class are in two parts: of whole scans, that is trials and their twins, and of
//! excerpts, whose features differ with their length. The class mean m_c is that of the whole scans. The
//! scatter W pools all vectors, each minus the mean of its part. The metric is
//! S = (1 − γ)·W + γ·(tr W/d)·I. The shrinkage γ is estimated (Ledoit and Wolf 2004, "A well-conditioned
//! estimator for large-dimensional covariance matrices"); each trial with its copies counts as one
//! observation. The distances ‖u − m_c‖² are computed in the space that the class means span after
//! whitening by S. They order classes like the full Mahalanobis distance, since directions outside that
//! space do not separate classes.

use ndarray::{Array1, Array2, ArrayView1, ArrayView2, Axis, s};
use serde::{Deserialize, Serialize};

use super::lanes::products;
use super::linear::{cholesky, lower_gram, solve_lower, solve_lower_transposed};
use super::packed;

/// Variance within classes counts as at least this share of all variance, since a detector that has
/// never erred in the library may still err.
const LEAST_WITHIN: f64 = 1e-3;

/// A class mean counts as lying in the space of the other means if its squared distance to that space
/// is below this share of the largest squared length of a mean.
const INSIDE: f64 = 1e-10;

/// Least and greatest shrinkage.
const SHRINKAGE: (f64, f64) = (1e-4, 1.0);

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Discriminant {
    /// Matrix from the member's features to the whitened space of the class means; shape (r, d), r < C.
    #[serde(with = "packed::matrix")]
    projection: Array2<f32>,
    origin: Array1<f64>,
    /// Class means m_c in that space, shape (C, r).
    means: Array2<f64>,
    /// ‖m_c‖² of each class.
    lengths: Vec<f64>,
    /// Whether a class had training vectors.
    present: Vec<bool>,
}

/// Classes, groups and trials of the rows of training vectors.
#[derive(Clone, Debug, Default)]
pub(crate) struct Rows {
    /// Part of each row: of class c, c for whole scans and C + c for excerpts.
    pub part: Vec<usize>,
    /// Group of each row. Groups are left out one at a time.
    pub groups: Vec<usize>,
    /// Trial of each row.
    pub trials: Vec<usize>,
    /// Number C of classes.
    pub classes: usize,
    pub group_count: usize,
}

impl Rows {
    /// Number of rows of each part, among those that `keep` chooses.
    fn counts(&self, keep: impl Fn(usize) -> bool) -> Vec<f64> {
        let mut counts = vec![0.0; 2 * self.classes];
        let kept = (0..self.part.len()).filter(|&row| keep(row));
        kept.for_each(|row| counts[self.part[row]] += 1.0);
        counts
    }
}

impl Discriminant {
    /// Trains on all vectors, shape (N, d), and on those outside each of the first `groups` groups.
    ///
    /// Gives `None` if all vectors are equal, no part has two, or fewer than two classes occur.
    pub(crate) fn train(
        vectors: Array2<f32>,
        rows: &Rows,
        groups: usize,
    ) -> (Option<Self>, Vec<Option<Self>>) {
        let total = total_variance(&vectors.view());
        let counts = rows.counts(|_| true);
        let (means, residuals) = residuals(vectors, &rows.part, &counts);
        let scatter = lower_gram(&residuals.view());
        let shrinkage = shrinkage(&residuals, &scatter, &rows.trials);
        let of = |scatter: Array2<f64>, counts: &[f64], means: Array2<f64>| {
            Self::of_scatter(scatter, counts, means, total?, shrinkage)
        };
        let without = |group: usize| {
            let stay = rows.counts(|row| rows.groups[row] != group);
            let (lost, moved) = left_out(&residuals, rows, group, (&counts, &stay));
            let mut left = lower_gram(&lost.view());
            left.zip_mut_with(&scatter, |left, all| *left = all - *left);
            of(left, &stay, &means - &moved)
        };
        let without = (0..groups).map(without).collect();
        (of(scatter, &counts, means), without)
    }

    /// Takes the lower triangle of Σ r·rᵀ, and the number of rows and the mean of each part.
    fn of_scatter(
        mut factor: Array2<f64>,
        counts: &[f64],
        means: Array2<f64>,
        total: f64,
        shrinkage: f64,
    ) -> Option<Self> {
        let freedom: f64 = counts.iter().filter(|n| **n > 0.5).map(|n| n - 1.0).sum();
        let means = means.slice_move(s![..counts.len() / 2, ..]);
        let present: Vec<bool> = counts[..means.nrows()].iter().map(|n| *n > 0.5).collect();
        let known: Vec<usize> = (0..present.len()).filter(|&class| present[class]).collect();
        if known.len() < 2 || freedom < 0.5 {
            return None;
        }
        let within = factor.diag().sum() / freedom / factor.nrows() as f64;
        factor *= (1.0 - shrinkage) / freedom;
        let ridge = shrinkage * within.max(LEAST_WITHIN * total);
        factor.diag_mut().map_inplace(|x| *x += ridge);
        let factor = cholesky(factor)?;
        let centre = means.select(Axis(0), &known).sum_axis(Axis(0)) / known.len() as f64;
        let mut white = means - &centre;
        for (mut mean, &present) in white.rows_mut().into_iter().zip(&present) {
            if !present {
                mean.fill(0.0);
            }
        }
        let mut white = white.reversed_axes().as_standard_layout().into_owned();
        solve_lower(&factor, &mut white);
        Self::of_white(&white, &factor, &centre, present)
    }

    /// Takes the class means in white coordinates, shape (d, C), the factor L of the metric, and the
    /// centre of the means. The means of classes without vectors are 0.
    fn of_white(
        white: &Array2<f64>,
        factor: &Array2<f64>,
        centre: &Array1<f64>,
        present: Vec<bool>,
    ) -> Option<Self> {
        // Cholesky factor of the means' inner products; a mean that depends on others adds no column.
        let inner = white.t().dot(white);
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
        let means = means.slice(s![.., ..independent.len()]).to_owned();
        let mut back = white.select(Axis(1), &independent);
        solve_lower_transposed(factor, &mut back);
        let mut projection = back.reversed_axes().as_standard_layout().into_owned();
        solve_lower(&means.select(Axis(0), &independent), &mut projection);
        let origin = projection.dot(centre);
        let projection = projection.mapv(|x| x as f32);
        let sound = projection.iter().all(|x| x.is_finite()) && means.iter().all(|x| x.is_finite());
        let lengths = means.rows().into_iter().map(|mean| mean.dot(&mean)).collect();
        sound.then_some(Self { projection, origin, means, lengths, present })
    }

    /// A discriminant that tells nothing apart: all classes are at the same distance.
    pub(crate) fn indifferent(classes: usize, dims: usize) -> Self {
        Self {
            projection: Array2::zeros((0, dims)),
            origin: Array1::zeros(0),
            means: Array2::zeros((classes, 0)),
            lengths: vec![0.0; classes],
            present: vec![true; classes],
        }
    }

    pub(crate) fn is_of(&self, classes: usize, dims: usize) -> bool {
        let space = self.origin.len();
        [self.present.len(), self.lengths.len()] == [classes; 2]
            && self.means.dim() == (classes, space)
            && self.projection.dim() == (space, dims)
    }

    /// Number of products that a distance takes.
    pub(crate) fn work(&self) -> usize {
        self.projection.len() + self.means.len()
    }

    pub(crate) fn knows(&self, class: usize) -> bool {
        self.present[class]
    }

    /// w_c, shape (C, d), and b_c such that u·m_c = w_c·x − b_c, where the vector x projects to u.
    pub(crate) fn weights(&self) -> (Array2<f32>, Array1<f64>) {
        let of_class = self.means.mapv(|x| x as f32).dot(&self.projection);
        (of_class, self.means.dot(&self.origin))
    }

    /// Squared distance of each vector, shape (n, d), to each class mean; infinite for classes without
    /// training vectors.
    pub(crate) fn distances(&self, vectors: ArrayView2<'_, f32>) -> Vec<Vec<f64>> {
        let one = vectors.to_slice().filter(|one| vectors.nrows() == 1 && !one.is_empty());
        let (u, inner) = if let (Some(one), Some(rows)) = (one, self.projection.as_slice()) {
            // One row is multiplied faster as a vector.
            let u = Array1::from(products(rows, one)) - &self.origin;
            let inner = self.means.dot(&u);
            (u.insert_axis(Axis(0)), inner.insert_axis(Axis(0)))
        } else {
            let u = vectors.dot(&self.projection.t()).mapv(f64::from) - &self.origin;
            let inner = u.dot(&self.means.t());
            (u, inner)
        };
        let distances = |(u, inner): (ArrayView1<'_, f64>, ArrayView1<'_, f64>)| {
            let own = u.dot(&u);
            let of_class = |(class, inner): (usize, &f64)| match self.present[class] {
                true => (own + self.lengths[class] - 2.0 * inner).max(0.0),
                false => f64::INFINITY,
            };
            inner.iter().enumerate().map(of_class).collect()
        };
        u.rows().into_iter().zip(inner.rows()).map(distances).collect()
    }
}

/// Variance of all vectors about their mean, per feature; `None` if they are all alike.
fn total_variance(vectors: &ArrayView2<'_, f32>) -> Option<f64> {
    let (n, dims) = (vectors.nrows() as f64, vectors.ncols() as f64);
    let square: f64 = vectors.iter().map(|x| f64::from(*x).powi(2)).sum();
    let sum = vectors.fold_axis(Axis(0), 0.0, |sum: &f64, &x| sum + f64::from(x));
    let overall: f64 = sum.iter().map(|sum| (sum / n).powi(2)).sum();
    let total = (square / n - overall) / dims;
    // The sums of squares have a relative error of about 1e-6; a smaller variance is only noise.
    (total > 1e-5 * square / n / dims).then_some(total)
}

/// The mean of each part, shape (2C, d), and the vectors minus the mean of their part.
fn residuals(
    mut vectors: Array2<f32>,
    part: &[usize],
    counts: &[f64],
) -> (Array2<f64>, Array2<f32>) {
    let mut means = Array2::<f64>::zeros((counts.len(), vectors.ncols()));
    for (row, &part) in vectors.rows().into_iter().zip(part) {
        means.row_mut(part).zip_mut_with(&row, |sum, &x| *sum += f64::from(x));
    }
    for (mut mean, &n) in means.rows_mut().into_iter().zip(counts) {
        mean /= f64::max(n, 1.0);
    }
    for (mut row, &part) in vectors.rows_mut().into_iter().zip(part) {
        row.zip_mut_with(&means.row(part), |x, mean| *x -= *mean as f32);
    }
    (means, vectors)
}

/// γ = [Σ_trials Σ_{a,b of the trial} (r_a·r_b)²/N² − ‖S‖²/n] / ‖S − μI‖². The r_a are the N residuals
/// of n trials, S = Σ r_a·r_aᵀ/N and μ = tr(S)/d. If copies counted as separate observations, γ would
/// be half as large.
fn shrinkage(residuals: &Array2<f32>, scatter: &Array2<f64>, trials: &[usize]) -> f64 {
    let (n, d) = (residuals.nrows() as f64, residuals.ncols() as f64);
    let trace = scatter.diag().sum() / n;
    let lower = |(i, row): (usize, ArrayView1<'_, f64>)| {
        let off: f64 = row.iter().take(i).map(|x| x * x).sum();
        2.0 * off + row[i] * row[i]
    };
    let square = scatter.rows().into_iter().enumerate().map(lower).sum::<f64>() / (n * n);
    let mut of_trial: Vec<Vec<usize>> = vec![Vec::new(); trials.iter().max().map_or(0, |t| t + 1)];
    trials.iter().enumerate().for_each(|(row, &trial)| of_trial[trial].push(row));
    let within = |own: &Vec<usize>| -> f64 {
        let inner = |a: usize, b: usize| f64::from(residuals.row(a).dot(&residuals.row(b)));
        own.iter().flat_map(|&a| own.iter().map(move |&b| inner(a, b).powi(2))).sum()
    };
    let spread = square - trace * trace / d;
    let within = of_trial.iter().map(within).sum::<f64>() / (n * n);
    let shrinkage = (within - square / of_trial.len().max(1) as f64) / spread;
    if shrinkage.is_nan() { SHRINKAGE.1 } else { shrinkage.clamp(SHRINKAGE.0, SHRINKAGE.1) }
}

/// Rows whose scatter is what the scatter loses without a group, and what the means of parts lose, shape
/// (2C, d). The mean of n rows moves by −s/(n − k) when k of them leave, whose residuals sum to s: Σ r·rᵀ
/// loses Σ_group r·rᵀ + s·sᵀ/(n − k). That is the scatter of r + β·s, where (1 + β·k)² = n/(n − k).
fn left_out(
    residuals: &Array2<f32>,
    rows: &Rows,
    group: usize,
    (counts, stay): (&[f64], &[f64]),
) -> (Array2<f32>, Array2<f64>) {
    let members: Vec<usize> =
        (0..rows.part.len()).filter(|&row| rows.groups[row] == group).collect();
    let mut sums = Array2::<f64>::zeros((counts.len(), residuals.ncols()));
    let mut lost = residuals.select(Axis(0), &members);
    for (row, &member) in lost.rows().into_iter().zip(&members) {
        let mut sum = sums.row_mut(rows.part[member]);
        sum.zip_mut_with(&row, |sum, &x| *sum += f64::from(x));
    }
    for (mut row, &member) in lost.rows_mut().into_iter().zip(&members) {
        let part = rows.part[member];
        let (n, stay) = (counts[part], stay[part]);
        if stay > 0.5 {
            let beta = ((n / stay).sqrt() - 1.0) / (n - stay);
            row.zip_mut_with(&sums.row(part), |x, sum| *x += (beta * sum) as f32);
        }
    }
    for (mut sum, &stay) in sums.rows_mut().into_iter().zip(stay) {
        sum /= stay.max(1.0);
    }
    (lost, sums)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 90 vectors of three classes in turn.
    fn data() -> (Array2<f32>, Vec<usize>) {
        let class: Vec<usize> = (0..90).map(|i| i % 3).collect();
        let vectors = Array2::from_shape_fn((90, 8), |(i, j)| {
            let noise = ((i * 37 + j * 101) as f32 * 0.7).sin() * (1.0 + j as f32 * 0.3);
            noise + if j == i % 3 { 2.0 } else { 0.0 }
        });
        (vectors, class)
    }

    /// Every third vector of a class is of an excerpt.
    fn rows(class: &[usize], groups: Vec<usize>, classes: usize) -> Rows {
        Rows {
            part: (0..class.len())
                .map(|i| class[i] + classes * usize::from(i / 3 % 3 == 2))
                .collect(),
            group_count: groups.iter().max().map_or(0, |last| last + 1),
            groups,
            trials: (0..class.len()).collect(),
            classes,
        }
    }

    fn trained(vectors: &Array2<f32>, class: &[usize], classes: usize) -> Option<Discriminant> {
        Discriminant::train(vectors.clone(), &rows(class, vec![0; class.len()], classes), 0).0
    }

    /// Mahalanobis distances of a vector to the class means, by the definition, with the scatter of the
    /// `kept` rows and the shrinkage of all.
    fn by_definition(
        (vectors, rows): (&Array2<f32>, &Rows),
        kept: &[usize],
        vector: ArrayView1<'_, f32>,
    ) -> Vec<f64> {
        let z = vectors.mapv(f64::from);
        let (_, rest) = residuals(vectors.clone(), &rows.part, &rows.counts(|_| true));
        let gamma = shrinkage(&rest, &lower_gram(&rest.view()), &rows.trials);
        let mut means = Array2::<f64>::zeros((2 * rows.classes, z.ncols()));
        let (mut freedom, mut w) = (0.0, Array2::<f64>::zeros((z.ncols(), z.ncols())));
        for (part, mut mean) in means.rows_mut().into_iter().enumerate() {
            let members: Vec<usize> =
                kept.iter().copied().filter(|&i| rows.part[i] == part).collect();
            mean.assign(&z.select(Axis(0), &members).mean_axis(Axis(0)).unwrap());
            for &i in &members {
                let r = (&z.row(i) - &mean).insert_axis(Axis(1));
                w += &r.dot(&r.t());
            }
            freedom += members.len() as f64 - 1.0;
        }
        let ridge = gamma * w.diag().sum() / freedom / z.ncols() as f64;
        let metric = w * ((1.0 - gamma) / freedom) + Array2::<f64>::eye(z.ncols()) * ridge;
        let factor = cholesky(metric).unwrap();
        let distance = |mean: ArrayView1<'_, f64>| {
            let mut d = (&vector.mapv(f64::from) - &mean).insert_axis(Axis(1));
            solve_lower(&factor, &mut d);
            d.iter().map(|x| x * x).sum::<f64>()
        };
        means.rows().into_iter().take(rows.classes).map(distance).collect()
    }

    fn distances(of: &Discriminant, vector: ArrayView1<'_, f32>) -> Vec<f64> {
        of.distances(vector.insert_axis(Axis(0))).remove(0)
    }

    fn differ_alike(ours: &[f64], full: &[f64]) {
        for (a, b) in [(0, 1), (1, 2)] {
            let (ours, full) = (ours[a] - ours[b], full[a] - full[b]);
            assert!((ours - full).abs() < 1e-3 * (1.0 + full.abs()), "{ours} vs {full}");
        }
    }

    #[test]
    fn differences_of_distances_are_those_of_the_full_mahalanobis_distance() {
        let (vectors, class) = data();
        let all: Vec<usize> = (0..90).collect();
        let ours = distances(&trained(&vectors, &class, 3).unwrap(), vectors.row(5));
        let full = by_definition((&vectors, &rows(&class, vec![], 3)), &all, vectors.row(5));
        differ_alike(&ours, &full);
        assert!(ours[0] <= full[0] + 1e-3, "a projection shortens");
    }

    #[test]
    fn leaving_a_group_out_is_training_without_it() {
        let (vectors, class) = data();
        let groups: Vec<usize> = (0..90).map(|i| (i / 9).min(4)).collect();
        let of = rows(&class, groups.clone(), 3);
        let (all, without) = Discriminant::train(vectors.clone(), &of, of.group_count);
        assert!(all.is_some() && without.len() == 5);
        for (group, without) in without.into_iter().enumerate() {
            let kept: Vec<usize> = (0..90).filter(|&i| groups[i] != group).collect();
            for query in [3, 40, 80] {
                let ours = distances(without.as_ref().unwrap(), vectors.row(query));
                let full = by_definition((&vectors, &of), &kept, vectors.row(query));
                differ_alike(&ours, &full);
            }
        }
    }

    #[test]
    fn a_class_that_is_only_in_one_group_is_unknown_without_it() {
        let (vectors, class) = data();
        let groups = class.iter().map(|&class| usize::from(class == 2)).collect();
        let (_, without) = Discriminant::train(vectors.clone(), &rows(&class, groups, 3), 2);
        let left = without[1].as_ref().unwrap();
        assert!(left.knows(0) && left.knows(1) && !left.knows(2));
        assert_eq!(distances(left, vectors.row(2))[2], f64::INFINITY);
        assert!(without[0].is_none(), "one class is nothing to choose between");
    }

    #[test]
    fn inner_products_with_the_class_means_make_the_distance() {
        let (vectors, class) = data();
        let trained = trained(&vectors, &class, 3).unwrap();
        let z = vectors.row(4);
        let (weights, offsets) = trained.weights();
        let projected = trained.projection.dot(&z);
        let u = projected.iter().zip(&trained.origin).map(|(&x, o)| f64::from(x) - o);
        let u: f64 = u.map(|x| x * x).sum();
        for (class, distance) in distances(&trained, z).iter().enumerate() {
            let inner = f64::from(weights.row(class).dot(&z)) - offsets[class];
            let mean: f64 = trained.means.row(class).iter().map(|x| x * x).sum();
            assert!((distance - (u + mean - 2.0 * inner)).abs() < 1e-2);
        }
    }

    #[test]
    fn a_detector_that_never_errs_is_trusted_within_bounds_and_a_constant_is_not() {
        let class = [0, 1, 0, 1, 0, 1];
        let switch = Array2::from_shape_fn((6, 3), |(i, j)| ((i % 2) + j) as f32);
        let trained_on = trained(&switch, &class, 2).unwrap();
        let d = distances(&trained_on, ArrayView1::from(&[1.0, 2.0, 3.0]));
        assert!(d[1] < 1e-3 && d[0].is_finite() && d[0] > 1.0, "{d:?}");
        assert!(trained(&Array2::from_elem((6, 3), 0.7), &class, 2).is_none());
        let two = switch.slice(s![..2, ..]).to_owned();
        assert!(trained(&two, &class[..2], 2).is_none());
    }
}
