//! Delay pairs: what is kept of a series in time, such as a force.
//!
//! A series is averaged down to about 1 kHz. A sample is a pair (value, increment after a lag),
//! an invertible linear map of the delay pair, so that each coordinate has a scale of its own.
//! Lags are 1, 4, 16, 64 and 256 ms; each channel and lag is a group of samples, and so is each
//! pair of channels at one time.

use std::ops::Range;

/// The rate that series are averaged down to, in Hz, as near as whole factors come.
const SLOW_RATE_HZ: f64 = 1000.0;

/// Lags in seconds.
const LAGS_S: [f64; 5] = [0.001, 0.004, 0.016, 0.064, 0.256];

/// A lag is used where at least this many pairs remain.
const LEAST_PAIRS: usize = 16;

/// A series at about 1 kHz, channel by channel, growing at its end.
#[derive(Clone, Debug, serde::Serialize, serde::Deserialize)]
pub struct DecimatedSeries {
    /// Its rate in Hz.
    pub rate_hz: f64,
    /// Samples of the source that one value averages.
    factor: usize,
    /// One list a channel, all of one length.
    pub channels: Vec<Vec<f32>>,
}

/// A group of sample pairs: first and second coordinate of each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DecimatedGroup {
    /// Value and increment of a channel after the lag of that index.
    Lag(usize, usize),
    /// Values of two channels at one time.
    Cross(usize, usize),
}

impl DecimatedSeries {
    /// The series of a recording; `samples` are interleaved. One that is shorter than a value
    /// takes is averaged whole.
    pub fn new(rate_hz: f64, channels: usize, samples: &[f32]) -> Self {
        let mut series = Self::empty(rate_hz, channels);
        series.extend(samples);
        if series.len() == 0 {
            series.average(samples);
        }
        series
    }

    /// A series without values yet.
    pub fn empty(rate_hz: f64, channels: usize) -> Self {
        let factor = ((rate_hz / SLOW_RATE_HZ).round() as usize).max(1);
        Self { rate_hz: rate_hz / factor as f64, factor, channels: vec![Vec::new(); channels] }
    }

    /// Appends the values that `samples` fill; returns how many samples a channel need not be
    /// seen again.
    pub fn extend(&mut self, samples: &[f32]) -> usize {
        let step = self.factor * self.channels.len();
        samples.chunks_exact(step).for_each(|chunk| self.average(chunk));
        samples.len() / step * self.factor
    }

    /// Appends the mean of all `samples`.
    pub fn average(&mut self, samples: &[f32]) {
        let width = self.channels.len();
        for (c, values) in self.channels.iter_mut().enumerate() {
            let of_channel = || samples[c..].iter().step_by(width).map(|&x| f64::from(x));
            let mean = of_channel().sum::<f64>() / of_channel().count().max(1) as f64;
            // Beyond this, differences of values would overflow.
            values.push(mean.clamp(-1e18, 1e18) as f32);
        }
    }

    /// Number of values of a channel.
    pub fn len(&self) -> usize {
        self.channels.first().map_or(0, Vec::len)
    }

    /// Lag `index` in values.
    pub fn lag(&self, index: usize) -> usize {
        ((LAGS_S[index] * self.rate_hz).round() as usize).max(1)
    }

    /// The values within `[from_s, to_s)`; at least one.
    pub fn within(&self, from_s: f64, to_s: f64) -> Range<usize> {
        let first = ((from_s * self.rate_hz).round() as usize).min(self.len().saturating_sub(1));
        let last = (to_s * self.rate_hz).round() as usize;
        first..last.clamp(first + 1, self.len().max(first + 1))
    }

    /// All groups of a series with so many channels, in order.
    pub fn groups(channels: usize) -> Vec<DecimatedGroup> {
        let lags =
            (0..channels).flat_map(|c| (0..LAGS_S.len()).map(move |l| DecimatedGroup::Lag(c, l)));
        let pairs = (0..channels).flat_map(|a| (a + 1..channels).map(move |b| (a, b)));
        lags.chain(pairs.map(|(a, b)| DecimatedGroup::Cross(a, b))).collect()
    }

    /// At most `most` pairs of a group within some values, evenly spaced: `each` is told value
    /// and increment (or two values). Says how many there were: 0 where the lag is too long.
    pub fn pairs(
        &self,
        group: DecimatedGroup,
        within: Range<usize>,
        most: usize,
        mut each: impl FnMut(f32, f32),
    ) -> usize {
        let values = within.len();
        let (pairs, lag) = match group {
            DecimatedGroup::Cross(..) => (values, 0),
            DecimatedGroup::Lag(_, index) => {
                let lag = self.lag(index);
                (values.saturating_sub(lag), lag)
            }
        };
        if pairs < LEAST_PAIRS && lag > 0 {
            return 0;
        }
        let used = pairs.min(most);
        for i in 0..used {
            let at = within.start + i * pairs / used;
            match group {
                DecimatedGroup::Cross(a, b) => each(self.channels[a][at], self.channels[b][at]),
                DecimatedGroup::Lag(c, _) => {
                    let x = self.channels[c][at];
                    each(x, self.channels[c][at + lag] - x);
                }
            }
        }
        used
    }

    /// Mean of a channel over some values.
    pub fn mean(&self, channel: usize, within: Range<usize>) -> f32 {
        let values = &self.channels[channel][within];
        (values.iter().map(|&x| f64::from(x)).sum::<f64>() / values.len().max(1) as f64) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_series_in_pieces_is_the_series_at_once() {
        let samples: Vec<f32> = (0..9_999).map(|i| (i as f32 * 0.01).sin()).collect();
        let whole = DecimatedSeries::new(10_000.0, 3, &samples);
        assert_eq!((whole.len(), whole.rate_hz), (333, 1000.0));
        let (mut pieces, mut pending) = (DecimatedSeries::empty(10_000.0, 3), Vec::new());
        for chunk in samples.chunks(51) {
            pending.extend_from_slice(chunk);
            let done = pieces.extend(&pending);
            pending.drain(..done * 3);
        }
        assert_eq!(pieces.channels, whole.channels);
    }

    #[test]
    fn a_lag_longer_than_the_window_has_no_pairs() {
        let series = DecimatedSeries::new(1000.0, 2, &[0.5; 400]);
        assert_eq!(DecimatedSeries::groups(2).len(), 11);
        assert_eq!(series.pairs(DecimatedGroup::Lag(0, 4), 0..200, 64, |_, _| ()), 0);
        assert_eq!(
            series.pairs(DecimatedGroup::Lag(1, 3), 0..200, 64, |_, d| assert_eq!(d, 0.0)),
            64
        );
        assert_eq!(series.pairs(DecimatedGroup::Cross(0, 1), 0..1, 64, |_, _| ()), 1);
    }
}
