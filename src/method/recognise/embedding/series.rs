//! Turns a series, a copy or a beginning into a vector (README §4): Fourier features of its
//! log-band frames, moments, quantiles and lag covariance. Features that depend on loudness occur in
//! shape (relative to the series' own level) and in level. The means of channels join them, except
//! where a source is compared in only part of its spectrum ([`crate::features::passed`]).

use std::borrow::Cow;

use multiversion::multiversion;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::eigen::{EigenPairs, push_upper};
use super::places::{PlaceEmbedder, STILL};
use super::view::ViewEmbedder;
use crate::features::counts::Counts;
use crate::features::frames::SeriesFrames;
use crate::features::growing::Piece;
use crate::features::moments::{LOUDNESS, MOMENTS, MOST_LAGGED, Moments, Statistics};
use crate::features::packed::PackedFrames;
use crate::features::quantiles::QUANTILES;
use crate::features::views::SourceViews;
use crate::features::windowed_frames::{FrameView, ln};
use crate::recognise::rank::median;
use crate::trial::usual_rests;

/// Lags in samples; the joint covariance is of the series shifted by each of them.
const LAGS: [usize; 3] = [0, 1, 3];

/// Series of fewer samples have no quantiles: the frames say more of them.
const FEWEST_RANKED: f64 = 64.0;

/// Steps count as this many times as large before the inverse hyperbolic sine.
const STEP_GAIN: f64 = 4.0;

/// Added to the eigenvalues of the covariance, in units of the library's variance.
const RIDGE: f64 = 1e-3;

/// Correlations are clipped to ± this value before their inverse hyperbolic tangent.
const MOST_CORRELATED: f64 = 0.99;

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct SeriesEmbedder {
    pub views: SourceViews,
    frames: [ViewEmbedder; 2],
    /// Median over a library of the standard deviation of each channel.
    deviations: Vec<f64>,
    /// Whether the library's median trial is long enough for quantiles.
    ranked: bool,
    /// The course of a series, if it says something about the surface.
    places: Option<PlaceEmbedder>,
    /// Share of time that each channel rests in the library ([`usual_rests`]).
    pub rests: Vec<f32>,
}

impl SeriesEmbedder {
    /// Takes means and deviations from `trials` of a library, at least one, with the surface of each.
    pub(super) fn new(trials: &[(&str, &SeriesFrames)]) -> Self {
        let views = trials[0].1.views.clone();
        let embedder = |view: usize| {
            let counts: Vec<Counts> = (trials.par_iter())
                .map(|(_, trial)| counted(&views.frames[view], &trial.whole.frames[view]))
                .collect();
            ViewEmbedder::new(&counts)
        };
        let frames = [embedder(0), embedder(1)];
        let all: Vec<Statistics> = (trials.iter())
            .map(|(_, trial)| trial.whole.moments.statistics(views.moments_hz(), 0.0))
            .collect();
        let deviation = |c: usize| median(all.iter().map(|stats| stats.deviations[c]).collect());
        let length = median(trials.iter().map(|(_, trial)| trial.samples as f64).collect());
        let deviations = (0..views.channels()).map(deviation).collect();
        let places = views.places.and_then(|places| {
            let placed = trials.iter().zip(&all);
            let placed = placed
                .map(|((surface, trial), stats)| (*surface, trial.whole.places.as_slice(), stats));
            PlaceEmbedder::new(places, views.channels(), &placed.collect::<Vec<_>>())
        });
        let rests: Vec<&[f32]> = trials.iter().map(|(_, trial)| trial.rests.as_slice()).collect();
        Self {
            frames,
            deviations,
            places,
            ranked: length >= FEWEST_RANKED,
            rests: usual_rests(&rests),
            views,
        }
    }

    /// Whether a channel is constant in the library and compared by its level, like a switch.
    pub(super) fn has_switch(&self) -> bool {
        !self.views.passed && self.deviations.iter().any(|deviation| *deviation <= STILL)
    }

    fn channels(&self) -> usize {
        self.deviations.len()
    }

    /// The lags of the covariance.
    fn lags(&self) -> &'static [usize] {
        if self.channels() > MOST_LAGGED { &LAGS[..1] } else { &LAGS }
    }

    pub(super) fn dims(&self) -> usize {
        let channels = self.channels();
        let stacked = self.lags().len() * channels;
        let of_channel = usize::from(!self.views.passed)
            + MOMENTS
            + LOUDNESS.len()
            + if self.ranked { 2 * QUANTILES } else { 0 };
        self.frames[0].dims()
            + self.frames[1].dims()
            + of_channel * channels
            + self.places.as_ref().map_or(0, PlaceEmbedder::dims)
            + stacked * (stacked + 1) / 2
            + channels * channels.saturating_sub(1) / 2
    }

    /// The vector of a series or a copy, as if multiplied by a gain of e^`ln_gain`. `places` are the
    /// means of its places. `moments_hz` is [`SourceViews::moments_hz`].
    pub(super) fn embed(
        &self,
        piece: &Piece,
        places: &[f32],
        moments_hz: f64,
        ln_gain: f64,
    ) -> Vec<f32> {
        let counts = [0, 1].map(|view| counted(&self.views.frames[view], &piece.frames[view]));
        self.vector(counts.each_ref(), &piece.moments, places, moments_hz, ln_gain)
    }

    /// The vector of the beginning of a series, from the sums of its complete frames. `end` holds the
    /// frames after these.
    pub(super) fn growing(&self, sums: &[Counts; 2], end: &Piece, moments_hz: f64) -> Vec<f32> {
        let counts = [0, 1].map(|view| {
            let mut all = Cow::Borrowed(&sums[view]);
            let after = end.frames[view].values();
            if !after.is_empty() {
                all.to_mut().add(&after);
            }
            all
        });
        let counts = counts.each_ref().map(AsRef::as_ref);
        self.vector(counts, &end.moments, &end.places, moments_hz, 0.0)
    }

    /// The vector of a series, or of a part of it. `counts` holds the frames of each view.
    fn vector(
        &self,
        counts: [&Counts; 2],
        moments: &Moments,
        places: &[f32],
        moments_hz: f64,
        ln_gain: f64,
    ) -> Vec<f32> {
        let mut vector = Vec::with_capacity(self.dims());
        for (embedder, counts) in self.frames.iter().zip(counts) {
            embedder.push(counts, ln_gain, &mut vector);
        }
        let stats = moments.statistics(moments_hz, ln_gain);
        if !self.views.passed {
            let means = stats.means.iter().zip(&self.deviations);
            vector.extend(means.map(|(mean, deviation)| (mean / deviation).asinh() as f32));
        }
        vector.extend(stats.moments.iter().map(|&x| x as f32));
        let gain = self.ln_gain(&stats);
        for of_channel in stats.moments.chunks_exact(MOMENTS) {
            vector.extend(LOUDNESS.map(|at| (of_channel[at] - gain) as f32));
        }
        if self.ranked {
            let of_channels = stats.quantiles.chunks_exact(2 * QUANTILES).zip(&self.deviations);
            for (quantiles, deviation) in of_channels {
                let (values, steps) = quantiles.split_at(QUANTILES);
                vector.extend(values.iter().map(|x| (x / deviation).asinh() as f32));
                vector.extend(steps.iter().map(|x| (STEP_GAIN * x / deviation).asinh() as f32));
            }
        }
        if let Some(embedder) = &self.places {
            embedder.push(places, &self.deviations, ln_gain.exp(), &mut vector);
        }
        self.push_covariance(&stats, &mut vector);
        // Statistics of samples far beyond full scale may overflow; such features are set to 0.
        vector.iter_mut().filter(|x| !x.is_finite()).for_each(|x| *x = 0.0);
        vector
    }

    /// ln of the gain of a series over the library: the mean over channels that vary in both.
    fn ln_gain(&self, stats: &Statistics) -> f64 {
        let louder: Vec<f64> = (stats.deviations.iter().zip(&self.deviations))
            .filter(|(own, library)| **own > STILL && **library > STILL)
            .map(|(own, library)| (own / library).ln())
            .collect();
        louder.iter().sum::<f64>() / louder.len().max(1) as f64
    }

    /// Appends the upper triangle of ln(C + RIDGE·I), so that distances are log-Euclidean (Arsigny et
    /// al. 2006). C is the covariance of (x̃_t, x̃_{t−1}, x̃_{t−3}), and x̃ is x divided by the
    /// library's deviation. Then appends the atanh of the correlations between channels.
    fn push_covariance(&self, stats: &Statistics, vector: &mut Vec<f32>) {
        let (channels, lags) = (self.channels(), self.lags());
        let size = lags.len() * channels;
        let entry = |row: usize, column: usize| {
            let ((a, i), (b, j)) =
                ((row / channels, row % channels), (column / channels, column % channels));
            let lag = lags[b].abs_diff(lags[a]);
            let (later, earlier) = if lags[a] <= lags[b] { (i, j) } else { (j, i) };
            let covariance = stats.covariances[lag][later * channels + earlier];
            covariance / (self.deviations[i] * self.deviations[j])
        };
        let places = (0..size * size).map(|at| (at / size, at % size));
        let both = |(row, column)| 0.5 * (entry(row, column) + entry(column, row));
        let matrix = places.map(both).collect();
        let log = EigenPairs::new(matrix, size, RIDGE).map(|x| (x.max(0.0) + RIDGE).ln());
        push_upper(&log, size, vector);
        let pairs = (0..channels).flat_map(|i| (i + 1..channels).map(move |j| (i, j)));
        let correlation = |(i, j): (usize, usize)| {
            stats.covariances[0][i * channels + j] / (stats.deviations[i] * stats.deviations[j])
        };
        push_atanh(&pairs.map(correlation).collect::<Vec<_>>(), vector);
    }
}

/// Appends the atanh of correlations, at most that of [`MOST_CORRELATED`].
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn push_atanh(correlations: &[f64], vector: &mut Vec<f32>) {
    let first = vector.len();
    vector.resize(first + correlations.len(), 0.0);
    let out = &mut vector[first..];
    for i in 0..out.len().min(correlations.len()) {
        let x = correlations[i].clamp(-MOST_CORRELATED, MOST_CORRELATED);
        out[i] = (0.5 * ln((1.0 + x) / (1.0 - x))) as f32;
    }
}

fn counted(view: &FrameView, frames: &PackedFrames) -> Counts {
    let mut counts = Counts::new(view.channels, view.width());
    counts.add(&frames.values());
    counts
}
