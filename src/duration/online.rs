//! T* of one source during a scan, by the rule `pooled` on the samples of this scan alone.
//!
//! The statistic is that of [`super::pooled`], on the last seconds of the stream, thinned so that a
//! fraction of a core suffices. T* can only be found in a recording many times longer, so a slow
//! source has no T* in the first seconds. To plan scans, use many trials instead.

use super::need::Second;
use super::pooled::{CORRELATION, at_needed_rate};
use crate::trial::Series;

/// Fewest frames for an estimate.
const FEWEST_FRAMES: usize = 500;

/// Settings of the online estimate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OnlineSettings {
    /// Threshold: the dependence of a Gaussian process with this correlation is small enough.
    pub dependence: f64,
    /// Number of values used of each of one or two channels; with more channels, which have many
    /// pairs, fewer values of each are used.
    pub values: usize,
    /// Time between estimates.
    pub every_s: Second,
    /// Length of the latest part of the stream that is used.
    pub window_s: Second,
}

impl Default for OnlineSettings {
    fn default() -> Self {
        Self { dependence: CORRELATION, values: 8000, every_s: 1.0, window_s: 10.0 }
    }
}

/// The reason why samples are refused.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[allow(missing_docs)] // The messages are the documentation.
pub enum OnlineError {
    #[error("{len} values are no whole frames of {channels} channels")]
    Ragged { len: usize, channels: usize },
    #[error("a sample is not finite; the estimate starts anew (check the cable)")]
    NotFinite,
}

/// The estimate from the stream so far.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct OnlineEstimate {
    /// T* in samples; `None` if this recording is too short to show it, or if nothing changes.
    pub t_star_samples: Option<usize>,
    /// Upper bound of T* in samples: the spacing to use.
    pub t_star_upper_samples: Option<usize>,
    /// T* in seconds.
    pub t_star_s: Option<Second>,
    /// Effective number of independent samples in the part that was used.
    pub effective_samples: Option<f64>,
    /// Length of the part of the stream that was used.
    pub window_s: Second,
}

/// Estimates T* of a single stream as blocks of samples arrive. Holds at most twice the window.
#[derive(Clone, Debug)]
pub struct OnlineDuration {
    rate_hz: f64,
    channels: usize,
    settings: OnlineSettings,
    /// Interleaved frames, oldest first; up to twice the window.
    history: Vec<f32>,
    since: usize,
}

impl OnlineDuration {
    /// An estimator for a stream of `rate_hz` frames a second with `channels` channels.
    pub fn new(rate_hz: f64, channels: usize, settings: OnlineSettings) -> Self {
        Self { rate_hz, channels, settings, history: Vec::new(), since: 0 }
    }

    /// Forgets the stream so far: a new scan begins.
    pub fn clear(&mut self) {
        self.history.clear();
        self.since = 0;
    }

    /// Adds a block of interleaved frames; returns a new estimate when one is due.
    ///
    /// # Errors
    /// If the block is not whole frames, or holds NaN or infinity (which drops earlier samples).
    pub fn push(&mut self, block: &[f32]) -> Result<Option<OnlineEstimate>, OnlineError> {
        if !block.len().is_multiple_of(self.channels) {
            return Err(OnlineError::Ragged { len: block.len(), channels: self.channels });
        }
        if block.iter().any(|x| !x.is_finite()) {
            self.clear();
            return Err(OnlineError::NotFinite);
        }
        self.history.extend_from_slice(block);
        let window = self.frames_in(self.settings.window_s) * self.channels;
        if self.history.len() > 2 * window {
            self.history.drain(..self.history.len() - window);
        }
        self.since += block.len() / self.channels;
        if self.since < self.frames_in(self.settings.every_s) {
            return Ok(None);
        }
        self.since = 0;
        Ok(self.estimate())
    }

    /// T* of the frames in the window; `None` if there are too few.
    pub fn estimate(&self) -> Option<OnlineEstimate> {
        let held = self.history.len() / self.channels;
        let frames = held.min(self.frames_in(self.settings.window_s));
        if frames < FEWEST_FRAMES {
            return None;
        }
        let window = self.history[(held - frames) * self.channels..].to_vec();
        // `push` has checked the frames; a rate that is not valid gives no estimate.
        let series = [Series::new(self.rate_hz, self.channels, window).ok()?];
        let OnlineSettings { dependence, values, .. } = self.settings;
        let values = (4 * values / self.channels.max(2).pow(2)).max(1);
        let found = at_needed_rate(&series, frames, dependence, values);
        let found = found.as_ref();
        let t_star_samples = found.and_then(|found| found.t_star_samples());
        Some(OnlineEstimate {
            t_star_samples,
            t_star_upper_samples: found.and_then(|found| found.upper_samples()),
            t_star_s: t_star_samples.map(|lag| lag as f64 / self.rate_hz),
            effective_samples: found.and_then(|found| found.effective_samples(frames)),
            window_s: frames as f64 / self.rate_hz,
        })
    }

    /// Number of frames in a time, at most 10¹², also for an infinite time.
    fn frames_in(&self, seconds: Second) -> usize {
        (seconds * self.rate_hz).min(1e12) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::super::simulate;
    use super::*;

    fn estimate(frames: Vec<f32>) -> OnlineEstimate {
        let mut online = OnlineDuration::new(1e4, 1, OnlineSettings::default());
        online.push(&frames).unwrap().unwrap()
    }

    #[test]
    fn an_estimate_comes_every_second_from_the_last_ten() {
        let mut rng = crate::seed::rng(5, &[b"online"]);
        let stream = simulate::ar1(250_000, 20.0, &mut rng);
        let mut online = OnlineDuration::new(1e4, 1, OnlineSettings::default());
        let found: Vec<_> =
            stream.chunks(2500).filter_map(|block| online.push(block).unwrap()).collect();
        assert_eq!(found.len(), 25);
        assert_eq!(found[24].window_s, 10.0);
        assert!(online.history.len() <= 200_000);
        // 10 s are 100,000 samples, of which 40 (2τ) count as one independent sample.
        let effective = found[24].effective_samples.unwrap();
        assert!((2000.0..3200.0).contains(&effective), "{effective}");
    }

    #[test]
    fn t_star_grows_with_the_correlation_time_of_the_stream() {
        let mut rng = crate::seed::rng(6, &[b"online"]);
        for tau in [10.0, 50.0, 200.0] {
            let mut found: Vec<f64> = (0..21)
                .filter_map(|_| estimate(simulate::ar1(100_000, tau, &mut rng)).t_star_samples)
                .map(|lag| lag as f64 / tau)
                .collect();
            assert!(found.len() >= 12, "τ = {tau}: {}", found.len());
            found.sort_unstable_by(f64::total_cmp);
            let median = found[found.len() / 2];
            assert!((1.7..3.2).contains(&median), "τ = {tau}: {median} τ");
        }
    }

    #[test]
    fn independent_noise_is_independent_at_once() {
        let mut rng = crate::seed::rng(7, &[b"online"]);
        let at_once = (0..40)
            .filter(|_| estimate(simulate::ar1(20_000, 0.0, &mut rng)).t_star_samples == Some(1))
            .count();
        assert!(at_once >= 36, "{at_once} of 40");
    }

    #[test]
    fn a_sine_never_becomes_independent() {
        let mut rng = crate::seed::rng(8, &[b"online"]);
        for period in [37.0, 200.0, 1000.0] {
            let found = estimate(simulate::sine(40_000, period, &mut rng)).t_star_samples;
            assert_eq!(found, None, "period {period}");
        }
    }

    #[test]
    fn a_constant_stream_has_no_t_star_and_nan_starts_anew() {
        assert_eq!(estimate(vec![1.0; 20_000]).t_star_samples, None);
        let mut online = OnlineDuration::new(1e4, 2, OnlineSettings::default());
        assert_eq!(online.push(&[1.0, f32::NAN]), Err(OnlineError::NotFinite));
        assert_eq!(online.push(&[1.0]), Err(OnlineError::Ragged { len: 1, channels: 2 }));
    }
}
