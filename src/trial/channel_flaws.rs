//! Finds channels that are stuck, as by a broken cable, or reach their limits too often, as by a
//! wrong gain.

use std::collections::HashMap;

use super::{Image, Series};

#[derive(Clone, Debug, PartialEq)]
pub enum Flaw {
    /// Every sample has the same value.
    Constant {
        /// channel, counted from 1
        channel: usize,
        value: f32,
    },
    /// All samples from some point to the end of the scan have the same value.
    Stuck {
        /// channel, counted from 1
        channel: usize,
        value: f32,
        /// share of samples from that point on, 0 to 1
        share: f64,
    },
    /// The channel rests at its highest or lowest value too often to be chance.
    Saturated {
        /// channel, counted from 1
        channel: usize,
        /// the limit; a value of 0 points to a loose cable, not to a limit of the converter
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

/// If a channel is constant for at least this share of a scan, the whole channel is called dead.
const DEAD: f64 = 0.9;

/// The worst damage of a source, and the remedy; a dead channel is worse than a clipped one.
/// A constant channel counts only if it changes in the library (`moves` is true for its index).
pub(crate) fn worst_damage(flaws: &[Flaw], moves: impl Fn(usize) -> bool) -> Option<String> {
    // Ranks a flaw by whether the channel is dead (not clipped), then by the affected share of time.
    let weight = |flaw: &Flaw| match flaw {
        Flaw::Constant { .. } => (true, 1.0),
        Flaw::Stuck { share, .. } | Flaw::Saturated { value: 0.0, share, .. } => (true, *share),
        Flaw::Saturated { share, .. } => (false, *share),
    };
    let found =
        flaws.iter().filter(|flaw| !weight(flaw).0 || moves(flaw.channel() - 1)).map(weight);
    let worst = found.max_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)))?;
    let percent = 100.0 * worst.1;
    Some(match worst {
        (true, DEAD..) => "dead, check the cable".into(),
        (true, _) => format!("dead for {percent:.0} % of the scan, check the cable"),
        (false, _) => {
            format!("clipped in {percent:.0} % of its samples, lower the gain or press less")
        }
    })
}

/// A channel with fewer distinct values is a switch or a coarse converter, and may rest at its limits.
const FEWEST_VALUES: usize = 16;
/// Samples rest at a value if at least this many of them in a row have it.
const RUN: usize = 3;
/// A channel is stuck if it is constant for at least this share of a scan, up to its end.
const STUCK: f64 = 0.5;
/// A channel is saturated if at least this share of its samples rests at its limits. At zero, where
/// many sensors rest, [`STUCK`] applies instead.
const SHARE: f64 = 0.02;
/// A limit counts if it has at least this many times the resting samples of any value in between.
/// Otherwise the channel may be intact: coarse or repeated samples rest at every value, and the top step
/// of a sine has 2.4 times as many resting samples as the next step.
const ABOVE_OTHERS: usize = 4;

/// Whether all pixels of a picture are equal, as if the lens is covered or the camera delivers no data.
pub(crate) fn is_plain(image: &Image) -> bool {
    let first = &image.rgb()[..3];
    image.rgb().chunks_exact(3).all(|pixel| pixel == first)
}

#[derive(Clone, Debug)]
struct ChannelFlaws {
    samples: usize,
    last: f32,
    /// Number of equal samples in a row up to the latest.
    run: usize,
    /// The first distinct values, at most [`FEWEST_VALUES`].
    seen: Vec<f32>,
    low: f32,
    high: f32,
    /// For the bits of each value, the number of samples in runs of at least [`RUN`] equal samples.
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
    fn add(&mut self, x: f32) {
        self.run = if self.samples > 0 && x == self.last { self.run + 1 } else { 1 };
        self.samples += 1;
        self.last = x;
        if self.run == 1 && self.varies_little() && !self.seen.contains(&x) {
            self.seen.push(x);
        }
        (self.low, self.high) = (self.low.min(x), self.high.max(x));
        if self.run >= RUN {
            // Adding 0 turns -0 into 0, so that both count as one value.
            let of_value = self.resting.entry((x + 0.0).to_bits()).or_default();
            *of_value += if self.run == RUN { RUN } else { 1 };
        }
    }

    fn varies_little(&self) -> bool {
        self.seen.len() < FEWEST_VALUES
    }

    /// [`Flaw::Constant`] or [`Flaw::Stuck`], if the samples show it; `channel` counts from 0.
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

    fn share(&self, samples: usize) -> f64 {
        samples as f64 / self.samples.max(1) as f64
    }
}

#[derive(Clone, Debug)]
pub struct SeriesFlaws(Vec<ChannelFlaws>);

impl SeriesFlaws {
    pub fn new(channels: usize) -> Self {
        Self(vec![ChannelFlaws::default(); channels])
    }

    /// Takes the next frames, their channels interleaved.
    pub fn add(&mut self, frames: &[f32]) {
        for frame in frames.chunks_exact(self.0.len()) {
            for (channel, &x) in frame.iter().enumerate() {
                self.0[channel].add(x);
            }
        }
    }

    pub fn flaws(&self) -> Vec<Flaw> {
        let channels = self.0.iter().enumerate();
        channels.filter_map(|(at, c)| c.dead(at).or_else(|| c.saturated(at))).collect()
    }

    /// The [`Flaw::Constant`]s and [`Flaw::Stuck`]s so far, channel by channel.
    pub fn dead(&self) -> impl Iterator<Item = Flaw> {
        self.0.iter().enumerate().filter_map(|(at, channel)| channel.dead(at))
    }
}

pub fn flaws(series: &Series) -> Vec<Flaw> {
    let mut found = SeriesFlaws::new(series.channels());
    found.add(series.samples());
    found.flaws()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn damage_says_what_to_do_about_the_worst_channel() {
        let of = |flaws: &[Flaw]| worst_damage(flaws, |channel| channel != 2);
        let text = |flaws: &[Flaw]| of(flaws).unwrap();
        let dead = |channel| Flaw::Constant { channel, value: 0.0 };
        let clipped = |channel, share| Flaw::Saturated { channel, value: 1.0, share };
        assert_eq!(text(&[dead(1), clipped(2, 0.1)]), "dead, check the cable");
        let loose = Flaw::Saturated { channel: 1, value: 0.0, share: 0.6 };
        assert_eq!(text(&[loose]), "dead for 60 % of the scan, check the cable");
        let texts = text(&[clipped(1, 0.1), clipped(2, 0.47)]);
        assert_eq!(texts, "clipped in 47 % of its samples, lower the gain or press less");
        assert_eq!(of(&[dead(3)]), None, "it rests in the library, too");
    }
}
