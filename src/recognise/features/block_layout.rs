//! What is kept of a block of samples, and at which place ([`super::block_sums`]).

/// Lags of the products x_t·x_{t−l}, in samples: 0 … 3.
pub const LAGS: usize = 4;

/// Places of what is kept of a channel, behind the block's length.
#[derive(Clone, Copy)]
pub(super) enum Of {
    /// Σ x
    Sum,
    /// Σ x³
    Cubes,
    /// Σ x⁴
    Fourths,
    /// (Σ x)²/n
    SquaredLevel,
    /// Σ |x − m|, m the block's mean
    Magnitude,
    /// Σ √|x − m|
    Root,
    /// crossings of the block's mean
    Crossings,
    /// least x
    Least,
    /// greatest x
    Greatest,
}

/// Values kept of a channel.
pub(super) const OF_CHANNEL: usize = 9;

/// Values kept of a block: its length, [`OF_CHANNEL`] of each channel, C × C products of each lag.
pub(super) fn width(channels: usize) -> usize {
    1 + OF_CHANNEL * channels + LAGS * channels * channels
}

pub(super) fn place(of: Of, channel: usize) -> usize {
    1 + OF_CHANNEL * channel + of as usize
}

pub(super) fn products(channels: usize, lag: usize) -> usize {
    1 + OF_CHANNEL * channels + lag * channels * channels
}
