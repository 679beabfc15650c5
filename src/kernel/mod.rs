//! The Gaussian kernel and the statistics that stand on it.
//!
//! Samples are arrays of shape (n, channels), in the order in which they were drawn. Everything
//! here is pure, and works in f64 unless it says otherwise.

mod hsic;
mod lanes;
mod length_scale;
mod mmd;
mod pearson3;
mod permutation_moments;
mod permute;

pub use hsic::{
    Dependence, FEWEST_PAIRS, HsicError, PERMUTATIONS, Threshold, centred, hsic_b, kernel_matrix,
    permuted, quantile_index, test_independence,
};
pub use lanes::{Lanes, lane_scale, lane_sum};
pub use length_scale::{MEDIAN_SUBSET, length_scale, length_scale_of};
pub use mmd::{CrossSums, kernel_sum, mmd2_biased, mmd2_from_sums};
pub use pearson3::Pearson3;
pub use permutation_moments::{CentredMoments, Moments, permutation_moments};
pub use permute::{PairTest, pair_test};
