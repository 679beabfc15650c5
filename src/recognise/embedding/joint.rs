//! Puts all sources of a trial into one vector of features, standardised by the mean and deviation of
//! the library. The *stretch* of a source is its range of columns in the vector.

use std::ops::Range;
use std::sync::Arc;

use ndarray::ArrayView1;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::band_sums::BandSums;
use super::copies::{Copy, copies};
use super::frames::{SeriesFrames, SourceFrames, TrialFrames, samples_by};
use super::picture::PictureEmbedder;
use super::series::SeriesEmbedder;
use crate::recognise::error::{RecogniseError, nothing_in_common};
use crate::recognise::follow::LOOK_S;
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
    fn new(spec: &SourceSpec, trials: &[&SourceFrames]) -> Self {
        let series: Vec<_> = trials.iter().filter_map(|source| source.series()).collect();
        if series.is_empty() {
            let picture = |source: &&SourceFrames| match source {
                SourceFrames::Picture(tiles) => Some(tiles.counts(None)),
                SourceFrames::Series(_) => None,
            };
            let counts: Vec<_> = trials.iter().filter_map(picture).collect();
            return Self::Picture(PictureEmbedder::new(&counts));
        }
        Self::Series(Box::new(SeriesEmbedder::new(&series, spec.domain.band_hz())))
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
                embedder.embed(piece, series.rate_hz(), ln_gain)
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
    pub columns: Range<usize>,
}

impl Stretch {
    /// Whether a channel of the source is constant in the library and compared by its level.
    pub fn has_switch(&self) -> bool {
        matches!(&self.embedder, SourceEmbedder::Series(embedder) if embedder.has_switch())
    }

    /// Checks that the frequency bands of a series are those of the library. Its rate may differ, but
    /// must not be too low for the bands.
    fn check_rate(&self, series: &SeriesFrames) -> Result<(), RecogniseError> {
        match &self.embedder {
            SourceEmbedder::Series(library) if !series.views.comparable(&library.views) => {
                Err(RecogniseError::Rates {
                    source_name: self.spec.id.clone(),
                    query_hz: series.rate_hz(),
                    library_hz: library.views.0[0].rate_hz,
                    trial: self.first.to_string(),
                })
            }
            _ => Ok(()),
        }
    }
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct JointEmbedder {
    /// In the order of the scene; only sources that the library has.
    pub stretches: Vec<Stretch>,
    /// Mean of each feature over the library's whole trials.
    mean: Vec<f32>,
    /// 1/(standard deviation) of each feature.
    factor: Vec<f32>,
}

/// For each source of the vector, whether a trial has it.
pub(super) type Present = Vec<bool>;

impl JointEmbedder {
    /// Takes the scales of each source from a library; `standardise_by` sets means and deviations.
    pub fn new(scene: &Scene, library: &[Arc<TrialFrames>]) -> Self {
        let mut stretches: Vec<Stretch> = Vec::new();
        let mut dims = 0;
        for spec in scene.sources() {
            let with = |trial: &&Arc<TrialFrames>| trial.sources.contains_key(&spec.id);
            let Some(first) = library.iter().find(with) else { continue };
            let trials: Vec<_> = library.iter().filter_map(|t| t.sources.get(&spec.id)).collect();
            let embedder = SourceEmbedder::new(spec, &trials);
            let columns = dims..dims + embedder.dims();
            dims = columns.end;
            stretches.push(Stretch {
                spec: spec.clone(),
                embedder,
                first: first.key.clone(),
                columns,
            });
        }
        Self { stretches, mean: vec![0.0; dims], factor: vec![1.0; dims] }
    }

    /// Whether a stored embedder belongs to this scene, and its parts fit each other.
    pub fn is_of(&self, scene: &Scene) -> bool {
        let mut dims = 0;
        let follows = |stretch: &Stretch| {
            let columns = dims..dims + stretch.embedder.dims();
            dims = columns.end;
            stretch.columns == columns && scene.get(stretch.spec.id.as_str()) == Some(&stretch.spec)
        };
        self.stretches.iter().all(follows) && [self.mean.len(), self.factor.len()] == [dims; 2]
    }

    /// The stretch of a source; `None` if the library lacks the source.
    pub fn stretch(&self, id: &SourceId) -> Option<&Stretch> {
        self.stretches.iter().find(|stretch| stretch.spec.id == *id)
    }

    /// Checks that a query, or a library trial itself, can be compared with the library.
    pub fn check(&self, query: &TrialFrames) -> Result<(), RecogniseError> {
        if !query.sources.keys().any(|id| self.stretch(id).is_some()) {
            let ids = self.stretches.iter().map(|stretch| &stretch.spec.id);
            return Err(nothing_in_common(query.sources.keys(), ids));
        }
        for stretch in &self.stretches {
            if let Some(series) = query.sources.get(&stretch.spec.id).and_then(|s| s.series()) {
                stretch.check_rate(series)?;
            }
        }
        Ok(())
    }

    pub fn dims(&self) -> usize {
        self.mean.len()
    }

    pub fn present(&self, trial: &TrialFrames) -> Present {
        self.stretches.iter().map(|s| trial.sources.contains_key(&s.spec.id)).collect()
    }

    /// The vector of a whole trial, or of one copy with its number, and which sources the trial has.
    /// The vector is not standardised yet.
    pub fn raw(&self, trial: &TrialFrames, copy: Option<(usize, &Copy)>) -> (Vec<f32>, Present) {
        let of_source = |stretch: &Stretch| {
            let source = trial.sources.get(&stretch.spec.id)?;
            Some(stretch.embedder.embed(source, copy))
        };
        let parts: Vec<_> = self.stretches.par_iter().map(of_source).collect();
        self.joined(parts.into_iter())
    }

    /// Joins the columns of the sources to one vector; the columns of a missing source are 0.
    pub fn joined(&self, parts: impl Iterator<Item = Option<Vec<f32>>>) -> (Vec<f32>, Present) {
        let mut vector = vec![0.0; self.dims()];
        let mut present = vec![false; self.stretches.len()];
        for ((stretch, part), has) in self.stretches.iter().zip(parts).zip(&mut present) {
            if let Some(of_source) = part {
                vector[stretch.columns.clone()].copy_from_slice(&of_source);
                *has = true;
            }
        }
        (vector, present)
    }

    /// The vectors of a library trial, not standardised yet: first the whole trial, then its copies,
    /// which are drawn with `seed`.
    pub fn training_vectors(&self, trial: &TrialFrames, seed: u64) -> Vec<Vec<f32>> {
        let copies = copies(&trial.key, seed);
        let copies = copies.iter().enumerate().map(|copy| self.raw(trial, Some(copy)).0);
        std::iter::once(self.raw(trial, None).0).chain(copies).collect()
    }

    /// Sets the mean and deviation of each feature from whole trials. Each is given by its vector, not
    /// standardised yet, and by the sources that it has.
    pub fn standardise_by(&mut self, wholes: &[(&[f32], &Present)]) {
        for (s, stretch) in self.stretches.iter().enumerate() {
            let with: Vec<&[f32]> =
                wholes.iter().filter(|(_, has)| has[s]).map(|(vector, _)| *vector).collect();
            let n = with.len().max(1) as f64;
            for column in stretch.columns.clone() {
                let values = || with.iter().map(|vector| f64::from(vector[column]));
                let mean = values().sum::<f64>() / n;
                let variance = values().map(|x| (x - mean).powi(2)).sum::<f64>() / n;
                // A feature that hardly varies is not magnified.
                let deviation = variance.sqrt().max(1e-6 + 1e-3 * mean.abs());
                self.mean[column] = mean as f32;
                self.factor[column] = (1.0 / deviation) as f32;
            }
        }
    }

    /// Standardises a vector. Sources that are not `present` stay 0, which is the library's mean.
    pub fn standardise(&self, vector: &mut [f32], present: &Present) {
        for (stretch, _) in self.stretches.iter().zip(present).filter(|(_, has)| **has) {
            self.standardise_source(stretch, vector);
        }
    }

    fn standardise_source(&self, stretch: &Stretch, vector: &mut [f32]) {
        for column in stretch.columns.clone() {
            let z = (vector[column] - self.mean[column]) * self.factor[column];
            vector[column] = z.clamp(-CLIP, CLIP);
        }
        debug_assert!(vector.iter().all(|x| x.is_finite()));
    }

    /// The standardised vectors of the beginnings of a library trial's drag at each of `looks`: steps
    /// of [`LOOK_S`], counted from 1, ascending. Sources that do not belong to the drag, or ended
    /// before, have the values of `whole`, the vector of the whole trial.
    pub fn beginnings(
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
        for (stretch, part) in self.stretches.iter().zip(parts) {
            for (vector, of_source) in all.iter_mut().zip(part.into_iter().flatten()) {
                if let Some(of_source) = of_source {
                    vector[stretch.columns.clone()].copy_from_slice(&of_source);
                    self.standardise_source(stretch, vector);
                }
            }
        }
        all
    }

    /// Whether a trial has anything to compare: a picture, or a series at least as long as a short
    /// frame. The series must vary, or have a channel that is constant in the library, like a switch.
    pub fn says_something(&self, trial: &TrialFrames) -> bool {
        self.stretches.iter().any(|stretch| match trial.sources.get(&stretch.spec.id) {
            Some(SourceFrames::Series(series)) => {
                series.is_a_frame_long()
                    && (stretch.has_switch() || !series.whole.moments.is_constant())
            }
            Some(SourceFrames::Picture(_)) => true,
            None => false,
        })
    }

    /// Length of a trial's drag in seconds: its longest source recorded while dragging, if any.
    pub fn drag_s(&self, trial: &TrialFrames) -> Option<f64> {
        let drags = self.stretches.iter().filter(|s| s.spec.phase == Phase::Drag);
        let lengths = drags.filter_map(|s| trial.sources.get(&s.spec.id)?.series());
        lengths.map(|series| series.duration_s()).max_by(f64::total_cmp)
    }
}

pub(super) fn columns(stretches: &[Stretch], present: &Present) -> Vec<usize> {
    let there = stretches.iter().zip(present).filter(|(_, has)| **has);
    there.flat_map(|(stretch, _)| stretch.columns.clone()).collect()
}

/// The vectors of the beginnings of a series at each of `looks`; `None` after its end.
fn beginnings(
    embedder: &SeriesEmbedder,
    series: &SeriesFrames,
    looks: &[usize],
) -> Vec<Option<Vec<f32>>> {
    let rate_hz = series.rate_hz();
    let mut sums = series.views.0.each_ref().map(|view| BandSums::new(view.channels, view.width()));
    let mut taken = [0; 2];
    let of_look = |&number: &usize| {
        let look = series.looks.get(number.checked_sub(1)?)?;
        let samples = samples_by(number as f64 * LOOK_S, rate_hz);
        for (v, view) in series.views.0.iter().enumerate() {
            let end = view.frames_in(samples).max(taken[v]);
            sums[v].add(&series.whole.frames[v].part(view.width(), taken[v]..end));
            taken[v] = end;
        }
        let mut filled = sums.clone();
        filled.iter_mut().zip(&look.frames).for_each(|(sums, frame)| sums.add(&frame.values()));
        Some(embedder.vector(&filled, &look.moments, rate_hz, 0.0))
    };
    looks.iter().map(of_look).collect()
}
