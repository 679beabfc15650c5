//! What left-out library trials tell of a model: how sure it may be, how strange a trial of the
//! library can look, and when an answer is settled.

use std::collections::BTreeMap;
use std::sync::Arc;

use rayon::prelude::*;

use super::calibrate::{HeldOut, PREFIXES_S, log_posterior};
use super::source::Window;
use super::train::{Labels, SourceModel};
use super::{EmbeddingModel, most_probable};
use crate::recognise::decide::conformal::{Conformity, nonconformity};
use crate::recognise::decide::settle::{Look, Settling, Stops};
use crate::recognise::features::frame_features::{FrameFeatures, SourceFrames};
use crate::recognise::follow::{FollowOptions, LOOK_S};
use crate::scene::{Phase, SourceId};

/// Combined distances of left-out trials, by the trial's place in the library; at `seconds` of the
/// drag, or whole.
pub(super) struct LeftOut<'a> {
    pub library: &'a [Arc<FrameFeatures>],
    pub labels: &'a Labels,
    pub sources: &'a BTreeMap<SourceId, SourceModel>,
}

impl LeftOut<'_> {
    fn distances(&self, trial: usize, seconds: Option<f64>) -> Option<Vec<f64>> {
        let mut sum = vec![0.0; self.labels.classes];
        let ids = || self.library[trial].sources.keys();
        let alone = is_alone(self.sources, ids());
        for model in ids().filter_map(|id| trained(self.sources, id)) {
            let (whole, beginnings) = model.held_out[trial].as_ref()?.split_last()?;
            let (length_s, distances) = match seconds {
                Some(t) if model.spec.phase == Phase::Drag => {
                    beginnings.iter().find(|(length_s, _)| *length_s == t)?
                }
                _ => whole,
            };
            model.add_evidence(&mut sum, distances.clone(), *length_s, alone);
        }
        sum.iter().any(|&d| d > 0.0).then_some(sum)
    }

    /// Combined distances of whole trials, with the class of each.
    pub fn whole(&self) -> Vec<HeldOut> {
        let of_trial = |i: usize| Some((self.distances(i, None)?, self.labels.class[i]));
        (0..self.library.len()).filter_map(of_trial).collect()
    }

    /// Nonconformity of those trials that have all sources that are trained.
    pub fn conformity(&self) -> Conformity {
        let is_full = |trial: &FrameFeatures| {
            let mut all = self.sources.keys().filter(|id| trained(self.sources, id).is_some());
            all.all(|id| trial.sources.contains_key(id))
        };
        let full: Vec<usize> =
            (0..self.library.len()).filter(|&i| is_full(&self.library[i])).collect();
        let mut lengths: Vec<f64> =
            full.iter().filter_map(|&i| drag_s(self.sources, &self.library[i])).collect();
        lengths.sort_by(f64::total_cmp);
        let middle = lengths.get(lengths.len() / 2).copied();
        let of_length = |seconds: Option<f64>| {
            let strange = |&i: &usize| nonconformity(&self.distances(i, seconds)?);
            full.iter().filter_map(strange).collect::<Vec<f64>>()
        };
        let beginnings = PREFIXES_S.iter().filter(|&&t| middle.is_some_and(|middle| t < middle));
        let mut by_length: Vec<_> = beginnings.map(|&t| (t, of_length(Some(t)))).collect();
        by_length.push((middle.unwrap_or(0.0), of_length(None)));
        Conformity::new(by_length)
    }
}

/// A source's model, if it has a discriminant.
fn trained<'a>(
    sources: &'a BTreeMap<SourceId, SourceModel>,
    id: &SourceId,
) -> Option<&'a SourceModel> {
    sources.get(id).filter(|model| model.discriminant.is_some())
}

/// Whether but one of a trial's sources has a discriminant.
pub(super) fn is_alone<'a>(
    sources: &BTreeMap<SourceId, SourceModel>,
    ids: impl Iterator<Item = &'a SourceId>,
) -> bool {
    ids.filter_map(|id| trained(sources, id)).count() == 1
}

/// Length in seconds of the longest trained source of a trial's drag, if it has one.
pub(super) fn drag_s(
    sources: &BTreeMap<SourceId, SourceModel>,
    trial: &FrameFeatures,
) -> Option<f64> {
    let drags = trial.sources.iter().filter_map(|(id, source)| {
        let model = trained(sources, id)?;
        (model.spec.phase == Phase::Drag).then_some(source.duration_s)
    });
    drags.max_by(f64::total_cmp)
}

impl EmbeddingModel {
    /// The stop rule, found but once.
    pub(super) fn settling(&self, options: &FollowOptions) -> Settling {
        let (asked, settling) =
            self.calibrated.get_or_init(|| (options.clone(), self.calibrate(options)));
        if asked == options { settling.clone() } else { self.calibrate(options) }
    }

    /// Looks at each library trial as [`crate::recognise::Follow`] would, with models trained
    /// without it.
    fn calibrate(&self, options: &FollowOptions) -> Settling {
        let stops: Vec<Stops> = (0..self.library.len())
            .into_par_iter()
            .filter_map(|i| self.stops(i, options))
            .collect();
        Settling::choose(&stops, options.loss)
    }

    fn stops(&self, trial: usize, options: &FollowOptions) -> Option<Stops> {
        let framed = &self.library[trial];
        let drag_s = drag_s(&self.sources, framed)?;
        let mut at_rest = vec![0.0; self.surfaces.len()];
        let mut dragged = Vec::new();
        for (id, source) in &framed.sources {
            let Some(model) = trained(&self.sources, id) else { continue };
            // A trial whose class is not known without it says nothing.
            model.without.get(self.labels.group[trial])?.as_ref()?;
            if model.spec.phase == Phase::Drag {
                dragged.push((model, source));
            } else {
                self.add_left_out(&mut at_rest, model, source, trial, None)?;
            }
        }
        let distances = |seconds: Option<f64>| {
            let mut sum = at_rest.clone();
            for (model, source) in &dragged {
                self.add_left_out(&mut sum, model, source, trial, seconds)?;
            }
            Some(sum)
        };
        let look = |step: usize| {
            let scan_s = step as f64 * LOOK_S;
            let sum = distances(Some(scan_s))?;
            let log_posterior = log_posterior(&sum, self.temperature);
            let label = most_probable(&log_posterior);
            let p_value = nonconformity(&sum).and_then(|s| self.conformity.p_value(scan_s, s));
            let fits = p_value.is_none_or(|p_value| {
                options.rejection.as_ref().is_none_or(|rejection| !rejection.rejects(p_value))
            });
            Some(Look { scan_s, label, probability: log_posterior[label].exp(), fits })
        };
        let whole = most_probable(&log_posterior(&distances(None)?, self.temperature));
        let steps = (drag_s / LOOK_S + 1e-9).floor() as usize;
        let looks = (1..=steps).map_while(look);
        Some(Stops::new(looks, self.labels.class[trial], whole, drag_s))
    }

    /// Adds the distances of a source of a library trial, by the model trained without its group.
    fn add_left_out(
        &self,
        sum: &mut [f64],
        model: &SourceModel,
        source: &SourceFrames,
        trial: usize,
        seconds: Option<f64>,
    ) -> Option<()> {
        let without = model.without[self.labels.group[trial]].as_ref()?;
        let (window, length_s) = match seconds {
            Some(t) if t < source.duration_s => (Window::Seconds(0.0, t), t),
            _ => (Window::Whole, source.duration_s),
        };
        let distances = match window {
            Window::Whole => without.distances(model.vectors[trial].as_ref()?),
            _ => without.distances(&model.embedder.embed(source, window)),
        };
        if !distances[self.labels.class[trial]].is_finite() {
            return None;
        }
        let alone = is_alone(&self.sources, self.library[trial].sources.keys());
        model.add_evidence(sum, distances, length_s, alone);
        Some(())
    }
}
