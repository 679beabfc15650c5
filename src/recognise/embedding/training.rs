//! Training vectors of whole trials and their copies, and the shrinkage of their scatter.
//!
//! There are three kinds of vectors: of whole trials, of excerpts and of twins ([`super::copies`]).
//! The scatter within classes pools them, each minus the mean of its class and kind. The shrinkage is
//! estimated (Ledoit and Wolf 2004, "A well-conditioned estimator for large-dimensional covariance
//! matrices"); each trial with its copies counts as one observation.

use std::sync::Arc;

use ndarray::{Array1, Array2, ArrayView1, Axis};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::copies::{COPIES, EXCERPTS};
use super::discriminant::{Discriminant, Vectors};
use super::frames::TrialFrames;
use super::joint::{JointEmbedder, Present, Stretch, columns, place};
use super::labels::Labels;
use super::linear::Residuals;
use super::packed;
use crate::system::give_back_memory;

/// Number of kinds of training vectors: whole trials, excerpts and twins.
const KINDS: usize = 3;

const SHRINKAGE: (f64, f64) = (1e-4, 1.0);

#[derive(Serialize, Deserialize)]
pub(super) struct Training {
    /// Shape (rows, D): one row for each whole trial, then the rows of each trial's copies.
    #[serde(with = "packed::matrix")]
    rows: Array2<f32>,
    /// Class and kind of each row: kind · classes + class; kind 0 is a whole trial.
    labels: Vec<usize>,
    /// Group of each row. Rows of one group are left out together.
    groups: Vec<usize>,
    classes: usize,
    /// Shrinkage γ of the scatter.
    shrinkage: f64,
    group_count: usize,
    pub present: Vec<Present>,
}

impl Training {
    /// Embeds a library, and sets the scales and bases of `joint`. Frees the copies, which take most of
    /// the memory, unless other folds share the trials.
    pub(super) fn new(
        joint: &mut JointEmbedder,
        library: &mut [Arc<TrialFrames>],
        labels: &Labels,
        seed: u64,
    ) -> Self {
        let forget = |trial: &mut Arc<TrialFrames>| {
            Arc::get_mut(trial).into_iter().for_each(TrialFrames::forget_copies);
        };
        let rows = joint.training_rows(library, seed, forget);
        let present = library.iter().map(|trial| joint.present(trial)).collect();
        give_back_memory();
        let mut training = Self::of(rows, present, 0.0, labels);
        training.fill_absent(joint);
        training.shrinkage = training.measured_shrinkage(features(&joint.stretches, None));
        training
    }

    fn of(rows: Array2<f32>, present: Vec<Present>, shrinkage: f64, labels: &Labels) -> Self {
        let of_row = |row: usize| {
            let (trial, vector) = place(row, present.len());
            let kind = usize::from(vector > 0) + usize::from(vector > EXCERPTS);
            (kind * labels.classes + labels.class[trial], labels.group[trial])
        };
        let (of_rows, groups) = (0..rows.nrows()).map(of_row).unzip();
        let (classes, group_count) = (labels.classes, labels.groups);
        Self { rows, labels: of_rows, groups, classes, group_count, shrinkage, present }
    }

    /// Checks stored training vectors; `None` if they do not fit these labels or `dims` features.
    pub(super) fn restored(self, labels: &Labels, dims: usize) -> Option<Self> {
        let Self { rows, present, shrinkage, .. } = self;
        let trials = labels.class.len();
        let fits = present.len() == trials && rows.dim() == (trials * (1 + COPIES), dims);
        fits.then(|| Self::of(rows, present, shrinkage, labels))
    }

    /// Sets the columns of a source that a row lacks to the mean of the other rows of its label, so
    /// that they neither move means nor add scatter.
    fn fill_absent(&mut self, joint: &JointEmbedder) {
        let trial = |row| place(row, self.present.len()).0;
        for (s, stretch) in joint.stretches.iter().enumerate() {
            if self.present.iter().all(|has| has[s]) {
                continue;
            }
            let columns = ndarray::s![stretch.columns.clone()];
            let none = (0.0f32, Array1::<f32>::zeros(stretch.columns.len()));
            let mut sums = vec![none; KINDS * self.classes];
            for (row, values) in self.rows.rows().into_iter().enumerate() {
                if self.present[trial(row)][s] {
                    let (count, sum) = &mut sums[self.labels[row]];
                    *count += 1.0;
                    *sum += &values.slice(columns);
                }
            }
            for (row, mut values) in self.rows.rows_mut().into_iter().enumerate() {
                let (count, sum) = &sums[self.labels[row]];
                if !self.present[trial(row)][s] && *count > 0.0 {
                    values.slice_mut(columns).assign(&(sum / *count));
                }
            }
        }
    }

    /// γ = [Σ_trials Σ_{a,b of the trial} (r_a·r_b)²/N² − ‖S‖²/n] / ‖S − μI‖². The r_a are the N rows
    /// of n trials minus the means of their labels, S = Σ r_a·r_aᵀ/N and μ = tr(S)/D for D features. If
    /// copies counted as separate observations, γ would be half as large.
    fn measured_shrinkage(&self, features: usize) -> f64 {
        let residuals = Residuals::new(&self.rows, &self.labels);
        let trials = self.present.len();
        let product = residuals.scatter();
        let residuals = residuals.rows;
        let (n, d) = (self.rows.nrows() as f64, features as f64);
        let trace = product.diag().sum() / n;
        let lower = |(i, row): (usize, ArrayView1<'_, f64>)| {
            let off: f64 = row.iter().take(i).map(|x| x * x).sum();
            2.0 * off + row[i] * row[i]
        };
        let square = product.rows().into_iter().enumerate().map(lower).sum::<f64>() / (n * n);
        let of_trial = |trial: usize| -> f64 {
            let copies = (0..COPIES).map(|copy| trials + trial * COPIES + copy);
            let own: Vec<usize> = std::iter::once(trial).chain(copies).collect();
            let inner = |a: usize, b: usize| f64::from(residuals.row(a).dot(&residuals.row(b)));
            own.iter().flat_map(|&a| own.iter().map(move |&b| inner(a, b).powi(2))).sum()
        };
        let within: f64 =
            (0..trials).into_par_iter().map(of_trial).collect::<Vec<_>>().iter().sum();
        let spread = square - trace * trace / d;
        let shrinkage = (within / (n * n) - square / trials.max(1) as f64) / spread;
        if shrinkage.is_nan() { SHRINKAGE.1 } else { shrinkage.clamp(SHRINKAGE.0, SHRINKAGE.1) }
    }

    pub(super) fn whole(&self, trial: usize) -> ArrayView1<'_, f32> {
        self.rows.row(trial)
    }

    pub(super) fn excerpts(&self, trial: usize) -> impl Iterator<Item = ArrayView1<'_, f32>> {
        let first = self.present.len() + trial * COPIES;
        (first..first + EXCERPTS).map(|row| self.rows.row(row))
    }

    pub(super) fn class_mean(&self, labels: &Labels, class: usize) -> Array1<f32> {
        let members: Vec<usize> =
            (0..labels.class.len()).filter(|&i| labels.class[i] == class).collect();
        let sum = self.rows.select(Axis(0), &members).sum_axis(Axis(0));
        sum / members.len().max(1) as f32
    }

    /// Discriminants for the sources that are `present`: trained on all trials, and without each
    /// group. An entry is `None` if the remaining trials are too few or all alike. If not even all
    /// trials can train a discriminant, the first one gives plain distances to the class means.
    pub(super) fn discriminants(
        &self,
        joint: &JointEmbedder,
        present: &Present,
    ) -> (Discriminant, Vec<Option<Discriminant>>) {
        let columns = columns(&joint.stretches, present);
        let selected;
        let rows = if columns.len() == self.rows.ncols() {
            &self.rows
        } else {
            selected = self.rows.select(Axis(1), &columns);
            &selected
        };
        let features = features(&joint.stretches, Some(present));
        let (all, without) = Discriminant::train(&self.vectors(rows), features, self.shrinkage);
        let spread = |discriminant: Discriminant| discriminant.spread(&columns, joint.dims());
        let all = all.unwrap_or_else(|| Discriminant::of_means(&self.vectors(rows)));
        (spread(all), without.into_iter().map(|without| without.map(spread)).collect())
    }

    fn vectors<'a>(&'a self, rows: &'a Array2<f32>) -> Vectors<'a> {
        let Self { labels, groups, classes, group_count, .. } = self;
        Vectors { rows, labels, groups, classes: *classes, group_count: *group_count }
    }
}

/// Number of features of the sources that are `present`, or of all.
fn features(stretches: &[Stretch], present: Option<&Present>) -> usize {
    let is_present = |source: &usize| present.is_none_or(|present| present[*source]);
    (0..stretches.len()).filter(is_present).map(|source| stretches[source].features()).sum()
}
