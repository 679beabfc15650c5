//! The paper's method, exactly (method §2): raw samples, n·MMD²_b for each source, the product over
//! sources, and the nearest neighbour.
//!
//! [`ReferenceOptions`] has shortcuts that keep the result, at least within a stated bound:
//! positions shared over the library; K(z, z) summed once for each query and K(y, y) read from a
//! table, both within 1e-4 of a score ([`SumPrecision`]); and, on request, successive halving.
//! Results depend neither on the number of threads nor on the library's order.

mod domain;
mod halving;
mod model;
pub(super) mod prepared_trial;
mod sample_set;
mod sampling;
mod score;

pub use domain::DomainSamples;
pub use halving::{STAGES, Stage};
pub use model::ReferenceModel;
pub use prepared_trial::PreparedTrial;
pub(super) use prepared_trial::{SampledSource, shared_sources};
pub use sample_set::{SampleSet, Scratch};
pub use sampling::image_grid;
pub(super) use sampling::keyed_positions;
pub(super) use score::aligned;
pub use score::{QuerySet, SumPrecision, log_score, score_samples};

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use self::model::Sampler;
use super::checks::check_surfaces;
use super::error::RecogniseError;
use super::method::{Method, Model};
use super::prepared::Prepared;
use super::shape::LibraryShape;
use crate::kernel::{FOLD, NODES};
use crate::library::Entry;
use crate::scene::Scene;
use crate::seed;
use crate::trial::Trial;

/// The method `reference`.
#[derive(Clone, Debug)]
pub struct Reference(Sampler);

impl Reference {
    /// The method for the sources of a scene.
    pub fn new(scene: Scene, options: ReferenceOptions) -> Self {
        Self(Sampler { scene, options })
    }

    /// A model of a library, which may have only one surface.
    ///
    /// # Errors
    /// If a trial was prepared for another method.
    pub fn model(&self, library: &[Prepared]) -> Result<ReferenceModel, RecogniseError> {
        let library = library.iter().map(|trial| trial.samples(NAME).cloned());
        Ok(ReferenceModel { sampler: self.0.clone(), library: library.collect::<Result<_, _>>()? })
    }
}

impl Method for Reference {
    fn name(&self) -> &'static str {
        NAME
    }

    fn settings_key(&self, _: &LibraryShape) -> u64 {
        let ReferenceOptions { samples, repetitions, positions, seed, precision, tabulate, .. } =
            self.0.options;
        let sources: Vec<_> = self.0.scene.sources().collect();
        let settings = format!(
            "{samples} {repetitions} {positions:?} {seed} {precision:?} {tabulate} {NODES} {FOLD} \
             {sources:?}"
        );
        seed::stable_hash(&[NAME.as_bytes(), settings.as_bytes()])
    }

    fn prepare(
        &self,
        entry: &Entry,
        trial: &Trial,
        _: &LibraryShape,
    ) -> Result<Prepared, RecogniseError> {
        let ReferenceOptions { tabulate, precision, .. } = self.0.options;
        let tabulate = tabulate && precision == SumPrecision::Fast;
        Ok(Prepared::Samples(Arc::new(self.0.sampled(entry, trial, tabulate)?)))
    }

    fn fit(
        &self,
        library: Vec<Prepared>,
        _: &Arc<LibraryShape>,
    ) -> Result<Arc<dyn Model>, RecogniseError> {
        check_surfaces(library.iter().map(Prepared::key))?;
        Ok(Arc::new(self.model(&library)?))
    }
}

/// The method's name.
pub const NAME: &str = "reference";

/// The way to draw sample positions: once for the whole library, or for each pair of trials.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PositionMode {
    /// Once a repetition, the same for every trial: far cheaper.
    #[default]
    Shared,
    /// Anew for every pair, as the authors' program does.
    PerPair,
}

/// Settings of the method. The defaults are the paper's; except for n and R, they are left out when
/// settings are written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct ReferenceOptions {
    /// Samples drawn from a source, n.
    #[serde(rename = "n")]
    pub samples: usize,
    /// Repetitions whose scores are averaged, R.
    pub repetitions: usize,
    /// Nearest neighbours, k.
    #[serde(skip_serializing_if = "is_one")]
    pub neighbours: usize,
    /// The way to draw positions.
    #[serde(skip_serializing_if = "is_default")]
    pub positions: PositionMode,
    /// Seed of all positions.
    #[serde(skip_serializing_if = "is_one")]
    pub seed: u64,
    /// The precision of kernel sums.
    #[serde(skip_serializing_if = "is_default")]
    pub precision: SumPrecision,
    /// Whether K(y, y) of library trials is tabulated over σ: slower to prepare, faster to compare.
    #[serde(skip_serializing_if = "is_true")]
    pub tabulate: bool,
    /// Stages of successive halving, in order; without any, all trials get all repetitions.
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
    /// The stages for a library of `trials`; the last one has all repetitions and drops no trial.
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
