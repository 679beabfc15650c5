//! Light, lens and place of pictures.

use super::setting::{Setting, each_picture};
use crate::trial::{Image, Trial};

/// Less light, by a factor; what is dark loses its steps.
pub fn dark(trial: &mut Trial, setting: &mut Setting<'_>) {
    let factor = setting.level;
    each_picture(trial, |rgb| rgb.iter().map(|&x| (f64::from(x) * factor).round() as u8).collect());
}

/// Warmer light: red over blue grows by a factor.
pub fn tint(trial: &mut Trial, setting: &mut Setting<'_>) {
    let root = setting.level.sqrt();
    let gains = [root, 1.0, 1.0 / root];
    each_picture(trial, |rgb| {
        let channel = |(i, &x): (usize, &u8)| (f64::from(x) * gains[i % 3]).round() as u8;
        rgb.iter().enumerate().map(channel).collect()
    });
}

/// Another place: the picture moves by the level, in pixels, both ways; what leaves on one side enters on the other.
pub fn shift(trial: &mut Trial, setting: &mut Setting<'_>) {
    let by = setting.level as usize;
    each_picture(trial, |rgb| {
        let mut moved = Vec::with_capacity(rgb.len());
        for row in 0..Image::ROWS {
            let from = (row + by) % Image::ROWS * Image::COLS * 3;
            let line = &rgb[from..from + Image::COLS * 3];
            let cut = by % Image::COLS * 3;
            moved.extend_from_slice(&line[cut..]);
            moved.extend_from_slice(&line[..cut]);
        }
        moved
    });
}

/// Out of focus: the mean over a square that reaches the level, in pixels, to each side.
pub fn blur(trial: &mut Trial, setting: &mut Setting<'_>) {
    let radius = setting.level as usize;
    each_picture(trial, |rgb| {
        let across = blur_lines(rgb, Image::ROWS, Image::COLS, Image::COLS * 3, 3, radius);
        blur_lines(&across, Image::COLS, Image::ROWS, 3, Image::COLS * 3, radius)
    });
}

/// Means along lines: `lines` of them, `line_step` bytes apart, each of `len` pixels, `step` bytes
/// apart.
fn blur_lines(
    rgb: &[u8],
    lines: usize,
    len: usize,
    line_step: usize,
    step: usize,
    radius: usize,
) -> Vec<u8> {
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
