//! The Gaussian kernel and the statistics built on it.
//!
//! Samples are arrays of shape (n, channels), in the order in which they were drawn. Functions do
//! no I/O, and compute in f64 unless their comments name another type.

#![warn(missing_docs)]

mod hsic;
mod length_scale;
mod line;
mod mmd;
mod permutation_moments;
mod simd;
mod sums;
mod table;

pub use hsic::{Dependence, HsicError, PERMUTATIONS, Threshold, test_independence};
pub use length_scale::length_scale;
pub use mmd::{kernel_sum, mmd2_biased};

#[doc(hidden)] // For the project's own tests and tools.
pub use hsic::{centred, kernel_matrix, neighbours_alike, permuted, quantile};
#[doc(hidden)]
pub use sums::Points;

pub(crate) use hsic::{FEWEST_PAIRS, check_level};
pub(crate) use line::LineSum;
pub(crate) use mmd::{CrossSums, mmd2_from_sums, pair_test};
pub(crate) use sums::Number;
pub(crate) use table::{FOLD, NODES, SelfMean};
