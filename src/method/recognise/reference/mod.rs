//! The paper's method, exactly (README §2): raw samples, n·MMD²_b for each source, the product over
//! sources, and the nearest neighbour.
//!
//! [`ReferenceOptions`] has shortcuts that keep the result exact or within a stated bound. Positions
//! are shared over the library. K(z, z) is summed once for each query, and K(y, y) is read from a
//! table; both change a score by at most 1e-4 ([`SumPrecision`]). Successive halving is optional.
//! Results depend neither on the number of threads nor on the order of the library.

mod model;
pub(super) mod prepared_trial;
mod sample_set;
mod sampling;
mod score;

pub(super) use model::ReferenceModel;
pub use model::{STAGES, Stage};
pub(super) use prepared_trial::{PreparedTrial, SampledSource, shared_sources};
pub use sample_set::{SampleSet, Scratch};
pub use sampling::{DomainSamples, image_grid};
pub use score::{QuerySet, SumPrecision, score_samples};
pub(super) use score::{aligned, log_score};

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::error::{Result, check_surfaces};
use super::method::{Method, Model};
use super::prepared::Prepared;
use crate::kernel::{FOLD, NODES};
use crate::library::Entry;
use crate::library::shape::LibraryShape;
use crate::scene::Scene;
use crate::seed;
use crate::trial::Trial;

#[derive(Clone, Debug)]
pub struct Reference {
    scene: Scene,
    options: ReferenceOptions,
}

impl Reference {
    pub fn new(scene: Scene, options: ReferenceOptions) -> Self {
        Self { scene, options }
    }

    /// Makes a model of a library, which may have only one surface.
    ///
    /// # Errors
    /// If a trial was prepared for another method.
    pub fn model(&self, library: &[Prepared]) -> Result<ReferenceModel> {
        let library = library.iter().map(|trial| trial.samples(NAME).cloned());
        Ok(ReferenceModel { method: self.clone(), library: library.collect::<Result<_, _>>()? })
    }
}

impl Method for Reference {
    fn name(&self) -> &'static str {
        NAME
    }

    fn settings_key(&self, _: &LibraryShape) -> u64 {
        let ReferenceOptions { samples, repetitions, positions, seed, precision, tabulate, .. } =
            self.options;
        let sources: Vec<_> = self.scene.sources().collect();
        let settings = format!(
            "{samples} {repetitions} {positions:?} {seed} {precision:?} {tabulate} {NODES} {FOLD} \
             {sources:?}"
        );
        seed::stable_hash(&[NAME.as_bytes(), settings.as_bytes()])
    }

    fn prepare(&self, entry: &Entry, trial: &Trial, _: &LibraryShape) -> Result<Prepared> {
        let ReferenceOptions { tabulate, precision, .. } = self.options;
        let tabulate = tabulate && precision == SumPrecision::Fast;
        Ok(Prepared::Samples(Arc::new(self.sampled(entry, trial, tabulate)?)))
    }

    fn fit(&self, library: Vec<Prepared>, _: &Arc<LibraryShape>) -> Result<Arc<dyn Model>> {
        check_surfaces(library.iter().map(Prepared::key))?;
        Ok(Arc::new(self.model(&library)?))
    }
}

pub(crate) const NAME: &str = "reference";

/// How sample positions are drawn: once for the whole library, or for each pair of trials.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PositionMode {
    /// Once a repetition, the same for every trial; far cheaper.
    #[default]
    Shared,
    /// Anew for every pair of trials, like the authors' program.
    PerPair,
}

/// Settings of the method `reference`. The defaults are the paper's. When settings are written,
/// defaults are left out, except n and R.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct ReferenceOptions {
    /// Number of samples drawn from each source, n.
    #[serde(rename = "n")]
    pub samples: usize,
    /// Number of repetitions, R; scores are averaged over them.
    pub repetitions: usize,
    /// Number of nearest neighbours, k.
    #[serde(skip_serializing_if = "is_one")]
    pub neighbours: usize,
    #[serde(skip_serializing_if = "is_default")]
    pub positions: PositionMode,
    #[serde(skip_serializing_if = "is_one")]
    pub seed: u64,
    /// How precisely kernel sums are computed.
    #[serde(skip_serializing_if = "is_default")]
    pub precision: SumPrecision,
    /// Whether K(y, y) of library trials is tabulated over σ: slower preparation, faster comparison.
    #[serde(skip_serializing_if = "is_true")]
    pub tabulate: bool,
    /// Stages of successive halving, in order. If empty, all trials get all repetitions.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub halving: Vec<Stage>,
}

fn is_one<T: PartialEq + From<u8>>(value: &T) -> bool {
    *value == T::from(1)
}

fn is_default<T: PartialEq + Default>(value: &T) -> bool {
    *value == T::default()
}

fn is_true(value: &bool) -> bool {
    *value
}

impl ReferenceOptions {
    /// The stages for a library of `trials` trials. The last has all repetitions and drops no trial.
    pub(super) fn stages(&self, trials: usize) -> Vec<Stage> {
        let Self { repetitions, neighbours, halving, .. } = self;
        let mut stages: Vec<Stage> = Vec::new();
        for stage in halving {
            let so_far = stages.last().map_or((0, trials), |s| (s.repetitions, s.keep));
            let keep = stage.keep.max(*neighbours).max(2);
            if so_far.0 < stage.repetitions && stage.repetitions < *repetitions && keep < so_far.1 {
                stages.push(Stage { repetitions: stage.repetitions, keep });
            }
        }
        stages.push(Stage { repetitions: *repetitions, keep: trials });
        stages
    }
}

impl Default for ReferenceOptions {
    fn default() -> Self {
        Self {
            samples: 400,
            repetitions: 10,
            neighbours: 1,
            positions: PositionMode::Shared,
            seed: 1,
            precision: SumPrecision::Fast,
            tabulate: true,
            halving: Vec::new(),
        }
    }
}
