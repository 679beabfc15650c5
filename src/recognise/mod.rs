//! Names the surface of a trial: sampling ─► kernel ─► score ─► rank.
//!
//! A [`Method`] is a way of comparing trials. It prepares each trial once, fits a model to the
//! prepared library, and ranks the library's surfaces for a prepared query. [`Reference`] is the
//! paper's method, exactly.

mod any;
pub mod classify;
mod colour;
mod compare;
mod conductivity;
mod domain;
pub mod embedding;
pub mod features;
mod flawed;
mod follow;
pub mod framed;
mod frames;
mod grouped;
mod halving;
mod joint;
mod merge;
mod pixels;
mod prepare;
mod prepared;
mod rank;
mod reference;
mod samples;
mod sampling;
mod scale;
mod score;
pub mod settle;
mod share;
mod slow;
mod spectrum;
mod storage;
mod unknown;

pub use any::{AnyMethod, AnyModel, AnyPrepared};
pub use colour::hsv;
pub use compare::{Comparison, SourceComparison, TestOptions, compare};
pub use conductivity::{ByConductivity, metal_detector};
pub use domain::DomainSamples;
pub use embedding::{Embedding, EmbeddingModel, EmbeddingOptions, Posterior, SourceDistances};
pub use flawed::without_flawed;
pub use follow::{Follow, FollowOptions, FreshFrames, GuessSoFar, LOOK_S};
pub use framed::{FramedStream, FramedTrial};
pub use halving::{STAGES, Stage};
pub use joint::{Joint, JointModel};
pub use prepare::{Preparation, prepare_library};
pub use prepared::PreparedTrial;
pub use rank::{Candidate, RankedSurface, Ranking, rank};
pub use reference::{PositionMode, Reference, ReferenceOptions};
pub use samples::{SampleSet, Scratch};
pub use sampling::{Extent, IMAGE_COLS, IMAGE_ROWS, Positions, draw_positions, image_grid};
pub use score::{
    Precision, QuerySet, SCORE_FLOOR, SampleScore, log_score, score_samples, score_sets,
};
pub use settle::{SettleRule, Settling};
pub use share::jeffreys_quantile;
pub use spectrum::{amplitude_spectrum, band_bins};
pub use unknown::{Conformity, Rejection, RejectionError, strangeness};

use std::sync::Arc;

use self::features::FeatureVector;
use crate::library::{Entry, LibraryError};
use crate::scene::SourceId;
use crate::trial::Trial;

/// Why a trial cannot be named.
#[derive(Debug, thiserror::Error)]
pub enum RecogniseError {
    /// a trial of the library cannot be read
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// nothing to choose between
    #[error(
        "the library holds {trials} trial(s) of {surfaces} surface(s); naming needs trials of at \
         least two surfaces: enrol more, or open another library"
    )]
    TooFewSurfaces {
        /// number of surfaces
        surfaces: usize,
        /// number of trials
        trials: usize,
    },
    /// no source in common
    #[error("no source in common: the query has {query}; the library has {library}")]
    NothingInCommon {
        /// the query's sources
        query: String,
        /// the library's sources
        library: String,
    },
    /// two rates in one source
    #[error(
        "{source_name}: {query_hz} Hz in the query, but {library_hz} Hz in {trial}; one source has \
         one rate: resample one of them"
    )]
    Rates {
        /// the source
        source_name: SourceId,
        /// the query's rate
        query_hz: f64,
        /// the library's rate
        library_hz: f64,
        /// the library's trial
        trial: String,
    },
    /// features alone, by a method that compares recordings
    #[error(
        "{0} needs recordings; on feature tables use naive-bayes, svm, knn, mahalanobis, adaboost \
         or random-forest"
    )]
    NeedsRecordings(&'static str),
    /// a number of channels that the scene does not describe
    #[error("{source_name}: {found} channel(s) in {trial}, but the scene says {expected}")]
    Channels {
        /// the source
        source_name: SourceId,
        /// what the trial has
        found: usize,
        /// what the scene says
        expected: usize,
        /// the trial
        trial: String,
    },
    /// a series where an image should be, or an image where a series should be
    #[error("{source_name}: {trial} holds {found}, but the scene says {expected}")]
    Kind {
        /// the source
        source_name: SourceId,
        /// the trial
        trial: String,
        /// what the trial holds
        found: &'static str,
        /// what the scene says
        expected: &'static str,
    },
}

/// The methods, by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MethodName {
    /// The paper's method, exactly.
    Reference,
    /// The kernel two-sample test on samples that keep where they came from.
    Joint,
    /// Fourier features and a shrinkage discriminant.
    Embedding,
    /// Hand-made features: Gaussian naive Bayes.
    NaiveBayes,
    /// Hand-made features: support vector machine with RBF kernel.
    Svm,
    /// Hand-made features: nearest neighbours.
    Knn,
    /// Hand-made features: nearest neighbours by Mahalanobis distance.
    Mahalanobis,
    /// Hand-made features: boosted trees.
    Adaboost,
    /// Hand-made features: random forest.
    RandomForest,
}

impl MethodName {
    /// All of them.
    pub fn all() -> &'static [Self] {
        clap::ValueEnum::value_variants()
    }

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Reference => "reference",
            Self::Joint => "joint",
            Self::Embedding => "embedding",
            Self::NaiveBayes => "naive-bayes",
            Self::Svm => "svm",
            Self::Knn => "knn",
            Self::Mahalanobis => "mahalanobis",
            Self::Adaboost => "adaboost",
            Self::RandomForest => "random-forest",
        }
    }
}

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
