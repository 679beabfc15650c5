//! Hand-made features of a trial, for the comparison classifiers, and log-band frames, which
//! `embedding` uses, too. A [`FeatureVector`] holds
//!
//! | source | features, for each channel | |
//! |---|---|---|
//! | any series | `series_statistics::MOMENTS` | level, spread, moments and ratios in time |
//! | domain `spectrum` | log-band levels, mean and deviation over frames of 46 ms | up to 40 bands |
//! | domain `time` | the same over frames of 0.2 s, to 500 Hz | up to 16 bands |
//! | picture | `picture_statistics::FEATURES` | colour statistics, co-occurrence, gradients |
//!
//! Nothing here knows of other trials.

mod colour;
pub(crate) mod picture_statistics;
pub(crate) mod series_statistics;
mod vector;
pub(super) mod windowed_frames;

pub use colour::hsv;
pub use vector::FeatureVector;

pub(crate) use vector::SourceFeatures;
