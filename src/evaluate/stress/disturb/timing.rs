//! Time that is lost, stretched or cut short.

use super::setting::{Setting, analog, drag, each_series, replace, slow as in_time};
use crate::seed::uniform;
use crate::trial::{Series, Trial};

/// Length of a gap in the line, in s.
const GAP_S: f64 = 0.05;

/// A share of the samples lost one by one, exactly that many; what follows moves up.
pub fn dropped(trial: &mut Trial, setting: &mut Setting<'_>) {
    each_series(trial, setting, drag, |_, series, rng, share| {
        let mut left = series.frames();
        let mut wanted = ((1.0 - share) * left as f64).round() as usize;
        // Selection sampling (Knuth, The Art of Computer Programming 2, 3.4.2, algorithm S).
        let keep = |_: &&[f32]| {
            let keep = uniform(rng) * (left as f64) < wanted as f64;
            left -= 1;
            wanted -= usize::from(keep);
            keep
        };
        let frames = series.samples().chunks_exact(series.channels());
        let kept = frames.filter(keep).flatten().copied().collect();
        replace(series, kept);
    });
}

/// A share of the time lost in pieces of 50 ms, for which the last value is held.
pub fn gaps(trial: &mut Trial, setting: &mut Setting<'_>) {
    each_series(trial, setting, drag, |_, series, rng, share| {
        let (channels, piece) = (series.channels(), (GAP_S * series.rate_hz()).ceil() as usize);
        let mut samples = series.samples().to_vec();
        for start in (piece..series.frames()).step_by(piece.max(1)) {
            if uniform(rng) < share {
                let end = (start + piece).min(series.frames());
                let held = samples[(start - 1) * channels..start * channels].to_vec();
                for frame in samples[start * channels..end * channels].chunks_exact_mut(channels) {
                    frame.copy_from_slice(&held);
                }
            }
        }
        replace(series, samples);
    });
}

/// A clock that is wrong by the level, in per cent: pitch and length change.
pub fn clock(trial: &mut Trial, setting: &mut Setting<'_>) {
    each_series(trial, setting, analog, |_, series, _, percent| {
        stretch(series, 1.0 + percent / 100.0);
    });
}

/// Only the first seconds of the drag.
pub fn short(trial: &mut Trial, setting: &mut Setting<'_>) {
    each_series(trial, setting, drag, |_, series, _, seconds| {
        let frames = (seconds * series.rate_hz()).round() as usize;
        *series = series.crop(0, frames);
    });
}

/// A hand that moves slower by a factor, the level, in a scan no longer than before: neighbouring samples
/// are that much closer than T*.
pub fn slow(trial: &mut Trial, setting: &mut Setting<'_>) {
    each_series(trial, setting, in_time, |_, series, _, factor| {
        let frames = series.frames();
        *series = series.crop(0, (frames as f64 / factor).ceil() as usize);
        stretch(series, 1.0 / factor);
        *series = series.crop(0, frames);
    });
}

/// Reads a series `pace` times as fast, by linear interpolation.
pub(super) fn stretch(series: &mut Series, pace: f64) {
    let channels = series.channels();
    let frames = ((series.frames() as f64 / pace).floor() as usize).max(1);
    let from = series.samples();
    let last = series.frames() - 1;
    let mut samples = Vec::with_capacity(frames * channels);
    for i in 0..frames {
        let at = (i as f64 * pace).min(last as f64);
        let before = (at as usize).min(last);
        let (after, part) = ((before + 1).min(last), (at - before as f64) as f32);
        for channel in 0..channels {
            let (a, b) = (from[before * channels + channel], from[after * channels + channel]);
            samples.push(a + part * (b - a));
        }
    }
    replace(series, samples);
}
