//! T* from one stream, while dragging: no second trial to compare with.
//!
//! Pairs (x(s), x(s + t)) are taken at many moments s of the same recording. They follow each
//! other, so permuting them would break their own autocorrelation and make κ too small. The wild
//! bootstrap keeps it: the null distribution of HSIC_b = Σᵢⱼ K̃ᵢⱼL̃ᵢⱼ/m² is that of
//! Σᵢⱼ W̃ᵢW̃ⱼK̃ᵢⱼL̃ᵢⱼ/m², where W is a stationary Gaussian AR(1) sequence of correlation length l
//! pairs and W̃ is W less its mean (K. Chwialkowski, D. Sejdinovic, A. Gretton, "A wild bootstrap
//! for degenerate kernel tests", NIPS 2014, Eqs. 7 and 8 and section 4.2).
//!
//! The length l follows from the question: if samples t apart are independent, pairs t apart are
//! too, so l = 1 + 2t/spacing covers what autocorrelation the null hypothesis leaves. It must stay
//! small against the number of pairs, which limits t to a 24th of what was recorded. One σ serves
//! both sides, since both come from the same stream.
//!
//! This is an estimate to show while dragging. It tells what the stream so far shows, from one
//! recording; [`super::t_star`] over many trials is what a plan should rest on.

use rand::Rng;

use super::lanes::{LANES, Lane};
use super::need::Second;
use super::simulate::normal;
use super::wild::{kernels, multipliers, quadratic_form};
use crate::kernel::quantile_index;

/// Longest lag that a recording can speak of, as a share of its length.
const LONGEST_LAG: usize = 24;
/// Fewest frames to say anything.
const FEWEST_FRAMES: usize = 1000;

/// How the online form works.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OnlineSettings {
    /// Pairs that each test is made of.
    pub pairs: usize,
    /// Bootstrap samples of a test, a multiple of eight.
    pub bootstraps: usize,
    /// Significance level.
    pub alpha: f64,
    /// A new estimate every so often.
    pub every_s: Second,
    /// How much of the past is looked at.
    pub window_s: Second,
    /// Seed of the multipliers.
    pub seed: u64,
}

impl Default for OnlineSettings {
    fn default() -> Self {
        Self { pairs: 128, bootstraps: 104, alpha: 0.05, every_s: 0.5, window_s: 10.0, seed: 1 }
    }
}

/// Why samples cannot be taken.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum OnlineError {
    /// a block that is not whole frames
    #[error("{len} values are no whole frames of {channels} channels")]
    Ragged {
        /// values given
        len: usize,
        /// channels expected
        channels: usize,
    },
    /// NaN or infinity
    #[error("a sample is not finite; the estimate starts anew (check the cable)")]
    NotFinite,
}

/// What the stream so far shows.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct OnlineEstimate {
    /// Smallest lag, in samples, at which no dependence is seen; none if every lag that this
    /// recording can speak of is dependent, or if nothing moves.
    pub t_star_samples: Option<usize>,
    /// The same in seconds.
    pub t_star_s: Option<Second>,
    /// Largest lag that was within reach, in samples.
    pub largest_lag: usize,
    /// How much was looked at.
    pub heard_s: Second,
}

/// T* of a single stream, updated as blocks of samples come in. Memory is bounded by the window.
#[derive(Clone, Debug)]
pub struct OnlineDuration {
    rate_hz: f64,
    channels: usize,
    settings: OnlineSettings,
    /// Interleaved frames, oldest first; up to twice the window.
    history: Vec<f32>,
    since: usize,
    /// Where in its slot each pair starts, from 0 to 1: regular spacing would alias.
    jitter: Vec<f64>,
    /// Standard normal numbers, pairs × bootstraps, in lanes.
    noise: Vec<Lane>,
    multipliers: Vec<Lane>,
    first: Vec<f64>,
    second: Vec<f64>,
    distances: Vec<f64>,
}

impl OnlineDuration {
    /// For a stream of `rate_hz` frames a second with `channels` channels.
    pub fn new(rate_hz: f64, channels: usize, settings: OnlineSettings) -> Self {
        let pairs = settings.pairs.max(LONGEST_LAG);
        let blocks = settings.bootstraps.max(24).div_ceil(LANES);
        let mut rng = crate::seed::rng(settings.seed, &[b"online duration"]);
        let jitter = (0..pairs).map(|_| f64::from(rng.next_u32()) / 4_294_967_296.0).collect();
        let noise: Vec<Lane> =
            (0..pairs * blocks).map(|_| std::array::from_fn(|_| normal(&mut rng))).collect();
        Self {
            rate_hz,
            channels,
            settings: OnlineSettings { pairs, bootstraps: blocks * LANES, ..settings },
            history: Vec::new(),
            since: 0,
            jitter,
            multipliers: noise.clone(),
            noise,
            first: vec![0.0; pairs * pairs],
            second: vec![0.0; pairs * pairs],
            distances: vec![0.0; pairs * (pairs - 1) / 2],
        }
    }

    /// Forgets what was heard: a new scan begins.
    pub fn clear(&mut self) {
        self.history.clear();
        self.since = 0;
    }

    /// Takes a block of interleaved frames; gives a new estimate when one is due.
    ///
    /// # Errors
    /// If the block is not whole frames, or holds NaN or infinity (all that came before is then
    /// forgotten).
    pub fn push(&mut self, block: &[f32]) -> Result<Option<OnlineEstimate>, OnlineError> {
        if !block.len().is_multiple_of(self.channels) {
            return Err(OnlineError::Ragged { len: block.len(), channels: self.channels });
        }
        if block.iter().any(|x| !x.is_finite()) {
            self.clear();
            return Err(OnlineError::NotFinite);
        }
        self.history.extend_from_slice(block);
        let window = (self.settings.window_s * self.rate_hz) as usize * self.channels;
        if self.history.len() > 2 * window {
            self.history.drain(..self.history.len() - window);
        }
        self.since += block.len() / self.channels;
        if self.since < (self.settings.every_s * self.rate_hz) as usize {
            return Ok(None);
        }
        self.since = 0;
        Ok(self.estimate())
    }

    /// T* of what is in the window, if that is enough to say anything.
    pub fn estimate(&mut self) -> Option<OnlineEstimate> {
        let window = (self.settings.window_s * self.rate_hz) as usize;
        let held = self.history.len() / self.channels;
        let frames = held.min(window);
        if frames < FEWEST_FRAMES.max(4 * self.settings.pairs) {
            return None;
        }
        let start = held - frames;
        let largest_lag = frames / LONGEST_LAG;
        let spacing = (frames - largest_lag) as f64 / self.settings.pairs as f64;
        let mut first = std::mem::take(&mut self.first);
        let median = self.distances_at(start, spacing, 0);
        let t_star = median.and_then(|median| {
            kernels(&self.distances, -1.0 / median, self.settings.pairs, &mut first);
            self.search(&first, median, start, spacing, largest_lag)
        });
        self.first = first;
        Some(OnlineEstimate {
            t_star_samples: t_star,
            t_star_s: t_star.map(|lag| lag as f64 / self.rate_hz),
            largest_lag,
            heard_s: frames as f64 / self.rate_hz,
        })
    }

    fn search(
        &mut self,
        first: &[f64],
        median: f64,
        start: usize,
        spacing: f64,
        largest_lag: usize,
    ) -> Option<usize> {
        let (mut dependent, mut lag) = (0, 1);
        while self.dependent(first, median, start, spacing, lag) {
            if lag == largest_lag {
                return None;
            }
            dependent = lag;
            lag = (lag + (lag / 2).max(1)).min(largest_lag);
        }
        while lag - dependent > 1.max(lag / 16) {
            let middle = (lag + dependent) / 2;
            if self.dependent(first, median, start, spacing, middle) {
                dependent = middle;
            } else {
                lag = middle;
            }
        }
        Some(lag)
    }

    /// Whether HSIC_b of pairs `lag` apart exceeds its bootstrap quantile.
    fn dependent(
        &mut self,
        first: &[f64],
        median: f64,
        start: usize,
        spacing: f64,
        lag: usize,
    ) -> bool {
        let m = self.settings.pairs;
        self.distances_at(start, spacing, lag);
        kernels(&self.distances, -1.0 / median, m, &mut self.second);
        // From here on the second matrix is the product of both, entry by entry.
        self.second.iter_mut().zip(first).for_each(|(l, k)| *l *= k);
        let observed: f64 = self.second.iter().sum();
        let length = 1.0 + 2.0 * lag as f64 / spacing;
        let blocks = self.settings.bootstraps / LANES;
        let mut null = Vec::with_capacity(self.settings.bootstraps);
        for block in 0..blocks {
            let noise = &self.noise[block * m..(block + 1) * m];
            let w = &mut self.multipliers[..m];
            multipliers(noise, length, w);
            null.extend(quadratic_form(&self.second, w));
        }
        null.sort_unstable_by(f64::total_cmp);
        observed > null[quantile_index(null.len(), self.settings.alpha)]
    }

    /// Squared distances of the samples `lag` after each pair's start, and their median (of those
    /// that are not zero) for lag 0.
    fn distances_at(&mut self, start: usize, spacing: f64, lag: usize) -> Option<f64> {
        let channels = self.channels;
        let history = &self.history;
        let at: Vec<usize> = (self.jitter.iter().enumerate())
            .map(|(i, jitter)| start + ((i as f64 + jitter) * spacing) as usize + lag)
            .collect();
        let mut pair = 0;
        for i in 0..at.len() {
            let a = &history[at[i] * channels..][..channels];
            for &other in &at[..i] {
                let b = &history[other * channels..][..channels];
                self.distances[pair] = a.iter().zip(b).map(|(x, y)| f64::from(x - y).powi(2)).sum();
                pair += 1;
            }
        }
        if lag > 0 {
            return None;
        }
        let mut positive: Vec<f64> = self.distances.iter().copied().filter(|&d| d > 0.0).collect();
        if positive.is_empty() {
            return None;
        }
        let middle = positive.len() / 2;
        Some(*positive.select_nth_unstable_by(middle, f64::total_cmp).1)
    }
}

#[cfg(test)]
mod tests {
    use super::super::simulate;
    use super::*;

    fn estimate(frames: Vec<f32>) -> OnlineEstimate {
        let mut online = OnlineDuration::new(1e4, 1, OnlineSettings::default());
        let mut last = None;
        for block in frames.chunks(100) {
            last = online.push(block).unwrap().or(last);
        }
        last.unwrap()
    }

    #[test]
    fn t_star_grows_with_the_correlation_time_of_the_stream() {
        let mut rng = crate::seed::rng(6, &[b"online"]);
        for tau in [10.0, 50.0, 200.0] {
            let mut found: Vec<f64> = (0..21)
                .filter_map(|_| estimate(simulate::ar1(50_000, tau, &mut rng)).t_star_samples)
                .map(|lag| lag as f64 / tau)
                .collect();
            assert!(found.len() >= 18, "τ = {tau}: {}", found.len());
            found.sort_unstable_by(f64::total_cmp);
            let median = found[found.len() / 2];
            assert!((0.7..4.0).contains(&median), "τ = {tau}: {median} τ");
        }
    }

    #[test]
    fn independent_noise_is_independent_at_once() {
        let mut rng = crate::seed::rng(7, &[b"online"]);
        let at_once = (0..40)
            .filter(|_| estimate(simulate::ar1(20_000, 0.0, &mut rng)).t_star_samples == Some(1))
            .count();
        assert!(at_once >= 34, "{at_once} of 40");
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
