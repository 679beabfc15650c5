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
//!
//! A mean of n_c trials is off by t/n_c on average, as a squared distance, where t is that of one trial from its
//! class mean; by t/(n_c + 1) if a mean was known beforehand as well as by one trial. So a class of few trials
//! would seem further away than one of many. The others' distances are raised by the difference.

use ndarray::{Array1, Array2, ArrayView1, ArrayView2, Axis, s};
use serde::{Deserialize, Serialize};

use super::linear::{cholesky, lower_gram, solve_lower, solve_lower_transposed};
use crate::features::packed::{self, PackedMatrix};
use crate::lanes::products;

/// Variance within classes counts as at least this share of all variance, since a detector that has
/// never erred in the library may still err.
const LEAST_WITHIN: f64 = 1e-3;

/// A class mean counts as lying in the space of the other means if its squared distance to that space
/// is below this share of the largest squared length of a mean.
const INSIDE: f64 = 1e-10;

/// Least and greatest shrinkage.
const SHRINKAGE: (f64, f64) = (1e-4, 1.0);

/// So many trials are enough to tell how far one lies from its class mean.
const MEASURED: usize = 100;

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Discriminant {
    /// Matrix from the member's features to the whitened space of the class means; shape (r, d), r < C.
    projection: PackedMatrix,
    origin: Array1<f64>,
    /// Class means m_c in that space, shape (C, r).
    #[serde(with = "packed::matrix")]
    means: Array2<f32>,
    /// ‖m_c‖² of each class, and by how much its distances are raised.
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
    /// Number of rows of each part among `rows`.
    fn counts(&self, rows: impl Iterator<Item = usize>) -> Vec<f64> {
        let mut counts = vec![0.0; 2 * self.classes];
        rows.for_each(|row| counts[self.part[row]] += 1.0);
        counts
    }

    /// The rows of the whole scans of each trial.
    fn scans(&self) -> Vec<Vec<usize>> {
        let mut scans = vec![Vec::new(); self.trials.iter().max().map_or(0, |last| last + 1)];
        let whole = (0..self.part.len()).filter(|&row| self.part[row] < self.classes);
        whole.for_each(|row| scans[self.trials[row]].push(row));
        scans.retain(|rows| !rows.is_empty());
        scans
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
        let everyone = 0..rows.part.len();
        let counts = rows.counts(everyone.clone());
        let (means, residuals) = residuals(vectors, &rows.part, &counts);
        let scatter = lower_gram(&residuals.view());
        let shrinkage = shrinkage(&residuals, &scatter, &rows.trials);
        let scans = rows.scans();
        // One row of each trial; the number of these rows is that of the trials of a class.
        let firsts = || scans.iter().map(|rows| rows[0]);
        let trials = &rows.counts(firsts())[..rows.classes];
        let all = total.and_then(|total| metric(scatter.clone(), &counts, total, shrinkage));
        let off = all.as_ref().map_or(0.0, |factor| {
            let classes = trials.iter().filter(|n| **n > 0.5).count();
            off_mean(factor, &residuals, &scans, classes)
        });
        let without = |group: usize| {
            let stays = |row: &usize| rows.groups[*row] != group;
            let stay = rows.counts(everyone.clone().filter(stays));
            let (lost, moved) = left_out(&residuals, rows, group, (&counts, &stay));
            let mut left = lower_gram(&lost.view());
            left.zip_mut_with(&scatter, |left, all| *left = all - *left);
            let factor = metric(left, &stay, total?, shrinkage)?;
            let trials = &rows.counts(firsts().filter(stays))[..rows.classes];
            Self::of_factor(&factor, &means - &moved, trials, off)
        };
        let without = (0..groups).map(without).collect();
        (all.and_then(|factor| Self::of_factor(&factor, means, trials, off)), without)
    }

    /// Takes the factor L of the metric, the mean of each part, the number of trials of each class, and how
    /// far a trial is from its class mean.
    fn of_factor(
        factor: &Array2<f64>,
        means: Array2<f64>,
        trials: &[f64],
        off: f64,
    ) -> Option<Self> {
        let means = means.slice_move(s![..trials.len(), ..]);
        let present: Vec<bool> = trials.iter().map(|n| *n > 0.5).collect();
        let known: Vec<usize> = (0..present.len()).filter(|&class| present[class]).collect();
        if known.len() < 2 {
            return None;
        }
        let centre = means.select(Axis(0), &known).sum_axis(Axis(0)) / known.len() as f64;
        let mut white = means - &centre;
        for (mut mean, &present) in white.rows_mut().into_iter().zip(&present) {
            if !present {
                mean.fill(0.0);
            }
        }
        let mut white = white.reversed_axes().as_standard_layout().into_owned();
        solve_lower(&factor.view(), white.view_mut());
        let mut found = Self::of_white(&white, factor, &centre, present)?;
        let fewest = known.iter().map(|&class| trials[class]).fold(f64::INFINITY, f64::min);
        for class in known {
            found.lengths[class] += off * (1.0 / (fewest + 1.0) - 1.0 / (trials[class] + 1.0));
        }
        Some(found)
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
        solve_lower_transposed(&factor.view(), back.view_mut());
        let mut projection = back.reversed_axes().as_standard_layout().into_owned();
        solve_lower(&means.select(Axis(0), &independent).view(), projection.view_mut());
        let origin = projection.dot(centre);
        let lengths = means.rows().into_iter().map(|mean| mean.dot(&mean)).collect();
        if !projection.iter().chain(&means).all(|x| x.is_finite()) {
            return None;
        }
        let (projection, means) = (PackedMatrix::new(&projection), means.mapv(|x| x as f32));
        Some(Self { projection, origin, means, lengths, present })
    }

    /// A discriminant that tells nothing apart: all classes are at the same distance.
    pub(crate) fn indifferent(classes: usize, dims: usize) -> Self {
        Self {
            projection: PackedMatrix::new(&Array2::zeros((0, dims))),
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
            && self.projection.is_of((space, dims))
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
        let of_class = self.means.dot(&self.projection.matrix());
        (of_class, self.means.mapv(f64::from).dot(&self.origin))
    }

    /// Squared distance of each vector, shape (n, d), to each class mean; infinite for classes without
    /// training vectors.
    pub(crate) fn distances(&self, vectors: ArrayView2<'_, f32>) -> Vec<Vec<f64>> {
        let one = vectors.to_slice().filter(|_| vectors.nrows() == 1 && !self.origin.is_empty());
        let (u, inner) = if let (Some(one), Some(means)) = (one, self.means.as_slice()) {
            // One row is multiplied faster as a vector.
            let u = self.projection.products(one) - &self.origin;
            let in_f32: Vec<f32> = u.iter().map(|x| *x as f32).collect();
            let inner = Array1::from(products(means, &in_f32));
            (u.insert_axis(Axis(0)), inner.insert_axis(Axis(0)))
        } else {
            let u = vectors.dot(&self.projection.matrix().t()).mapv(f64::from) - &self.origin;
            let inner = u.dot(&self.means.mapv(f64::from).t());
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

/// The factor L of the metric S, of the lower triangle of Σ r·rᵀ and the number of rows of each part.
fn metric(
    mut scatter: Array2<f64>,
    counts: &[f64],
    total: f64,
    shrinkage: f64,
) -> Option<Array2<f64>> {
    let freedom: f64 = counts.iter().filter(|n| **n > 0.5).map(|n| n - 1.0).sum();
    if freedom < 0.5 {
        return None;
    }
    let within = scatter.diag().sum() / freedom / scatter.nrows() as f64;
    scatter *= (1.0 - shrinkage) / freedom;
    let ridge = shrinkage * within.max(LEAST_WITHIN * total);
    scatter.diag_mut().map_inplace(|x| *x += ridge);
    cholesky(scatter)
}

/// The mean squared distance of a trial, the mean of its whole scans, from the mean of its class.
fn off_mean(
    factor: &Array2<f64>,
    residuals: &Array2<f32>,
    scans: &[Vec<usize>],
    classes: usize,
) -> f64 {
    let some = &scans[..scans.len().min(MEASURED)];
    let mut trials = Array2::<f64>::zeros((residuals.ncols(), some.len()));
    for (mut trial, rows) in trials.columns_mut().into_iter().zip(some) {
        for &row in rows {
            let share = 1.0 / rows.len() as f64;
            trial.zip_mut_with(&residuals.row(row), |sum, &x| *sum += share * f64::from(x));
        }
    }
    solve_lower(&factor.view(), trials.view_mut());
    let mean = trials.iter().map(|x| x * x).sum::<f64>() / some.len().max(1) as f64;
    // The class means are of the same trials.
    let free = scans.len().saturating_sub(classes);
    if free == 0 { 0.0 } else { mean * scans.len() as f64 / free as f64 }
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
mod tests;
