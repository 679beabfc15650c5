//! T* of one source during a scan, by the rule `pooled` from the samples of this scan alone.
//!
//! Computes [`super::pooled`] on thinned samples, to take only a fraction of a processor core. A
//! recording must be many times longer than T* to show it, so a slow source has no T* in the first
//! seconds. To plan scans, use many trials instead.

use super::pooled::{CORRELATION, PooledEstimate, at_needed_rate};
use crate::trial::Series;

const FEWEST_FRAMES: usize = 500;
/// Values used of each channel, if there are one or two; fewer of more, which make many pairs.
const VALUES: usize = 8000;
/// Seconds of scan from one estimate to the next.
const EVERY_S: f64 = 1.0;

#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum OnlineError {
    #[error("{len} values cannot be divided into frames of {channels} channels")]
    Ragged { len: usize, channels: usize },
    #[error("a sample is not finite; the estimate starts anew (check the cable)")]
    NotFinite,
}

/// Estimates T* of a single stream as blocks of samples arrive. Keeps all samples of the scan.
#[derive(Clone, Debug)]
pub struct OnlineDuration {
    rate_hz: f64,
    channels: usize,
    /// Interleaved frames; the oldest comes first.
    history: Vec<f32>,
    since: usize,
}

impl OnlineDuration {
    /// An estimator for a stream of `rate_hz` frames a second with `channels` channels.
    pub fn new(rate_hz: f64, channels: usize) -> Self {
        Self { rate_hz, channels, history: Vec::new(), since: 0 }
    }

    /// Adds a block of interleaved frames. Returns a new estimate once a second. `None` if no estimate
    /// is due, if there are too few frames yet, or if nothing changes.
    ///
    /// # Errors
    /// If the block is not whole frames, or is not finite (which also drops all earlier samples).
    pub fn push(&mut self, block: &[f32]) -> Result<Option<PooledEstimate>, OnlineError> {
        if !block.len().is_multiple_of(self.channels) {
            return Err(OnlineError::Ragged { len: block.len(), channels: self.channels });
        }
        if block.iter().any(|x| !x.is_finite()) {
            self.history.clear();
            self.since = 0;
            return Err(OnlineError::NotFinite);
        }
        self.history.extend_from_slice(block);
        self.since += block.len() / self.channels;
        if self.since < (EVERY_S * self.rate_hz) as usize {
            return Ok(None);
        }
        self.since = 0;
        // The frames have been checked; a rate that is not valid gives no estimate.
        let series = Series::new(self.rate_hz, self.channels, self.history.clone());
        Ok(series.ok().and_then(|series| of_recording(&series)))
    }
}

/// T* of one recording, thinned as during a scan; `None` if it is too short, or if nothing changes.
pub fn of_recording(series: &Series) -> Option<PooledEstimate> {
    if series.frames() < FEWEST_FRAMES {
        return None;
    }
    let values = (4 * VALUES / series.channels().max(2).pow(2)).max(1);
    at_needed_rate(std::slice::from_ref(series), series.frames(), CORRELATION, values)
}

#[cfg(test)]
mod tests {
    use super::super::simulate;
    use super::*;

    fn t_star(frames: Vec<f32>) -> Option<usize> {
        of_recording(&Series::new(1e4, 1, frames).unwrap())?.t_star_samples()
    }

    #[test]
    fn an_estimate_comes_every_second_from_all_so_far() {
        let mut rng = crate::seed::rng(5, &[b"online"]);
        let stream = simulate::ar1(100_000, 20.0, &mut rng);
        let mut online = OnlineDuration::new(1e4, 1);
        let found: Vec<_> =
            stream.chunks(2500).filter_map(|block| online.push(block).unwrap()).collect();
        assert_eq!(found.len(), 10);
        assert_eq!(found[9], of_recording(&Series::new(1e4, 1, stream).unwrap()).unwrap());
        // 10 s are 100,000 samples; 40 samples (2τ) count as one independent sample.
        let effective = found[9].effective_samples(100_000).unwrap();
        assert!((2000.0..3200.0).contains(&effective), "{effective}");
    }

    #[test]
    fn t_star_grows_with_the_correlation_time_of_the_stream() {
        let mut rng = crate::seed::rng(6, &[b"online"]);
        for tau in [10.0, 50.0, 200.0] {
            let lags = (0..21).filter_map(|_| t_star(simulate::ar1(100_000, tau, &mut rng)));
            let mut found: Vec<f64> = lags.map(|lag| lag as f64 / tau).collect();
            assert!(found.len() >= 12, "τ = {tau}: {}", found.len());
            found.sort_unstable_by(f64::total_cmp);
            let median = found[found.len() / 2];
            assert!((1.7..3.2).contains(&median), "τ = {tau}: {median} τ");
        }
    }

    #[test]
    fn a_constant_stream_has_no_t_star_and_nan_starts_anew() {
        assert_eq!(t_star(vec![1.0; 20_000]), None);
        let mut online = OnlineDuration::new(1e4, 2);
        assert_eq!(online.push(&[1.0, f32::NAN]), Err(OnlineError::NotFinite));
        assert_eq!(online.push(&[1.0]), Err(OnlineError::Ragged { len: 1, channels: 2 }));
    }
}
