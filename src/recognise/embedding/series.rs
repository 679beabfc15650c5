//! A series, or a window of it, as a vector (method §9): Fourier features of its log-band frames,
//! moments, lag covariance.
//!
//! Moments and lag covariance see all frequencies. They are left out where a source is compared by
//! a part of its spectrum alone: what a configuration excludes must not come in by another way.
//!
//! Everything is a mean over frames or a sum over blocks, so that windows of one trial share their
//! work, and a scan that grows is looked at in constant time.

use std::ops::Range;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::fourier::{BAND_FEATURES, BandScale};
use super::library_scale::band_scale;
use super::linear::log_symmetric;
use super::view_sums::ViewSums;
use crate::recognise::features::frame_features::{SeriesFrames, SourceViews};
use crate::recognise::features::window_sums::{MOMENTS, WindowStatistics, WindowSums};

/// Lags in samples that the covariance stacks.
const LAGS: [usize; 3] = [0, 1, 3];

/// Added to the variances of the covariance, in the library's.
const RIDGE: f64 = 1e-3;

/// Correlations are held within this before their inverse hyperbolic tangent is taken.
const MOST_CORRELATED: f64 = 0.99;

/// What a constant channel's deviation is said to be.
const STILL: f64 = 1e-9;

/// Places among [`MOMENTS`] of ln deviation and ln drift, which a gain moves.
const LOUDNESS: [usize; 2] = [0, 8];

/// A part of a trial.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Window {
    /// All of it.
    Whole,
    /// From one share of its length, another share of it.
    Share {
        /// where it begins, 0 to 1
        from: f64,
        /// how long it is, 0 to 1
        length: f64,
    },
    /// The first seconds.
    Beginning(f64),
}

/// What of a series' level is compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Level {
    /// Its mean and its loudness: alignment is off.
    Mean,
    /// Its loudness: the mean is taken off (Eq. 8 in the time domain).
    Loudness,
    /// Neither: the mean of log levels is taken off, too (Eq. 8 in the spectral domain), so that
    /// gain and force count for nothing.
    Shape,
}

/// How the series of one source become vectors.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct SeriesEmbedder {
    pub views: SourceViews,
    scales: [BandScale; 2],
    /// Mean over a library of the mean ln power of each channel, one list a view.
    levels: [Vec<f64>; 2],
    /// Median over a library of the deviation of each channel.
    deviations: Vec<f64>,
    level: Level,
    /// Whether moments and lag covariance are features.
    all_frequencies: bool,
}

/// What a window of a series adds up to.
#[derive(Clone, Debug)]
pub(super) struct SeriesSums {
    /// One a view.
    views: [ViewSums; 2],
    /// Sums over blocks.
    pub blocks: WindowSums,
}

impl SeriesSums {
    /// Number of frames of a view.
    pub fn frames(&self, view: usize) -> usize {
        self.views[view].frames()
    }
}

impl SeriesEmbedder {
    /// In units of some trials of a library, at least one.
    /// `all_frequencies` says whether the source is compared by all there are.
    pub fn new(trials: &[&SeriesFrames], level: Level, all_frequencies: bool) -> Self {
        let views = trials[0].views.clone();
        let channels = views.0[0].channels;
        let [(long, of_long), (short, of_short)] =
            [0, 1].map(|view| band_scale(trials, view, level == Level::Shape));
        let of_trial = |trial: &&SeriesFrames| {
            let sums = trial.blocks.window(0..trial.blocks.blocks());
            sums.statistics(trial.rate_hz()).deviations
        };
        let all: Vec<Vec<f64>> = trials.par_iter().map(of_trial).collect();
        let median = |c: usize| {
            let mut of_channel: Vec<f64> = all.iter().map(|d| d[c]).collect();
            of_channel.sort_by(f64::total_cmp);
            of_channel[of_channel.len() / 2]
        };
        Self {
            deviations: (0..channels).map(median).collect(),
            levels: [of_long, of_short],
            scales: [long, short],
            views,
            level,
            all_frequencies,
        }
    }

    /// Whether a channel moves in most trials of the library.
    pub fn moves(&self, channel: usize) -> bool {
        self.deviations.get(channel).is_none_or(|&deviation| deviation > 2.0 * STILL)
    }

    fn channels(&self) -> usize {
        self.deviations.len()
    }

    /// Length of a vector.
    pub fn dims(&self) -> usize {
        let channels = self.channels();
        let bands: usize = self.views.0.iter().map(|view| view.width()).sum();
        if !self.all_frequencies {
            return BAND_FEATURES * bands;
        }
        let stacked = LAGS.len() * channels;
        BAND_FEATURES * bands
            + (MOMENTS.len() + usize::from(self.level == Level::Mean)) * channels
            + stacked * (stacked + 1) / 2
            + channels * (channels - 1) / 2
    }

    /// Sums without a frame or a block.
    pub fn no_sums(&self) -> SeriesSums {
        let view = |v: usize| ViewSums::new(self.channels(), self.views.0[v].width());
        SeriesSums { views: [view(0), view(1)], blocks: WindowSums::new(self.channels()) }
    }

    /// Adds frames of one view, as ln power.
    pub fn add_frames(&self, sums: &mut SeriesSums, view: usize, values: &[f32]) {
        sums.views[view].add(&self.scales[view], values);
    }

    /// The vectors of some windows of a trial.
    pub fn embed(&self, series: &SeriesFrames, windows: &[Window]) -> Vec<Vec<f32>> {
        let blocks: Vec<Range<usize>> =
            windows.iter().map(|window| blocks_of(series, *window)).collect();
        let [long, short] = [0, 1].map(|view| self.view_sums(series, view, &blocks));
        let none = || WindowSums::new(self.channels());
        let sums = sums_of(&blocks, none, |sums, blocks| series.blocks.add_to(sums, blocks));
        let of_window = |((long, short), blocks)| {
            let sums = SeriesSums { views: [long, short], blocks };
            self.vector(&sums, series.blocks.reference(), series.rate_hz())
        };
        long.into_iter().zip(short).zip(sums).map(of_window).collect()
    }

    /// Sums of one view over each window. Each frame is worked on once, however many windows hold
    /// it.
    fn view_sums(
        &self,
        series: &SeriesFrames,
        view: usize,
        windows: &[Range<usize>],
    ) -> Vec<ViewSums> {
        let ranges: Vec<Range<usize>> =
            windows.iter().map(|blocks| frames_of(series, view, blocks)).collect();
        let mut ends: Vec<usize> = ranges.iter().flat_map(|r| [r.start, r.end]).collect();
        ends.sort_unstable();
        ends.dedup();
        let width = self.views.0[view].width();
        let none = || ViewSums::new(self.channels(), width);
        let mut values = Vec::new();
        let mut of_piece = |piece: &[usize]| {
            let holds = |r: &Range<usize>| r.start <= piece[0] && piece[1] <= r.end;
            ranges.iter().any(holds).then(|| {
                series.frames[view].unpack(width, piece[0]..piece[1], &mut values);
                let mut sums = none();
                sums.add(&self.scales[view], &values);
                sums
            })
        };
        let pieces: Vec<Option<ViewSums>> = ends.windows(2).map(&mut of_piece).collect();
        sums_of(&ranges, none, |sums, frames| {
            let within = ends.iter().zip(&pieces).filter(|(begin, _)| frames.contains(begin));
            within.filter_map(|(_, piece)| piece.as_ref()).for_each(|piece| sums.join(piece));
        })
    }

    /// The vector of what a window adds up to; `reference` is that of its blocks.
    pub fn vector(&self, sums: &SeriesSums, reference: &[f32], rate_hz: f64) -> Vec<f32> {
        let mut vector = Vec::with_capacity(self.dims());
        for (v, of_view) in sums.views.iter().enumerate() {
            let bands = self.views.0[v].bands();
            let of_view = of_view.on_surface();
            let shift = |channel: usize| match self.level {
                Level::Shape => of_view.level(channel) - self.levels[v][channel],
                Level::Mean | Level::Loudness => 0.0,
            };
            let shifts: Vec<f64> = (0..self.channels()).map(shift).collect();
            let shift = |band: usize| shifts[band / bands];
            vector.extend(self.scales[v].shifted_means(&of_view.bands, of_view.frames, shift));
        }
        if !self.all_frequencies {
            return vector;
        }
        let stats = sums.blocks.statistics(rate_hz);
        let gain = self.ln_gain(&stats);
        for of_channel in stats.moments.chunks_exact(MOMENTS.len()) {
            let value = |(i, x): (usize, &f64)| if LOUDNESS.contains(&i) { x - gain } else { *x };
            vector.extend(of_channel.iter().enumerate().map(|x| value(x) as f32));
        }
        if self.level == Level::Mean {
            vector.extend(stats.means.iter().zip(reference).map(|(m, r)| *m as f32 + r));
        }
        self.push_covariance(&stats, gain, &mut vector);
        vector
    }

    /// By how much the window is louder than the library, over all channels: what is taken off
    /// where loudness counts for nothing.
    fn ln_gain(&self, stats: &WindowStatistics) -> f64 {
        if self.level != Level::Shape {
            return 0.0;
        }
        let louder = |(own, library): (&f64, &f64)| (own / library).ln();
        stats.deviations.iter().zip(&self.deviations).map(louder).sum::<f64>()
            / self.channels() as f64
    }

    /// Upper triangle of ln(Cov + RIDGE·I), Cov of (x̃_t, x̃_{t−1}, x̃_{t−3}) with x̃ = x over the
    /// library's deviation, off-diagonal entries times √2, so that the squared distance is that of
    /// the log-Euclidean metric (Arsigny et al. 2006); then atanh of the channels' correlations.
    fn push_covariance(&self, stats: &WindowStatistics, ln_gain: f64, vector: &mut Vec<f32>) {
        let channels = self.channels();
        let size = LAGS.len() * channels;
        let power = (2.0 * ln_gain).exp();
        let entry = |row: usize, column: usize| {
            let ((a, i), (b, j)) =
                ((row / channels, row % channels), (column / channels, column % channels));
            let lag = LAGS[b].abs_diff(LAGS[a]);
            let (later, earlier) = if LAGS[a] <= LAGS[b] { (i, j) } else { (j, i) };
            let covariance = stats.covariances[lag][later * channels + earlier];
            covariance / (self.deviations[i] * self.deviations[j] * power)
        };
        let mut matrix = vec![0.0; size * size];
        for row in 0..size {
            for column in 0..size {
                let mean = 0.5 * (entry(row, column) + entry(column, row));
                matrix[row * size + column] = mean + if row == column { RIDGE } else { 0.0 };
            }
        }
        let log = log_symmetric(matrix, size);
        for row in 0..size {
            for column in row..size {
                let factor = if row == column { 1.0 } else { std::f64::consts::SQRT_2 };
                vector.push((factor * log[row * size + column]) as f32);
            }
        }
        for i in 0..channels {
            for j in i + 1..channels {
                let scale = stats.deviations[i] * stats.deviations[j];
                let correlation = stats.covariances[0][i * channels + j] / scale;
                vector.push(correlation.clamp(-MOST_CORRELATED, MOST_CORRELATED).atanh() as f32);
            }
        }
    }
}

/// What some ranges add up to; one that begins as another does continues it.
fn sums_of<S: Clone>(
    ranges: &[Range<usize>],
    none: impl Fn() -> S,
    mut add: impl FnMut(&mut S, Range<usize>),
) -> Vec<S> {
    let mut order: Vec<usize> = (0..ranges.len()).collect();
    order.sort_unstable_by_key(|&i| (ranges[i].start, ranges[i].end));
    let mut all = vec![none(); ranges.len()];
    let mut before: Option<usize> = None;
    for i in order {
        let mut missing = ranges[i].clone();
        if let Some(begun) = before.filter(|&b| ranges[b].start == missing.start) {
            all[i] = all[begun].clone();
            missing.start = ranges[begun].end;
        }
        add(&mut all[i], missing);
        before = Some(i);
    }
    all
}

/// The blocks of a window; at least one.
fn blocks_of(series: &SeriesFrames, window: Window) -> Range<usize> {
    let all = series.blocks.blocks();
    let per_block = series.blocks.block() as f64;
    match window {
        Window::Whole => 0..all,
        Window::Share { from, length } => {
            let blocks = |share: f64| (share * series.samples as f64 / per_block).round() as usize;
            // Two blocks hold one long frame.
            let wanted = blocks(length).max(2).min(all);
            let first = blocks(from).min(all - wanted);
            first..first + wanted
        }
        Window::Beginning(seconds) => {
            let blocks = (seconds * series.rate_hz() / per_block + 1e-9) as usize;
            0..blocks.clamp(1, all)
        }
    }
}

/// The frames of a view that lie within some blocks; at least one.
fn frames_of(series: &SeriesFrames, view: usize, blocks: &Range<usize>) -> Range<usize> {
    let views = &series.views.0;
    let frames = series.frames[view].frames(views[view].width());
    if *blocks == (0..series.blocks.blocks()) {
        return 0..frames;
    }
    // A frame is two hops long: the one that begins a hop before the end ends beyond it.
    let hops = views[0].hop() / views[view].hop();
    let first = (hops * blocks.start).min(frames - 1);
    let last = (hops * blocks.end - 1).min(frames);
    first..last.max(first + 1)
}
