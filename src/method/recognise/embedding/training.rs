//! Training vectors of whole trials and their copies.
//!
//! There are vectors of whole trials, of excerpts and of twins ([`super::copies`]).

use std::sync::Arc;

use ndarray::{Array1, Array2, ArrayView1, Axis, s};
use serde::{Deserialize, Serialize};

use super::discriminant::Rows;
use super::ensemble::Ensemble;
use super::joint::{JointEmbedder, Present, places};
use super::labels::Labels;
use crate::features::frames::TrialFrames;
use crate::features::packed;
use crate::system::give_back_memory;

/// Whole scans whose features differ by less, in standard deviations over scans and copies, are alike.
const ALIKE: f32 = 0.01;

#[derive(Serialize, Deserialize)]
pub(super) struct Training {
    /// Shape (rows, D): one row for each whole trial, then the rows of each trial's copies.
    #[serde(with = "packed::matrix")]
    vectors: Array2<f32>,
    /// The trial of each row, and whether the row is of an excerpt.
    origins: Vec<(usize, bool)>,
    #[serde(skip)]
    rows: Rows,
    pub present: Vec<Present>,
    seed: u64,
}

impl Training {
    /// Embeds a library, and sets the scales of `joint`. Frees the copies, which take most of the
    /// memory, unless other folds share the trials.
    pub(super) fn new(
        joint: &mut JointEmbedder,
        library: &mut [Arc<TrialFrames>],
        labels: &Labels,
        seed: u64,
    ) -> Self {
        let forget = |trial: &mut Arc<TrialFrames>| {
            Arc::get_mut(trial).into_iter().for_each(TrialFrames::forget_copies);
        };
        let origins = places(library).into_iter().map(|(trial, copy)| {
            let copy = copy.and_then(|copy| library[trial].copies[copy].place);
            (trial, copy.is_some())
        });
        let origins: Vec<_> = origins.collect();
        let vectors = joint.training_rows(library, forget);
        let present: Vec<Present> = library.iter().map(|trial| joint.present(trial)).collect();
        give_back_memory();
        let rows = rows(labels, &origins);
        let mut training = Self { vectors, origins, rows, present, seed };
        training.fill_absent(joint);
        training
    }

    /// Checks stored training vectors; `None` if they do not fit these labels or `dims` features.
    pub(super) fn restored(mut self, labels: &Labels, dims: usize) -> Option<Self> {
        let trials = labels.class.len();
        let fits = self.present.len() == trials
            && self.vectors.dim() == (self.origins.len(), dims)
            && self.origins.len() > trials
            && (0..trials).all(|trial| self.origins[trial] == (trial, false))
            && self.origins.iter().all(|(trial, _)| *trial < trials);
        self.rows = fits.then(|| rows(labels, &self.origins))?;
        Some(self)
    }

    /// Sets the columns of a source that a row lacks to the mean of the other rows of its class, whole
    /// scans and excerpts apart, so that they do not move means.
    fn fill_absent(&mut self, joint: &JointEmbedder) {
        let Self { vectors, rows, present, .. } = self;
        for (s, stretch) in joint.stretches.iter().enumerate() {
            if present.iter().all(|has| has[s]) {
                continue;
            }
            let columns = s![stretch.columns.clone()];
            let none = (0.0f32, Array1::<f32>::zeros(stretch.columns.len()));
            let mut sums = vec![none; 2 * rows.classes];
            for (row, values) in vectors.rows().into_iter().enumerate() {
                if present[rows.trials[row]][s] {
                    let (count, sum) = &mut sums[rows.part[row]];
                    *count += 1.0;
                    *sum += &values.slice(columns);
                }
            }
            for (row, mut values) in vectors.rows_mut().into_iter().enumerate() {
                let (count, sum) = &sums[rows.part[row]];
                if !present[rows.trials[row]][s] && *count > 0.0 {
                    values.slice_mut(columns).assign(&(sum / *count));
                }
            }
        }
    }

    pub(super) fn whole(&self, trial: usize) -> ArrayView1<'_, f32> {
        self.vectors.row(trial)
    }

    pub(super) fn excerpts(&self, trial: usize) -> impl Iterator<Item = ArrayView1<'_, f32>> {
        let rows = self.origins.iter().zip(self.vectors.rows());
        rows.filter(move |(origin, _)| **origin == (trial, true)).map(|(_, row)| row)
    }

    pub(super) fn class_mean(&self, labels: &Labels, class: usize) -> Array1<f32> {
        let members: Vec<usize> =
            (0..labels.class.len()).filter(|&i| labels.class[i] == class).collect();
        let sum = self.vectors.select(Axis(0), &members).sum_axis(Axis(0));
        sum / members.len().max(1) as f32
    }

    /// Ensembles for the sources that are `present`: trained on all trials, and without each group; see
    /// [`Ensemble::train`].
    pub(super) fn ensembles(
        &self,
        joint: &JointEmbedder,
        present: &Present,
    ) -> (Ensemble, Vec<Option<Ensemble>>) {
        let columns = self.varying(joint.columns(present));
        Ensemble::train(&self.vectors, &columns, &self.rows, self.seed)
    }

    /// The columns in which whole scans differ, or all if none is such. Most of a constant channel's columns
    /// vary in the copies alone, and would leave no room for its level.
    fn varying(&self, columns: Vec<usize>) -> Vec<usize> {
        let whole = self.vectors.slice(s![..self.present.len(), ..]);
        let differ = |&column: &usize| {
            let first = whole[[0, column]];
            whole.column(column).iter().any(|x| (x - first).abs() > ALIKE)
        };
        let varying: Vec<usize> = columns.iter().copied().filter(differ).collect();
        if varying.is_empty() { columns } else { varying }
    }
}

/// Classes, groups and trials of the training vectors of a library.
fn rows(labels: &Labels, origins: &[(usize, bool)]) -> Rows {
    let part = |&(trial, is_excerpt): &(usize, bool)| {
        labels.class[trial] + labels.classes * usize::from(is_excerpt)
    };
    Rows {
        part: origins.iter().map(part).collect(),
        groups: origins.iter().map(|(trial, _)| labels.group[*trial]).collect(),
        trials: origins.iter().map(|(trial, _)| *trial).collect(),
        classes: labels.classes,
        group_count: labels.groups,
    }
}
