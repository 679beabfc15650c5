//! A way of comparing trials.

use std::sync::Arc;

use super::decide::conformal::{Rejection, RejectionError};
use super::error::RecogniseError;
use super::features::FeatureVector;
use super::follow::{Follow, FollowOptions};
use super::rank::Ranking;
use crate::library::Entry;
use crate::trial::Trial;

/// A way of comparing trials.
pub trait Method: Send + Sync {
    /// What a comparison needs to know of one trial.
    type Prepared: Send + Sync;
    /// A library, ready to be compared with.
    type Model: Send + Sync;

    /// The method's name, as on the command line.
    fn name(&self) -> &'static str;

    /// Does for one trial what need be done but once, whatever it is then compared with. `entry`
    /// can load the trial again, so that its raw samples need not stay in memory.
    ///
    /// # Errors
    /// If the trial does not fit the scene.
    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<Self::Prepared, RecogniseError>;

    /// The same for a trial of a library, which many queries will be compared with.
    ///
    /// # Errors
    /// As [`Method::prepare`].
    fn prepare_for_library(
        &self,
        entry: &Entry,
        trial: &Trial,
    ) -> Result<Self::Prepared, RecogniseError> {
        self.prepare(entry, trial)
    }

    /// A trial of which hand-made features are all that is known; `None` for a method that needs
    /// recordings.
    fn of_features(&self, _features: FeatureVector) -> Option<Self::Prepared> {
        None
    }

    /// A number for all settings that prepared trials depend on, if they can be stored.
    fn storage_key(&self) -> Option<u64> {
        None
    }

    /// A prepared trial as bytes; asked for only where there is a [`Method::storage_key`].
    fn store(&self, _prepared: &Self::Prepared) -> Vec<u8> {
        Vec::new()
    }

    /// A prepared trial from bytes that [`Method::store`] made under the same key, or nothing.
    fn restore(&self, _entry: &Entry, _bytes: &[u8]) -> Option<Self::Prepared> {
        None
    }

    /// Makes a model of a library.
    ///
    /// # Errors
    /// If the library holds fewer than two surfaces.
    fn fit(&self, library: Vec<Arc<Self::Prepared>>) -> Result<Self::Model, RecogniseError>;

    /// Ranks the library's surfaces, the most alike first.
    ///
    /// # Errors
    /// If the query has no source in common with the library, or another sample rate.
    fn rank(&self, model: &Self::Model, query: &Self::Prepared) -> Result<Ranking, RecogniseError>;

    /// Follows scans while they go on; `None` for a method that cannot. The first time, the stop
    /// rule is calibrated, which takes a while.
    fn follow(
        &self,
        _model: &Arc<Self::Model>,
        _options: &FollowOptions,
    ) -> Option<Box<dyn Follow>> {
        None
    }

    /// The fit at or below which a query is called unknown, for a stated rate of false rejections.
    ///
    /// # Errors
    /// If the method has no measure of fit, or the library too few trials.
    fn rejection(&self, _model: &Self::Model, _rate: f64) -> Result<Rejection, RejectionError> {
        Err(RejectionError::Method(self.name()))
    }
}
