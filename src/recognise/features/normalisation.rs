//! Where the values of a library lie and how far they spread: the units in which `embedding`
//! measures. Taken from library trials alone.

use super::decimated::{DecimatedGroup, DecimatedSeries};
use super::frame_features::Framed;
use super::image_features::{Part, PixelGroup, pixel_pairs};

/// Spread of values per median of absolute deviations, for normal ones.
const PER_MAD: f32 = 1.4826;

/// Values of one quantity that a median is taken of, at most (about).
const ENOUGH: usize = 20_000;

/// Scale of one view of a spectrum.
#[derive(Clone, Debug)]
pub struct ViewScale {
    /// Median of each column.
    pub centre: Vec<f32>,
    /// Spread of each channel: the median over its bands.
    pub spread: Vec<f32>,
    /// Median over trials of the mean power of each channel: what "as loud as the library" means.
    pub power: Vec<f32>,
}

/// Centre and spread of one coordinate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    /// Median.
    pub centre: f32,
    /// Robust standard deviation; never 0.
    pub spread: f32,
}

/// Scales of one source.
#[derive(Clone, Debug)]
pub enum SourceScale {
    /// View by view.
    Bands(Vec<ViewScale>),
    /// For each group of [`DecimatedSeries::groups`], both coordinates.
    Slow(Vec<[Spread; 2]>),
    /// For each group of [`PixelGroup::ALL`], both coordinates.
    Pixels(Vec<[Spread; 2]>),
}

impl SourceScale {
    /// The scales of a source over a library, each trial aligned as a whole if `align` says so.
    ///
    /// # Panics
    /// Without a trial.
    pub fn new(trials: &[&Framed], align: bool) -> Self {
        match trials[0] {
            Framed::Bands(views) => {
                let view = |v| view_scale(trials, v, align);
                Self::Bands((0..views.len()).map(view).collect())
            }
            Framed::Slow(series) => Self::Slow(slow_scale(trials, series.channels.len(), align)),
            Framed::Pixels(_) => Self::Pixels(pixel_scale(trials)),
        }
    }
}

fn view_scale(trials: &[&Framed], v: usize, align: bool) -> ViewScale {
    let views: Vec<_> = trials
        .iter()
        .filter_map(|framed| match framed {
            Framed::Bands(views) => Some(&views[v]),
            _ => None,
        })
        .collect();
    let view = &views[0].view;
    let (width, bands) = (view.width(), view.bands());
    let shifts: Vec<f32> =
        views.iter().map(|f| if align { mean(&f.values) } else { 0.0 }).collect();
    let frames: usize = views.iter().map(|f| f.frames()).sum();
    let every = frames.div_ceil(ENOUGH).max(1);
    let (mut centre, mut mads) = (Vec::with_capacity(width), Vec::with_capacity(width));
    for column in 0..width {
        let mut values: Vec<f32> = (views.iter().zip(&shifts))
            .flat_map(|(f, shift)| {
                f.values[column..].iter().step_by(width * every).map(move |x| x - shift)
            })
            .collect();
        let middle = median(&mut values);
        values.iter_mut().for_each(|x| *x = (*x - middle).abs());
        centre.push(middle);
        mads.push(PER_MAD * median(&mut values));
    }
    let spread = mads.chunks_mut(bands).map(|of_channel| median(of_channel).max(1e-3)).collect();
    let power = (0..view.channels).map(|c| {
        let of_trial = |f: &&super::frames::ViewFrames| {
            let rows = f.values.chunks_exact(width);
            let sum: f64 = rows
                .flat_map(|row| &row[c * bands..(c + 1) * bands])
                .map(|&a| f64::from(a).exp())
                .sum();
            (sum / (f.frames() * bands) as f64).min(1e30) as f32
        };
        median(&mut views.iter().map(of_trial).collect::<Vec<_>>())
    });
    ViewScale { centre, spread, power: power.collect() }
}

fn slow_scale(trials: &[&Framed], channels: usize, align: bool) -> Vec<[Spread; 2]> {
    let series: Vec<&DecimatedSeries> = trials
        .iter()
        .filter_map(|framed| if let Framed::Slow(series) = framed { Some(series) } else { None })
        .collect();
    let each = (ENOUGH / series.len()).max(64);
    let of = |group: DecimatedGroup| {
        let (mut first, mut second) = (Vec::new(), Vec::new());
        for one in &series {
            let means = group_means(one, group, 0..one.len(), align);
            one.pairs(group, 0..one.len(), each, |a, b| {
                first.push(a - means[0]);
                second.push(b - means[1]);
            });
        }
        [robust(first), robust(second)]
    };
    DecimatedSeries::groups(channels).into_iter().map(of).collect()
}

/// What alignment takes off both coordinates of a group: the means of the channels over the
/// window. Increments have no mean to take off.
pub fn group_means(
    series: &DecimatedSeries,
    group: DecimatedGroup,
    within: std::ops::Range<usize>,
    align: bool,
) -> [f32; 2] {
    match group {
        _ if !align => [0.0; 2],
        DecimatedGroup::Lag(c, _) => [series.mean(c, within), 0.0],
        DecimatedGroup::Cross(a, b) => [series.mean(a, within.clone()), series.mean(b, within)],
    }
}

fn pixel_scale(trials: &[&Framed]) -> Vec<[Spread; 2]> {
    let every = trials.len().div_ceil(32);
    let cells: Vec<_> = (trials.iter().step_by(every))
        .filter_map(|framed| match framed {
            Framed::Pixels(grid) => Some(grid.cells(Part::Whole)),
            _ => None,
        })
        .collect();
    let of = |group: PixelGroup| {
        let (mut first, mut second) = (Vec::new(), Vec::new());
        for cells in &cells {
            pixel_pairs(cells, group, |a, b, _| {
                first.push(a);
                second.push(b);
            });
        }
        [robust(first), robust(second)]
    };
    PixelGroup::ALL.into_iter().map(of).collect()
}

/// Median and robust standard deviation; where more than half the values are equal, the plain
/// standard deviation; where all are, 1.
fn robust(mut values: Vec<f32>) -> Spread {
    let centre = median(&mut values);
    values.iter_mut().for_each(|x| *x -= centre);
    let square = |x: &f32| f64::from(*x).powi(2);
    let squares: f64 = values.iter().map(square).sum::<f64>() / values.len().max(1) as f64;
    values.iter_mut().for_each(|x| *x = x.abs());
    let spread = match (PER_MAD * median(&mut values), squares.sqrt() as f32) {
        (mad, _) if mad > 0.0 => mad,
        (_, deviation) if deviation > 0.0 => deviation,
        _ => 1.0,
    };
    Spread { centre, spread }
}

/// The median of some values (the upper one of an even number); 0 without any. Reorders them.
pub fn median(values: &mut [f32]) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

/// Mean in f64.
pub fn mean(values: &[f32]) -> f32 {
    (values.iter().map(|&x| f64::from(x)).sum::<f64>() / values.len().max(1) as f64) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spread_is_never_zero() {
        assert_eq!(robust(vec![3.0; 9]), Spread { centre: 3.0, spread: 1.0 });
        assert_eq!(robust(Vec::new()).spread, 1.0);
        let switch: Vec<f32> = (0..100).map(|i| if i < 80 { 0.0 } else { 1.0 }).collect();
        assert!((robust(switch).spread - 0.2f32.sqrt()).abs() < 1e-6);
        assert!((robust((0..1001).map(|i| i as f32).collect()).spread - 370.65).abs() < 0.1);
    }
}
