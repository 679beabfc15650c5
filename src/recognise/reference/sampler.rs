//! Draws the samples of a trial's sources, at whatever length a comparison asks for.

use std::sync::Arc;

use rayon::prelude::*;

use super::domain::DomainSamples;
use super::options::{PositionMode, ReferenceOptions};
use super::prepared_trial::{Cut, PreparedTrial};
use super::sample_set::SampleSet;
use super::sampling::{DomainExtent, Positions, keyed_positions};
use crate::library::Entry;
use crate::recognise::error::RecogniseError;
use crate::scene::{Scene, SourceSpec};
use crate::trial::{Signal, Trial};

/// A scene, and how its sources are sampled.
#[derive(Clone, Debug)]
pub struct Sampler {
    pub scene: Scene,
    pub options: ReferenceOptions,
}

impl Sampler {
    /// A trial, sampled; `tabulate` prepares it for many comparisons.
    pub fn sampled(
        &self,
        entry: &Entry,
        trial: &Trial,
        tabulate: bool,
    ) -> Result<PreparedTrial, RecogniseError> {
        let per_pair = self.options.positions == PositionMode::PerPair;
        PreparedTrial::new(entry, trial, &self.scene, per_pair, |spec, signal, frames| {
            self.cut(spec, signal, frames, tabulate)
        })
    }

    fn cut(&self, spec: &SourceSpec, signal: &Signal, frames: usize, tabulate: bool) -> Cut {
        let domain = DomainSamples::new(spec, signal, frames);
        if self.options.positions == PositionMode::PerPair {
            return Cut { sets: Vec::new(), domain: Some(domain) };
        }
        let draw = |repetition| {
            let at = self.positions(spec, domain.extent(), repetition, None);
            let mut set = SampleSet::new(&domain.at(&at), spec.sigma);
            if tabulate {
                set.tabulate();
            }
            set
        };
        let sets = (0..self.options.repetitions).into_par_iter().map(draw).collect();
        Cut { sets, domain: None }
    }

    /// A source of a trial, cut to `frames`.
    pub fn cut_of(
        &self,
        trial: &PreparedTrial,
        spec: &SourceSpec,
        frames: usize,
    ) -> Result<Arc<Cut>, RecogniseError> {
        trial.at_length(&spec.id, frames, |signal| self.cut(spec, signal, frames, false))
    }

    /// The positions of one repetition; `pair` as in [`keyed_positions`].
    pub fn positions(
        &self,
        spec: &SourceSpec,
        extent: DomainExtent,
        repetition: usize,
        pair: Option<(u64, u64)>,
    ) -> Positions {
        let ReferenceOptions { samples, seed, .. } = self.options;
        keyed_positions(&spec.id, extent, samples, seed, repetition, pair)
    }
}
