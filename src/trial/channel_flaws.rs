//! Flaws that a person with the cable in hand would want to know: a channel that is stuck, or
//! one that runs into its limits.

use super::{Image, Series};

/// A flaw of one channel of a series.
#[derive(Clone, Debug, PartialEq)]
pub enum Flaw {
    /// Every sample has the same value.
    Constant {
        /// channel, counted from 1
        channel: usize,
        /// that value
        value: f32,
    },
    /// From some sample on every sample has the same value.
    Stuck {
        /// channel, counted from 1
        channel: usize,
        /// that value
        value: f32,
        /// share of samples that have it, 0 to 1
        share: f64,
    },
    /// The channel rests at its highest or lowest value too often to be chance.
    Saturated {
        /// channel, counted from 1
        channel: usize,
        /// share of samples at the limit, 0 to 1
        share: f64,
    },
}

impl Flaw {
    /// The channel, counted from 1.
    pub fn channel(&self) -> usize {
        let (Self::Constant { channel, .. }
        | Self::Stuck { channel, .. }
        | Self::Saturated { channel, .. }) = self;
        *channel
    }
}

impl std::fmt::Display for Flaw {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Constant { channel, value } => {
                write!(f, "channel {channel} is stuck at {value}; check its cable")
            }
            Self::Stuck { channel, value, share } => write!(
                f,
                "channel {channel} is stuck at {value} for the last {:.0} % of the scan; check its \
                 cable",
                share * 100.0
            ),
            Self::Saturated { channel, share } => write!(
                f,
                "channel {channel} is saturated: {:.1} % of its samples are at its limit; lower \
                 the gain, or press less",
                share * 100.0
            ),
        }
    }
}

/// Fewer values than this are a switch or a coarse converter, whose limits are not flaws.
const FEWEST_VALUES: usize = 16;
/// This many samples in a row at a limit are a flaw.
const RUN: usize = 3;
/// A channel that rests for so large a share at the end of a scan is stuck.
const STUCK: f64 = 0.5;
/// Share of samples in such runs that makes a flaw.
const SHARE: f64 = 0.02;

/// Whether a picture is of one colour throughout: a covered lens, or a camera that gives nothing.
pub fn is_plain(image: &Image) -> bool {
    let first = &image.rgb()[..3];
    image.rgb().chunks_exact(3).all(|pixel| pixel == first)
}

/// Finds the flaws of one channel, sample by sample.
#[derive(Clone, Debug)]
struct ChannelFlaws {
    samples: usize,
    last: f32,
    /// Samples at the end that are equal.
    resting: usize,
    /// Distinct values, up to [`FEWEST_VALUES`].
    seen: Vec<f32>,
    low: Limit,
    high: Limit,
}

/// The lowest or highest value so far.
#[derive(Clone, Copy, Debug)]
struct Limit {
    value: f32,
    /// Samples that rest there, in runs of at least [`RUN`].
    resting: usize,
}

impl Limit {
    fn at(value: f32) -> Self {
        Self { value, resting: 0 }
    }

    /// Takes a sample at the limit, which is the `run`-th of equal ones.
    fn add(&mut self, run: usize) {
        self.resting += match run {
            0..RUN => 0,
            RUN => RUN,
            _ => 1,
        };
    }
}

impl Default for ChannelFlaws {
    fn default() -> Self {
        let (low, high) = (Limit::at(f32::INFINITY), Limit::at(f32::NEG_INFINITY));
        Self { samples: 0, last: 0.0, resting: 0, seen: Vec::new(), low, high }
    }
}

impl ChannelFlaws {
    /// Takes the next sample.
    fn add(&mut self, x: f32) {
        self.resting = if self.samples > 0 && x == self.last { self.resting + 1 } else { 1 };
        self.samples += 1;
        self.last = x;
        if self.resting == 1 && self.varies_little() && !self.seen.contains(&x) {
            self.seen.push(x);
        }
        if x < self.low.value {
            self.low = Limit::at(x);
        }
        if x > self.high.value {
            self.high = Limit::at(x);
        }
        if x == self.low.value {
            self.low.add(self.resting);
        }
        if x == self.high.value {
            self.high.add(self.resting);
        }
    }

    fn varies_little(&self) -> bool {
        self.seen.len() < FEWEST_VALUES
    }

    /// [`Flaw::Constant`] or [`Flaw::Stuck`], if the samples so far show it; `channel` counts
    /// from 0.
    fn dead(&self, channel: usize) -> Option<Flaw> {
        let (channel, value) = (channel + 1, self.last);
        if self.samples > 0 && self.resting == self.samples {
            return Some(Flaw::Constant { channel, value });
        }
        let share = self.resting as f64 / self.samples.max(1) as f64;
        (share >= STUCK && !self.varies_little()).then_some(Flaw::Stuck { channel, value, share })
    }

    /// The channel's flaw, if the samples so far show one; `channel` counts from 0.
    fn flaw(&self, channel: usize) -> Option<Flaw> {
        let share = (self.low.resting + self.high.resting) as f64 / self.samples.max(1) as f64;
        let saturated = share >= SHARE && !self.varies_little();
        let saturated = saturated.then_some(Flaw::Saturated { channel: channel + 1, share });
        self.dead(channel).or(saturated)
    }
}

/// Finds the flaws of a series frame by frame.
#[derive(Clone, Debug)]
pub struct SeriesFlaws(Vec<ChannelFlaws>);

impl SeriesFlaws {
    /// Of a series of this many channels that has no frame yet.
    pub fn new(channels: usize) -> Self {
        Self(vec![ChannelFlaws::default(); channels])
    }

    /// Takes the next frames, their channels interleaved.
    pub fn add(&mut self, frames: &[f32]) {
        for frame in frames.chunks_exact(self.0.len()) {
            self.0.iter_mut().zip(frame).for_each(|(channel, &x)| channel.add(x));
        }
    }

    /// The flaws so far, channel by channel.
    pub fn flaws(&self) -> Vec<Flaw> {
        self.each(ChannelFlaws::flaw).collect()
    }

    /// Of these, [`Flaw::Constant`] and [`Flaw::Stuck`].
    pub fn dead(&self) -> impl Iterator<Item = Flaw> {
        self.each(ChannelFlaws::dead)
    }

    fn each(
        &self,
        find: impl Fn(&ChannelFlaws, usize) -> Option<Flaw>,
    ) -> impl Iterator<Item = Flaw> {
        self.0.iter().enumerate().filter_map(move |(at, channel)| find(channel, at))
    }
}

/// The flaws of a series, channel by channel.
pub fn flaws(series: &Series) -> Vec<Flaw> {
    let mut found = SeriesFlaws::new(series.channels());
    found.add(series.samples());
    found.flaws()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one_channel(values: impl Iterator<Item = f32>) -> Vec<Flaw> {
        flaws(&Series::new(100.0, 1, values.collect()).unwrap())
    }

    #[test]
    fn a_stuck_channel_is_found_and_its_neighbour_is_not() {
        let samples = (0..100).flat_map(|i| [i as f32, 4.0]).collect();
        let found = flaws(&Series::new(100.0, 2, samples).unwrap());
        assert_eq!(found, [Flaw::Constant { channel: 2, value: 4.0 }]);
        assert!(found[0].to_string().contains("stuck at 4"));
    }

    #[test]
    fn a_clipped_sine_is_saturated_and_a_whole_one_is_not() {
        let sine = |i: i32| (i as f32 * 0.01).sin();
        assert_eq!(one_channel((0..10_000).map(sine)), []);
        let clipped = one_channel((0..10_000).map(|i| sine(i).clamp(-0.7, 0.7)));
        assert!(matches!(clipped[..], [Flaw::Saturated { channel: 1, share }] if share > 0.3));
    }

    #[test]
    fn a_limit_counts_wherever_it_is_reached_first_and_no_value_that_is_passed_later() {
        let ramp = |i: i32| (i % 50) as f32;
        let begins_high = (0..1000).map(|i| if i < 100 { 49.0 } else { ramp(i) });
        assert_eq!(one_channel(begins_high), [Flaw::Saturated { channel: 1, share: 0.1 }]);
        let rests_below = (0..1000).map(|i| if i < 100 { 40.0 } else { ramp(i) });
        assert_eq!(one_channel(rests_below), []);
    }

    #[test]
    fn a_switch_is_not_saturated() {
        assert_eq!(one_channel((0..1000).map(|i| if i < 500 { 0.0 } else { 1.0 })), []);
    }
}
