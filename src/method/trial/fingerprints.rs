//! Fingerprints by which recordings that share samples are found: excerpts that overlap, and copies.
//!
//! Of each series, some windows are taken, chosen by their content, so that two recordings choose the
//! same windows of what they share (Broder 1997, "On the resemblance and containment of documents").

use multiversion::multiversion;

use super::{Series, Signal, is_plain};

/// Frames of a window.
pub(crate) const WINDOW: usize = 16;
/// Fewest frames of a window that differ from the one before them.
const LIVELY: usize = 8;
/// Fewest sizes of steps between samples in a shared run. Sensors that rest have fewer.
const LEAST_SIZES: usize = 8;
/// Least information in the steps of a shared run, in bits. Chance does not bring about that much: a
/// library has fewer than 2^70 pairs of moments.
const LEAST_BITS: f64 = 120.0;
/// The same in series that are equal from begin to end: a library has fewer than 2^35 pairs of series.
const LEAST_BITS_OF_ALL: f64 = 60.0;
/// Steps are compared in this part of their range, so that a ramp has steps of one size.
const STEP: f32 = 1.0 / SIZES as f32;
const SIZES: usize = 1024;
/// Frames that are hashed together.
const CHUNK: usize = 4096;
/// Frames of a run that are looked at for its information.
const ENOUGH_FRAMES: usize = 4096;

#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Fingerprints {
    /// Hash of the whole signal; `None` if signals can be equal by chance.
    pub whole: Option<u64>,
    /// Hashes of windows, with the frames where they begin: the smallest ones, sorted. A picture has none.
    pub windows: Vec<(u64, usize)>,
}

/// Odd, so that multiplying loses nothing: 2^64 divided by the golden ratio.
const BASE: u64 = 0x9e37_79b9_7f4a_7c15;

impl Fingerprints {
    /// Takes the windows with the smallest hashes, at most this many.
    pub(crate) fn of(signal: &Signal, most: usize) -> Self {
        match signal {
            Signal::Image(image) => {
                // A picture is a whole number of words.
                let words = image.rgb().as_chunks().0.iter().map(|word| u64::from_le_bytes(*word));
                let whole = || of_all(&words.collect::<Vec<_>>());
                Self { whole: (!is_plain(image)).then(whole), windows: Vec::new() }
            }
            Signal::Series(series) => Self::of_series(series, most),
        }
    }

    fn of_series(series: &Series, most: usize) -> Self {
        let (samples, channels, frames) = (series.samples(), series.channels(), series.frames());
        // Hashes are spread evenly, so this leaves four times as many as are kept.
        let below = (u64::MAX / frames as u64).saturating_mul(4 * most as u64);
        let (mut whole, mut found, mut hashes) = (frames as u64, Vec::new(), Vec::new());
        for begin in (0..frames).step_by(CHUNK) {
            // With the frame before the first window, and the end of the last one.
            let first = begin.saturating_sub(1);
            let end = (begin + CHUNK + WINDOW - 1).min(frames);
            hashes.clear();
            hashes.resize(end - first, 0);
            hash_frames(&samples[first * channels..end * channels], channels, &mut hashes);
            let own = &hashes[begin - first..];
            whole = mixed(whole, of_all(&own[..own.len().min(CHUNK)]));
            let windows = windows(&hashes, begin - first, below);
            found.extend(windows.into_iter().map(|(hash, at)| (hash, first + at)));
        }
        let whole = tells(series, 0, frames).then_some(whole);
        Self { whole, windows: smallest(found, most) }
    }
}

/// The hash of each frame of interleaved samples.
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn hash_frames(samples: &[f32], channels: usize, hashes: &mut [u64]) {
    for channel in 0..channels {
        let samples = &samples[channel..];
        for i in 0..hashes.len() {
            hashes[i] = mixed(hashes[i], u64::from(samples[i * channels].to_bits()));
        }
    }
}

/// One hash of many, in order; by four hashes, so that no step waits for the one before.
fn of_all(hashes: &[u64]) -> u64 {
    let (chunks, rest) = hashes.as_chunks::<4>();
    let mut lanes = [0; 4];
    for chunk in chunks {
        for lane in 0..4 {
            lanes[lane] = mixed(lanes[lane], chunk[lane]);
        }
    }
    lanes.iter().chain(rest).fold(hashes.len() as u64, |hash, x| mixed(hash, *x))
}

/// The windows that begin at frame `first` or later and have hashes up to `below`: their hashes, and the
/// frames where they begin. The hash of a window is the exclusive or of its frames' hashes, each rotated
/// by its place.
fn windows(frames: &[u64], first: usize, below: u64) -> Vec<(u64, usize)> {
    let mut hashes = frames[first..].to_vec();
    hash_windows(&mut hashes);
    let windows = (first + WINDOW <= frames.len()).then(|| frames.len() + 1 - WINDOW - first);
    let small =
        hashes[..windows.unwrap_or(0)].iter().enumerate().filter(|(_, hash)| **hash <= below);
    let small = small.map(|(at, hash)| (*hash, first + at));
    let lively =
        |&(_, begin): &(u64, usize)| is_lively(&frames[begin.saturating_sub(1)..begin + WINDOW]);
    small.filter(lively).collect()
}

/// Turns hashes of frames into hashes of the windows that begin there: of 2 frames, then of 4, 8 and 16.
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn hash_windows(hashes: &mut [u64]) {
    let mut length = 1;
    while length < WINDOW {
        for i in 0..hashes.len().saturating_sub(length) {
            hashes[i] = hashes[i].rotate_left(length as u32) ^ hashes[i + length];
        }
        length *= 2;
    }
}

/// The smallest hashes, at most this many, sorted.
fn smallest(mut found: Vec<(u64, usize)>, most: usize) -> Vec<(u64, usize)> {
    if found.len() > most {
        found.select_nth_unstable(most);
        found.truncate(most);
    }
    found.sort_unstable();
    found.dedup_by_key(|(hash, _)| *hash);
    found
}

fn is_lively(frames: &[u64]) -> bool {
    frames.windows(2).filter(|two| two[0] != two[1]).count() >= LIVELY
}

/// Adds a number to a hash, and spreads its bits over all others.
#[inline(always)]
fn mixed(hash: u64, x: u64) -> u64 {
    let product = (hash.rotate_left(23) ^ x).wrapping_mul(BASE);
    product ^ (product >> 32)
}

/// Whether a run could not be equal by chance: the steps of some channel have many sizes, and tell much.
/// The information of a step is its collision entropy, −log2 Σ p² over the sizes of steps. Short series
/// that are equal from begin to end may tell enough by all their channels only.
pub(crate) fn tells(series: &Series, begin: usize, frames: usize) -> bool {
    let channels = series.channels();
    let until = begin + frames.min(ENOUGH_FRAMES);
    let bits = |channel: usize| {
        let values = (begin..until).map(|frame| series.samples()[frame * channels + channel]);
        let values: Vec<f32> = values.collect();
        let (low, high) =
            values.iter().fold((f32::MAX, f32::MIN), |(l, h), &x| (l.min(x), h.max(x)));
        let grain = (high - low) * STEP;
        if !(grain > 0.0 && grain.is_finite()) {
            return 0.0;
        }
        // No step is larger than the range.
        let mut counts = [0usize; 2 * SIZES + 1];
        for step in values.windows(2) {
            let size = ((step[1] - step[0]) / grain).round() + SIZES as f32;
            counts[(size as usize).min(2 * SIZES)] += 1;
        }
        let steps = (values.len() - 1) as f64;
        let sizes = counts.iter().filter(|count| **count > 0);
        let equal: f64 = sizes.clone().map(|&count| (count as f64 / steps).powi(2)).sum();
        if sizes.count() >= LEAST_SIZES { -equal.log2() * steps } else { 0.0 }
    };
    if frames < series.frames() {
        return (0..channels).any(|channel| bits(channel) >= LEAST_BITS);
    }
    let mut sum = 0.0;
    (0..channels).any(|channel| {
        sum += bits(channel);
        sum >= LEAST_BITS_OF_ALL
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_have_the_hash_of_their_frames_and_only_small_ones_are_taken() {
        let frames: Vec<u64> = (0..100).map(|i| mixed(1, i)).collect();
        let hash = |window: &[u64]| window.iter().fold(0u64, |hash, x| hash.rotate_left(1) ^ x);
        let all = frames.windows(WINDOW).map(hash).zip(0..);
        for (first, below) in [(0, u64::MAX), (1, u64::MAX), (0, u64::MAX / 4), (90, u64::MAX)] {
            let expected = all.clone().filter(|(hash, at)| *at >= first && *hash <= below);
            assert_eq!(windows(&frames, first, below), expected.collect::<Vec<_>>());
        }
    }
}
