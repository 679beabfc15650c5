//! The rule `pooled`: measures how *large* dependence is, from all pairs of samples of all trials.
//!
//! ```text
//! samples ─► features ─► covariance (at lags) ─► size ─► crossing
//!                └► echo
//! ```
//!
//! `features` makes values Gaussian by their ranks, and computes Hermite polynomials of them.
//! [`covariance`] computes the covariance of these features at each of the `lags`, and undoes the
//! effect of centring each trial. [`size`] measures the covariance without bias. [`crossing`] finds
//! the lag from which on it stays below the threshold. [`echo`] tests each lag. [`at_needed_rate`]
//! chooses how far a source is thinned.

mod covariance;
mod crossing;
mod echo;
mod features;
mod lags;
mod size;

use covariance::{Covariances, covariances};
use crossing::{Crossing, Curve};
use features::{Features, Samples, features};
use lags::{Lags, lags};
use ndarray::Array2;

use crate::trial::Series;

/// Default threshold: dependence is small up to that of a Gaussian process with this correlation.
pub const CORRELATION: f64 = 0.1;
/// Most values used of a channel, over all trials: about 10 trials of 4.8 s at 10 kHz.
pub const VALUES: usize = 500_000;
/// Frames are thinned less if T* is shorter than this number of thinned frames.
const RESOLUTION: f64 = 32.0;
/// The longest lag must exceed T* by this factor, to show that dependence does not return.
const BEYOND: f64 = 1.5;
/// Largest number of corrections for trial means. They depend on T*, and T* on them.
const CORRECTIONS: usize = 3;

/// T* in samples, or why there is none.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PooledAnswer {
    /// T* and its one-sided 95 % upper bound; use that as the distance between samples.
    Found { t_star: f64, upper: f64 },
    /// Dependence stays above the threshold up to the longest lag: the signal repeats or drifts.
    Never,
    /// Dependence falls below the threshold too late for the trials to show that it stays below.
    NotWithinRange,
    /// Number of further trials like these that would suffice, about.
    TooLittleData { more_trials: usize },
}

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
        let PooledAnswer::Found { t_star, .. } = self.answer else { return None };
        Some(t_star.ceil() as usize)
    }

    /// Upper bound of T* in samples; use it as the distance between samples.
    pub fn upper_samples(&self) -> Option<usize> {
        let PooledAnswer::Found { upper, .. } = self.answer else { return None };
        Some(upper.ceil() as usize)
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

/// T* from `samples`: every `step`-th sample of the trials; `None` if nothing changes, or if they are too
/// short. The threshold is the dependence of a Gaussian process with this `correlation`.
fn pooled(
    samples: &Samples,
    correlation: f64,
    step: usize,
    rate_hz: f64,
) -> Option<PooledEstimate> {
    let (features, scale) = (features(samples), step as f64);
    let lags = lags(samples.trials, samples.frames);
    if features.columns.is_empty() || lags.bins.len() < 2 {
        return None;
    }
    let threshold = size::of_correlation(correlation);
    let longest = lags.all.last().map_or(0, |lag| lag.frames);
    let range = longest as f64 / BEYOND;
    let (at_once, raw) = covariances(&features, &lags.all);

    let mut found = PairCurves::new(&raw, &features, &lags, threshold);
    let (mut corrected, mut variance) = (None, Array2::zeros(at_once.raw_dim()));
    let mut summed = None;
    for _ in 0..CORRECTIONS {
        let reach = found.reach(longest);
        // Summing over the same lags again would change nothing.
        let lags_within = lags.all.iter().filter(|lag| lag.frames as f64 <= reach).count();
        if summed.replace(lags_within) == Some(lags_within) {
            break;
        }
        variance = covariance::mean_variance(&at_once, &raw, &lags.all, features.frames, reach);
        let now = covariance::corrected(&raw, &variance);
        found = PairCurves::new(&now, &features, &lags, threshold);
        corrected = Some(now);
    }
    if let Some(t_star) = found.estimate
        && let Some(echo) = echo::last_echo(&features, correlation, t_star.ceil() as usize, longest)
    {
        let after = (echo + 1) as f64;
        found.estimate = Some(after);
        found.upper = found.upper.map(|upper| upper.max(after));
    }
    let mut answer = found.answer(threshold, range, longest as f64, samples.trials);
    let mut inflation = None;
    if let PooledAnswer::Found { t_star, upper } = &mut answer {
        (*t_star, *upper) = (scale * *t_star, scale * *upper);
        let of = |c| scale * size::inflation(c, &features, &lags.all, found.reach(longest));
        inflation = corrected.as_ref().map(of);
    }
    let (range, lasting_share) = (scale * range, lasting(&features, &variance));
    let curve = found.points(threshold, scale, rate_hz);
    Some(PooledEstimate { answer, step, range, inflation, lasting_share, curve })
}

/// Curves of dependence for all ordered pairs of channels, with the longest T* and its upper bound.
struct PairCurves {
    curves: Vec<Curve>,
    /// Index of the curve that falls below the threshold last.
    worst: usize,
    estimate: Option<f64>,
    upper: Option<f64>,
}

impl PairCurves {
    fn new(covariances: &Covariances, features: &Features, lags: &Lags, threshold: f64) -> Self {
        let centres: Vec<f64> = lags.bins.iter().map(|bin| bin.centre).collect();
        let mut curves = Vec::new();
        for earlier in &features.channels {
            for later in &features.channels {
                let size = |bin| size::size(covariances, bin, earlier, later);
                curves.push(Curve::new(centres.clone(), lags.bins.iter().map(size).collect()));
            }
        }
        let crossings: Vec<_> = curves.iter().map(|curve| curve.crossing(threshold)).collect();
        let latest = |of: fn(&Crossing) -> Option<f64>| {
            let all: Option<Vec<f64>> = crossings.iter().map(of).collect();
            Some(all?.into_iter().fold(0.0, f64::max))
        };
        let (estimate, upper) = (latest(|c| c.estimate), latest(|c| c.upper));
        let key = |i: &usize| crossings[*i].estimate.unwrap_or(f64::INFINITY);
        let worst = (0..curves.len()).max_by(|a, b| key(a).total_cmp(&key(b))).unwrap_or(0);
        Self { curves, worst, estimate, upper }
    }

    /// The lag up to which correlation is summed: twice T*, but at most the longest lag.
    fn reach(&self, longest: usize) -> f64 {
        self.estimate.map_or(longest as f64, |t| (2.0 * t).min(longest as f64))
    }

    fn answer(&self, threshold: f64, range: f64, longest: f64, trials: usize) -> PooledAnswer {
        let stays = |lag: f64| self.curves.iter().any(|curve| curve.stays_above(threshold, lag));
        match (self.estimate, self.upper) {
            (Some(t_star), Some(upper)) if upper <= range => PooledAnswer::Found { t_star, upper },
            _ if stays(longest) => PooledAnswer::Never,
            _ if stays(range) => PooledAnswer::NotWithinRange,
            _ => PooledAnswer::TooLittleData { more_trials: self.more_trials(threshold, trials) },
        }
    }

    /// Trials that are lacking until the upper bound for independent samples is half the threshold.
    fn more_trials(&self, threshold: f64, trials: usize) -> usize {
        let needed = self.curves.iter().map(|curve| curve.lacking(threshold)).fold(1.0, f64::max);
        ((trials as f64 * needed).ceil() as usize).saturating_sub(trials).max(1)
    }

    fn points(&self, threshold: f64, scale: f64, rate_hz: f64) -> Vec<PooledDependence> {
        let Some(curve) = self.curves.get(self.worst) else { return Vec::new() };
        let correlation = |root: f64| size::as_correlation(root.max(0.0).powi(2));
        (0..curve.lags.len())
            .map(|bin| {
                let root = curve.fitted[bin].max(0.0).sqrt();
                let half_width = curve.half_width(bin, threshold);
                PooledDependence {
                    lag_samples: scale * curve.lags[bin],
                    lag_s: scale * curve.lags[bin] / rate_hz,
                    dependence: size::as_correlation(curve.sizes[bin].value),
                    fitted: correlation(root),
                    low: correlation(root - half_width),
                    high: correlation(root + half_width),
                }
            })
            .collect()
    }
}

/// Share of the variance that lies between trial means and is not explained by slow changes within
/// trials, for the channel with the largest share.
fn lasting(features: &Features, mean_variance: &Array2<f64>) -> Option<f64> {
    if features.trials < 2 {
        return None;
    }
    let share = |i: usize| {
        let v = mean_variance[[i, i]];
        features.between[i] - v / (1.0 + v)
    };
    (features.channels.iter())
        .map(|channel| channel.clone().map(share).sum::<f64>() / channel.len() as f64)
        .max_by(f64::total_cmp)
        .map(|worst| worst.clamp(0.0, 1.0))
}
