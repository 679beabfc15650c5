//! The paper's method, exactly (method §2): raw samples, n·MMD²_b a source, product over sources,
//! nearest neighbour.
//!
//! [`ReferenceOptions`] has the shortcuts that do not change it, or do so within a stated bound:
//! positions shared over the library, sums K(z, z) once a query and K(y, y) from a table, both
//! within 1e-4 of a score ([`SumPrecision`]), and, where asked for, successive halving. Results depend
//! neither on the number of threads nor on the library's order.

mod amplitude_spectrum;
mod domain;
mod halving;
mod model;
mod options;
pub(super) mod prepared_trial;
mod rounding;
mod sample_set;
mod sampler;
mod sampling;
mod score;
pub(super) mod storage;

pub use amplitude_spectrum::amplitude_spectrum;
pub use domain::DomainSamples;
pub use halving::{STAGES, Stage};
pub use model::ReferenceModel;
pub use options::{PositionMode, ReferenceOptions};
pub use prepared_trial::PreparedTrial;
pub(super) use prepared_trial::{Cut, shared_sources};
pub use sample_set::{SampleSet, Scratch};
pub use sampling::image_grid;
pub(super) use sampling::keyed_positions;
pub use score::{QuerySet, SumPrecision, log_score, score_samples};

use std::sync::Arc;

use self::options::NAME;
use self::sampler::Sampler;
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

    /// A model of a library, which may be of one surface.
    ///
    /// # Errors
    /// If a trial was prepared by another kind of method.
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
