//! What is computed of a trial before any comparison.
//!
//! Of frames of log-band levels, block sums and neighbouring pixels: [`FrameFeatures`], for
//! `embedding`. Of fixed lists of numbers, for the comparison classifiers: [`FeatureVector`], with
//!
//! | source | features, for each channel | |
//! |---|---|---|
//! | any series | `series_statistics::MOMENTS` | level, spread, moments and ratios in time |
//! | domain `spectrum` | log-band levels, mean and deviation over frames of 46 ms | up to 40 bands |
//! | domain `time` | the same over frames of 0.2 s, to 500 Hz | up to 16 bands |
//! | picture | `picture_statistics::FEATURES` | colour statistics, co-occurrence, gradients |
//!
//! Nothing here knows of other trials, but for their lengths, which frames follow.

mod block_layout;
pub(super) mod block_sums;
mod colour;
pub(super) mod frame_features;
pub(super) mod image_features;
pub(crate) mod picture_statistics;
pub(crate) mod series_statistics;
mod vector;
pub(super) mod window_sums;
pub(super) mod windowed_frames;

pub use colour::hsv;
pub use frame_features::FrameFeatures;
pub use vector::FeatureVector;

pub(crate) use vector::SourceFeatures;
