//! What discriminants are trained on: whole trials and random excerpts of them.
//!
//! Other people drag at other places and speeds. Random excerpts of 40 % of a trial, the same span
//! for all its sources, show within one person's library what such differences do (method §9); the
//! scatter within classes pools them about the class's mean of excerpts, and whole trials about the
//! class's mean of whole trials. Where a library has several people, its whole trials show what
//! people do: how much excerpts still weigh is found by leaving people out (`left_out`).

use std::sync::{Arc, OnceLock};

use ndarray::{Array1, Array2, ArrayView1, Axis};
use rayon::prelude::*;

use super::discriminant::Discriminant;
use super::joint::{Excerpt, JointEmbedder, Present, columns};
use super::labels::Labels;
use super::linear::{cholesky, solve_lower_transposed};
use super::scatter::Scatter;
use super::series::Window;
use crate::recognise::features::frame_features::FrameFeatures;
use crate::recognise::features::image_features::QUARTERS;
use crate::seed;
use crate::trial::TrialKey;

/// Random excerpts of each trial.
const EXCERPTS: usize = 6;

/// Length of an excerpt as a share of its trial.
const SHARE: f64 = 0.4;

/// Added to the diagonal of inner products of vectors, as a share of its mean: beyond rounding in
/// f32, far below the shrinkage.
const JITTER: f64 = 1e-5;

/// The training vectors of a library, in the library's deviations.
pub(super) struct Training {
    /// Shape (rows, D): the whole of each trial, in order, then the excerpts of each.
    rows: Array2<f32>,
    /// Class of a whole trial; classes + class of an excerpt.
    labels: Vec<usize>,
    /// Group of each row: groups are left out together.
    groups: Vec<usize>,
    classes: usize,
    /// How much an excerpt weighs in the scatter within classes; a whole trial weighs 1.
    excerpt_weight: f64,
    /// Which sources each trial has.
    pub present: Vec<Present>,
    /// Sums over all rows, once they are needed.
    all: OnceLock<Scatter>,
}

impl Training {
    /// Embeds a library, and sets `joint` to its units.
    pub fn new(
        joint: &mut JointEmbedder,
        library: &[Arc<FrameFeatures>],
        labels: &Labels,
        seed: u64,
    ) -> Self {
        let embed = |trial: &Arc<FrameFeatures>| joint.raw(trial, &excerpts(&trial.key, seed));
        let mut vectors: Vec<Vec<Vec<f32>>> = library.par_iter().map(embed).collect();
        let present: Vec<Present> = library.iter().map(|trial| joint.present(trial)).collect();
        let wholes: Vec<(&[f32], &Present)> =
            vectors.iter().zip(&present).map(|(v, has)| (&v[0][..], has)).collect();
        joint.standardise_by(&wholes);
        vectors.par_iter_mut().zip(&present).for_each(|(of_trial, present)| {
            of_trial.iter_mut().for_each(|vector| joint.standardise(vector, present));
        });
        let mut rows = Array2::zeros((library.len() * (1 + EXCERPTS), joint.dims()));
        for (row, mut values) in rows.rows_mut().into_iter().enumerate() {
            let (trial, vector) = place(row, library.len());
            values.assign(&ArrayView1::from(&vectors[trial][vector]));
        }
        let mut training = Self::of(rows, present, 1.0, labels);
        training.fill_absent(joint);
        training
    }

    fn of(rows: Array2<f32>, present: Vec<Present>, excerpt_weight: f64, labels: &Labels) -> Self {
        let of_row = |row: usize| {
            let (trial, vector) = place(row, present.len());
            let class = labels.class[trial];
            (if vector == 0 { class } else { labels.classes + class }, labels.group[trial])
        };
        let (of_rows, groups) = (0..rows.nrows()).map(of_row).unzip();
        let (labels, classes) = (of_rows, labels.classes);
        Self { rows, labels, groups, classes, excerpt_weight, present, all: OnceLock::new() }
    }

    /// How much an excerpt weighs.
    pub fn excerpt_weight(&self) -> f64 {
        self.excerpt_weight
    }

    /// Gives excerpts a weight; sums by the one that they had are made anew.
    pub fn weigh_excerpts(&mut self, weight: f64) {
        if weight != self.excerpt_weight {
            (self.excerpt_weight, self.all) = (weight, OnceLock::new());
        }
    }

    /// All of it that does not follow from the labels: vectors, which sources each trial has, and
    /// the weight of excerpts.
    pub fn to_stored(&self) -> (&Array2<f32>, &[Present], f64) {
        (&self.rows, &self.present, self.excerpt_weight)
    }

    /// The same again; `None` if that is not of trials with these labels and vectors of `dims`.
    pub fn from_stored(
        (rows, present, excerpt_weight): (Array2<f32>, Vec<Present>, f64),
        labels: &Labels,
        dims: usize,
    ) -> Option<Self> {
        let trials = labels.class.len();
        let fits = present.len() == trials && rows.dim() == (trials * (1 + EXCERPTS), dims);
        fits.then(|| Self::of(rows, present, excerpt_weight, labels))
    }

    /// Sources that a row lacks take the mean of their label's other rows, so that they neither
    /// move means nor add scatter.
    fn fill_absent(&mut self, joint: &JointEmbedder) {
        let trial = |row| place(row, self.present.len()).0;
        for (s, stretch) in joint.stretches.iter().enumerate() {
            if self.present.iter().all(|has| has[s]) {
                continue;
            }
            let columns = ndarray::s![stretch.columns.clone()];
            let mut sums = vec![
                (0.0f32, ndarray::Array1::<f32>::zeros(stretch.columns.len()));
                2 * self.classes
            ];
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

    /// The whole of a trial.
    pub fn whole(&self, trial: usize) -> ArrayView1<'_, f32> {
        self.rows.row(trial)
    }

    /// Mean of the whole trials of a class.
    pub fn class_mean(&self, labels: &Labels, class: usize) -> Array1<f32> {
        let members: Vec<usize> =
            (0..labels.class.len()).filter(|&i| labels.class[i] == class).collect();
        let sum = self.rows.select(Axis(0), &members).sum_axis(Axis(0));
        sum / members.len().max(1) as f32
    }

    /// Distances to the class means alone, for a library that can train nothing.
    pub fn untrained(&self, joint: &JointEmbedder, present: &Present) -> Discriminant {
        let columns = columns(&joint.stretches, present);
        Discriminant::of_means(&self.all().select(&columns), self.classes)
            .spread(&columns, joint.dims())
    }

    /// A discriminant of the sources that are `present`, from all trials or from those outside one
    /// group. `None` where these are too few, or all alike.
    pub fn discriminant(
        &self,
        joint: &JointEmbedder,
        present: &Present,
        without: Option<usize>,
    ) -> Option<Discriminant> {
        let columns = columns(&joint.stretches, present);
        let used = |row: &usize| without.is_none_or(|group| self.groups[*row] != group);
        let rows: Vec<usize> = (0..self.rows.nrows()).filter(used).collect();
        let discriminant = if 2 * rows.len() < columns.len() {
            self.in_their_span(&rows, &columns)?
        } else {
            let mut scatter = self.all().select(&columns);
            if let Some(group) = without {
                let left_out: Vec<usize> =
                    (0..self.rows.nrows()).filter(|&row| self.groups[row] == group).collect();
                scatter.subtract(&self.select(&left_out, &columns), &self.labels_of(&left_out));
            }
            Discriminant::new(scatter, self.classes, columns.len())?
        };
        Some(discriminant.spread(&columns, joint.dims()))
    }

    fn all(&self) -> &Scatter {
        self.all.get_or_init(|| Scatter::new(&self.rows, &self.labels, self.weights()))
    }

    /// The weight of each label.
    fn weights(&self) -> Vec<f64> {
        let mut weights = vec![1.0; self.classes];
        weights.resize(2 * self.classes, self.excerpt_weight);
        weights
    }

    fn labels_of(&self, rows: &[usize]) -> Vec<usize> {
        rows.iter().map(|&row| self.labels[row]).collect()
    }

    fn select(&self, rows: &[usize], columns: &[usize]) -> Array2<f32> {
        let selected = self.rows.select(Axis(0), rows);
        if columns.len() == selected.ncols() { selected } else { selected.select(Axis(1), columns) }
    }

    /// The same discriminant where features are more than rows: in coordinates of the space that
    /// the rows span. With Z·Zᵀ = L·Lᵀ the rows of L are the rows of Z in the orthonormal basis
    /// L⁻¹·Z, and what lies outside that space is the same for all classes.
    fn in_their_span(&self, rows: &[usize], columns: &[usize]) -> Option<Discriminant> {
        let vectors = self.select(rows, columns);
        let mut inner = vectors.dot(&vectors.t()).mapv(f64::from);
        let jitter = JITTER * inner.diag().sum() / rows.len().max(1) as f64;
        inner.diag_mut().map_inplace(|x| *x += jitter);
        let mut factor = cholesky(inner)?;
        for (i, mut row) in factor.rows_mut().into_iter().enumerate() {
            row.slice_mut(ndarray::s![i + 1..]).fill(0.0);
        }
        let (inside, labels) = (factor.mapv(|x| x as f32), self.labels_of(rows));
        let scatter = Scatter::new(&inside, &labels, self.weights());
        let inside = Discriminant::new(scatter, self.classes, columns.len())?;
        Some(inside.map_projection(|projection| {
            let mut back = projection.t().mapv(f64::from);
            solve_lower_transposed(&factor, &mut back);
            back.t().mapv(|x| x as f32).dot(&vectors)
        }))
    }
}

/// The trial of a row, and which of its vectors the row is: 0 is the whole.
fn place(row: usize, trials: usize) -> (usize, usize) {
    match row.checked_sub(trials) {
        None => (row, 0),
        Some(excerpt) => (excerpt / EXCERPTS, 1 + excerpt % EXCERPTS),
    }
}

/// The whole, and random excerpts: the same for a trial of that name and that seed, whatever else
/// is in the library.
fn excerpts(key: &TrialKey, seed: u64) -> Vec<Excerpt> {
    let name = key.to_string();
    let mut rng = seed::rng(seed, &[b"excerpts", name.as_bytes()]);
    let excerpt = |i: usize| {
        let from = seed::uniform(&mut rng) * (1.0 - SHARE);
        let window = Window::Share { from, length: SHARE };
        Excerpt { window, part: QUARTERS[i % QUARTERS.len()] }
    };
    std::iter::once(Excerpt::WHOLE).chain((0..EXCERPTS).map(excerpt)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn excerpts_depend_on_trial_and_seed_alone() {
        let key = |n| TrialKey::new("oak", "expert", n);
        assert_eq!(excerpts(&key(1), 1), excerpts(&key(1), 1));
        assert_ne!(excerpts(&key(1), 1), excerpts(&key(2), 1));
        assert_ne!(excerpts(&key(1), 1), excerpts(&key(1), 2));
        assert_eq!(excerpts(&key(1), 1)[0], Excerpt::WHOLE);
        for excerpt in &excerpts(&key(3), 1)[1..] {
            let Window::Share { from, length } = excerpt.window else { panic!("a share") };
            assert!(from >= 0.0 && from + length <= 1.0);
        }
    }
}
