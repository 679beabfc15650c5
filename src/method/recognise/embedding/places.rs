//! The course of a short series: a spectrum over wavelengths, or an echo over time, is not
//! stationary, and its frames and moments, which forget the place, leave out most of it.
//!
//! A series is cut into equal parts of the library's median trial, the *places*. Their means are features
//! if they tell surfaces apart better than they do once each trial is turned round by a drawn number of
//! places. Turned trials keep all but the place, so that a drag, which may begin anywhere, has none of
//! these features.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::labels;
use crate::features::moments::Statistics;
use crate::features::places::Places;
use crate::lanes::sum;
use crate::seed;

/// A channel with at most this standard deviation counts as constant.
pub(super) const STILL: f64 = 2e-9;

/// Number of times that all trials are turned.
const TURNS: u64 = 99;

/// Turns the means of places into features: less the library's mean, divided by the library's deviation of
/// the channel.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct PlaceEmbedder {
    /// The library's mean of each place, shape (places, channels).
    means: Vec<f32>,
}

/// A trial of a library: its surface, the means of its places, and its statistics.
pub(super) type Placed<'t> = (&'t str, &'t [f32], &'t Statistics);

impl PlaceEmbedder {
    /// Takes means from the `trials` of a library; `None` if the place says nothing about the surface.
    pub(super) fn new(places: Places, channels: usize, trials: &[Placed<'_>]) -> Option<Self> {
        let width = places.count * channels;
        if !tells(trials, width, channels) {
            return None;
        }
        let mean = |column: usize| {
            let there: Vec<f32> =
                trials.iter().filter_map(|(_, means, _)| means.get(column).copied()).collect();
            (sum(&there) / there.len().max(1) as f64) as f32
        };
        Some(Self { means: (0..width).map(mean).collect() })
    }

    pub(super) fn dims(&self) -> usize {
        self.means.len()
    }

    /// Appends the features of a series with these `means`, as if multiplied by `gain`. A place that was not
    /// reached is like the library's mean, as is a channel that is constant in the library: it has only
    /// one level. `deviations` are the library's.
    pub(super) fn push(&self, means: &[f32], deviations: &[f64], gain: f64, vector: &mut Vec<f32>) {
        let first = vector.len();
        let of_library = self.means.iter().zip(deviations.iter().cycle());
        vector.extend(of_library.zip(means).map(|((mean, deviation), x)| {
            let apart = gain * f64::from(*x) - f64::from(*mean);
            if *deviation > STILL { (apart / deviation).asinh() as f32 } else { 0.0 }
        }));
        vector.resize(first + self.dims(), 0.0);
    }
}

/// Whether places tell surfaces apart: whether the share of the variance that lies between surfaces is
/// greater than after each of [`TURNS`] turns of all trials, as it is by chance once in a hundred times. A
/// series counts less its own mean, divided by its own deviation.
fn tells(trials: &[Placed<'_>], width: usize, channels: usize) -> bool {
    let shapes: Vec<Vec<f64>> = trials
        .iter()
        .map(|(_, means, stats)| {
            let own = stats.means.iter().zip(&stats.deviations).cycle();
            let shape = means.iter().zip(own).map(|(x, (mean, dev))| (f64::from(*x) - mean) / dev);
            shape.chain(std::iter::repeat(0.0)).take(width).collect()
        })
        .collect();
    let (surfaces, classes) = labels::places(trials.iter().map(|(surface, ..)| *surface));
    let mut sizes = vec![0.0; surfaces.len()];
    classes.iter().for_each(|&class| sizes[class] += 1.0);
    let between = |turns: &[usize]| -> f64 {
        let mut sums = vec![vec![0.0; width]; sizes.len()];
        let mut squares = vec![0.0; width];
        for ((shape, &class), &turn) in shapes.iter().zip(&classes).zip(turns) {
            let turned = shape[turn * channels..].iter().chain(&shape[..turn * channels]);
            for ((sum, square), x) in sums[class].iter_mut().zip(&mut squares).zip(turned) {
                *sum += x;
                *square += x * x;
            }
        }
        let share = |column: usize| {
            let total: f64 = sums.iter().map(|of_class| of_class[column]).sum();
            let of_mean = total * total / shapes.len() as f64;
            let of_classes =
                sums.iter().zip(&sizes).map(|(sums, size)| sums[column].powi(2) / size);
            (of_classes.sum::<f64>() - of_mean) / (squares[column] - of_mean).max(1e-12)
        };
        (0..width).map(share).sum()
    };
    let here = between(&vec![0; shapes.len()]);
    let places = (width / channels) as f64;
    (0..TURNS).into_par_iter().all(|number| {
        let mut rng = seed::rng(number, &[b"turns"]);
        let turns: Vec<usize> =
            shapes.iter().map(|_| (seed::uniform(&mut rng) * places) as usize).collect();
        between(&turns) < here
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::library::Library;
    use crate::recognise::{MethodName, MethodSpec};
    use crate::scene::SourceId;
    use crate::trial::{Series, Trial, TrialKey};

    const SAMPLES: usize = 28;

    fn source() -> SourceId {
        SourceId::new("ir").unwrap()
    }

    fn noise(i: usize, salt: usize) -> f32 {
        let mixed = ((i + 1) ^ (salt + 7) << 9).wrapping_mul(2_654_435_761) as u32;
        (mixed >> 16) as f32 / 65_536.0 - 0.5
    }

    /// A spectrum with a peak at a wavelength of its surface, turned round by `turn` samples.
    fn spectrum(surface: usize, number: usize, turn: usize) -> (TrialKey, Series) {
        let value = |i: usize| {
            let at = (i + turn) % SAMPLES;
            let peak = (-((at as f32 - 6.0 - 5.0 * surface as f32) / 1.5).powi(2)).exp();
            peak + 0.2 * noise(at, 100 * surface + number)
        };
        let series = Series::new(4.0, 1, (0..SAMPLES).map(value).collect()).unwrap();
        let key = TrialKey::new(["oak", "pine", "yew"][surface], "expert", number as u32);
        (key, series)
    }

    fn right(turn: impl Fn(usize) -> usize) -> usize {
        let all = (0..3).flat_map(|surface| (1..=8).map(move |number| (surface, number)));
        let of = |(surface, number): (usize, usize)| {
            spectrum(surface, number, turn(31 * surface + 7 * number))
        };
        let library = Library::of_series(&source(), None, all.map(of)).unwrap();
        let model = MethodSpec::from(MethodName::Embedding).fit(&library).unwrap();
        let queries = (0..3).flat_map(|surface| (11..=20).map(move |number| (surface, number)));
        queries
            .filter(|&(surface, number)| {
                let (key, series) = of((surface, number));
                let truth = key.surface.clone();
                let query = Trial::of_series(key, source(), series);
                model.rank_trial(query).unwrap().surface() == truth
            })
            .count()
    }

    #[test]
    fn spectra_are_told_apart_by_where_their_peaks_are() {
        assert_eq!(right(|_| 0), 30);
        assert!(right(|salt| salt % SAMPLES) < 24, "nothing else tells them apart");
    }

    #[test]
    fn a_place_that_was_not_reached_is_like_the_library() {
        let embedder = PlaceEmbedder { means: vec![1.0, 5.0, 2.0, 6.0] };
        let mut features = Vec::new();
        embedder.push(&[1.5, 9.0], &[0.5, 0.0], 1.0, &mut features);
        assert_eq!(features, [1f64.asinh() as f32, 0.0, 0.0, 0.0]);
    }
}
