//! Names the surface of a trial: sampling ─► kernel ─► score ─► rank.
//!
//! A [`Method`] is a way of comparing trials. It prepares each trial once, fits a model to the
//! prepared library, and ranks the library's surfaces for a prepared query. [`Reference`] is the
//! paper's method, exactly.

mod any;
mod checks;
pub mod classify;
mod combine;
mod compare;
mod decide;
pub mod embedding;
mod error;
pub mod features;
mod follow;
mod method;
mod prepare;
mod rank;
pub mod reference;
mod spec;

pub use any::{AnyMethod, AnyModel, AnyPrepared};
pub use compare::{Comparison, SourceComparison, TestOptions, compare};
pub use decide::conformal::{Conformity, Rejection, RejectionError, nonconformity};
pub use decide::dead_sensor::without_flawed;
pub use decide::interval::jeffreys_quantile;
pub use decide::settle::{SettleRule, Settling};
pub use embedding::{Embedding, EmbeddingModel, EmbeddingOptions, Posterior, SourceDistances};
pub use error::RecogniseError;
pub use features::{FrameFeatures, FrameStream, amplitude_spectrum, band_bins, hsv};
pub use follow::{Follow, FollowOptions, FreshFrames, GuessSoFar, LOOK_S};
pub use method::Method;
pub use prepare::{Preparation, prepare_library};
pub use rank::{Candidate, RankedSurface, Ranking, rank};
pub use reference::{
    DomainSamples, Extent, IMAGE_COLS, IMAGE_ROWS, PositionMode, Positions, Precision,
    PreparedTrial, QuerySet, Reference, ReferenceOptions, SCORE_FLOOR, STAGES, SampleScore,
    SampleSet, Scratch, Stage, draw_positions, image_grid, log_score, score_samples, score_sets,
};
pub use spec::MethodName;
