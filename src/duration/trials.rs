//! The trials of one surface and source, checked before anything is computed from them.

use crate::kernel::{FEWEST_PAIRS, HsicError};
use crate::trial::Series;

/// Share of equal samples at one end of a channel's range above which the channel is refused.
const SATURATED: f64 = 0.5;
/// Share of equal samples at one end of a channel's range above which a remark tells of saturation.
const WORTH_SAYING: f64 = 0.02;
/// Trials are compared at about this number of frames, to see whether they differ.
const MOMENTS: usize = 2000;

/// The reason why T* cannot be computed.
#[derive(Debug, thiserror::Error, PartialEq)]
#[allow(missing_docs)] // The messages are the documentation.
pub enum DurationError {
    #[error("{0} trials; expected at least {FEWEST_PAIRS} of one surface (record more)")]
    TooFewTrials(usize),
    #[error("trial {trial} has {rate_hz} Hz and trial 1 has {expected_hz} Hz; expected one rate")]
    Rates {
        /// trial, counted from 1
        trial: usize,
        rate_hz: f64,
        expected_hz: f64,
    },
    #[error("trial {trial} has {channels} channels and trial 1 has {expected}")]
    Channels {
        /// trial, counted from 1
        trial: usize,
        channels: usize,
        expected: usize,
    },
    #[error("the shortest trial has {frames} samples; expected at least {expected}")]
    TooShort { frames: usize, expected: usize },
    #[error(
        "the source is constant: nothing moves, so there is no time after which it is independent"
    )]
    Constant,
    #[error(
        "all trials hold one and the same value {:.0} % of the time, as a metal detector does; \
         T* has no meaning here", share * 100.0
    )]
    MostlyOneValue { share: f64 },
    #[error(
        "channel {channel} is saturated: {:.0} % of its samples lie at one end of its range; \
         lower the gain and record again", share * 100.0
    )]
    Saturated {
        /// channel, counted from 1
        channel: usize,
        share: f64,
    },
    #[error("{0}")]
    Settings(String),
    #[error(transparent)]
    Hsic(#[from] HsicError),
}

/// Fewest samples of a trial for Algorithm 1.
pub const FEWEST_FRAMES: usize = 100;
/// Fewest samples of a trial for `pooled`, whose lags reach a quarter of a trial.
const FEWEST_POOLED: usize = 40;

/// Q trials of one surface and source, with one rate and number of channels, used up to the length
/// of the shortest.
#[derive(Clone, Debug)]
pub struct Trials {
    series: Vec<Series>,
    frames: usize,
    /// Remarks on how far T* can be trusted, a line each.
    pub remarks: Vec<String>,
}

impl Trials {
    /// Trials for Algorithm 1, each an independent recording of the same surface.
    ///
    /// # Errors
    /// If there are fewer than five, or if they differ in rate or channels, are too short, constant
    /// or saturated, or have one value most of the time. A [`Series`] holds no NaN or infinity.
    pub fn new(series: Vec<Series>) -> Result<Self, DurationError> {
        if series.len() < FEWEST_PAIRS {
            return Err(DurationError::TooFewTrials(series.len()));
        }
        let mut trials = Self::of_one_shape(series, FEWEST_FRAMES)?;
        trials.check_values(true)?;
        if trials.count() < 30 {
            trials.remarks.push(format!(
                "{} trials have little power: a weak dependence is not seen, so T* is rather too \
                 short than too long",
                trials.count()
            ));
        }
        Ok(trials)
    }

    /// Trials for `pooled`, one or more.
    ///
    /// # Errors
    /// Like [`Self::new`], but one trial suffices, and it may have fewer samples.
    pub(crate) fn pooled(series: Vec<Series>) -> Result<Self, DurationError> {
        if series.is_empty() {
            return Err(DurationError::TooFewTrials(0));
        }
        let mut trials = Self::of_one_shape(series, FEWEST_POOLED)?;
        trials.check_values(false)?;
        Ok(trials)
    }

    fn of_one_shape(series: Vec<Series>, fewest_frames: usize) -> Result<Self, DurationError> {
        let (rate_hz, channels) = (series[0].rate_hz(), series[0].channels());
        for (i, s) in series.iter().enumerate() {
            let trial = i + 1;
            if s.channels() != channels {
                let (channels, expected) = (s.channels(), channels);
                return Err(DurationError::Channels { trial, channels, expected });
            }
            if s.rate_hz() != rate_hz {
                let (rate_hz, expected_hz) = (s.rate_hz(), rate_hz);
                return Err(DurationError::Rates { trial, rate_hz, expected_hz });
            }
        }
        let frames = series.iter().map(Series::frames).min().unwrap_or(0);
        if frames < fewest_frames {
            return Err(DurationError::TooShort { frames, expected: fewest_frames });
        }
        Ok(Self { series, frames, remarks: Vec::new() })
    }

    /// The trials, not cropped: all have at least [`Self::frames`] frames.
    pub(crate) fn series(&self) -> &[Series] {
        &self.series
    }

    pub(crate) fn count(&self) -> usize {
        self.series.len()
    }

    /// Samples of the shortest trial.
    pub(crate) fn frames(&self) -> usize {
        self.frames
    }

    pub(crate) fn channels(&self) -> usize {
        self.series[0].channels()
    }

    /// Samples a second.
    pub(crate) fn rate_hz(&self) -> f64 {
        self.series[0].rate_hz()
    }

    /// The sample of one trial at one frame, both counted from 0: one value for each channel.
    #[inline]
    pub(crate) fn sample(&self, trial: usize, frame: usize) -> &[f32] {
        let channels = self.series[trial].channels();
        &self.series[trial].samples()[frame * channels..(frame + 1) * channels]
    }

    /// Refuses trials that hold no information, and remarks on those that hold little. With κ, that
    /// includes channels of two values, whose ties make κ coarse.
    fn check_values(&mut self, has_kappa: bool) -> Result<(), DurationError> {
        let channels = self.channels();
        let ranges: Vec<_> = (0..channels).map(|c| self.range(c)).collect();
        if ranges.iter().all(|range| range.low == range.high) {
            return Err(DurationError::Constant);
        }
        let share = self.agreement();
        if self.count() > 1 && share > 0.5 {
            return Err(DurationError::MostlyOneValue { share });
        }
        for (i, range) in ranges.iter().enumerate() {
            let channel = i + 1;
            if range.low == range.high {
                self.remarks.push(format!("channel {channel} is constant and adds nothing"));
            } else if range.binary {
                if has_kappa {
                    self.remarks.push(format!(
                        "channel {channel} has two values only: ties make κ coarse, and rare \
                         changes are easily missed"
                    ));
                }
            } else if range.at_an_end > SATURATED {
                return Err(DurationError::Saturated { channel, share: range.at_an_end });
            } else if range.at_an_end > WORTH_SAYING {
                self.remarks.push(format!(
                    "channel {channel} is saturated in {:.0} % of its samples",
                    range.at_an_end * 100.0
                ));
            }
        }
        Ok(())
    }

    fn range(&self, channel: usize) -> Range {
        let values = || {
            self.series
                .iter()
                .flat_map(move |s| s.samples()[channel..].iter().step_by(s.channels()))
        };
        let (low, high) =
            values().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), &x| (l.min(x), h.max(x)));
        let (mut at_low, mut at_high, mut count) = (0usize, 0usize, 0usize);
        for &x in values() {
            at_low += usize::from(x == low);
            at_high += usize::from(x == high);
            count += 1;
        }
        let at_an_end = at_low.max(at_high) as f64 / count as f64;
        Range { low, high, binary: at_low + at_high == count, at_an_end }
    }

    /// Share of frames at which all trials hold the same sample.
    fn agreement(&self) -> f64 {
        let step = self.frames.div_ceil(MOMENTS);
        let (mut same, mut looked) = (0usize, 0usize);
        for frame in (0..self.frames).step_by(step) {
            let first = self.sample(0, frame);
            same += usize::from((1..self.count()).all(|q| self.sample(q, frame) == first));
            looked += 1;
        }
        same as f64 / looked as f64
    }
}

struct Range {
    low: f32,
    high: f32,
    binary: bool,
    /// Share of samples at the low or at the high end of the range, whichever is larger.
    at_an_end: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn trials(make: impl Fn(usize, usize) -> f32) -> Result<Trials, DurationError> {
        let one = |q| (0..1000).map(|i| make(q, i)).collect();
        Trials::new((0..10).map(|q| Series::new(1e4, 1, one(q)).unwrap()).collect())
    }

    fn noise(q: usize, i: usize) -> f32 {
        ((q * 7919 + i * 104_729 + q * i) % 1009) as f32
    }

    #[test]
    fn a_constant_source_is_refused() {
        assert_eq!(trials(|_, _| 3.0).unwrap_err(), DurationError::Constant);
    }

    #[test]
    fn a_metal_detector_that_rarely_fires_is_refused() {
        let error = trials(|q, i| f32::from(q == 3 && i > 900)).unwrap_err();
        assert!(matches!(error, DurationError::MostlyOneValue { .. }), "{error}");
    }

    #[test]
    fn a_saturated_channel_is_refused_and_a_partly_saturated_one_remarked() {
        let error = trials(|q, i| noise(q, i).min(300.0)).unwrap_err();
        assert!(matches!(error, DurationError::Saturated { channel: 1, .. }), "{error}");
        let some = trials(|q, i| noise(q, i).min(900.0)).unwrap();
        assert!(some.remarks.iter().any(|r| r.contains("saturated in 1")), "{:?}", some.remarks);
    }

    #[test]
    fn a_binary_channel_is_answered_with_its_limits() {
        let some = trials(|q, i| f32::from(noise(q, i) > 500.0)).unwrap();
        assert!(some.remarks.iter().any(|r| r.contains("two values")), "{:?}", some.remarks);
    }

    #[test]
    fn four_trials_are_too_few() {
        let one = |q: usize| (0..1000).map(|i| noise(q, i)).collect();
        let four = (0..4).map(|q| Series::new(1e4, 1, one(q)).unwrap()).collect();
        assert_eq!(Trials::new(four).unwrap_err(), DurationError::TooFewTrials(4));
    }
}
