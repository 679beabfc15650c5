//! Features of samples: Hermite polynomials of normal scores. Their covariance at two times
//! measures how samples at these times depend on each other, like a kernel of finite rank (H. O.
//! Lancaster, "The structure of bivariate distributions", Ann. Math. Statist. 29, 1958).

use std::ops::Range;

use ndarray::Array1;
use statrs::distribution::{ContinuousCDF, Normal};

use crate::lanes::dot;
use crate::trial::{Series, power};

/// A feature is kept if at least this share of its variance is uncorrelated with earlier features.
const LEAST_KEPT: f64 = 0.05;
/// Products of two channels are added only up to this number of channels.
const MOST_PAIRED: usize = 4;

/// Features of all trials. Each feature has mean 0 in every trial and variance 1 over all trials. The
/// features of one channel are uncorrelated.
#[derive(Clone, Debug, Default)]
pub(super) struct Features {
    /// Q, the number of trials.
    pub trials: usize,
    /// L, the number of frames of each trial.
    pub frames: usize,
    /// The values of each feature, one trial after another.
    pub columns: Vec<Vec<f32>>,
    /// Range of columns of each channel, then of each product of two channels.
    pub channels: Vec<Range<usize>>,
    /// For each feature, (variance of the trial means)/(total variance).
    pub between: Vec<f64>,
}

/// z, (z² − 1)/√2 and (z³ − 3z)/√6 for the normal scores z of each channel, and products of two z.
///
/// A constant channel is left out. A feature is left out if it depends nearly linearly on earlier
/// features of its channel (a channel of two values keeps one feature). With more than four channels
/// there are no products, since their number grows with the square.
pub(super) fn features(samples: &Samples) -> Features {
    let Samples { trials, frames, ref channels } = *samples;
    let mut features = Features { trials, frames, ..Features::default() };
    let scores: Vec<Vec<f32>> = channels.iter().filter_map(|z| normal_scores(z)).collect();
    for z in &scores {
        let hermite = |f: fn(f32) -> f32| z.iter().map(|&z| f(z)).collect::<Vec<f32>>();
        features.add([
            z.clone(),
            hermite(|z| (z * z - 1.0) * std::f32::consts::FRAC_1_SQRT_2),
            hermite(|z| (z * z * z - 3.0 * z) * 0.408_248_3),
        ]);
    }
    if scores.len() <= MOST_PAIRED {
        for (a, x) in scores.iter().enumerate() {
            for y in &scores[..a] {
                features.add([x.iter().zip(y).map(|(x, y)| x * y).collect()]);
            }
        }
    }
    features
}

impl Features {
    /// Adds a channel's features, each made orthonormal to the channel's features before it.
    fn add<const N: usize>(&mut self, raw: [Vec<f32>; N]) {
        let first = self.columns.len();
        for mut column in raw {
            let before = power(column.iter().map(|&x| f64::from(x)));
            let between = self.centre(&mut column);
            let within = dot(&column, &column) / column.len() as f64;
            // Rounding can leave a little variance in a feature that is constant.
            if within <= 1e-9 * before.max(1.0) {
                continue;
            }
            for kept in &self.columns[first..] {
                let share = dot(kept, &column) / column.len() as f64;
                column.iter_mut().zip(kept).for_each(|(x, k)| *x -= share as f32 * k);
            }
            let left = dot(&column, &column) / column.len() as f64;
            if left < LEAST_KEPT * within {
                continue;
            }
            let scale = (1.0 / left.sqrt()) as f32;
            column.iter_mut().for_each(|x| *x *= scale);
            self.columns.push(column);
            self.between.push(between / before);
        }
        if self.columns.len() > first {
            self.channels.push(first..self.columns.len());
        }
    }

    /// Subtracts each trial's mean, and returns the variance of these means.
    fn centre(&self, column: &mut [f32]) -> f64 {
        let means: Array1<f64> = (column.chunks_exact_mut(self.frames))
            .map(|trial| {
                let mean = trial.iter().map(|&x| f64::from(x)).sum::<f64>() / trial.len() as f64;
                trial.iter_mut().for_each(|x| *x -= mean as f32);
                mean
            })
            .collect();
        if means.len() < 2 { 0.0 } else { means.var(1.0) }
    }
}

/// Q trials of L frames of each channel.
#[derive(Clone, Debug)]
pub(super) struct Samples {
    pub trials: usize,
    pub frames: usize,
    /// The values of each channel, one trial after another: frame i of trial q at q·L + i.
    pub channels: Vec<Vec<f32>>,
}

impl Samples {
    /// Takes every `step`-th frame from the frames `range` of each trial. Frames are dropped, not
    /// averaged, so the dependence at the remaining lags is unchanged.
    pub(super) fn every(step: usize, range: Range<usize>, series: &[Series]) -> Self {
        let channels = series.first().map_or(0, Series::channels);
        let channel = |c: usize| -> Vec<f32> {
            (series.iter())
                .flat_map(|s| {
                    let frames = &s.samples()[range.start * channels..range.end * channels];
                    frames.iter().skip(c).step_by(channels * step)
                })
                .copied()
                .collect()
        };
        let channels = (0..channels).map(channel).collect();
        Self { trials: series.len(), frames: range.len().div_ceil(step), channels }
    }
}

/// Normal scores Φ⁻¹((r − ½)/N), where r are the midranks of N values, scaled to mean 0 and variance
/// 1. Equal values get equal scores. `None` if all values are equal.
pub(super) fn normal_scores(values: &[f32]) -> Option<Vec<f32>> {
    let count = values.len();
    // Adding 0 turns −0 into 0. Indices of 32 bits make the sort faster (up to 500,000 values).
    let mut order: Vec<(f32, u32)> = values.iter().map(|x| x + 0.0).zip(0..).collect();
    order.sort_unstable_by(|(a, _), (b, _)| a.total_cmp(b));
    if order.first().map(|(x, _)| x) == order.last().map(|(x, _)| x) {
        return None;
    }
    let normal = Normal::standard();
    let mut scores = vec![0.0f32; count];
    let (mut first, mut sum, mut squares) = (0, 0.0, 0.0);
    while first < count {
        let ties = order[first..].iter().take_while(|(x, _)| *x == order[first].0).count();
        // The midrank of ranks first + 1 to first + ties, minus ½, is first + ties/2.
        let score = normal.inverse_cdf((first as f64 + 0.5 * ties as f64) / count as f64);
        for &(_, at) in &order[first..first + ties] {
            scores[at as usize] = score as f32;
        }
        sum += score * ties as f64;
        squares += score * score * ties as f64;
        first += ties;
    }
    let mean = sum / count as f64;
    let variance = squares / count as f64 - mean * mean;
    let scale = 1.0 / variance.sqrt();
    scores.iter_mut().for_each(|z| *z = ((f64::from(*z) - mean) * scale) as f32);
    Some(scores)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn samples(channels: usize, make: impl Fn(usize, usize) -> f32) -> Samples {
        let channel = |c: usize| (0..4000).map(|i| make(c, i)).collect();
        Samples { trials: 4, frames: 1000, channels: (0..channels).map(channel).collect() }
    }

    fn noise(c: usize, i: usize) -> f32 {
        let mut x = (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(c as u64 * 77);
        x ^= x >> 29;
        x = x.wrapping_mul(0xbf58_476d_1ce4_e5b9);
        (x >> 40) as f32
    }

    #[test]
    fn features_of_a_channel_are_orthonormal_and_centred_in_every_trial() {
        let got = features(&samples(2, noise));
        assert_eq!(got.channels, [0..3, 3..6, 6..7]);
        for (i, a) in got.columns.iter().enumerate() {
            for trial in a.chunks(1000) {
                assert!(trial.iter().sum::<f32>().abs() < 0.01);
            }
            for b in &got.columns[got.channels.iter().find(|r| r.contains(&i)).unwrap().start..=i] {
                let want = if std::ptr::eq(a, b) { 1.0 } else { 0.0 };
                assert!((dot(a, b) / 4000.0 - want).abs() < 1e-4);
            }
        }
    }

    #[test]
    fn a_channel_of_two_values_keeps_one_feature_and_a_constant_one_none() {
        let got = features(&samples(1, |_, i| f32::from(noise(0, i) > 6e6)));
        assert_eq!(got.channels, vec![0..1; 1]);
        assert!(features(&samples(1, |_, _| 2.0)).channels.is_empty());
    }

    #[test]
    fn what_differs_between_trials_for_good_is_counted_and_taken_out() {
        let got = features(&samples(1, |c, i| noise(c, i) + (i / 1000) as f32 * 1e7));
        assert!(got.between[0] > 0.3, "{:?}", got.between);
        assert!(features(&samples(1, noise)).between[0] < 0.02);
    }

    /// Normal scores from midranks, found by counting.
    fn by_counting(values: &[f32]) -> Vec<f64> {
        let n = values.len() as f64;
        let normal = Normal::standard();
        let z: Vec<f64> = values
            .iter()
            .map(|x| {
                let below = values.iter().filter(|y| *y < x).count() as f64;
                let ties = values.iter().filter(|y| *y == x).count() as f64;
                normal.inverse_cdf((below + 0.5 * ties) / n)
            })
            .collect();
        let mean = z.iter().sum::<f64>() / n;
        let deviation = (z.iter().map(|z| (z - mean).powi(2)).sum::<f64>() / n).sqrt();
        z.iter().map(|z| (z - mean) / deviation).collect()
    }

    #[test]
    fn scores_are_those_of_ranks_by_counting_ties_and_signs_included() {
        let values: Vec<f32> = (0..500u32)
            .map(|i| ((i * 7919 % 101) as f32 - 50.0) / 8.0 * ((i % 3) as f32))
            .collect();
        let got = normal_scores(&values).unwrap();
        for (g, w) in got.iter().zip(by_counting(&values)) {
            assert!((f64::from(*g) - w).abs() < 1e-5, "{g} {w}");
        }
        let zeros = normal_scores(&[-0.0, 0.0, 1.0, -1.0]).unwrap();
        assert_eq!(zeros[0], zeros[1]);
        // Equal values have no scores.
        assert_eq!(normal_scores(&[3.0; 9]), None);
        assert_eq!(normal_scores(&[]), None);
    }
}
