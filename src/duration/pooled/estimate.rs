//! T* of recordings, thinned as far as precision allows.

use super::features::Samples;
use super::{PooledAnswer, pooled};
use crate::trial::Series;

/// Default threshold: dependence is small up to that of a Gaussian process with this correlation.
pub const CORRELATION: f64 = 0.1;
/// Most values used of a channel, over all trials: about 10 trials of 4.8 s at 10 kHz.
pub const VALUES: usize = 500_000;
/// Frames are thinned less if T* is shorter than this number of thinned frames.
const RESOLUTION: f64 = 32.0;

#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct PooledDependence {
    pub lag_samples: f64,
    pub lag_s: f64,
    /// The measured dependence, as the correlation of an equally dependent Gaussian process.
    pub dependence: f64,
    /// Fit of the dependence that never rises with the lag. T* is read from this fit.
    pub fitted: f64,
    /// Lower end of the fit's 90 % interval.
    pub low: f64,
    pub high: f64,
}

/// The result of `pooled`. Lags and lengths are in samples of the source.
#[derive(Clone, Debug, PartialEq)]
pub struct PooledEstimate {
    /// T*, or why there is none.
    pub answer: PooledAnswer,
    /// k: every k-th sample was used.
    pub step: usize,
    /// Longest T* that these trials can show.
    pub range: f64,
    /// Number of successive samples that are worth one independent sample; `None` without a T*.
    pub inflation: Option<f64>,
    /// Share of the variance from lasting differences between trials; `None` for a single trial.
    pub lasting_share: Option<f64>,
    /// Dependence at each lag, for the pair of channels with the longest T*.
    pub curve: Vec<PooledDependence>,
}

impl PooledEstimate {
    /// T* in samples: dependence is small at this whole lag and all longer ones.
    pub fn t_star_samples(&self) -> Option<usize> {
        match self.answer {
            PooledAnswer::Found { t_star, .. } => Some(t_star.ceil() as usize),
            _ => None,
        }
    }

    /// Upper bound of T* in samples; use it as the distance between samples.
    pub fn upper_samples(&self) -> Option<usize> {
        match self.answer {
            PooledAnswer::Found { upper, .. } => Some(upper.ceil() as usize),
            _ => None,
        }
    }

    /// Effective number of independent samples among `samples` successive samples.
    pub fn effective_samples(&self, samples: usize) -> Option<f64> {
        self.inflation.map(|inflation| samples as f64 / inflation)
    }
}

/// T* from the first `frames` frames of `series`: trials with the same rate and number of channels.
/// `correlation` is the threshold. `None` if nothing changes in the trials.
///
/// Uses every k-th frame, so that a channel has about `values` values. The error of T* depends on how
/// often T* fits into the recordings, and hardly on how many samples lie within T*. If T* is shorter
/// than 32 thinned frames, k was too large. A smaller k is then computed from T*, and only the last
/// `values`·k frames of all trials together are used. Frames are dropped, not averaged, since the
/// dependence of the original samples is wanted.
pub fn at_needed_rate(
    series: &[Series],
    frames: usize,
    correlation: f64,
    values: usize,
) -> Option<PooledEstimate> {
    let rate_hz = series.first()?.rate_hz();
    let mut step = (series.len() * frames).div_ceil(values);
    let found = pooled(&Samples::every(step, 0..frames, series), correlation, step, rate_hz)?;
    if let PooledAnswer::Found { t_star, .. } = found.answer
        && t_star < RESOLUTION * step as f64
        && step > 1
    {
        step = ((t_star / RESOLUTION) as usize).max(1);
        let kept = frames.min(values * step / series.len());
        let samples = Samples::every(step, frames - kept..frames, series);
        return pooled(&samples, correlation, step, rate_hz).or(Some(found));
    }
    Some(found)
}
