//! Flaws that a person with the cable in hand would want to know: a channel that is stuck, or
//! one that runs into its limits.

use super::{Image, Series};

/// What is wrong with one channel of a series.
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

/// Fewer values than this are a switch or a coarse converter, whose limits are no flaw.
const FEWEST_VALUES: usize = 16;
/// This many samples in a row at a limit are no coincidence.
const RUN: usize = 3;
/// A channel that rests for so large a share at the end of a scan is stuck.
const STUCK: f64 = 0.5;
/// Share of samples in such runs that makes a flaw.
const SHARE: f64 = 0.02;

/// The flaws of a series, channel by channel.
pub fn flaws(series: &Series) -> Vec<Flaw> {
    (0..series.channels()).filter_map(|channel| flaw(series, channel)).collect()
}

/// Whether a picture is of one colour throughout: a covered lens, or a camera that gives nothing.
pub fn is_plain(image: &Image) -> bool {
    let first = &image.rgb()[..3];
    image.rgb().chunks_exact(3).all(|pixel| pixel == first)
}

/// How long a channel has rested, sample by sample.
#[derive(Clone, Debug, Default)]
pub struct Rest {
    samples: usize,
    last: f32,
    /// Samples at the end that are equal.
    resting: usize,
    /// Distinct values, up to [`FEWEST_VALUES`].
    seen: Vec<f32>,
}

impl Rest {
    /// Takes the next sample.
    pub fn add(&mut self, x: f32) {
        self.resting = if self.samples > 0 && x == self.last { self.resting + 1 } else { 1 };
        self.samples += 1;
        self.last = x;
        if self.resting == 1 && self.varies_little() && !self.seen.contains(&x) {
            self.seen.push(x);
        }
    }

    fn varies_little(&self) -> bool {
        self.seen.len() < FEWEST_VALUES
    }

    /// [`Flaw::Constant`] or [`Flaw::Stuck`], if the samples so far show it; `channel` counts
    /// from 0.
    pub fn flaw(&self, channel: usize) -> Option<Flaw> {
        let (channel, value) = (channel + 1, self.last);
        if self.samples > 0 && self.resting == self.samples {
            return Some(Flaw::Constant { channel, value });
        }
        let share = self.resting as f64 / self.samples.max(1) as f64;
        (share >= STUCK && !self.varies_little()).then_some(Flaw::Stuck { channel, value, share })
    }
}

fn flaw(series: &Series, channel: usize) -> Option<Flaw> {
    let view = series.view();
    let samples = view.column(channel);
    let mut rest = Rest::default();
    samples.iter().for_each(|&x| rest.add(x));
    let stuck = rest.flaw(channel);
    if stuck.is_some() || rest.varies_little() {
        return stuck;
    }
    let low = samples.fold(f32::INFINITY, |a, &x| a.min(x));
    let high = samples.fold(f32::NEG_INFINITY, |a, &x| a.max(x));
    let (mut at_limit, mut run) = (0, 0);
    for &x in samples {
        run = if x == low || x == high { run + 1 } else { 0 };
        at_limit += match run {
            0..RUN => 0,
            RUN => RUN,
            _ => 1,
        };
    }
    let share = at_limit as f64 / samples.len() as f64;
    (share >= SHARE).then_some(Flaw::Saturated { channel: channel + 1, share })
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
    fn a_switch_is_not_saturated() {
        assert_eq!(one_channel((0..1000).map(|i| if i < 500 { 0.0 } else { 1.0 })), []);
    }
}
