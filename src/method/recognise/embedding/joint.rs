//! Puts all sources of a trial into one vector. The features of each source are standardised by the
//! mean and deviation of the library. The *stretch* of a source is its range of columns in the vector.

use std::fmt::Display;
use std::ops::Range;
use std::sync::Arc;

use ndarray::{Array2, ArrayView1, ArrayViewMut1, ArrayViewMut2, Axis, s};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::picture::PictureEmbedder;
use super::series::SeriesEmbedder;
use crate::features::copies::Copy;
use crate::features::counts::Counts;
use crate::features::frames::{LOOK_S, SeriesFrames, SourceFrames, TrialFrames, samples_by};
use crate::features::moments::Moments;
use crate::features::views::SourceViews;
use crate::recognise::error::{RecogniseError, Result, nothing_in_common};
use crate::scene::{Phase, Scene, SourceId, SourceSpec};
use crate::trial::TrialKey;

/// Standardised features are clipped to ± this value.
const CLIP: f32 = 8.0;

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) enum SourceEmbedder {
    Series(Box<SeriesEmbedder>),
    Picture(PictureEmbedder),
}

impl SourceEmbedder {
    /// Makes the embedder of a source from the `trials` of a library that have it, at least one.
    fn new(trials: &[(&str, &SourceFrames)]) -> Self {
        let series =
            trials.iter().filter_map(|(surface, source)| Some((*surface, source.series()?)));
        let series: Vec<_> = series.collect();
        if series.is_empty() {
            let picture = |(_, source): &(_, &SourceFrames)| match source {
                SourceFrames::Picture(tiles) => Some(tiles.counts(None)),
                SourceFrames::Series(_) => None,
            };
            let counts: Vec<_> = trials.iter().filter_map(picture).collect();
            return Self::Picture(PictureEmbedder::new(&counts));
        }
        Self::Series(Box::new(SeriesEmbedder::new(&series)))
    }

    fn dims(&self) -> usize {
        match self {
            Self::Series(series) => series.dims(),
            Self::Picture(picture) => picture.dims(),
        }
    }

    /// The vector of a whole source, or of one copy of it; `copy` gives the number of the copy.
    fn embed(&self, source: &SourceFrames, copy: Option<(usize, &Copy)>) -> Vec<f32> {
        match (self, source) {
            (Self::Series(embedder), SourceFrames::Series(series)) => {
                let copied = copy.and_then(|(i, copy)| Some((series.copies.get(i)?, copy.ln_gain)));
                let (piece, ln_gain) = copied.unwrap_or((&series.whole, 0.0));
                // An excerpt may lie anywhere, so it has the places of the whole.
                let is_excerpt = copy.is_some_and(|(_, copy)| copy.place.is_some());
                let places = if is_excerpt { &series.whole.places } else { &piece.places };
                embedder.embed(piece, places, series.views.moments_hz(), ln_gain)
            }
            (Self::Picture(embedder), SourceFrames::Picture(tiles)) => {
                let ln_gain = copy.map_or(0.0, |(_, copy)| copy.picture_ln_gain);
                embedder.vector(tiles, copy.map(|(_, copy)| copy.quarter), ln_gain)
            }
            // Does not occur: trials were checked to hold the kind of data that the scene says.
            _ => vec![0.0; self.dims()],
        }
    }
}

/// One source and its columns in the vector.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Stretch {
    pub spec: SourceSpec,
    pub embedder: SourceEmbedder,
    /// The first library trial that has the source, for error messages.
    first: TrialKey,
    /// Mean of each feature over the library's trials and their copies.
    mean: Vec<f32>,
    /// 1/(standard deviation) of each feature.
    factor: Vec<f32>,
    pub columns: Range<usize>,
}

impl Stretch {
    /// Sets the columns of the source in a vector to its features, standardised.
    fn fill(&self, vector: &mut [f32], features: &[f32]) {
        let columns = &mut vector[self.columns.clone()];
        columns.copy_from_slice(features);
        standardise(columns.into(), &self.mean, &self.factor);
    }

    /// Sets the mean and deviation of each feature over the rows that are `there`, whole trials and
    /// copies, and standardises these rows. So a feature that noise or another hand moves far is not
    /// magnified because it hardly varies between whole trials.
    fn standardise_by(&mut self, mut rows: ArrayViewMut2<'_, f32>, there: &[usize]) {
        /// Columns that one thread standardises at a time.
        const COLUMNS: usize = 512;
        let (mean, factor) = (&mut self.mean, &mut self.factor);
        mean.resize(rows.ncols(), 0.0);
        factor.resize(rows.ncols(), 0.0);
        let scales = mean.par_chunks_mut(COLUMNS).zip(factor.par_chunks_mut(COLUMNS));
        let columns: Vec<_> = rows.axis_chunks_iter_mut(Axis(1), COLUMNS).collect();
        columns.into_par_iter().zip(scales).for_each(|(mut rows, (mean, factor))| {
            let n = there.len().max(1) as f64;
            let (mut means, mut variances) = (vec![0.0; mean.len()], vec![0.0; mean.len()]);
            // Row by row, as they lie in memory.
            for &row in there {
                means.iter_mut().zip(rows.row(row)).for_each(|(sum, &x)| *sum += f64::from(x));
            }
            means.iter_mut().for_each(|mean| *mean /= n);
            for &row in there {
                for ((sum, mean), &x) in variances.iter_mut().zip(&means).zip(rows.row(row)) {
                    *sum += (f64::from(x) - mean).powi(2);
                }
            }
            for (i, (own, variance)) in means.iter().zip(variances).enumerate() {
                mean[i] = *own as f32;
                // A feature that hardly varies is not magnified.
                factor[i] = (1.0 / (variance / n).sqrt().max(1e-6 + 1e-3 * own.abs())) as f32;
            }
            there.iter().for_each(|&row| standardise(rows.row_mut(row), mean, factor));
        });
    }

    /// Whether a series has anything to compare: it is at least as long as a short frame, and varies or
    /// has a channel that is constant in the library, like a switch.
    pub(super) fn compares(&self, views: &SourceViews, samples: usize, moments: &Moments) -> bool {
        let has_switch =
            matches!(&self.embedder, SourceEmbedder::Series(embedder) if embedder.has_switch());
        samples >= views.frames[1].points && (has_switch || !moments.is_constant())
    }

    /// Checks that the frequency bands of a series are those of the library. Its rate may differ, but
    /// must not be too low for the bands. `like` names what has the library's rate.
    pub(super) fn check_rate(&self, views: &SourceViews, like: &dyn Display) -> Result<()> {
        match &self.embedder {
            SourceEmbedder::Series(library) if !views.comparable(&library.views) => {
                Err(RecogniseError::Rates {
                    source_name: self.spec.id.clone(),
                    query_hz: views.frames[0].rate_hz,
                    library_hz: library.views.frames[0].rate_hz,
                    trial: like.to_string(),
                })
            }
            _ => Ok(()),
        }
    }
}

fn standardise(mut features: ArrayViewMut1<'_, f32>, mean: &[f32], factor: &[f32]) {
    for ((x, mean), factor) in features.iter_mut().zip(mean).zip(factor) {
        *x = ((*x - mean) * factor).clamp(-CLIP, CLIP);
    }
    debug_assert!(features.iter().all(|x| x.is_finite()));
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct JointEmbedder {
    /// In the order of the scene; only sources that the library has.
    pub stretches: Vec<Stretch>,
}

/// For each source of the vector, whether a trial has it.
pub(super) type Present = Vec<bool>;

impl JointEmbedder {
    /// Takes the scales of each source from a library. `training_rows` sets means and
    /// deviations.
    pub(super) fn new(scene: &Scene, library: &[Arc<TrialFrames>]) -> Self {
        let mut stretches: Vec<Stretch> = Vec::new();
        for spec in scene.sources() {
            let with = |trial: &&Arc<TrialFrames>| trial.sources.contains_key(&spec.id);
            let Some(first) = library.iter().find(with) else { continue };
            let trials = library.iter().filter_map(|trial| {
                Some((trial.key.surface.as_str(), trial.sources.get(&spec.id)?))
            });
            let embedder = SourceEmbedder::new(&trials.collect::<Vec<_>>());
            stretches.push(Stretch {
                spec: spec.clone(),
                embedder,
                first: first.key.clone(),
                mean: Vec::new(),
                factor: Vec::new(),
                columns: 0..0,
            });
        }
        Self { stretches }
    }

    /// Whether a stored embedder belongs to this scene, and its parts fit each other.
    pub(super) fn is_of(&self, scene: &Scene) -> bool {
        let mut dims = 0;
        let follows = |stretch: &Stretch| {
            let Stretch { spec, embedder, mean, factor, columns, .. } = stretch;
            let first = dims;
            dims = columns.end;
            columns.start == first
                && scene.get(spec.id.as_str()) == Some(spec)
                && [mean.len(), factor.len(), columns.len()] == [embedder.dims(); 3]
        };
        self.stretches.iter().all(follows)
    }

    /// The stretches of the sources that are `present`.
    pub(super) fn there<'a>(&'a self, present: &'a Present) -> impl Iterator<Item = &'a Stretch> {
        self.stretches.iter().zip(present).filter(|(_, has)| **has).map(|(stretch, _)| stretch)
    }

    pub(super) fn columns(&self, present: &Present) -> Vec<usize> {
        self.there(present).flat_map(|stretch| stretch.columns.clone()).collect()
    }

    /// The stretch of a source; `None` if the library lacks the source.
    pub(super) fn stretch(&self, id: &SourceId) -> Option<&Stretch> {
        self.stretches.iter().find(|stretch| stretch.spec.id == *id)
    }

    /// Checks that a query, or a library trial itself, can be compared with the library.
    pub(super) fn check(&self, query: &TrialFrames) -> Result<()> {
        if !query.sources.keys().any(|id| self.stretch(id).is_some()) {
            let ids = self.stretches.iter().map(|stretch| &stretch.spec.id);
            return Err(nothing_in_common(query.sources.keys(), ids));
        }
        for stretch in &self.stretches {
            if let Some(series) = query.sources.get(&stretch.spec.id).and_then(|s| s.series()) {
                stretch.check_rate(&series.views, &stretch.first)?;
            }
        }
        Ok(())
    }

    pub(super) fn dims(&self) -> usize {
        self.stretches.last().map_or(0, |stretch| stretch.columns.end)
    }

    pub(super) fn present(&self, trial: &TrialFrames) -> Present {
        self.stretches.iter().map(|s| trial.sources.contains_key(&s.spec.id)).collect()
    }

    /// The features of each source of a whole trial, or of one copy with its number.
    fn features(&self, trial: &TrialFrames, copy: Option<(usize, &Copy)>) -> Vec<Option<Vec<f32>>> {
        let of_source = |stretch: &Stretch| {
            let source = trial.sources.get(&stretch.spec.id)?;
            Some(stretch.embedder.embed(source, copy))
        };
        self.stretches.par_iter().map(of_source).collect()
    }

    /// The vector of a trial, and which sources it has.
    pub(super) fn embed(&self, trial: &TrialFrames) -> (Vec<f32>, Present) {
        self.joined(self.features(trial, None).into_iter())
    }

    /// Joins the features of the sources to one vector. The columns of a missing source are 0, which is
    /// the library's mean.
    pub(super) fn joined(
        &self,
        features: impl Iterator<Item = Option<Vec<f32>>>,
    ) -> (Vec<f32>, Present) {
        let mut vector = vec![0.0; self.dims()];
        let mut present = vec![false; self.stretches.len()];
        for ((stretch, features), has) in self.stretches.iter().zip(features).zip(&mut present) {
            if let Some(features) = features {
                stretch.fill(&mut vector, &features);
                *has = true;
            }
        }
        (vector, present)
    }

    /// Embeds a library and the copies of its trials, and sets the mean and deviation of each feature.
    /// Gives the vectors as rows: one for each whole trial, then those of each trial's copies. `done` is
    /// called with each trial after it was embedded.
    pub(super) fn training_rows(
        &mut self,
        library: &mut [Arc<TrialFrames>],
        done: impl Fn(&mut Arc<TrialFrames>) + Sync,
    ) -> Array2<f32> {
        let embed = |trial: &mut Arc<TrialFrames>| {
            let copies =
                trial.copies.iter().enumerate().map(|copy| self.features(trial, Some(copy)));
            let all: Vec<_> = std::iter::once(self.features(trial, None)).chain(copies).collect();
            done(trial);
            all
        };
        let mut vectors: Vec<Vec<Vec<Option<Vec<f32>>>>> =
            library.par_iter_mut().map(embed).collect();
        let places = places(library);
        let dims = self.stretches.iter().map(|stretch| stretch.embedder.dims()).sum();
        let rows = places.len();
        let mut all = Array2::zeros((rows, dims));
        let mut first = 0;
        for (source, stretch) in self.stretches.iter_mut().enumerate() {
            stretch.columns = first..first + stretch.embedder.dims();
            first = stretch.columns.end;
            let mut there = Vec::new();
            for (row, (trial, copy)) in places.iter().copied().enumerate() {
                let vector = copy.map_or(0, |copy| copy + 1);
                if let Some(features) = vectors[trial][vector][source].take() {
                    let columns = s![row, stretch.columns.clone()];
                    all.slice_mut(columns).assign(&ArrayView1::from(&features));
                    there.push(row);
                }
            }
            let columns = all.slice_mut(s![.., stretch.columns.clone()]);
            stretch.standardise_by(columns, &there);
        }
        all
    }

    /// The vectors of the beginnings of a library trial's drag at each of `looks`: steps
    /// of [`LOOK_S`], counted from 1, ascending. Sources that do not belong to the drag, or ended
    /// before, have the values of `whole`, the vector of the whole trial.
    pub(super) fn beginnings(
        &self,
        trial: &TrialFrames,
        whole: ArrayView1<'_, f32>,
        looks: &[usize],
    ) -> Vec<Vec<f32>> {
        let of_source = |stretch: &Stretch| match &stretch.embedder {
            SourceEmbedder::Series(embedder) if stretch.spec.phase == Phase::Drag => {
                let series = trial.sources.get(&stretch.spec.id)?.series()?;
                Some(beginnings(embedder, series, looks))
            }
            _ => None,
        };
        let parts: Vec<_> = self.stretches.par_iter().map(of_source).collect();
        let mut all = vec![whole.to_vec(); looks.len()];
        for (stretch, features) in self.stretches.iter().zip(parts) {
            let Some(features) = features.filter(|looks| !looks.is_empty()) else { continue };
            for (vector, features) in all.iter_mut().zip(features) {
                stretch.fill(vector, &features);
            }
        }
        all
    }

    /// Whether a trial has anything to compare: a picture, or a series that [`Stretch::compares`].
    pub(super) fn says_something(&self, trial: &TrialFrames) -> bool {
        self.stretches.iter().any(|stretch| match trial.sources.get(&stretch.spec.id) {
            Some(SourceFrames::Series(series)) => {
                stretch.compares(&series.views, series.samples, &series.whole.moments)
            }
            Some(SourceFrames::Picture(_)) => true,
            None => false,
        })
    }

    /// Length of a trial's drag in seconds: its longest source recorded while dragging, if any.
    pub(super) fn drag_s(&self, trial: &TrialFrames) -> Option<f64> {
        let drags = self.stretches.iter().filter(|s| s.spec.phase == Phase::Drag);
        let lengths = drags.filter_map(|s| trial.sources.get(&s.spec.id)?.series());
        lengths.map(|series| series.duration_s()).max_by(f64::total_cmp)
    }
}

/// The features of the beginnings of a series at each of `looks` up to its end.
fn beginnings(embedder: &SeriesEmbedder, series: &SeriesFrames, looks: &[usize]) -> Vec<Vec<f32>> {
    let (rate_hz, moments_hz) = (series.rate_hz(), series.views.moments_hz());
    let mut sums =
        series.views.frames.each_ref().map(|view| Counts::new(view.channels, view.width()));
    let mut taken = [0; 2];
    let of_look = |&number: &usize| {
        let look = series.looks.get(number.checked_sub(1)?)?;
        let samples = samples_by(number as f64 * LOOK_S, rate_hz);
        for (v, view) in series.views.frames.iter().enumerate() {
            let end = view.frames_in(samples).max(taken[v]);
            sums[v].add(&series.whole.frames[v].part(view.width(), taken[v]..end));
            taken[v] = end;
        }
        Some(embedder.growing(&sums, look, moments_hz))
    };
    looks.iter().map_while(of_look).collect()
}

/// The trial of each training row, and the number of its copy; none for the whole.
pub(super) fn places(library: &[Arc<TrialFrames>]) -> Vec<(usize, Option<usize>)> {
    let copies = library
        .iter()
        .enumerate()
        .flat_map(|(number, trial)| (0..trial.copies.len()).map(move |copy| (number, Some(copy))));
    (0..library.len()).map(|trial| (trial, None)).chain(copies).collect()
}
