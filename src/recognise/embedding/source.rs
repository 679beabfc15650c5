//! One source of a trial, or a window of it, as a vector of Fourier features.

use std::borrow::Cow;

use super::circle::{Columns, HALF_CIRCLE, PAIR_FEATURES, Pairs, column_features};
use crate::recognise::features::decimated::DecimatedSeries;
use crate::recognise::features::frame_features::{Framed, SourceFrames};
use crate::recognise::features::image_features::{Part, PixelGroup, pixel_pairs};
use crate::recognise::features::normalisation::{SourceScale, ViewScale, group_means, median};

/// Pairs of a group that are used, at most.
const ANCHORS: usize = 1024;

/// A part of a trial.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Window {
    /// All of it.
    Whole,
    /// From one time to another, in seconds from its beginning.
    Seconds(f64, f64),
    /// A quarter of a picture.
    Picture(Part),
}

/// How a source becomes a vector.
#[derive(Clone, Debug)]
pub(super) struct SourceEmbedder {
    scale: SourceScale,
    align: bool,
    harmonics: usize,
    /// 1/(P·spread) of each column, view by view.
    per_half_circle: Vec<Vec<f32>>,
}

impl SourceEmbedder {
    pub fn new(scale: SourceScale, align: bool, harmonics: usize) -> Self {
        let per_half_circle = match &scale {
            SourceScale::Bands(views) => views
                .iter()
                .map(|view| {
                    let bands = view.centre.len() / view.spread.len();
                    let each = |s: &f32| std::iter::repeat_n(1.0 / (HALF_CIRCLE * s), bands);
                    view.spread.iter().flat_map(each).collect()
                })
                .collect(),
            _ => Vec::new(),
        };
        Self { scale, align, harmonics, per_half_circle }
    }

    /// Length of a vector, D.
    pub fn dims(&self) -> usize {
        match &self.scale {
            SourceScale::Bands(views) => {
                2 * self.harmonics * views.iter().map(|view| view.centre.len()).sum::<usize>()
            }
            SourceScale::Slow(groups) | SourceScale::Pixels(groups) => PAIR_FEATURES * groups.len(),
        }
    }

    /// The vector of a window. Alignment sees nothing but the window.
    pub fn embed(&self, source: &SourceFrames, window: Window) -> Vec<f32> {
        let mut out = vec![0.0; self.dims()];
        match (&source.data, &self.scale) {
            (Framed::Bands(views), SourceScale::Bands(_)) => {
                let values: Vec<&[f32]> = views.iter().map(|view| &view.values[..]).collect();
                self.embed_bands(source, &values, window, &mut out);
            }
            (Framed::Slow(series), SourceScale::Slow(_)) => {
                self.embed_slow(series, window, &mut out);
            }
            (Framed::Pixels(grid), SourceScale::Pixels(scale)) => {
                let part = if let Window::Picture(part) = window { part } else { Part::Whole };
                let cells = grid.cells(part);
                let mut pairs = Pairs::default();
                for (group, (scale, out)) in PixelGroup::ALL
                    .into_iter()
                    .zip(scale.iter().zip(out.chunks_exact_mut(PAIR_FEATURES)))
                {
                    pairs.clear();
                    let circular = group.circular();
                    let place = |x: f32, which: usize| {
                        if circular[which] {
                            2.0 * (x - x.round())
                        } else {
                            (x - scale[which].centre) / (HALF_CIRCLE * scale[which].spread)
                        }
                    };
                    pixel_pairs(&cells, group, |a, b, saturation| {
                        let weight = if group.by_saturation() { saturation } else { 1.0 };
                        pairs.push(place(a, 0), place(b, 1), weight);
                    });
                    pairs.features(out);
                }
            }
            // The checks of a trial against its scene give a source one kind of data.
            _ => {}
        }
        out
    }

    /// The same of log-band frames with other values in them, one list a view.
    pub fn embed_bands(
        &self,
        source: &SourceFrames,
        values: &[&[f32]],
        window: Window,
        out: &mut [f32],
    ) {
        let (Framed::Bands(views), SourceScale::Bands(scales)) = (&source.data, &self.scale) else {
            return;
        };
        let mut rest = out;
        for (((frames, values), scale), factors) in
            views.iter().zip(values).zip(scales).zip(&self.per_half_circle)
        {
            let width = frames.view.width();
            let used = match window {
                Window::Seconds(from_s, to_s) => {
                    frames.view.frames_within(from_s, to_s, frames.frames())
                }
                _ => 0..frames.frames(),
            };
            let (values, level) = on_surface(&values[used.start * width..used.end * width], scale);
            let shift = if self.align { level } else { 0.0 };
            let (mine, others) = rest.split_at_mut(2 * self.harmonics * width);
            rest = others;
            let columns =
                Columns { values: &values, centre: &scale.centre, per_half_circle: factors, shift };
            column_features(columns, self.harmonics, mine);
        }
    }

    fn embed_slow(&self, series: &DecimatedSeries, window: Window, out: &mut [f32]) {
        let SourceScale::Slow(scales) = &self.scale else { return };
        let within = match window {
            Window::Seconds(from_s, to_s) => series.within(from_s, to_s),
            _ => 0..series.len(),
        };
        let mut pairs = Pairs::default();
        let groups = DecimatedSeries::groups(series.channels.len());
        for ((group, scale), out) in
            groups.into_iter().zip(scales).zip(out.chunks_exact_mut(PAIR_FEATURES))
        {
            pairs.clear();
            let means = group_means(series, group, within.clone(), self.align);
            let factor = scale.map(|s| 1.0 / (HALF_CIRCLE * s.spread));
            let shift = [means[0] + scale[0].centre, means[1] + scale[1].centre];
            series.pairs(group, within.clone(), ANCHORS, |a, b| {
                pairs.push((a - shift[0]) * factor[0], (b - shift[1]) * factor[1], 1.0);
            });
            pairs.features(out);
        }
    }

    /// The power, in the units of frames, that a channel of the library has on the median.
    pub fn power(&self, view: usize, channel: usize) -> f32 {
        match &self.scale {
            SourceScale::Bands(views) => views[view].power[channel],
            _ => 0.0,
        }
    }
}

/// The frames of a window that tell of the surface, and their level: the mean of values − centres.
///
/// Left out is what is quieter than the window's median by half the circle and more: there the
/// stylus had left the surface, or the line held its last value. All bands would lie at the
/// circle's end, and their level would shift all other frames.
fn on_surface<'v>(values: &'v [f32], scale: &ViewScale) -> (Cow<'v, [f32]>, f32) {
    let width = scale.centre.len();
    let of_centre = mean_level(&scale.centre);
    let levels: Vec<f32> =
        values.chunks_exact(width).map(|row| mean_level(row) - of_centre).collect();
    let spread = scale.spread.iter().sum::<f32>() / scale.spread.len() as f32;
    let least = median(&mut levels.clone()) - HALF_CIRCLE * spread;
    let (mut sum, mut kept) = (0f64, 0usize);
    for &level in levels.iter().filter(|level| **level >= least) {
        sum += f64::from(level);
        kept += 1;
    }
    let level = (sum / kept.max(1) as f64) as f32;
    if kept == levels.len() {
        return (Cow::Borrowed(values), level);
    }
    let rows = values.chunks_exact(width).zip(&levels).filter(|(_, level)| **level >= least);
    (Cow::Owned(rows.flat_map(|(row, _)| row).copied().collect()), level)
}

fn mean_level(values: &[f32]) -> f32 {
    values.iter().sum::<f32>() / values.len().max(1) as f32
}

/// Squared distance of two vectors.
pub(super) fn squared_distance(a: &[f32], b: &[f32]) -> f64 {
    let mut total = 0f64;
    for (a, b) in a.chunks(128).zip(b.chunks(128)) {
        let mut lanes = [0f32; 8];
        for (a, b) in a.chunks(8).zip(b.chunks(8)) {
            for ((lane, a), b) in lanes.iter_mut().zip(a).zip(b) {
                *lane += (a - b) * (a - b);
            }
        }
        total += lanes.iter().map(|&x| f64::from(x)).sum::<f64>();
    }
    total
}
