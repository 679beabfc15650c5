//! Names the surface of a trial.
//!
//! ```text
//! MethodSpec ─► Method: prepare ─► Prepared (cached beside the library) ─► fit ─► Model
//!               query ─► Model: prepare ─► rank ─► Ranking ─► decide
//! ```
//!
//! A [`Method`] is a way of comparing trials. It prepares each trial of a library once and fits a
//! [`Model`] to the prepared trials. The model prepares a query and ranks the library's surfaces by
//! likeness. [`Reference`] is the paper's method, exactly; [`Embedding`] is the default; the others of
//! [`MethodName`] are the paper's comparison classifiers.

pub(crate) mod classify;
mod compare;
mod decide;
pub(crate) mod embedding;
mod error;
mod method;
mod model_file;
mod prepared;
mod rank;
mod ready_model;
#[doc(hidden)]
pub mod reference;
mod spec;

pub use crate::features::sources::SourceError;
pub use crate::library::shape::{LibraryShape, SourceShape};
pub use decide::LeftOutBy;
pub use decide::conformal::{Rejection, RejectionError};
pub use decide::interval::wilson_interval;
pub use decide::scan_time::{AccuracyAt, Goal, LeftOutAccuracy, ScanTime, Shortfall};
pub use decide::settle::{FollowOptions, SettleRule, Settling};
pub use embedding::{
    Embedding, EmbeddingModel, EmbeddingOptions, Follower, FreshFrames, GuessSoFar, QueryVector,
};
pub use error::RecogniseError;
pub(crate) use error::if_enough;
pub use method::{Evidence, Method, Model, SourceEvidence};
pub use model_file::{ModelFile, ModelFileError};
pub use prepared::Prepared;
pub use rank::{Candidate, RankedSurface, Ranking};
pub use ready_model::{PreparedLibrary, ReadyModel, prepare_library, ready_model};
pub use reference::{PositionMode, Reference, ReferenceOptions, SumPrecision};
pub use spec::{MethodName, MethodSpec, NoOptions, TreeOptions};

pub(crate) use decide::interval::{chance, reaches, wilson_of_groups};

#[doc(hidden)] // For the project's own tests and tools.
pub use {
    crate::features::frames::{LOOK_S, TrialFrames},
    compare::{Comparison, TestOptions, compare},
    decide::{dead_sensor::without_flawed, sticky::StickyFilter},
    rank::{log_discrepancy, medians, stated_probabilities},
    reference::{
        DomainSamples, QuerySet, STAGES, SampleSet, Scratch, Stage, image_grid, score_samples,
    },
    spec::MOST_COUNT,
};
