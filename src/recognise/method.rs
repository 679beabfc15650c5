//! The interfaces of a way of comparing trials, and of a library made ready by it.

use std::sync::Arc;

use super::decide::scan_time::{Goal, ScanTime};
use super::embedding::EmbeddingModel;
use super::error::RecogniseError;
use super::prepared::Prepared;
use super::rank::Ranking;
use super::shape::LibraryShape;
use crate::library::Entry;
use crate::scene::SourceId;
use crate::trial::Trial;

/// A way of comparing trials, with its settings.
pub trait Method: Send + Sync {
    /// The method's name.
    fn name(&self) -> &'static str;

    /// A number for all settings that prepared trials of such a library depend on.
    fn settings_key(&self, shape: &LibraryShape) -> u64;

    /// Prepares a trial of a library of this shape, once, whatever it is then compared with.
    /// `entry` can load the trial again, so that its raw samples need not stay in memory.
    ///
    /// # Errors
    /// If the trial does not fit the scene.
    fn prepare(
        &self,
        entry: &Entry,
        trial: &Trial,
        shape: &LibraryShape,
    ) -> Result<Prepared, RecogniseError>;

    /// Makes a model of a prepared library, or of part of one; `shape` is that which its trials
    /// were prepared for.
    ///
    /// # Errors
    /// If the trials are of fewer than two surfaces, cannot be compared with each other, or were
    /// prepared by another kind of method.
    fn fit(
        &self,
        library: Vec<Prepared>,
        shape: &Arc<LibraryShape>,
    ) -> Result<Arc<dyn Model>, RecogniseError>;

    /// A number for all that a model of a library depends on besides its trials; `None` by a method
    /// whose models are made as fast as they are read.
    fn model_key(&self, _shape: &LibraryShape) -> Option<u64> {
        None
    }

    /// The model that [`EmbeddingModel`] gave these bytes for; `None` if there is none.
    fn restore(&self, _bytes: &[u8], _shape: &Arc<LibraryShape>) -> Option<Arc<dyn Model>> {
        None
    }
}

/// A library, ready to be compared with.
pub trait Model: Send + Sync {
    /// Prepares a query. One that a model has prepared serves all models of the same method and
    /// library shape.
    ///
    /// # Errors
    /// If the trial does not fit the scene.
    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<Prepared, RecogniseError>;

    /// Ranks the library's surfaces, the most alike first.
    ///
    /// # Errors
    /// If the query has no source in common with the library, has another sample rate, or was
    /// prepared by another kind of method.
    fn rank(&self, query: &Prepared) -> Result<Ranking, RecogniseError>;

    /// The evidence of each source alone; `None` by a method that cannot take them apart.
    ///
    /// # Errors
    /// As [`Model::rank`].
    fn explain(&self, _query: &Prepared) -> Result<Option<Evidence>, RecogniseError> {
        Ok(None)
    }

    /// The model as one of `embedding`, which can do more; `None` by any other method.
    fn embedding(self: Arc<Self>) -> Option<Arc<EmbeddingModel>> {
        None
    }

    /// How long scans must last for an accuracy; without one, to lose at most a point against whole
    /// scans. All commands and the page take it from here. `None` by a method that cannot follow scans.
    fn scan_time(self: Arc<Self>, accuracy: Option<f64>) -> Option<ScanTime> {
        Some(self.embedding()?.left_out_accuracy().scan_time(Goal::wanted(accuracy)))
    }
}

/// How unlike a query each surface is, source by source.
#[derive(Clone, Debug, PartialEq)]
pub struct Evidence {
    /// The surfaces of the library, sorted.
    pub surfaces: Vec<String>,
    /// The evidence of each source.
    pub sources: Vec<SourceEvidence>,
}

/// How unlike a query each surface is by one source.
#[derive(Clone, Debug, PartialEq)]
pub struct SourceEvidence {
    /// The source.
    pub source: SourceId,
    /// The term of each surface: those of all sources add up to what surfaces are ranked by, the
    /// smallest first. Infinite for a surface that lacks the source.
    pub terms: Vec<f64>,
}
