//! Sums over the frames of one view, and which of them are of the surface.
//!
//! Where the stylus leaves the surface, or a line holds its last value, frames are far quieter than
//! the rest and say nothing of it. What is too quiet is known at the end alone, when the median is,
//! so frames are summed loudness by loudness: a scan that grows need not be gone through again.

use std::collections::BTreeMap;

use super::fourier::{BAND_FEATURES, BandScale};

/// Classes of loudness in one unit of ln power (4.3 dB).
const CLASSES: f32 = 4.0;

/// Frames this many classes quieter than the median frame, 26 dB, are not of the surface. Nearer to
/// the median the quiet parts of a texture itself are lost: at 17 dB a foreign surface is caught
/// less often, and short scans are named worse.
const QUIETER: i32 = 24;

/// What some frames of one view add up to, loudness by loudness.
#[derive(Clone, Debug)]
pub(super) struct ViewSums {
    channels: usize,
    width: usize,
    /// By [`loudness`].
    by_loudness: BTreeMap<i32, FrameSums>,
}

/// What some frames add up to.
#[derive(Clone, Debug)]
pub(super) struct FrameSums {
    /// Fourier features.
    pub bands: Vec<f64>,
    /// ln power over the bands of each channel.
    levels: Vec<f64>,
    /// Number of frames.
    pub frames: usize,
}

impl FrameSums {
    fn new(channels: usize, width: usize) -> Self {
        Self { bands: vec![0.0; BAND_FEATURES * width], levels: vec![0.0; channels], frames: 0 }
    }

    fn add(&mut self, scale: &BandScale, values: &[f32], width: usize) {
        scale.add(values, &mut self.bands);
        let bands = width / self.levels.len();
        for row in values.chunks_exact(width) {
            for (sum, of_channel) in self.levels.iter_mut().zip(row.chunks_exact(bands)) {
                *sum += f64::from(of_channel.iter().sum::<f32>());
            }
        }
        self.frames += values.len() / width;
    }

    fn join(&mut self, other: &Self) {
        let pairs = self.bands.iter_mut().zip(&other.bands);
        pairs.chain(self.levels.iter_mut().zip(&other.levels)).for_each(|(sum, x)| *sum += x);
        self.frames += other.frames;
    }

    /// Mean ln power of a channel.
    pub fn level(&self, channel: usize) -> f64 {
        let bands = self.bands.len() / BAND_FEATURES / self.levels.len();
        self.levels[channel] / (self.frames.max(1) * bands) as f64
    }
}

impl ViewSums {
    /// Of no frame.
    pub fn new(channels: usize, width: usize) -> Self {
        Self { channels, width, by_loudness: BTreeMap::new() }
    }

    /// Adds frames, as ln power.
    pub fn add(&mut self, scale: &BandScale, values: &[f32]) {
        let mut sorted: BTreeMap<i32, Vec<f32>> = BTreeMap::new();
        for row in values.chunks_exact(self.width) {
            sorted.entry(loudness(row)).or_default().extend_from_slice(row);
        }
        for (loudness, rows) in sorted {
            let none = || FrameSums::new(self.channels, self.width);
            self.by_loudness.entry(loudness).or_insert_with(none).add(scale, &rows, self.width);
        }
    }

    /// Adds the frames of another.
    pub fn join(&mut self, other: &Self) {
        for (&loudness, sums) in &other.by_loudness {
            let none = || FrameSums::new(self.channels, self.width);
            self.by_loudness.entry(loudness).or_insert_with(none).join(sums);
        }
    }

    /// Number of frames, of the surface or not.
    pub fn frames(&self) -> usize {
        self.by_loudness.values().map(|sums| sums.frames).sum()
    }

    /// The frames that are of the surface together.
    pub fn on_surface(&self) -> FrameSums {
        let counts = self.by_loudness.iter().map(|(&loudness, sums)| (loudness, sums.frames));
        let least = median(counts) - QUIETER;
        let mut total = FrameSums::new(self.channels, self.width);
        self.by_loudness.range(least..).for_each(|(_, sums)| total.join(sums));
        total
    }
}

/// The frames of a trial that are of the surface.
pub(super) fn on_surface(values: &[f32], width: usize) -> Vec<f32> {
    let mut counts: BTreeMap<i32, usize> = BTreeMap::new();
    values.chunks_exact(width).for_each(|row| *counts.entry(loudness(row)).or_default() += 1);
    let least = median(counts.iter().map(|(&loudness, &n)| (loudness, n))) - QUIETER;
    let kept = values.chunks_exact(width).filter(|row| loudness(row) >= least);
    kept.flatten().copied().collect()
}

/// The class of a frame's mean ln power.
fn loudness(row: &[f32]) -> i32 {
    (CLASSES * row.iter().sum::<f32>() / row.len().max(1) as f32).floor() as i32
}

/// The median (the upper one of an even number) of values that rise, each with how often it occurs.
fn median(counts: impl Iterator<Item = (i32, usize)> + Clone) -> i32 {
    let half = counts.clone().map(|(_, n)| n).sum::<usize>() / 2;
    let mut below = 0;
    for (value, n) in counts {
        below += n;
        if below > half {
            return value;
        }
    }
    0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_far_below_the_median_are_not_of_the_surface_whatever_the_gain() {
        let scale = BandScale::new(vec![0.0; 2], &[1.0; 2]);
        for gain in [0.0, -12.3, 7.9] {
            let row = |x: f32| [x + gain, x + gain + 0.2];
            let loud: Vec<f32> = (0..12).flat_map(|i| row(-0.1 * i as f32)).collect();
            let quiet: Vec<f32> = (0..8).flat_map(|_| row(-20.0)).collect();
            let mut sums = ViewSums::new(1, 2);
            sums.add(&scale, &loud[..10]);
            sums.add(&scale, &quiet);
            sums.add(&scale, &loud[10..]);
            assert_eq!((sums.frames(), sums.on_surface().frames), (20, 12), "{gain}");
            let all = [&quiet[..], &loud].concat();
            assert_eq!(on_surface(&all, 2), loud);
            let mean = loud.iter().map(|&x| f64::from(x)).sum::<f64>() / 24.0;
            assert!((sums.on_surface().level(0) - mean).abs() < 1e-5);
        }
    }

    #[test]
    fn a_scan_that_is_silent_throughout_is_kept() {
        let scale = BandScale::new(vec![0.0], &[1.0]);
        let mut sums = ViewSums::new(1, 1);
        sums.add(&scale, &[-32.2; 7]);
        assert_eq!(sums.on_surface().frames, 7);
        assert_eq!(ViewSums::new(1, 1).on_surface().frames, 0);
    }
}
