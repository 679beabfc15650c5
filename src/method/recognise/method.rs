//! Traits of a comparison method and of the model that it fits to a library.

use std::any::Any;
use std::sync::Arc;

use super::error::Result;
use super::prepared::Prepared;
use super::rank::Ranking;
use crate::library::Entry;
use crate::library::shape::LibraryShape;
use crate::scene::SourceId;
use crate::trial::Trial;

/// A way of comparing trials, with its settings.
pub trait Method: Send + Sync {
    fn name(&self) -> &'static str;

    /// Hash of all settings that affect how trials are prepared for a library of this shape.
    fn settings_key(&self, shape: &LibraryShape) -> u64;

    /// Prepares a trial, once, for all later comparisons with trials of a library of this shape.
    /// `entry` can load the trial again, so its raw samples need not stay in memory.
    ///
    /// # Errors
    /// If the trial does not fit the scene.
    fn prepare(&self, entry: &Entry, trial: &Trial, shape: &LibraryShape) -> Result<Prepared>;

    /// Fits a model to a prepared library, or to part of it. `shape` is the library shape that the
    /// trials were prepared for.
    ///
    /// # Errors
    /// If the trials are of fewer than two surfaces, cannot be compared with each other, or were
    /// prepared for another method.
    fn fit(&self, library: Vec<Prepared>, shape: &Arc<LibraryShape>) -> Result<Arc<dyn Model>>;

    /// Hash of everything except the trials that affects a library's model. `None` for a method that
    /// fits a model as fast as it could read a stored one.
    fn model_key(&self, _shape: &LibraryShape) -> Option<u64> {
        None
    }

    /// Restores a model from the bytes stored by a model of this method; `None` if they are damaged.
    fn restore(&self, _bytes: &[u8], _shape: &Arc<LibraryShape>) -> Option<Arc<dyn Model>> {
        None
    }
}

/// A model of a library, ready to name queries.
pub trait Model: Send + Sync {
    /// Prepares a query, once for all models of the same method and library shape.
    ///
    /// # Errors
    /// If the trial does not fit the scene.
    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<Prepared>;

    /// Ranks the library's surfaces; the surface most like the query comes first.
    ///
    /// # Errors
    /// If the query has no source in common with the library, has another sample rate, or was
    /// prepared for another method.
    fn rank(&self, query: &Prepared) -> Result<Ranking>;

    /// Prepares a trial, and ranks the library's surfaces by it.
    ///
    /// # Errors
    /// The errors of [`Model::prepare`] and [`Model::rank`].
    fn rank_trial(&self, trial: Trial) -> Result<Ranking> {
        let trial = Arc::new(trial);
        self.rank(&self.prepare(&Entry::in_memory(trial.clone()), &trial)?)
    }

    /// The evidence of each source alone; `None` if the method cannot separate the sources.
    ///
    /// # Errors
    /// The errors of [`Model::rank`].
    fn explain(&self, _query: &Prepared) -> Result<Option<Evidence>> {
        Ok(None)
    }

    /// The model itself, if models of its method can do more than others; see `embedding`.
    fn as_any(self: Arc<Self>) -> Option<Arc<dyn Any + Send + Sync>> {
        None
    }
}

/// How unlike the query each surface is, source by source.
#[derive(Clone, Debug, PartialEq)]
pub struct Evidence {
    /// The surfaces of the library, in any order.
    pub surfaces: Vec<String>,
    pub sources: Vec<SourceEvidence>,
}

/// How unlike the query each surface is by one source.
#[derive(Clone, Debug, PartialEq)]
pub struct SourceEvidence {
    pub source: SourceId,
    /// A term for each surface; infinite if the surface lacks the source. The smaller the sum of its
    /// terms over all sources, the more a surface is like the query.
    pub terms: Vec<f64>,
}
