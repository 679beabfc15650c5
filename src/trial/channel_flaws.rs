//! Flaws of a channel that a broken cable or a wrong gain causes: the channel is stuck, or it runs
//! into its limits.

use std::collections::HashMap;

use super::{Image, Series};

/// A flaw of one channel of a series.
#[derive(Clone, Debug, PartialEq)]
pub enum Flaw {
    /// Every sample has the same value.
    Constant {
        /// channel, counted from 1
        channel: usize,
        /// the value of every sample
        value: f32,
    },
    /// From some sample to the last, all have the same value.
    Stuck {
        /// channel, counted from 1
        channel: usize,
        /// that value
        value: f32,
        /// share of samples in this last run, 0 to 1
        share: f64,
    },
    /// The channel rests at its highest or lowest value too often to be chance.
    Saturated {
        /// channel, counted from 1
        channel: usize,
        /// that value; at 0, the cause is no converter's limit, but a loose cable
        value: f32,
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
            Self::Saturated { channel, value: 0.0, share } => write!(
                f,
                "channel {channel} is at 0 for {:.0} % of the scan; check its cable",
                share * 100.0
            ),
            Self::Saturated { channel, share, .. } => write!(
                f,
                "channel {channel} is saturated: {:.1} % of its samples are at its limit; lower \
                 the gain, or press less",
                share * 100.0
            ),
        }
    }
}

/// A channel with fewer distinct values is a switch or a coarse converter: no flaw at its limits.
const FEWEST_VALUES: usize = 16;
/// Length of a run of equal samples from which on they count as resting.
const RUN: usize = 3;
/// A channel that is constant for this share of a scan, at its end, is stuck.
const STUCK: f64 = 0.5;
/// Share of samples resting at the limits from which on a channel is saturated; at zero, where many
/// sensors rest, [`STUCK`] applies instead.
const SHARE: f64 = 0.02;
/// A limit must hold this many times as many resting samples as any other value. If samples are
/// coarse or repeated, they rest at all values, and the uppermost step of a sine holds 2.4 times as
/// many as the step below it.
const ABOVE_OTHERS: usize = 4;

/// Whether all pixels of a picture are equal: the lens is covered, or the camera delivers no data.
pub fn is_plain(image: &Image) -> bool {
    let first = &image.rgb()[..3];
    image.rgb().chunks_exact(3).all(|pixel| pixel == first)
}

/// Finds the flaws of one channel, sample by sample.
#[derive(Clone, Debug)]
struct ChannelFlaws {
    samples: usize,
    last: f32,
    /// Length of the run of equal samples at the end.
    run: usize,
    /// The first distinct values, at most [`FEWEST_VALUES`].
    seen: Vec<f32>,
    low: f32,
    high: f32,
    /// Number of samples in runs of at least [`RUN`] equal ones, by the bits of their value.
    resting: HashMap<u32, usize>,
}

impl Default for ChannelFlaws {
    fn default() -> Self {
        let (low, high) = (f32::INFINITY, f32::NEG_INFINITY);
        let (seen, resting) = (Vec::new(), HashMap::new());
        Self { samples: 0, last: 0.0, run: 0, seen, low, high, resting }
    }
}

impl ChannelFlaws {
    /// Takes the next sample.
    fn add(&mut self, x: f32) {
        self.run = if self.samples > 0 && x == self.last { self.run + 1 } else { 1 };
        self.samples += 1;
        self.last = x;
        if self.run == 1 && self.varies_little() && !self.seen.contains(&x) {
            self.seen.push(x);
        }
        (self.low, self.high) = (self.low.min(x), self.high.max(x));
        if self.run >= RUN {
            // Adding 0 turns -0 into 0.
            let of_value = self.resting.entry((x + 0.0).to_bits()).or_default();
            *of_value += if self.run == RUN { RUN } else { 1 };
        }
    }

    fn varies_little(&self) -> bool {
        self.seen.len() < FEWEST_VALUES
    }

    /// [`Flaw::Constant`] or [`Flaw::Stuck`], if the samples so far show it; `channel` counts
    /// from 0.
    fn dead(&self, channel: usize) -> Option<Flaw> {
        let (channel, value) = (channel + 1, self.last);
        if self.samples > 0 && self.run == self.samples {
            return Some(Flaw::Constant { channel, value });
        }
        let share = self.share(self.run);
        (share >= STUCK && !self.varies_little()).then_some(Flaw::Stuck { channel, value, share })
    }

    /// [`Flaw::Saturated`], if the samples so far show it; `channel` counts from 0.
    fn saturated(&self, channel: usize) -> Option<Flaw> {
        let limits = [self.low, self.high].map(|limit| (limit + 0.0).to_bits());
        let others = self.resting.iter().filter(|(value, _)| !limits.contains(value));
        let others = others.map(|(_, count)| *count).max().unwrap_or(0);
        let rests = |limit: &u32| self.resting.get(limit).copied().unwrap_or(0);
        let outstanding = |limit: &u32| rests(limit) >= ABOVE_OTHERS * others;
        let found = |value: f32, share: f64, least: f64| {
            let found = share >= least && !self.varies_little();
            found.then_some(Flaw::Saturated { channel: channel + 1, value, share })
        };
        let (zeros, limits): (Vec<u32>, _) = limits.into_iter().partition(|limit| *limit == 0);
        let limits: Vec<u32> = limits.into_iter().filter(outstanding).collect();
        let most = limits.iter().max_by_key(|limit| rests(limit)).copied().unwrap_or(0);
        let share = self.share(limits.iter().map(rests).sum());
        let at_zero = zeros.first().map_or(0.0, |zero| self.share(rests(zero)));
        found(f32::from_bits(most), share, SHARE).or_else(|| found(0.0, at_zero, STUCK))
    }

    /// A number of samples, as a share of all samples so far.
    fn share(&self, samples: usize) -> f64 {
        samples as f64 / self.samples.max(1) as f64
    }

    /// The channel's flaw, if the samples so far show one; `channel` counts from 0.
    fn flaw(&self, channel: usize) -> Option<Flaw> {
        self.dead(channel).or_else(|| self.saturated(channel))
    }
}

/// Finds the flaws of a series frame by frame.
#[derive(Clone, Debug)]
pub struct SeriesFlaws(Vec<ChannelFlaws>);

impl SeriesFlaws {
    /// For a series of this many channels, before its first frame.
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

    /// The [`Flaw::Constant`]s and [`Flaw::Stuck`]s so far, channel by channel.
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
        let [Flaw::Saturated { channel: 1, value, share }] = clipped[..] else {
            panic!("{clipped:?}")
        };
        assert!(value.abs() == 0.7 && share > 0.3, "{clipped:?}");
    }

    #[test]
    fn a_limit_counts_wherever_it_is_reached_first_and_no_value_that_is_passed_later() {
        let ramp = |i: i32| (i % 50) as f32;
        let begins_high = (0..1000).map(|i| if i < 100 { 49.0 } else { ramp(i) });
        assert_eq!(
            one_channel(begins_high),
            [Flaw::Saturated { channel: 1, value: 49.0, share: 0.1 }]
        );
        let rests_below = (0..1000).map(|i| if i < 100 { 40.0 } else { ramp(i) });
        assert_eq!(one_channel(rests_below), []);
    }

    #[test]
    fn a_switch_is_not_saturated() {
        assert_eq!(one_channel((0..1000).map(|i| if i < 500 { 0.0 } else { 1.0 })), []);
    }

    #[test]
    fn values_that_are_merely_coarse_or_repeated_are_not_saturated() {
        let sine = |i: i32| (i as f32 * 0.01).sin();
        for steps in [8.0, 20.0, 100.0] {
            assert_eq!(one_channel((0..10_000).map(|i| (sine(i) * steps).round())), [], "{steps}");
        }
        // Noise with each value five times; then a coarse sine that is clipped.
        let noise = |i: i32| ((i / 5) as f32 * 12.9898).sin() * 43_758.547;
        assert_eq!(one_channel((0..5000).map(|i| (noise(i).fract() * 9.0).round())), []);
        let clipped = (0..10_000).map(|i| (sine(i) * 20.0).round().clamp(-10.0, 10.0));
        assert!(matches!(one_channel(clipped)[..], [Flaw::Saturated { share, .. }] if share > 0.5));
    }

    #[test]
    fn a_channel_at_zero_has_a_loose_cable_and_no_gain_to_lower() {
        let loose = |i: i32| if i % 100 < 30 { i as f32 } else { 0.0 };
        let found = one_channel((0..1000).map(loose));
        assert!(matches!(found[..], [Flaw::Saturated { value: 0.0, .. }]), "{found:?}");
        assert!(found[0].to_string().contains("check its cable"));
        let lifted = |i: i32| if i % 100 < 70 { i as f32 } else { 0.0 };
        assert_eq!(one_channel((0..1000).map(lifted)), []);
    }
}
