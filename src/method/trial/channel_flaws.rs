//! Finds channels that are stuck, as by a broken cable, or reach their limits too often, as by a
//! wrong gain. All who judge signals do it here: scans in progress and finished ones, trials to be
//! kept, and the audit of a library.
//!
//! A channel may rest as long as it does in the library: a taxel, a switch or a counter is 0 most of
//! the time. So each channel is judged by its rest ([`usual_rest`]).

use std::collections::HashMap;

use multiversion::multiversion;

use super::doubt::Doubt;
use super::{Image, Series, Signal};
use crate::lanes::{extremes, less};
use crate::scene::SourceId;

/// A channel with fewer distinct values is a switch or a coarse converter, and may rest at its limits.
const FEWEST_VALUES: usize = 16;
/// Samples rest at a value if at least this many of them in a row have it.
const RUN: usize = 3;
/// Samples that are looked at together.
const CHUNK: usize = 32;
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
pub fn is_plain(image: &Image) -> bool {
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
    /// For the bits of each value, the number of samples in runs of at least [`RUN`] equal samples that have
    /// ended.
    resting: HashMap<u32, usize>,
}

impl ChannelFlaws {
    fn add(&mut self, samples: &[f32]) {
        let (chunks, rest) = samples.as_chunks();
        for chunk in chunks {
            if self.run == 0 || self.varies_little() || !differ(self.last, chunk) {
                self.add_each(chunk);
                continue;
            }
            self.end_run();
            self.samples += CHUNK;
            (self.run, self.last) = (1, chunk[CHUNK - 1]);
            let (low, high) = extremes(chunk);
            (self.low, self.high) = (self.low.min(low), self.high.max(high));
        }
        self.add_each(rest);
    }

    fn add_each(&mut self, samples: &[f32]) {
        self.samples += samples.len();
        for &x in samples {
            if self.run > 0 && x == self.last {
                self.run += 1;
                continue;
            }
            self.end_run();
            (self.run, self.last) = (1, x);
            (self.low, self.high) = (self.low.min(x), self.high.max(x));
            if self.varies_little() && !self.seen.contains(&x) {
                self.seen.push(x);
            }
        }
    }

    /// Notes the latest run of equal samples.
    fn end_run(&mut self) {
        if self.run >= RUN {
            // Adding 0 turns -0 into 0, so that both count as one value.
            *self.resting.entry((self.last + 0.0).to_bits()).or_default() += self.run;
        }
    }

    /// The number of resting samples of each value so far.
    fn resting(&self) -> HashMap<u32, usize> {
        let mut so_far = self.clone();
        so_far.end_run();
        so_far.resting
    }

    fn varies_little(&self) -> bool {
        self.seen.len() < FEWEST_VALUES
    }

    /// The channel as stuck, if the samples show it; `channel` counts from 1.
    fn dead(&self, source: &SourceId, channel: usize) -> Option<Doubt> {
        let share = self.share(self.run);
        let is_constant = self.samples > 0 && self.run == self.samples;
        let is_stuck = is_constant || share >= STUCK && !self.varies_little();
        let (source, value) = (source.clone(), self.last);
        is_stuck.then_some(Doubt::Stuck { source, channel, value, share })
    }

    /// The channel as clipped or at 0, if the samples so far show it; `channel` counts from 1.
    fn saturated(&self, source: &SourceId, channel: usize) -> Option<Doubt> {
        if self.varies_little() {
            return None;
        }
        let limits = [self.low, self.high].map(|limit| (limit + 0.0).to_bits());
        let resting = self.resting();
        let others = resting.iter().filter(|(value, _)| !limits.contains(value));
        let others = others.map(|(_, count)| *count).max().unwrap_or(0);
        let rests = |limit: &u32| resting.get(limit).copied().unwrap_or(0);
        let outstanding = |limit: &u32| rests(limit) >= ABOVE_OTHERS * others;
        let (zeros, limits): (Vec<u32>, _) = limits.into_iter().partition(|limit| *limit == 0);
        let limits: Vec<u32> = limits.into_iter().filter(outstanding).collect();
        let share = self.share(limits.iter().map(rests).sum());
        let source = source.clone();
        if share >= SHARE {
            let most = limits.iter().max_by_key(|limit| rests(limit)).copied().unwrap_or(0);
            return Some(Doubt::Clipped { source, channel, value: f32::from_bits(most), share });
        }
        let share = zeros.first().map_or(0.0, |zero| self.share(rests(zero)));
        (share >= STUCK).then_some(Doubt::AtZero { source, channel, share })
    }

    /// The largest share of the samples that rests at one value.
    fn rest(&self) -> f32 {
        if self.run == self.samples {
            return 1.0;
        }
        self.share(self.resting().values().copied().max().unwrap_or(0)) as f32
    }

    fn share(&self, samples: usize) -> f64 {
        samples as f64 / self.samples.max(1) as f64
    }
}

/// Whether each sample differs from the one before it; `last` precedes them.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn differ(last: f32, samples: &[f32; CHUNK]) -> bool {
    let mut before = [last; CHUNK];
    before[1..].copy_from_slice(&samples[..CHUNK - 1]);
    let mut equal = 0;
    for i in 0..CHUNK {
        equal |= u32::from(samples[i] == before[i]);
    }
    equal == 0
}

/// The `usual_rest` of each channel, from the rests of all channels in each trial.
pub fn usual_rests(trials: &[&[f32]]) -> Vec<f32> {
    let channels = trials.iter().map(|rests| rests.len()).max().unwrap_or(0);
    let of = |at: usize| trials.iter().filter_map(|rests| rests.get(at).copied()).collect();
    (0..channels).map(|at| usual_rest(of(at))).collect()
}

/// The flaws of a signal of `source`; `rests` as in [`SeriesFlaws::doubts`].
pub fn flaws_of(source: &SourceId, signal: &Signal, rests: &[f32]) -> Vec<Doubt> {
    match signal {
        Signal::Image(image) if is_plain(image) => {
            vec![Doubt::OneColour { source: source.clone() }]
        }
        Signal::Image(_) => Vec::new(),
        Signal::Series(series) => SeriesFlaws::of(series).doubts(source, rests),
    }
}

/// Share of the time that a library's channel usually rests, from its rest in each trial
/// ([`SeriesFlaws::rests`]); 0 if it moves all the time.
///
/// It is the rest that some trials reach: one of five, or one of 20 for a channel that rests at times
/// in most trials; always two, so that one broken trial hides no other. A channel that rests for half
/// of a trial may rest for a whole one, so its rest is 1.
fn usual_rest(mut of_trials: Vec<f32>) -> f32 {
    let trials = of_trials.len();
    of_trials.sort_by(|a, b| b.total_cmp(a));
    let is_steady = of_trials.get(trials / 2).is_none_or(|median| *median < STEADY);
    let some = trials.div_ceil(if is_steady { 5 } else { 20 }).max(2).min(trials);
    let rest = some.checked_sub(1).map_or(0.0, |at| of_trials[at]);
    if f64::from(rest) >= STUCK { 1.0 } else { rest }
}

/// A channel that rests for less than this share of most trials moves steadily.
pub(crate) const STEADY: f32 = 0.05;

impl Doubt {
    /// Whether a channel rests here as it does in the library, so that nothing is wrong. `rests` is
    /// the [`usual_rest`] of each channel; channels beyond its end never rest.
    pub(crate) fn is_usual(&self, rests: &[f32]) -> bool {
        let rest = |channel: usize| rests.get(channel - 1).copied().map_or(0.0, f64::from);
        match self {
            // The channel must rest for half of the time in which it usually moves.
            Self::Stuck { channel, share, .. } | Self::AtZero { channel, share, .. } => {
                let rest = rest(*channel);
                rest >= 1.0 || *share < rest + STUCK * (1.0 - rest)
            }
            // The limit may be the value at which the channel rests.
            Self::Clipped { channel, .. } => rest(*channel) >= 1.0,
            _ => false,
        }
    }
}

/// The flaws of the channels of a growing series.
#[derive(Clone, Debug)]
pub struct SeriesFlaws(Vec<ChannelFlaws>);

impl SeriesFlaws {
    pub fn new(channels: usize) -> Self {
        let (low, high) = (f32::INFINITY, f32::NEG_INFINITY);
        let (seen, resting) = (Vec::new(), HashMap::new());
        let none = ChannelFlaws { samples: 0, last: 0.0, run: 0, seen, low, high, resting };
        Self(vec![none; channels])
    }

    /// The flaws of a whole series.
    pub fn of(series: &Series) -> Self {
        let mut found = Self::new(series.channels());
        found.add(series.samples());
        found
    }

    /// Takes the next frames, their channels interleaved.
    pub fn add(&mut self, frames: &[f32]) {
        let channels = self.0.len();
        for (c, channel) in self.0.iter_mut().enumerate() {
            channel.add(&less(frames, (channels, c), 0.0));
        }
    }

    /// The channels of `source` that are stuck, at 0 or clipped so far. `rests` is the share of time
    /// that each channel rests in the library, see `is_usual`; empty if no channel may rest.
    pub fn doubts(&self, source: &SourceId, rests: &[f32]) -> Vec<Doubt> {
        let of = |(at, c): (usize, &ChannelFlaws)| {
            c.dead(source, at + 1).or_else(|| c.saturated(source, at + 1))
        };
        self.0.iter().enumerate().filter_map(of).filter(|doubt| !doubt.is_usual(rests)).collect()
    }

    /// Whether a channel is stuck so far; `rests` as in [`SeriesFlaws::doubts`].
    pub(crate) fn is_dead(&self, source: &SourceId, rests: &[f32]) -> bool {
        let mut dead = self.0.iter().enumerate().filter_map(|(at, c)| c.dead(source, at + 1));
        dead.any(|doubt| !doubt.is_usual(rests))
    }

    /// For each channel, the largest share of the samples that rests at one value.
    pub(crate) fn rests(&self) -> Vec<f32> {
        self.0.iter().map(ChannelFlaws::rest).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_channel_may_rest_as_some_trials_do_and_one_broken_trial_excuses_nothing() {
        assert_eq!(usual_rest(Vec::new()), 0.0);
        assert_eq!(usual_rest([vec![0.0; 9], vec![1.0]].concat()), 0.0, "one cable broke");
        assert_eq!(usual_rest([vec![0.0; 18], vec![1.0; 2]].concat()), 0.0, "in two of 20 trials");
        assert_eq!(usual_rest([vec![0.02; 7], vec![1.0; 3]].concat()), 1.0, "often untouched");
        assert_eq!(usual_rest([vec![0.3; 19], vec![0.8; 2]].concat()), 1.0, "a taxel");
        assert_eq!(usual_rest(vec![0.3; 20]), 0.3);
        assert_eq!(usual_rest(vec![1.0]), 1.0);
    }

    #[test]
    fn a_channel_is_stuck_if_it_rests_for_half_of_the_time_in_which_it_usually_moves() {
        let source = SourceId::new("skin").unwrap();
        let stuck = |share| Doubt::Stuck { source: source.clone(), channel: 2, value: 0.0, share };
        let usual = |share, rest: f32| stuck(share).is_usual(&[0.0, rest]);
        assert!(usual(0.49, 0.0) && !usual(0.5, 0.0) && !stuck(0.5).is_usual(&[]));
        assert!(usual(0.69, 0.4) && !usual(0.71, 0.4) && usual(1.0, 1.0));
    }

    #[test]
    fn samples_that_are_looked_at_together_have_the_flaws_of_single_ones() {
        // Runs of one to five samples between stretches that move; ±0 count as one value.
        let value = |i: usize| match i % 400 {
            0..100 => (i / 5 % 3) as f32 - 1.0,
            100..104 => [0.0, -0.0][i % 2],
            _ => (i * 7919 % 1000) as f32 / 250.0 - 2.0,
        };
        let samples: Vec<f32> = (0..4000).map(value).collect();
        let SeriesFlaws(mut single) = SeriesFlaws::new(1);
        single[0].add_each(&samples);
        for piece in [1, 31, 500, 4000] {
            let SeriesFlaws(mut together) = SeriesFlaws::new(1);
            samples.chunks(piece).for_each(|samples| together[0].add(samples));
            assert_eq!(format!("{:?}", together[0].seen), format!("{:?}", single[0].seen));
            let of = |flaws: &ChannelFlaws| (flaws.resting(), flaws.low, flaws.high, flaws.samples);
            assert_eq!(of(&together[0]), of(&single[0]), "in pieces of {piece}");
        }
        assert!(single[0].resting().len() > 2 && !single[0].varies_little());
    }
}
