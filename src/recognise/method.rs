//! Interfaces of a comparison method and of the model that it makes of a library.

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

    /// Hash of all settings that the prepared trials of a library of this shape depend on.
    fn settings_key(&self, shape: &LibraryShape) -> u64;

    /// Prepares a trial of a library of this shape, once, independently of what it is compared
    /// with. `entry` can load the trial again, so that its raw samples need not stay in memory.
    ///
    /// # Errors
    /// If the trial does not fit the scene.
    fn prepare(
        &self,
        entry: &Entry,
        trial: &Trial,
        shape: &LibraryShape,
    ) -> Result<Prepared, RecogniseError>;

    /// Makes a model of a prepared library, or of part of one; `shape` is the library shape that
    /// the trials were prepared for.
    ///
    /// # Errors
    /// If the trials are of fewer than two surfaces, cannot be compared with each other, or were
    /// prepared for another method.
    fn fit(
        &self,
        library: Vec<Prepared>,
        shape: &Arc<LibraryShape>,
    ) -> Result<Arc<dyn Model>, RecogniseError>;

    /// Hash of all that a library's model depends on besides the trials; `None` for a method whose
    /// models are made as fast as they could be read.
    fn model_key(&self, _shape: &LibraryShape) -> Option<u64> {
        None
    }

    /// Restores a model from the bytes that [`EmbeddingModel`] stored; `None` if they are damaged.
    fn restore(&self, _bytes: &[u8], _shape: &Arc<LibraryShape>) -> Option<Arc<dyn Model>> {
        None
    }
}

/// A library, ready to name queries.
pub trait Model: Send + Sync {
    /// Prepares a query, once for all models of the same method and library shape.
    ///
    /// # Errors
    /// If the trial does not fit the scene.
    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<Prepared, RecogniseError>;

    /// Ranks the library's surfaces, the most alike first.
    ///
    /// # Errors
    /// If the query has no source in common with the library, has another sample rate, or was
    /// prepared for another method.
    fn rank(&self, query: &Prepared) -> Result<Ranking, RecogniseError>;

    /// The evidence of each source by itself; `None` if the method cannot separate the sources.
    ///
    /// # Errors
    /// As [`Model::rank`].
    fn explain(&self, _query: &Prepared) -> Result<Option<Evidence>, RecogniseError> {
        Ok(None)
    }

    /// The model as that of the method `embedding`, which can do more; `None` for other methods.
    fn embedding(self: Arc<Self>) -> Option<Arc<EmbeddingModel>> {
        None
    }

    /// How long scans must last to reach `accuracy`; without it, to lose at most one percentage
    /// point against whole scans. All commands use this one number. `None` if the method cannot
    /// follow scans.
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
    /// A term for each surface: the smaller the sum of its terms over all sources, the more alike
    /// the surface. Infinite for a surface that lacks the source.
    pub terms: Vec<f64>,
}
