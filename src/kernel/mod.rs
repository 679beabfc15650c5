//! The Gaussian kernel and the statistics that stand on it.
//!
//! Samples are arrays of shape (n, channels), in the order in which they were drawn. Everything
//! here is pure, and works in f64 unless it says otherwise.

mod lanes;
mod length_scale;
mod mmd;
mod permute;

pub use lanes::{Lanes, lane_scale, lane_sum};
pub use length_scale::{MEDIAN_SUBSET, length_scale};
pub use mmd::{CrossSums, kernel_sum, mmd2_biased, mmd2_from_sums};
pub use permute::{PairTest, pair_test};
