//! The units in which a library's bands are compared.

use rayon::prelude::*;

use super::fourier::BandScale;
use super::view_sums::on_surface;
use crate::recognise::features::frame_features::SeriesFrames;

/// Mean and deviation of each band over all frames of a library, and the mean level of each channel;
/// of trials each brought to that level, where they are `aligned`.
pub(super) fn band_scale(
    trials: &[&SeriesFrames],
    view: usize,
    aligned: bool,
) -> (BandScale, Vec<f64>) {
    let (width, channels) = (trials[0].views.0[view].width(), trials[0].views.0[view].channels);
    let bands = width / channels;
    let of_trial = |trial: &&SeriesFrames| {
        let mut values = Vec::new();
        trial.frames[view].unpack(width, 0..trial.frames[view].frames(width), &mut values);
        let values = on_surface(&values, width);
        let frames = values.len() / width;
        let (mut sums, mut squares) = (vec![0f64; width], vec![0f64; width]);
        for row in values.chunks_exact(width) {
            for ((sum, square), &x) in sums.iter_mut().zip(&mut squares).zip(row) {
                *sum += f64::from(x);
                *square += f64::from(x) * f64::from(x);
            }
        }
        (sums, squares, frames as f64)
    };
    // In the order of trials, so that rounding does not depend on threads.
    let all: Vec<_> = trials.par_iter().map(of_trial).collect();
    let total = all.iter().map(|(_, _, frames)| frames).sum::<f64>().max(1.0);
    let level_of = |sums: &[f64], channel: usize, frames: f64| {
        sums[channel * bands..(channel + 1) * bands].iter().sum::<f64>() / (frames * bands as f64)
    };
    let level = |channel: usize| {
        let of_trials = all.iter().map(|(sums, _, n)| n * level_of(sums, channel, *n));
        of_trials.sum::<f64>() / total
    };
    let levels: Vec<f64> = (0..channels).map(level).collect();
    let (mut centre, mut deviation) = (Vec::with_capacity(width), Vec::with_capacity(width));
    for band in 0..width {
        let channel = band / bands;
        let (mut sum, mut square) = (0.0, 0.0);
        for (sums, squares, n) in &all {
            let shift = if aligned { level_of(sums, channel, *n) - levels[channel] } else { 0.0 };
            sum += sums[band] - n * shift;
            square += squares[band] - 2.0 * shift * sums[band] + n * shift * shift;
        }
        let mean = sum / total;
        centre.push(mean as f32);
        deviation.push((square / total - mean * mean).max(0.0).sqrt() as f32);
    }
    (BandScale::new(centre, &deviation), levels)
}
