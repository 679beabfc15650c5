//! Puts all sources of a trial into one vector of features, standardised by mean and deviation of
//! the library. The *stretch* of a source is its range of columns.

use std::ops::Range;
use std::sync::Arc;

use ndarray::ArrayView1;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::copies::{Copy, copies};
use super::frames::{SeriesFrames, SourceFrames, TrialFrames, samples_by};
use super::picture::PictureEmbedder;
use super::series::{SeriesEmbedder, counted};
use super::tiles::Part;
use crate::recognise::checks::nothing_in_common;
use crate::recognise::error::RecogniseError;
use crate::recognise::follow::LOOK_S;
use crate::scene::{Phase, Scene, SourceId, SourceSpec};
use crate::trial::TrialKey;

/// Standardised features are clipped to plus or minus this.
const CLIP: f32 = 8.0;

/// How one source becomes its stretch of the vector.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) enum SourceEmbedder {
    Series(Box<SeriesEmbedder>),
    Picture(PictureEmbedder),
}

impl SourceEmbedder {
    fn new(spec: &SourceSpec, trials: &[&SourceFrames]) -> Option<Self> {
        let series: Vec<_> = trials.iter().filter_map(|source| source.series()).collect();
        let pictures: Vec<_> = trials.iter().filter_map(|source| source.picture()).collect();
        if !series.is_empty() {
            Some(Self::Series(Box::new(SeriesEmbedder::new(&series, spec.domain.band_hz()))))
        } else if !pictures.is_empty() {
            Some(Self::Picture(PictureEmbedder::new(&pictures)))
        } else {
            None
        }
    }

    fn dims(&self) -> usize {
        match self {
            Self::Series(series) => series.dims(),
            Self::Picture(picture) => picture.dims(),
        }
    }

    /// The vector of a whole source, or of a copy of it, which has this number among the copies.
    fn embed(&self, source: &SourceFrames, copy: Option<(usize, &Copy)>) -> Vec<f32> {
        match (self, source) {
            (Self::Series(embedder), SourceFrames::Series(series)) => {
                let copied = copy.and_then(|(i, copy)| Some((series.copies.get(i)?, copy.ln_gain)));
                let (piece, ln_gain) = copied.unwrap_or((&series.whole, 0.0));
                embedder.embed(piece, series.rate_hz(), ln_gain)
            }
            (Self::Picture(embedder), SourceFrames::Picture(tiles)) => {
                let copied =
                    |(_, copy): (usize, &Copy)| (Part::Quarter(copy.quarter), copy.picture_ln_gain);
                let (part, ln_gain) = copy.map_or((Part::Whole, 0.0), copied);
                embedder.vector(tiles, part, ln_gain)
            }
            // Does not occur: trials are checked to hold the kind of data that the scene says.
            _ => vec![0.0; self.dims()],
        }
    }
}

/// One source, and its columns of the vector.
#[derive(Clone, Debug)]
pub(super) struct Stretch {
    pub spec: SourceSpec,
    pub embedder: SourceEmbedder,
    /// The first trial of the library that has the source, for messages.
    first: TrialKey,
    /// Its columns of the vector.
    pub columns: Range<usize>,
}

impl Stretch {
    /// Whether a channel of the source is constant in the library and compared by its level.
    pub fn has_switch(&self) -> bool {
        matches!(&self.embedder, SourceEmbedder::Series(embedder) if embedder.has_switch())
    }

    /// Checks that a series can be compared with the library's by frequency in Hz. Its rate may
    /// differ, but must not be too low for the library's band.
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

/// How trials become vectors.
#[derive(Clone, Debug)]
pub(super) struct JointEmbedder {
    /// In the scene's order; only sources that the library has.
    pub stretches: Vec<Stretch>,
    /// Mean of each feature over the library's whole trials.
    mean: Vec<f32>,
    /// 1/standard deviation of each feature.
    factor: Vec<f32>,
}

/// The parts of a [`JointEmbedder`] that its scene does not give.
#[derive(Serialize, Deserialize)]
pub(super) struct StoredJoint {
    sources: Vec<(SourceId, SourceEmbedder, TrialKey)>,
    mean: Vec<f32>,
    factor: Vec<f32>,
}

/// For each source of the vector: whether a trial has it.
pub(super) type Present = Vec<bool>;

impl JointEmbedder {
    /// Takes each source's scales from a library; `standardise_by` sets means and deviations.
    pub fn new(scene: &Scene, library: &[Arc<TrialFrames>]) -> Self {
        let of_source = |spec: &SourceSpec| {
            let with = |t: &'_ Arc<TrialFrames>| t.sources.contains_key(&spec.id);
            let first = library.iter().find(|t| with(t))?.key.clone();
            let trials: Vec<_> = library.iter().filter_map(|t| t.sources.get(&spec.id)).collect();
            Some((spec.clone(), SourceEmbedder::new(spec, &trials)?, first))
        };
        let mut joint = Self::of(scene.sources().filter_map(of_source));
        let dims = joint.stretches.last().map_or(0, |s| s.columns.end);
        (joint.mean, joint.factor) = (vec![0.0; dims], vec![1.0; dims]);
        joint
    }

    fn of(sources: impl Iterator<Item = (SourceSpec, SourceEmbedder, TrialKey)>) -> Self {
        let mut stretches: Vec<Stretch> = Vec::new();
        for (spec, embedder, first) in sources {
            let begin = stretches.last().map_or(0, |s| s.columns.end);
            let columns = begin..begin + embedder.dims();
            stretches.push(Stretch { spec, embedder, first, columns });
        }
        Self { stretches, mean: Vec::new(), factor: Vec::new() }
    }

    /// The parts to store: those that the scene does not give.
    pub fn to_stored(&self) -> StoredJoint {
        let parts = |s: &Stretch| (s.spec.id.clone(), s.embedder.clone(), s.first.clone());
        StoredJoint {
            sources: self.stretches.iter().map(parts).collect(),
            mean: self.mean.clone(),
            factor: self.factor.clone(),
        }
    }

    /// Restores an embedder; `None` if the stored parts do not fit the scene.
    pub fn from_stored(scene: &Scene, stored: StoredJoint) -> Option<Self> {
        let with_spec = |(id, embedder, first): (SourceId, SourceEmbedder, TrialKey)| {
            let spec = scene.sources().find(|spec| spec.id == id)?.clone();
            Some((spec, embedder, first))
        };
        let sources: Option<Vec<_>> = stored.sources.into_iter().map(with_spec).collect();
        let joint = Self::of(sources?.into_iter());
        let dims = joint.stretches.last()?.columns.end;
        let fits = stored.mean.len() == dims && stored.factor.len() == dims;
        fits.then_some(Self { mean: stored.mean, factor: stored.factor, ..joint })
    }

    /// Checks that a query, or a trial of the library itself, can be compared with the library.
    pub fn check(&self, query: &TrialFrames) -> Result<(), RecogniseError> {
        let known = |id: &SourceId| self.stretches.iter().any(|stretch| stretch.spec.id == *id);
        if !query.sources.keys().any(known) {
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

    /// Length of a vector.
    pub fn dims(&self) -> usize {
        self.mean.len()
    }

    /// Which of the sources a trial has.
    pub fn present(&self, trial: &TrialFrames) -> Present {
        self.stretches.iter().map(|s| trial.sources.contains_key(&s.spec.id)).collect()
    }

    /// The vector of a whole trial, or of one of its copies, given with its number. It is not yet
    /// standardised, and 0 for sources that the trial lacks.
    fn raw(&self, trial: &TrialFrames, copy: Option<(usize, &Copy)>) -> Vec<f32> {
        let of_source = |stretch: &Stretch| {
            let source = trial.sources.get(&stretch.spec.id)?;
            Some(stretch.embedder.embed(source, copy))
        };
        let parts: Vec<_> = self.stretches.par_iter().map(of_source).collect();
        let mut vector = vec![0.0; self.dims()];
        for (stretch, part) in self.stretches.iter().zip(parts) {
            if let Some(of_source) = part {
                vector[stretch.columns.clone()].copy_from_slice(&of_source);
            }
        }
        vector
    }

    /// The vectors of a library trial, not yet standardised: of the whole trial, then of its
    /// copies, which are drawn by `seed`.
    pub fn training_vectors(&self, trial: &TrialFrames, seed: u64) -> Vec<Vec<f32>> {
        let copies = copies(&trial.key, seed);
        let copies = copies.iter().enumerate().map(|copy| self.raw(trial, Some(copy)));
        std::iter::once(self.raw(trial, None)).chain(copies).collect()
    }

    /// Sets the mean and deviation of each feature from whole trials: their vectors, not yet
    /// standardised, and the sources that each has.
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

    /// Standardises a vector; sources that are not `present` stay 0, which is the library's mean.
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

    /// The standardised vectors of the beginnings of a library trial's drag, after each of `looks`:
    /// steps of [`LOOK_S`], counted from 1, rising. Sources that do not belong to the drag, or
    /// ended before, are as in `whole`, the vector of the whole trial.
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

    /// The standardised vector of a trial, and which sources it has.
    pub fn embed(&self, trial: &TrialFrames) -> (Vec<f32>, Present) {
        let present = self.present(trial);
        let mut vector = self.raw(trial, None);
        self.standardise(&mut vector, &present);
        (vector, present)
    }

    /// Whether a trial has anything to compare: a picture, or a series as long as a short frame
    /// that is not constant, or of which a channel is constant in the library, like a switch.
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

    /// Whether a channel of a source moves in the library; true for sources that the library lacks.
    pub fn moves(&self, source: &SourceId, channel: usize) -> bool {
        let stretch = self.stretches.iter().find(|stretch| stretch.spec.id == *source);
        match stretch.map(|stretch| &stretch.embedder) {
            Some(SourceEmbedder::Series(embedder)) => embedder.moves(channel),
            _ => true,
        }
    }

    /// Length of a trial's drag in seconds: its longest source recorded while dragging, if any.
    pub fn drag_s(&self, trial: &TrialFrames) -> Option<f64> {
        let drags = self.stretches.iter().filter(|s| s.spec.phase == Phase::Drag);
        let lengths = drags.filter_map(|s| trial.sources.get(&s.spec.id)?.series());
        lengths.map(|series| series.duration_s()).max_by(f64::total_cmp)
    }
}

/// Columns of the sources that are present.
pub(super) fn columns(stretches: &[Stretch], present: &Present) -> Vec<usize> {
    let there = stretches.iter().zip(present).filter(|(_, has)| **has);
    there.flat_map(|(stretch, _)| stretch.columns.clone()).collect()
}

/// The vectors of the beginnings of a series, after each of `looks`; `None` after its end.
fn beginnings(
    embedder: &SeriesEmbedder,
    series: &SeriesFrames,
    looks: &[usize],
) -> Vec<Option<Vec<f32>>> {
    let rate_hz = series.rate_hz();
    let mut sums = [0, 1].map(|view| counted(&series.views, &Default::default(), view));
    let mut taken = [0; 2];
    let mut values = Vec::new();
    let of_look = |&number: &usize| {
        let look = series.looks.get(number.checked_sub(1)?)?;
        let samples = samples_by(number as f64 * LOOK_S, rate_hz);
        for (v, view) in series.views.0.iter().enumerate() {
            let end = view.frames_in(samples).max(taken[v]);
            series.whole.frames[v].unpack(view.width(), taken[v]..end, &mut values);
            sums[v].add(&values);
            taken[v] = end;
        }
        let mut filled = sums.clone();
        for (v, view) in series.views.0.iter().enumerate() {
            let padded = &look.padded[v];
            padded.unpack(view.width(), 0..padded.frames(view.width()), &mut values);
            filled[v].add(&values);
        }
        Some(embedder.vector(&filled, &look.moments, rate_hz, 0.0))
    };
    looks.iter().map(of_look).collect()
}
