//! The Gaussian kernel and the statistics that stand on it.
//!
//! Samples are arrays of shape (n, channels), in the order in which they were drawn. Everything
//! here is pure, and works in f64 unless it says otherwise.

mod f64_sums;
mod hsic;
mod lanes;
mod length_scale;
mod line;
mod mmd;
mod padded_points;
mod pearson3;
mod permutation_moments;
mod permute;
mod simd;
mod table;

pub use f64_sums::{F64Points, f64_self_sum, f64_sum};
pub use hsic::{
    Dependence, FEWEST_PAIRS, HsicError, PERMUTATIONS, Threshold, centred, hsic_b, kernel_matrix,
    permuted, quantile_index, test_independence,
};
pub use lanes::{InstructionSet, lane_self_sum, lane_self_sum_with, lane_sum, lane_sum_with};
pub use length_scale::{MEDIAN_SUBSET, length_scale, length_scale_of};
pub use line::LineSum;
pub use mmd::{CrossSums, kernel_sum, mmd2_biased, mmd2_from_sums};
pub use padded_points::{PaddedPoints, lane_scale};
pub use pearson3::Pearson3;
pub use permutation_moments::{CentredMoments, Moments, permutation_moments};
pub use permute::{PairTest, pair_test};
pub use table::{FOLD, NODES, SelfMean};
