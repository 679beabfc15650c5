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
mod simd;
mod table;

pub use hsic::{Dependence, HsicError, PERMUTATIONS, Threshold, hsic_b, test_independence};
pub use length_scale::length_scale;
pub use mmd::{kernel_sum, mmd2_biased};

#[doc(hidden)] // For the project's own tests and tools.
pub use hsic::{centred, kernel_matrix, permuted, quantile_index};
#[doc(hidden)]
pub use lanes::{InstructionSet, lane_self_sum_with, lane_sum_with};
#[doc(hidden)]
pub use padded_points::{PaddedPoints, lane_scale};

pub(crate) use f64_sums::{F64Points, f64_self_sum, f64_sum};
pub(crate) use hsic::FEWEST_PAIRS;
pub(crate) use lanes::{lane_self_sum, lane_sum};
pub(crate) use line::LineSum;
pub(crate) use mmd::{CrossSums, mmd2_from_sums, pair_test};
pub(crate) use pearson3::Pearson3;
pub(crate) use permutation_moments::{CentredMoments, permutation_moments};
pub(crate) use table::{FOLD, NODES, SelfMean};
