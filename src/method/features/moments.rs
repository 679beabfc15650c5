//! Running sums of a series, which give its moments and its lag covariance.
//!
//! A series is summed in blocks of half a long frame, so that a growing scan only adds its new blocks.
//! All powers are of x minus the mean of the first block, so that an offset costs no digits. The mean of
//! a scan that grows is not known yet, so mean magnitude, crossings and drift are about the means of
//! blocks. They are defined so for finished series, too: a look then says what the end would say.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use super::quantiles::{Histograms, QUANTILES};
use crate::lanes::{about, dot, extremes, less, powers, sum};

/// Number of lags of the products x_t·x_{t−l}: 0 … 3 samples.
const LAGS: usize = 4;

/// Sources with more channels than this have lagged products of each channel with itself alone: those of
/// pairs grow with the square.
pub(crate) const MOST_LAGGED: usize = 16;

/// Keeps logarithms finite; far below one step of a 24-bit converter.
const FLOOR: f64 = 1e-9;

/// Number of statistics of one channel, see [`Statistics::moments`].
pub(crate) const MOMENTS: usize = 9;

/// Indices of ln deviation and ln drift, the statistics that depend on gain.
pub(crate) const LOUDNESS: [usize; 2] = [0, 8];

/// The sums of a channel, in the order in which they are stored. `Root` is Σ √|x − m|.
#[derive(Clone, Copy)]
enum Of {
    Sum,
    Cubes,
    Fourths,
    /// Σ over blocks of (Σ x)²/n
    SquaredLevel,
    /// Σ |x − m|, where m is the mean of the block
    Magnitude,
    Root,
    Crossings,
    Least,
    Greatest,
}

const OF_CHANNEL: usize = 9;

/// Number of sums of a block: its length, [`OF_CHANNEL`] for each channel, the products of each lag.
fn width(channels: usize) -> usize {
    products(channels, LAGS)
}

fn place(of: Of, channel: usize) -> usize {
    1 + OF_CHANNEL * channel + of as usize
}

/// The place of the first product of a lag.
fn products(channels: usize, lag: usize) -> usize {
    1 + OF_CHANNEL * channels + (0..lag).map(|lag| pairs(channels, lag)).sum::<usize>()
}

/// Number of products of a lag: of each channel with each, or with itself alone.
fn pairs(channels: usize, lag: usize) -> usize {
    if lag > 0 && channels > MOST_LAGGED { channels } else { channels * channels }
}

/// The channels of each product of a lag: the later sample's, then the earlier one's.
fn of_pairs(channels: usize, lag: usize) -> impl Iterator<Item = (usize, usize)> {
    let each = pairs(channels, lag) / channels;
    (0..channels)
        .flat_map(move |i| (if each == 1 { i..i + 1 } else { 0..each }).map(move |j| (i, j)))
}

/// Sums over the blocks in which a channel moves, or over all blocks if no channel ever moves. Blocks
/// without movement are gaps that a serial line has filled with its last value.
#[derive(Clone, Debug)]
struct Sums {
    channels: usize,
    moved: bool,
    values: Vec<f64>,
}

impl Sums {
    fn new(channels: usize) -> Self {
        let mut values = vec![0.0; width(channels)];
        for c in 0..channels {
            values[place(Of::Least, c)] = f64::INFINITY;
            values[place(Of::Greatest, c)] = f64::NEG_INFINITY;
        }
        Self { channels, moved: false, values }
    }

    /// Adds the sums of a block. Tells whether they count, and whether those before do.
    fn add(&mut self, of_block: &[f32]) -> (bool, bool) {
        let extreme = |of: Of, c: usize| of_block[place(of, c)];
        let moves = (0..self.channels).any(|c| extreme(Of::Least, c) != extreme(Of::Greatest, c));
        if self.moved && !moves {
            return (false, true);
        }
        let first = moves && !self.moved;
        if first {
            *self = Self { moved: true, ..Self::new(self.channels) };
        }
        let (channels, values) = (self.channels, &mut self.values);
        let extremes: Vec<_> = (0..channels)
            .map(|c| [place(Of::Least, c), place(Of::Greatest, c)])
            .map(|[low, high]| [(low, values[low]), (high, values[high])])
            .collect();
        values.iter_mut().zip(of_block).for_each(|(sum, &x)| *sum += f64::from(x));
        for [(low, least), (high, greatest)] in extremes {
            values[low] = least.min(f64::from(of_block[low]));
            values[high] = greatest.max(f64::from(of_block[high]));
        }
        (true, !first)
    }
}

/// The sums of a series or of a part of it, which give its moments.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Moments {
    reference: Vec<f32>,
    sums: Vec<f32>,
    /// For each channel, quantiles of x minus `reference`, then of the size of steps.
    quantiles: Vec<f32>,
}

impl Moments {
    fn channels(&self) -> usize {
        self.reference.len()
    }

    pub fn is_constant(&self) -> bool {
        (0..self.channels())
            .all(|c| self.sums[place(Of::Least, c)] == self.sums[place(Of::Greatest, c)])
    }

    /// The statistics of a series at `rate_hz`, as if multiplied by a gain of e^`ln_gain`.
    pub fn statistics(&self, rate_hz: f64, ln_gain: f64) -> Statistics {
        let channels = self.channels();
        let n = f64::from(self.sums[0]).max(1.0);
        let at = |of: Of, c: usize| f64::from(self.sums[place(of, c)]);
        let level: Vec<f64> = (0..channels).map(|c| at(Of::Sum, c) / n).collect();
        // Γ(l)_ij: the mean of (x_i(t) − m_i)·(x_j(t − l) − m_j).
        let covariance = |lag: usize| -> Vec<f64> {
            let from = products(channels, lag);
            let products = of_pairs(channels, lag).zip(&self.sums[from..]);
            products.map(|((i, j), sum)| f64::from(*sum) / n - level[i] * level[j]).collect()
        };
        let mut covariances: Vec<Vec<f64>> = (0..LAGS).map(covariance).collect();
        let mut moments = Vec::with_capacity(MOMENTS * channels);
        let mut deviations = Vec::with_capacity(channels);
        for (c, &m) in level.iter().enumerate() {
            let own = |lag: usize| {
                let each = pairs(channels, lag) / channels;
                covariances[lag][c * each + if each == 1 { 0 } else { c }]
            };
            let variance = own(0).max(0.0);
            let deviation = variance.sqrt().max(FLOOR);
            let (second, third, fourth) =
                (variance + m * m, at(Of::Cubes, c) / n, at(Of::Fourths, c) / n);
            let skew = third - 3.0 * m * second + 2.0 * m.powi(3);
            let tail = fourth - 4.0 * m * third + 6.0 * m * m * second - 3.0 * m.powi(4);
            let peak = (at(Of::Greatest, c) - m).max(m - at(Of::Least, c)).max(FLOOR);
            let magnitude = (at(Of::Magnitude, c) / n).max(FLOOR);
            let root = (at(Of::Root, c) / n).powi(2).max(FLOOR);
            let step = (2.0 * (variance - own(1))).max(0.0).sqrt();
            let drift = (at(Of::SquaredLevel, c) / n - m * m).max(0.0).sqrt();
            moments.extend([
                deviation.ln() + ln_gain,
                (skew / deviation.powi(3)).cbrt(),
                (tail / deviation.powi(4)).max(FLOOR).ln(),
                (peak / deviation).ln(),
                (deviation / magnitude).ln(),
                (peak / root).ln(),
                ((at(Of::Crossings, c) + 1.0) * rate_hz / n).ln(),
                (step / deviation).max(FLOOR).ln(),
                drift.max(FLOOR).ln() + ln_gain,
            ]);
            deviations.push(deviation * ln_gain.exp());
        }
        let gain = ln_gain.exp();
        let quantile = |(i, x): (usize, &f32)| {
            let (channel, at) = (i / (2 * QUANTILES), i % (2 * QUANTILES));
            gain * (f64::from(*x) - if at < QUANTILES { level[channel] } else { 0.0 })
        };
        let quantiles = self.quantiles.iter().enumerate().map(quantile).collect();
        let power = (2.0 * ln_gain).exp();
        covariances.iter_mut().flatten().for_each(|x| *x *= power);
        let mean = |(m, r): (&f64, &f32)| m + f64::from(*r);
        let means = level.iter().zip(&self.reference).map(mean).collect();
        Statistics { moments, deviations, means, covariances, quantiles }
    }
}

#[derive(Clone, Debug)]
pub struct Statistics {
    /// For each channel: ln deviation, cube root of skewness, and the ln of these: kurtosis, crest
    /// (peak/deviation), shape (deviation/mean magnitude), clearance (peak/squared mean root), rate of
    /// mean crossings in Hz, (deviation of differences)/(deviation of values), and drift (deviation of
    /// the means of blocks). Magnitude, root and crossings are about the mean of each block.
    pub moments: Vec<f64>,
    /// Standard deviation of each channel; at least 1e-9.
    pub deviations: Vec<f64>,
    /// Mean of each channel, without the gain.
    pub means: Vec<f64>,
    /// Γ(l) for lags of 0 to 3 samples, each of shape (C, C); with more than [`MOST_LAGGED`] channels, the
    /// diagonal alone for the lags above 0.
    pub covariances: Vec<Vec<f64>>,
    /// For each channel, quantiles of x minus its mean, then of |step|; see [`QUANTILES`].
    pub quantiles: Vec<f64>,
}

#[derive(Clone, Debug)]
pub(super) struct GrowingMoments {
    block: usize,
    /// The mean of the first block; `None` until that block is complete.
    reference: Option<Vec<f32>>,
    /// The last frames before the current block, as many as the longest lag needs.
    before: Vec<f32>,
    /// Samples of the block that is not complete yet.
    pending: Vec<f32>,
    sums: Sums,
    histograms: Histograms,
}

impl GrowingMoments {
    /// Starts without samples; blocks hold `block` samples a channel.
    pub(super) fn new(channels: usize, block: usize) -> Self {
        Self {
            block,
            reference: None,
            before: Vec::new(),
            pending: Vec::new(),
            sums: Sums::new(channels),
            histograms: Histograms::new(channels),
        }
    }

    /// Adds interleaved samples.
    pub(super) fn extend(&mut self, samples: &[f32]) {
        let channels = self.sums.channels;
        let size = self.block * channels;
        let all = joined(&mut self.pending, samples);
        let mut blocks = all.chunks_exact(size);
        for block in &mut blocks {
            self.add(block);
            let kept = block.len().min((LAGS - 1) * channels);
            self.before.extend_from_slice(&block[block.len() - kept..]);
            let surplus = self.before.len().saturating_sub((LAGS - 1) * channels);
            self.before.drain(..surplus);
        }
        self.pending = blocks.remainder().to_vec();
    }

    /// The moments of the samples so far, if the series ends here.
    pub(super) fn ended(mut self) -> Moments {
        let pending = std::mem::take(&mut self.pending);
        if !pending.is_empty() {
            self.add(&pending);
        }
        let channels = self.sums.channels;
        Moments {
            sums: self.sums.values.into_iter().map(held).collect(),
            quantiles: self.histograms.quantiles(),
            reference: self.reference.unwrap_or_else(|| means(&[], channels)),
        }
    }

    /// Adds the sums of a block.
    fn add(&mut self, block: &[f32]) {
        let channels = self.sums.channels;
        let reference = self.reference.get_or_insert_with(|| means(block, channels));
        let planes = planes(block, &self.before, reference);
        let past = self.before.len() / channels;
        let counts = self.sums.add(&block_sums(&planes, past));
        self.histograms.add(counts, &planes, past);
    }
}

/// The samples that waited, and those after them; if none waited, nothing is copied.
pub(super) fn joined<'a>(pending: &mut Vec<f32>, samples: &'a [f32]) -> Cow<'a, [f32]> {
    if pending.is_empty() {
        return samples.into();
    }
    pending.extend_from_slice(samples);
    std::mem::take(pending).into()
}

/// Limits x to finite f32, since powers of samples far beyond full scale may overflow.
fn held(x: f64) -> f32 {
    x.clamp(f64::from(-f32::MAX), f64::from(f32::MAX)) as f32
}

/// The mean of each channel of interleaved samples.
pub(super) fn means(samples: &[f32], channels: usize) -> Vec<f32> {
    let frames = (samples.len() / channels).max(1) as f64;
    let mean = |c: usize| (sum(&less(samples, (channels, c), 0.0)) / frames) as f32;
    (0..channels).map(mean).collect()
}

/// Each channel of a block minus `reference`, preceded by its samples before the block.
fn planes(block: &[f32], before: &[f32], reference: &[f32]) -> Vec<Vec<f32>> {
    let (channels, all) = (reference.len(), [before, block].concat());
    let plane = |(c, reference): (usize, &f32)| less(&all, (channels, c), *reference);
    reference.iter().enumerate().map(plane).collect()
}

/// The sums of a block. It follows the first `past` samples of each channel.
fn block_sums(all: &[Vec<f32>], past: usize) -> Vec<f32> {
    let channels = all.len();
    let mut sums = vec![0.0; width(channels)];
    let frames = all[0].len() - past;
    sums[0] = frames as f32;
    for (c, of_channel) in all.iter().enumerate() {
        let of_block = &of_channel[past..];
        let [sum, cubes, fourths] = powers(of_block);
        let mean = (sum / frames.max(1) as f64) as f32;
        let [magnitude, root, crossings] = about(of_block, mean);
        let (least, greatest) = extremes(of_block);
        for (of, value) in [
            (Of::Sum, sum),
            (Of::Cubes, cubes),
            (Of::Fourths, fourths),
            (Of::SquaredLevel, sum * sum / frames.max(1) as f64),
            (Of::Magnitude, magnitude),
            (Of::Root, root),
            (Of::Crossings, crossings),
            (Of::Least, f64::from(least)),
            (Of::Greatest, f64::from(greatest)),
        ] {
            sums[place(of, c)] = value as f32;
        }
    }
    for lag in 0..LAGS {
        let at = products(channels, lag);
        // A recording has no samples before its first block.
        let from = past.max(lag);
        if from >= past + frames {
            continue;
        }
        for (k, (i, j)) in of_pairs(channels, lag).enumerate() {
            sums[at + k] = if lag == 0 && j < i {
                sums[at + j * channels + i]
            } else {
                let earlier = &all[j];
                dot(&all[i][from..], &earlier[from - lag..earlier.len() - lag]) as f32
            };
        }
    }
    sums.iter_mut().for_each(|x| *x = x.clamp(-f32::MAX, f32::MAX));
    sums
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Channels that swing about 0, 3, 6 …
    fn series(frames: usize, channels: usize) -> Vec<f32> {
        let value = |i: usize| {
            let (t, c) = ((i / channels) as f32, (i % channels) as f32);
            0.4 * (t * (0.31 + 0.2 * c)).sin() + 0.1 * ((t * t + c) * 0.77).cos() + 3.0 * c
        };
        (0..frames * channels).map(value).collect()
    }

    fn whole(channels: usize, block: usize, samples: &[f32]) -> Moments {
        let mut growing = GrowingMoments::new(channels, block);
        growing.extend(samples);
        growing.ended()
    }

    fn statistics(channels: usize, block: usize, samples: &[f32]) -> Statistics {
        whole(channels, block, samples).statistics(100.0, 0.0)
    }

    #[test]
    fn statistics_are_those_of_their_definitions() {
        let (n, channels, block) = (1000, 2, 64);
        let samples = series(n, channels);
        let stats = statistics(channels, block, &samples);
        let channel = |c: usize| -> Vec<f64> {
            samples.iter().skip(c).step_by(channels).map(|&x| f64::from(x)).collect()
        };
        let mean = |x: &[f64]| x.iter().sum::<f64>() / x.len() as f64;
        for c in 0..channels {
            let x = channel(c);
            let m = mean(&x);
            let of = |f: &dyn Fn(f64) -> f64| mean(&x.iter().map(|x| f(x - m)).collect::<Vec<_>>());
            let deviation = of(&|x| x * x).sqrt();
            let peak = x.iter().map(|x| (x - m).abs()).fold(0.0, f64::max);
            let moments = &stats.moments[c * MOMENTS..];
            assert!((stats.means[c] - m).abs() < 1e-5);
            assert!((moments[0] - deviation.ln()).abs() < 1e-4);
            assert!((moments[1].powi(3) - of(&|x| x.powi(3)) / deviation.powi(3)).abs() < 1e-3);
            assert!((moments[2].exp() - of(&|x| x.powi(4)) / deviation.powi(4)).abs() < 1e-3);
            assert!((moments[3].exp() - peak / deviation).abs() < 1e-3);
            let (mut magnitude, mut root, mut crossings, mut drift) = (0.0, 0.0, 0, 0.0);
            for x in x.chunks(block) {
                let own = mean(x);
                magnitude += x.iter().map(|x| (x - own).abs()).sum::<f64>() / n as f64;
                root += x.iter().map(|x| (x - own).abs().sqrt()).sum::<f64>() / n as f64;
                crossings += x.windows(2).filter(|w| (w[0] < own) != (w[1] < own)).count();
                drift += x.len() as f64 * (own - m).powi(2) / n as f64;
            }
            let crossings = crossings as f64;
            assert!((deviation / magnitude - moments[4].exp()).abs() < 1e-3);
            assert!((peak / root.powi(2) - moments[5].exp()).abs() < 1e-3);
            assert!(((crossings + 1.0) / 10.0 - moments[6].exp()).abs() < 1e-3);
            assert!((drift.sqrt().ln() - moments[8]).abs() < 1e-3, "{drift}");
        }
        let (a, b) = (channel(0), channel(1));
        let (ma, mb) = (mean(&a), mean(&b));
        let lagged: f64 = (2..n).map(|t| (a[t] - ma) * (b[t - 2] - mb)).sum::<f64>() / n as f64;
        assert!((stats.covariances[2][1] - lagged).abs() < 2e-3, "{lagged}");
    }

    #[test]
    fn a_channel_among_many_has_the_moments_it_has_alone_though_pairs_have_no_lags() {
        let channels = MOST_LAGGED + 2;
        let samples = series(600, channels);
        let all = statistics(channels, 64, &samples);
        assert_eq!(all.covariances[1].len(), channels);
        for c in 0..channels {
            let own = statistics(1, 64, &less(&samples, (channels, c), 0.0));
            assert_eq!(all.moments[c * MOMENTS..][..MOMENTS], own.moments);
            for lag in 1..LAGS {
                assert_eq!(all.covariances[lag][c], own.covariances[lag][0], "{c}, {lag}");
            }
            // Of two channels, as without the others.
            let d = (c + 5) % channels;
            let pair: Vec<f32> =
                samples.chunks_exact(channels).flat_map(|frame| [frame[c], frame[d]]).collect();
            let pair = statistics(2, 64, &pair);
            assert_eq!(all.covariances[0][c * channels + d], pair.covariances[0][1]);
            assert_eq!(all.covariances[0][d * channels + c], pair.covariances[0][1]);
        }
    }

    #[test]
    fn an_offset_costs_no_digits() {
        let samples = series(4000, 1);
        let shifted: Vec<f32> = samples.iter().map(|x| x + 500.0).collect();
        let (a, b) = (statistics(1, 128, &samples), statistics(1, 128, &shifted));
        for (a, b) in a.moments.iter().zip(&b.moments).take(6) {
            assert!((a - b).abs() < 0.01, "{a} vs {b}");
        }
    }

    #[test]
    fn constants_and_single_samples_have_finite_statistics() {
        for samples in [vec![0.5; 300], vec![1e30, -1e30, 0.0], vec![-1e-30; 5], vec![1.0, 2.0]] {
            let stats = statistics(1, 16, &samples);
            let all = stats.moments.iter().chain(&stats.covariances[3]);
            assert!(all.chain(&stats.deviations).all(|x| x.is_finite()), "{stats:?}");
        }
    }

    #[test]
    fn a_series_in_pieces_has_the_moments_of_the_series_at_once() {
        let samples = series(1000, 3);
        let mut growing = GrowingMoments::new(3, 48);
        samples.chunks(3 * 7).for_each(|piece| growing.extend(piece));
        assert_eq!(growing.ended(), whole(3, 48, &samples));
    }

    #[test]
    fn a_gain_scales_what_a_gain_moves_and_nothing_else() {
        let samples = series(700, 2);
        let louder: Vec<f32> = samples.iter().map(|x| x * 2.0).collect();
        let asked = whole(2, 64, &samples).statistics(100.0, 2f64.ln());
        let played = statistics(2, 64, &louder);
        for (a, b) in asked.moments.iter().zip(&played.moments) {
            assert!((a - b).abs() < 1e-3, "{a} vs {b}");
        }
        assert!((asked.covariances[1][3] - played.covariances[1][3]).abs() < 1e-3);
    }
}
