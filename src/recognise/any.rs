//! A method behind a pointer: whatever works with any method is compiled once, not once a method.

use std::any::Any;
use std::sync::Arc;

use super::features::FeatureVector;
use super::{Follow, FollowOptions, Method, Ranking, RecogniseError, Rejection, RejectionError};
use crate::library::Entry;
use crate::trial::Trial;

/// Any method. What it prepares and fits is its own: a trial that one method prepared, or a model
/// that it fitted, means nothing to another, and to hand it over is a mistake that panics.
pub struct AnyMethod(Box<dyn Erased>);

/// What some method needs to know of one trial.
pub struct AnyPrepared(Arc<dyn Any + Send + Sync>);

/// A library, ready to be compared with by some method.
pub struct AnyModel(Arc<dyn Any + Send + Sync>);

impl AnyMethod {
    /// Hides which method it is.
    pub fn new(method: impl Method<Prepared: 'static, Model: 'static> + 'static) -> Self {
        Self(Box::new(Known(method)))
    }
}

fn known<T: Any + Send + Sync>(what: &Arc<dyn Any + Send + Sync>) -> Arc<T> {
    // A mistake of the program's, as the type says.
    what.clone().downcast().expect("prepared or fitted by this very method")
}

struct Known<M>(M);

trait Erased: Send + Sync {
    fn name(&self) -> &'static str;
    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<AnyPrepared, RecogniseError>;
    fn prepare_for_library(
        &self,
        entry: &Entry,
        trial: &Trial,
    ) -> Result<AnyPrepared, RecogniseError>;
    fn of_features(&self, features: FeatureVector) -> Option<AnyPrepared>;
    fn storage_key(&self) -> Option<u64>;
    fn store(&self, prepared: &AnyPrepared) -> Vec<u8>;
    fn restore(&self, entry: &Entry, bytes: &[u8]) -> Option<AnyPrepared>;
    fn fit(&self, library: Vec<Arc<AnyPrepared>>) -> Result<AnyModel, RecogniseError>;
    fn rank(&self, model: &AnyModel, query: &AnyPrepared) -> Result<Ranking, RecogniseError>;
    fn follow(&self, model: &AnyModel, options: &FollowOptions) -> Option<Box<dyn Follow>>;
    fn rejection(&self, model: &AnyModel, rate: f64) -> Result<Rejection, RejectionError>;
}

impl<M: Method<Prepared: 'static, Model: 'static>> Erased for Known<M> {
    fn name(&self) -> &'static str {
        self.0.name()
    }

    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<AnyPrepared, RecogniseError> {
        Ok(AnyPrepared(Arc::new(self.0.prepare(entry, trial)?)))
    }

    fn prepare_for_library(
        &self,
        entry: &Entry,
        trial: &Trial,
    ) -> Result<AnyPrepared, RecogniseError> {
        Ok(AnyPrepared(Arc::new(self.0.prepare_for_library(entry, trial)?)))
    }

    fn of_features(&self, features: FeatureVector) -> Option<AnyPrepared> {
        Some(AnyPrepared(Arc::new(self.0.of_features(features)?)))
    }

    fn storage_key(&self) -> Option<u64> {
        self.0.storage_key()
    }

    fn store(&self, prepared: &AnyPrepared) -> Vec<u8> {
        self.0.store(&known::<M::Prepared>(&prepared.0))
    }

    fn restore(&self, entry: &Entry, bytes: &[u8]) -> Option<AnyPrepared> {
        Some(AnyPrepared(Arc::new(self.0.restore(entry, bytes)?)))
    }

    fn fit(&self, library: Vec<Arc<AnyPrepared>>) -> Result<AnyModel, RecogniseError> {
        let library = library.iter().map(|trial| known(&trial.0)).collect();
        Ok(AnyModel(Arc::new(self.0.fit(library)?)))
    }

    fn rank(&self, model: &AnyModel, query: &AnyPrepared) -> Result<Ranking, RecogniseError> {
        self.0.rank(&known::<M::Model>(&model.0), &known::<M::Prepared>(&query.0))
    }

    fn follow(&self, model: &AnyModel, options: &FollowOptions) -> Option<Box<dyn Follow>> {
        self.0.follow(&known(&model.0), options)
    }

    fn rejection(&self, model: &AnyModel, rate: f64) -> Result<Rejection, RejectionError> {
        self.0.rejection(&known::<M::Model>(&model.0), rate)
    }
}

impl Method for AnyMethod {
    type Prepared = AnyPrepared;
    type Model = AnyModel;

    fn name(&self) -> &'static str {
        self.0.name()
    }

    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<AnyPrepared, RecogniseError> {
        self.0.prepare(entry, trial)
    }

    fn prepare_for_library(
        &self,
        entry: &Entry,
        trial: &Trial,
    ) -> Result<AnyPrepared, RecogniseError> {
        self.0.prepare_for_library(entry, trial)
    }

    fn of_features(&self, features: FeatureVector) -> Option<AnyPrepared> {
        self.0.of_features(features)
    }

    fn storage_key(&self) -> Option<u64> {
        self.0.storage_key()
    }

    fn store(&self, prepared: &AnyPrepared) -> Vec<u8> {
        self.0.store(prepared)
    }

    fn restore(&self, entry: &Entry, bytes: &[u8]) -> Option<AnyPrepared> {
        self.0.restore(entry, bytes)
    }

    fn fit(&self, library: Vec<Arc<AnyPrepared>>) -> Result<AnyModel, RecogniseError> {
        self.0.fit(library)
    }

    fn rank(&self, model: &AnyModel, query: &AnyPrepared) -> Result<Ranking, RecogniseError> {
        self.0.rank(model, query)
    }

    fn follow(&self, model: &Arc<AnyModel>, options: &FollowOptions) -> Option<Box<dyn Follow>> {
        self.0.follow(model, options)
    }

    fn rejection(&self, model: &AnyModel, rate: f64) -> Result<Rejection, RejectionError> {
        self.0.rejection(model, rate)
    }
}
