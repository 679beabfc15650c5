//! The trials of one surface and source, with checks of their number, length and values.

use crate::kernel::{FEWEST_PAIRS, HsicError};
use crate::trial::Series;

/// A channel is refused if more than this share of its samples lies at one end of its range.
const SATURATED: f64 = 0.5;
/// A remark reports saturation if more than this share of samples lies at one end of the range.
const WORTH_SAYING: f64 = 0.02;
/// Approximate number of frames at which trials are compared to see whether they differ.
const MOMENTS: usize = 2000;

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum DurationError {
    /// trials that are too few, too short or too different, or that hold no information
    #[error("{0}")]
    Trials(String),
    #[error("{0}")]
    Settings(String),
    #[error(transparent)]
    Hsic(#[from] HsicError),
}

/// The reason given for a source that never changes, and so has no T*.
pub(crate) const CONSTANT: &str =
    "the source is constant: nothing moves, so there is no time after which it is independent";

/// Fewest samples in a trial for Algorithm 1.
pub(super) const FEWEST_FRAMES: usize = 100;
/// Fewest samples in a trial for the rule `pooled`, whose lags reach a quarter of a trial.
const FEWEST_POOLED: usize = 40;

/// Q trials of one surface and source, with the same rate and number of channels. Each trial is
/// used up to the length of the shortest.
#[derive(Clone, Debug)]
pub struct Trials {
    /// The trials, not cropped; each has at least `frames` frames.
    pub(crate) series: Vec<Series>,
    /// Number of frames of the shortest trial.
    pub(crate) frames: usize,
    /// Remarks on how far T* can be trusted, one line of text each.
    pub remarks: Vec<String>,
}

impl Trials {
    /// Trials for Algorithm 1, each an independent recording of the same surface.
    ///
    /// # Errors
    /// If there are fewer than five trials, or if they differ in rate or channels, are too short,
    /// constant or saturated, or all hold the same value most of the time.
    pub fn new(series: Vec<Series>) -> Result<Self, DurationError> {
        let mut trials = Self::checked(series, true)?;
        if trials.count() < 30 {
            trials.remarks.push(format!(
                "{} trials are few: weak dependence may be missed, so T* may be too short; record \
                 more",
                trials.count()
            ));
        }
        Ok(trials)
    }

    /// Trials for the rule `pooled`, of which one suffices; it may have fewer samples.
    pub(crate) fn pooled(series: Vec<Series>) -> Result<Self, DurationError> {
        Self::checked(series, false)
    }

    fn checked(series: Vec<Series>, has_kappa: bool) -> Result<Self, DurationError> {
        let (fewest, fewest_frames) =
            if has_kappa { (FEWEST_PAIRS, FEWEST_FRAMES) } else { (1, FEWEST_POOLED) };
        let fail = |problem| Err(DurationError::Trials(problem));
        let count = series.len();
        if count < fewest {
            return fail(format!(
                "{count} trials; expected at least {FEWEST_PAIRS} of one surface (record more)"
            ));
        }
        let (rate_hz, channels) = (series[0].rate_hz(), series[0].channels());
        for (trial, s) in (1..).zip(&series) {
            let (found_hz, found) = (s.rate_hz(), s.channels());
            if found != channels {
                return fail(format!(
                    "trial {trial} has {found} channels and trial 1 has {channels}"
                ));
            }
            if found_hz != rate_hz {
                return fail(format!(
                    "trial {trial} has {found_hz} Hz and trial 1 has {rate_hz} Hz; expected one rate"
                ));
            }
        }
        let frames = series.iter().map(Series::frames).min().unwrap_or(0);
        if frames < fewest_frames {
            return fail(format!(
                "the shortest trial has {frames} samples; expected at least {fewest_frames}"
            ));
        }
        let mut trials = Self { series, frames, remarks: Vec::new() };
        trials.check_values(has_kappa).map_err(DurationError::Trials)?;
        Ok(trials)
    }

    pub(crate) fn count(&self) -> usize {
        self.series.len()
    }

    pub(crate) fn channels(&self) -> usize {
        self.series[0].channels()
    }

    pub(crate) fn rate_hz(&self) -> f64 {
        self.series[0].rate_hz()
    }

    /// The sample of one trial at one frame, both counted from 0: one value for each channel.
    #[inline]
    pub(crate) fn sample(&self, trial: usize, frame: usize) -> &[f32] {
        let channels = self.series[trial].channels();
        &self.series[trial].samples()[frame * channels..(frame + 1) * channels]
    }

    /// Refuses trials that hold no information, and adds remarks on those that hold little. With
    /// `has_kappa`, adds a remark on a channel with only two values, since its ties make κ coarse.
    fn check_values(&mut self, has_kappa: bool) -> Result<(), String> {
        let channels = self.channels();
        let ranges: Vec<_> = (0..channels).map(|c| self.range(c)).collect();
        if ranges.iter().all(|range| range.constant) {
            return Err(CONSTANT.into());
        }
        let share = self.agreement();
        if self.count() > 1 && share > 0.5 {
            return Err(format!(
                "all trials hold one and the same value {:.0} % of the time, as a metal detector \
                 does; T* has no meaning here",
                share * 100.0
            ));
        }
        for (i, range) in ranges.iter().enumerate() {
            let (channel, percent) = (i + 1, 100.0 * range.at_an_end);
            if range.constant {
                self.remarks.push(format!("channel {channel} is constant and adds nothing"));
            } else if range.binary {
                if has_kappa {
                    self.remarks.push(format!(
                        "channel {channel} has only two values: κ is coarse, and rare changes may be \
                         missed"
                    ));
                }
            } else if range.at_an_end > SATURATED {
                return Err(format!(
                    "channel {channel} is saturated: {percent:.0} % of its samples lie at one end of its \
                     range; lower the gain and record again"
                ));
            } else if range.at_an_end > WORTH_SAYING {
                let remark =
                    format!("channel {channel} is saturated in {percent:.0} % of its samples");
                self.remarks.push(remark);
            }
        }
        Ok(())
    }

    fn range(&self, channel: usize) -> Range {
        let values = || self.series.iter().flat_map(move |series| series.channel(channel));
        let low = values().fold(f64::INFINITY, f64::min);
        let high = values().fold(f64::NEG_INFINITY, f64::max);
        let at = |end: f64| values().filter(|x| *x == end).count();
        let (at_low, at_high, count) = (at(low), at(high), values().count());
        let at_an_end = at_low.max(at_high) as f64 / count as f64;
        Range { constant: low == high, binary: at_low + at_high == count, at_an_end }
    }

    /// Share of frames at which all trials hold the same sample.
    fn agreement(&self) -> f64 {
        let frames = (0..self.frames).step_by(self.frames.div_ceil(MOMENTS));
        let agree = |&i: &usize| (1..self.count()).all(|q| self.sample(q, i) == self.sample(0, i));
        frames.clone().filter(agree).count() as f64 / frames.len() as f64
    }
}

struct Range {
    constant: bool,
    /// Whether there are only two values.
    binary: bool,
    /// Share of samples at the low or at the high end of the range, whichever is larger.
    at_an_end: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn some(count: usize, make: impl Fn(usize, usize) -> f32) -> Result<Trials, DurationError> {
        let one = |q| (0..1000).map(|i| make(q, i)).collect();
        Trials::new((0..count).map(|q| Series::new(1e4, 1, one(q)).unwrap()).collect())
    }

    fn noise(q: usize, i: usize) -> f32 {
        ((q * 7919 + i * 104_729 + q * i) % 1009) as f32
    }

    #[test]
    fn what_holds_no_information_is_refused_and_what_holds_little_is_remarked() {
        for (refused, problem) in [
            (some(10, |_, _| 3.0), CONSTANT),
            (
                some(10, |q, i| f32::from(q == 3 && i > 900)),
                "all trials hold one and the same value",
            ),
            (some(10, |q, i| noise(q, i).min(300.0)), "channel 1 is saturated: "),
            (some(4, noise), "4 trials; expected at least"),
        ] {
            let said = refused.unwrap_err().to_string();
            assert!(said.starts_with(problem), "{said}");
        }
        for (kept, remark) in [
            (some(10, |q, i| noise(q, i).min(900.0)), "saturated in 1"),
            (some(10, |q, i| f32::from(noise(q, i) > 500.0)), "two values"),
        ] {
            let remarks = kept.unwrap().remarks;
            assert!(remarks.iter().any(|said| said.contains(remark)), "{remarks:?}");
        }
    }
}
