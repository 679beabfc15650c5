//! The features whose covariance between two moments says how they depend on each other: Hermite
//! polynomials of normal scores, a kernel of finite rank (Lancaster's expansion; H. O. Lancaster,
//! "The structure of bivariate distributions", Ann. Math. Statist. 29, 1958).

use std::ops::Range;

use super::normal_scores::normal_scores;
use super::samples::Samples;

/// Share of its variance that a feature must keep when those before it are taken out.
const LEAST_KEPT: f64 = 0.05;
/// Channels up to which each pair adds its product.
const MOST_PAIRED: usize = 4;

/// Features of all trials: each with mean 0 in every trial and variance 1 over all, those of one
/// channel uncorrelated.
#[derive(Clone, Debug)]
pub struct Features {
    /// Q.
    pub trials: usize,
    /// L.
    pub frames: usize,
    /// For each feature the trials one after the other.
    pub columns: Vec<Vec<f32>>,
    /// Columns of each channel, then of each product of two channels.
    pub channels: Vec<Range<usize>>,
    /// For each feature the variance between the trials' means over the whole variance.
    pub between: Vec<f64>,
}

/// z, (z² − 1)/√2 and (z³ − 3z)/√6 of each channel, and the products of two channels' z.
///
/// A feature that keeps too little of its variance is left out (a channel of two values keeps one),
/// and so is a constant channel. With more than four channels there are no products, whose
/// number grows with the square.
pub fn features(samples: &Samples) -> Features {
    let mut features = Features {
        trials: samples.trials,
        frames: samples.frames,
        columns: Vec::new(),
        channels: Vec::new(),
        between: Vec::new(),
    };
    let scores: Vec<Vec<f32>> =
        samples.channels.iter().filter_map(|values| normal_scores(values)).collect();
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
    /// Adds a channel's features, made orthonormal one after the other.
    fn add<const N: usize>(&mut self, raw: [Vec<f32>; N]) {
        let first = self.columns.len();
        for mut column in raw {
            let before = variance(&column);
            let between = self.centre(&mut column);
            let within = dot(&column, &column) / column.len() as f64;
            // Rounding leaves a hair of variance in what is constant.
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

    /// Takes each trial's mean out; gives the variance between those means.
    fn centre(&self, column: &mut [f32]) -> f64 {
        let means: Vec<f64> = (column.chunks_exact_mut(self.frames))
            .map(|trial| {
                let mean = trial.iter().map(|&x| f64::from(x)).sum::<f64>() / trial.len() as f64;
                trial.iter_mut().for_each(|x| *x -= mean as f32);
                mean
            })
            .collect();
        let mean = means.iter().sum::<f64>() / means.len() as f64;
        let squares: f64 = means.iter().map(|m| (m - mean).powi(2)).sum();
        if means.len() < 2 { 0.0 } else { squares / (means.len() - 1) as f64 }
    }
}

fn variance(column: &[f32]) -> f64 {
    let count = column.len() as f64;
    let mean = column.iter().map(|&x| f64::from(x)).sum::<f64>() / count;
    column.iter().map(|&x| (f64::from(x) - mean).powi(2)).sum::<f64>() / count
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    (a.chunks(4096).zip(b.chunks(4096))).map(|(a, b)| f64::from(super::dot::dot(a, b))).sum()
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
}
