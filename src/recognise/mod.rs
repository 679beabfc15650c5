//! Names the surface of a trial.
//!
//! ```text
//! MethodSpec ─► Method: prepare ─► Prepared (cached beside the library) ─► fit ─► Model
//!               query ─► Model: prepare ─► rank ─► Ranking ─► decide
//! ```
//!
//! A [`Method`] is a way of comparing trials. It prepares each trial of a library once and fits a
//! [`Model`] to them, which prepares a query and ranks the library's surfaces for it. [`reference`](mod@reference)
//! is the paper's method, exactly; [`embedding`] the default; [`classify`] are the paper's
//! comparison classifiers.

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
mod prepared;
mod prepared_library;
mod rank;
pub mod reference;
mod shape;
mod spec;

pub use combine::{log_discrepancy, medians};
pub use compare::{Comparison, SourceComparison, TestOptions, compare};
pub use decide::conformal::{Conformity, Rejection, RejectionError, nonconformity};
pub use decide::dead_sensor::without_flawed;
pub use decide::interval::{can_show, reaches, wilson, wilson_of_groups};
pub use decide::scan_time::{AccuracyAt, Goal, LeftOutAccuracy, ScanTime, Shortfall};
pub use decide::settle::{SettleRule, Settling};
pub use embedding::{Embedding, EmbeddingModel, EmbeddingOptions};
pub use error::RecogniseError;
pub use features::{FrameFeatures, amplitude_spectrum, band_bins, hsv};
pub use follow::{Follow, FollowOptions, FreshFrames, GuessSoFar, LOOK_S};
pub use method::{BySources, Evidence, Method, Model, SourceEvidence};
pub use prepared::Prepared;
pub use prepared_library::{PreparedLibrary, prepare_library};
pub use rank::{Candidate, RankedSurface, Ranking, rank};
pub use reference::{
    DomainExtent, DomainSamples, IMAGE_COLS, IMAGE_ROWS, PositionMode, Positions, PreparedTrial,
    QuerySet, Reference, ReferenceModel, ReferenceOptions, SCORE_FLOOR, STAGES, SampleScore,
    SampleSet, Scratch, Stage, SumPrecision, draw_positions, image_grid, log_score, score_samples,
    score_sets,
};
pub use shape::{LibraryShape, SourceShape};
pub use spec::{MOST_COUNT, MethodName, MethodSpec, NoOptions, TreeOptions};
