//! Disturbances of one trial: levels, drags, sensors, clocks, noise and pictures.

use std::f64::consts::TAU;

use rand_chacha::ChaCha8Rng;

use super::{ChannelSpread, Touches, change_picture, replace, to_sample};
use crate::scene::SourceSpec;
use crate::seed::{nearly_normal, uniform};
use crate::trial::{Image, Series, Signal, Trial};

/// The amplitude of vibration grows as force to this power.
const FORCE_POWER: f64 = 0.7;

/// Multiplies every analog series by a factor, like a higher gain of all amplifiers.
pub(super) fn gain(x: f64, _: ChannelSpread, factor: f64) -> f64 {
    factor * x
}

/// Presses harder: loads grow by a factor, vibrations less, and reflectance stays the same.
pub(super) fn force(spec: &SourceSpec, series: &mut Series, factor: f64, _: &mut ChaCha8Rng) {
    let gain = match spec.id.as_str() {
        "ir" => 1.0,
        "fr" => factor,
        _ => factor.powf(FORCE_POWER),
    };
    series.view_mut().mapv_inplace(|x| to_sample(gain * f64::from(x)));
}

/// Adds a constant to each channel; the level is in standard deviations of the channel.
pub(super) fn offset(x: f64, spread: ChannelSpread, level: f64) -> f64 {
    x + level * spread.deviation
}

/// Clips each channel at a distance from its mean: level · (peak − |mean|).
pub(super) fn saturation(x: f64, spread: ChannelSpread, share: f64) -> f64 {
    let limit = share * (spread.peak - spread.mean.abs()).max(spread.deviation);
    spread.mean + (x - spread.mean).clamp(-limit, limit)
}

/// Rounds to a number of bits, with the channel's largest magnitude as full scale.
pub(super) fn quantisation(x: f64, spread: ChannelSpread, bits: f64) -> f64 {
    let step = 2.0 * spread.peak / bits.exp2();
    if step > 0.0 { (x / step).round() * step } else { x }
}

const SLIPS_HZ: f64 = 5.0;
const LIFT_S: f64 = 0.1;
/// Factor on every signal while the stylus is in the air.
const IN_THE_AIR: f64 = 0.02;

/// The stylus sticks and slips five times a second: at each slip, every signal of the drag loses a
/// share of its strength, which is the level, and then swells again.
pub(super) fn stick_slip(spec: &SourceSpec, series: &mut Series, depth: f64, _: &mut ChaCha8Rng) {
    if spec.is_switch() {
        return;
    }
    let rate_hz = series.rate_hz();
    for (i, mut row) in series.view_mut().rows_mut().into_iter().enumerate() {
        let phase = (i as f64 / rate_hz * SLIPS_HZ).fract();
        let gain = 1.0 - depth * (1.0 - phase);
        row.mapv_inplace(|x| to_sample(gain * f64::from(x)));
    }
}

/// The stylus leaves the surface for 100 ms at a time, in all sources at once. The level is the mean
/// share of the drag in the air.
pub(super) fn lift_offs(trial: &mut Trial, touches: Touches<'_>, level: f64, rng: &mut ChaCha8Rng) {
    let pieces = (trial.longest_s(|_| true).unwrap_or(0.0) / LIFT_S).ceil() as usize;
    let up: Vec<bool> = (0..pieces).map(|_| uniform(rng) < level).collect();
    for (id, signal) in &mut trial.signals {
        let (Signal::Series(series), Some(_)) = (signal, touches(id)) else { continue };
        let rate_hz = series.rate_hz();
        for (i, mut row) in series.view_mut().rows_mut().into_iter().enumerate() {
            let piece = (i as f64 / rate_hz / LIFT_S) as usize;
            if up.get(piece).copied().unwrap_or(false) {
                row.mapv_inplace(|x| to_sample(IN_THE_AIR * f64::from(x)));
            }
        }
    }
}

/// Makes sensors dead, as many as the level says: series become zeros, and pictures black.
pub(super) fn dead(trial: &mut Trial, touches: Touches<'_>, level: f64, rng: &mut ChaCha8Rng) {
    for signal in picked(trial, touches, level, rng) {
        match signal {
            Signal::Series(series) => series.view_mut().fill(0.0),
            Signal::Image(image) => change_picture(image, |rgb| vec![0; rgb.len()]),
        }
    }
}

/// Makes sensors stuck, as many as the level says: a series repeats its first value.
pub(super) fn stuck(trial: &mut Trial, touches: Touches<'_>, level: f64, rng: &mut ChaCha8Rng) {
    for signal in picked(trial, touches, level, rng) {
        if let Signal::Series(series) = signal {
            let first = series.view().row(0).to_owned();
            series.view_mut().rows_mut().into_iter().for_each(|mut row| row.assign(&first));
        }
    }
}

/// Rotates the channels by the level: if it is 1, the second takes the place of the first, and so on.
pub(super) fn swapped(_: &SourceSpec, series: &mut Series, by: f64, _: &mut ChaCha8Rng) {
    for mut row in series.view_mut().rows_mut() {
        if let Some(row) = row.as_slice_mut() {
            let by = by as usize % row.len();
            row.rotate_left(by);
        }
    }
}

/// Picks as many signals as the level says, at random; at least one signal remains unpicked.
fn picked<'t>(
    trial: &'t mut Trial,
    touches: Touches<'_>,
    level: f64,
    rng: &mut ChaCha8Rng,
) -> Vec<&'t mut Signal> {
    let all = trial.signals.len();
    let mut signals: Vec<(f64, &mut Signal)> = (trial.signals.iter_mut())
        .filter(|(id, _)| touches(id).is_some())
        .map(|(_, signal)| (uniform(rng), signal))
        .collect();
    signals.sort_by(|a, b| a.0.total_cmp(&b.0));
    signals.truncate((level as usize).min(all.saturating_sub(1)));
    signals.into_iter().map(|(_, signal)| signal).collect()
}

const GAP_S: f64 = 0.05;

/// Drops exactly a share of the frames, at random places; later frames move up.
pub(super) fn dropped(_: &SourceSpec, series: &mut Series, share: f64, rng: &mut ChaCha8Rng) {
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
}

/// Holds the last value during gaps of 50 ms; the level is the mean share of time in gaps.
pub(super) fn gaps(_: &SourceSpec, series: &mut Series, share: f64, rng: &mut ChaCha8Rng) {
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
}

/// Makes the clock wrong by the level, in percent, so that pitch and length change.
pub(super) fn clock(_: &SourceSpec, series: &mut Series, percent: f64, _: &mut ChaCha8Rng) {
    stretch(series, 1.0 + percent / 100.0);
}

/// Keeps only the first seconds of the drag; the level is their number.
pub(super) fn short(_: &SourceSpec, series: &mut Series, seconds: f64, _: &mut ChaCha8Rng) {
    let frames = (seconds * series.rate_hz()).round() as usize;
    *series = series.crop(0, frames);
}

/// Moves the hand slower by a factor, the level, in a scan of the same length. So the time between
/// independent samples is longer than T* by that factor.
pub(super) fn slow(_: &SourceSpec, series: &mut Series, factor: f64, _: &mut ChaCha8Rng) {
    let frames = series.frames();
    *series = series.crop(0, (frames as f64 / factor).ceil() as usize);
    stretch(series, 1.0 / factor);
    *series = series.crop(0, frames);
}

/// Reads a series `pace` times as fast, by linear interpolation.
pub(super) fn stretch(series: &mut Series, pace: f64) {
    let frames = ((series.frames() as f64 / pace).floor() as usize).max(1);
    let (from, last) = (series.view(), series.frames() - 1);
    let mut samples = Vec::with_capacity(frames * series.channels());
    for i in 0..frames {
        let at = (i as f64 * pace).min(last as f64);
        let before = (at as usize).min(last);
        let (after, part) = ((before + 1).min(last), (at - before as f64) as f32);
        let pairs = from.row(before).into_iter().zip(from.row(after));
        samples.extend(pairs.map(|(a, b)| a + part * (b - a)));
    }
    replace(series, samples);
}

/// Corner frequency of red noise in Hz, above which its amplitude falls as 1/f.
const CORNER_HZ: f64 = 50.0;
/// Rate, in Hz, at which room noise swells and fades, chosen near the rate of syllables.
const SYLLABLES_HZ: f64 = 4.0;
const HUM_HZ: [f64; 3] = [50.0, 100.0, 150.0];
/// Power of the hum, relative to the power of the red noise.
const HUM_SHARE: f64 = 0.2;

pub(super) fn white(rng: &mut ChaCha8Rng, frames: usize, _: f64) -> Vec<f64> {
    (0..frames).map(|_| f64::from(nearly_normal(rng))).collect()
}

/// Noise that is strongest at low frequencies, as from handling, cables and drift.
pub(super) fn red(rng: &mut ChaCha8Rng, frames: usize, rate_hz: f64) -> Vec<f64> {
    let keep = (-TAU * CORNER_HZ / rate_hz).exp();
    let fresh = (1.0 - keep * keep).sqrt();
    let mut state = f64::from(nearly_normal(rng));
    let next = |_| {
        state = keep * state + fresh * f64::from(nearly_normal(rng));
        state
    };
    (0..frames).map(next).collect()
}

/// Room noise, for the microphone's sources: red noise that swells and fades, and hum.
pub(super) fn room(rng: &mut ChaCha8Rng, frames: usize, rate_hz: f64) -> Vec<f64> {
    let mut noise = red(rng, frames, rate_hz);
    let (pace, start) = (TAU * SYLLABLES_HZ / rate_hz, TAU * uniform(rng));
    let hum = (2.0 * HUM_SHARE / HUM_HZ.len() as f64).sqrt();
    let phases = HUM_HZ.map(|_| TAU * uniform(rng));
    for (i, x) in noise.iter_mut().enumerate() {
        let at = i as f64;
        *x *= 1.0 + 0.8 * (start + pace * at).sin();
        for (hz, phase) in HUM_HZ.iter().zip(phases) {
            *x += hum * (phase + TAU * hz / rate_hz * at).sin();
        }
    }
    noise
}

/// Adds noise to each channel. The deviation of the noise is `db` dB below that of the channel.
pub(super) fn add(
    series: &mut Series,
    db: f64,
    rng: &mut ChaCha8Rng,
    make: fn(&mut ChaCha8Rng, usize, f64) -> Vec<f64>,
) {
    for channel in 0..series.channels() {
        let noise = make(rng, series.frames(), series.rate_hz());
        let own = ChannelSpread::of(noise.iter().copied()).deviation;
        let scale = ChannelSpread::of(series.channel(channel)).deviation * 10f64.powf(-db / 20.0)
            / own.max(1e-12);
        for (x, noise) in series.view_mut().column_mut(channel).iter_mut().zip(noise) {
            *x = to_sample(f64::from(*x) + scale * noise);
        }
    }
}

/// Darkens pictures by a factor; dark areas lose detail to rounding.
pub(super) fn dark(rgb: &[u8], factor: f64) -> Vec<u8> {
    rgb.iter().map(|&x| (f64::from(x) * factor).round() as u8).collect()
}

/// Makes the light warmer, in that the ratio of red to blue grows by a factor.
pub(super) fn tint(rgb: &[u8], ratio: f64) -> Vec<u8> {
    let gains = [ratio.sqrt(), 1.0, 1.0 / ratio.sqrt()];
    let channel = |(i, &x): (usize, &u8)| (f64::from(x) * gains[i % 3]).round() as u8;
    rgb.iter().enumerate().map(channel).collect()
}

/// Shifts pictures by the level, in pixels, along rows and columns, cyclically.
pub(super) fn shift(rgb: &[u8], pixels: f64) -> Vec<u8> {
    let width = Image::COLS * 3;
    let mut moved = rgb.to_vec();
    moved.rotate_left(pixels as usize % Image::ROWS * width);
    for line in moved.chunks_exact_mut(width) {
        line.rotate_left(pixels as usize % Image::COLS * 3);
    }
    moved
}

/// Blurs pictures. A pixel becomes the mean over a square that extends `radius` pixels to each side.
pub(super) fn blur(rgb: &[u8], radius: f64) -> Vec<u8> {
    let radius = radius as usize;
    let (rows, columns) = ([Image::ROWS, Image::COLS * 3], [Image::COLS, 3]);
    blur_lines(&blur_lines(rgb, rows, columns, radius), columns, rows, radius)
}

/// Takes running means along lines of pixels; both are given as their number and their distance in bytes.
fn blur_lines(rgb: &[u8], lines: [usize; 2], pixels: [usize; 2], radius: usize) -> Vec<u8> {
    let ([lines, line_step], [len, step]) = (lines, pixels);
    let mut out = vec![0; rgb.len()];
    let mut sums = vec![0u32; len + 1];
    for line in 0..lines {
        for channel in 0..3 {
            let at = |i: usize| line * line_step + i * step + channel;
            for i in 0..len {
                sums[i + 1] = sums[i] + u32::from(rgb[at(i)]);
            }
            for i in 0..len {
                let (first, end) = (i.saturating_sub(radius), (i + radius + 1).min(len));
                out[at(i)] = ((sums[end] - sums[first]) / (end - first) as u32) as u8;
            }
        }
    }
    out
}
