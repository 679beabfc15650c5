//! Histograms of ln power in each band, from which all log-band features are computed.
//!
//! Features of log-band frames are means over frames of functions of ln power. These functions depend
//! on the mean power of the whole series, which changes with every new frame. So the frames are
//! counted in histograms: bins of ln power are an eighth apart, and each value is shared between the
//! two bins next to it; the nearer bin gets more. The mean of a function over a histogram is the mean
//! of its linear interpolation between bins. It is smooth in the samples, and does not cost more the
//! longer the scan lasts.

use std::cell::Cell;
use std::ops::Range;
use std::sync::OnceLock;

use multiversion::multiversion;

use super::windowed_frames::ln;
use crate::lanes::{extremes, total};

/// Number of values that are computed together. With 8, the compiler makes no vectors of some builds.
pub(crate) const LANES: usize = 16;

/// Number of bins in one unit of ln power.
const BINS: f32 = 8.0;

/// Added to P/P̄ (power over mean power) before the logarithm, to hide noise far below the signal.
const FLOOR: f64 = 1e-4;

/// Most P/P̄, e⁸⁰, where a mean is no more than the floor of numbers.
const MOST: f64 = 5.540_622_384_393_51e34;

/// Histograms of the frames of one view of a series, or of the tiles of a picture. They grow with it.
#[derive(Clone, Debug)]
pub(crate) struct Counts {
    pub channels: usize,
    /// Number of bands of all channels together.
    pub width: usize,
    pub frames: usize,
    /// The first bin has ln power `first`/[`BINS`].
    first: i32,
    pub bins: usize,
    /// Shape (width, bins).
    pub counts: Vec<f32>,
}

impl Counts {
    /// Starts without frames; `width` is the number of bands of all channels together.
    pub(crate) fn new(channels: usize, width: usize) -> Self {
        Self { channels, width, frames: 0, first: 0, bins: 0, counts: Vec::new() }
    }

    /// Adds frames of ln power, shape (frames, width).
    pub(crate) fn add(&mut self, values: &[f32]) {
        if let Some((first, last)) = values.chunks_exact(self.width).map(reached).reduce(wider) {
            self.reach(first, last);
        }
        for row in values.chunks_exact(self.width) {
            count(row, self.first, self.bins, &mut self.counts);
            self.frames += 1;
        }
    }

    /// Makes room for bins from `first` to `last`.
    fn reach(&mut self, first: i32, last: i32) {
        if self.bins > 0 && self.first <= first && last < self.first + self.bins as i32 {
            return;
        }
        let (first, end) = match self.bins {
            0 => (first, last + 1),
            bins => (first.min(self.first), (last + 1).max(self.first + bins as i32)),
        };
        // Rounded up to whole vector registers.
        let bins = ((end - first) as usize).next_multiple_of(LANES);
        let mut counts = zeros(self.width * bins);
        let from = (self.first - first) as usize;
        for (new, old) in counts.chunks_exact_mut(bins).zip(self.counts.chunks(self.bins.max(1))) {
            new[from..from + old.len()].copy_from_slice(old);
        }
        (self.first, self.bins, self.counts) = (first, bins, counts);
    }

    pub(crate) fn bands(&self) -> usize {
        self.width / self.channels
    }

    /// The first bin after the last.
    fn end(&self) -> i32 {
        self.first + self.bins as i32
    }

    /// The power of each bin.
    fn powers(&self) -> impl Iterator<Item = f64> {
        /// Places of the bins, in units of ln power, that are kept: the floor of silence, and full scale.
        const KEPT: Range<i32> = -40 * BINS as i32..24 * BINS as i32;
        static POWERS: OnceLock<Vec<f64>> = OnceLock::new();
        let power = |bin: i32| (f64::from(bin) / f64::from(BINS)).exp();
        let kept = POWERS.get_or_init(|| KEPT.map(power).collect());
        (self.first..self.end()).map(move |bin| match kept.get((bin - KEPT.start) as usize) {
            Some(kept) => *kept,
            None => power(bin),
        })
    }

    /// ln of each channel's mean power over frames and bands.
    pub(crate) fn ln_mean_power(&self) -> Vec<f64> {
        let power: Vec<f64> = self.powers().collect();
        let of_channel = |counts: &[f32]| {
            let mut of_bins = vec![0f32; self.bins];
            add_histograms(counts, &mut of_bins);
            let sum: f64 = of_bins.iter().zip(&power).map(|(n, p)| f64::from(*n) * p).sum();
            (sum / (self.frames.max(1) * self.bands()) as f64).max(f64::MIN_POSITIVE).ln()
        };
        let per_channel = (self.bands() * self.bins).max(1);
        let mut all: Vec<f64> = self.counts.chunks_exact(per_channel).map(of_channel).collect();
        all.resize(self.channels, f64::MIN_POSITIVE.ln());
        all
    }

    /// ln(P/P̄ + 1e-4) of each bin; `ln_mean` gives ln P̄ of each channel. Shape (channels, bins).
    pub(crate) fn relative(&self, ln_mean: &[f64]) -> Vec<f32> {
        let powers: Vec<f64> = self.powers().collect();
        let mut relative = vec![0.0; ln_mean.len() * self.bins];
        for (of_channel, mean) in relative.chunks_exact_mut(self.bins.max(1)).zip(ln_mean) {
            let scale = (-mean).exp();
            ln_relative(&powers, scale, of_channel);
        }
        relative
    }

    /// For each band: the sum over frames of the values in `table`, and the sum of their squares.
    pub(crate) fn sums(&self, table: &[f32]) -> Vec<(f64, f64)> {
        let of_band = |(band, counts): (usize, &[f32])| {
            sums(counts, &table[band / self.bands() * self.bins..][..self.bins])
        };
        self.counts.chunks_exact(self.bins.max(1)).enumerate().map(of_band).collect()
    }
}

thread_local! {
    /// The largest buffer of earlier histograms of the thread. Fresh memory costs more time than
    /// counting in it.
    static SPARE: Cell<Vec<f32>> = const { Cell::new(Vec::new()) };
}

/// `count` zeros, in the spare buffer.
fn zeros(count: usize) -> Vec<f32> {
    let mut spare = SPARE.take();
    spare.clear();
    spare.reserve_exact(count);
    spare.resize(count, 0.0);
    spare
}

impl Drop for Counts {
    fn drop(&mut self) {
        // A thread that ends has no spare buffer any more.
        let _ = SPARE.try_with(|spare| {
            let (kept, own) = (spare.take(), std::mem::take(&mut self.counts));
            spare.set(if own.capacity() > kept.capacity() { own } else { kept });
        });
    }
}

/// Adds one value to the histogram of each band; every histogram has `bins` bins.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn count(row: &[f32], first: i32, bins: usize, counts: &mut [f32]) {
    for (i, x) in row.iter().enumerate() {
        let at = x * BINS;
        let bin = at.floor();
        let (part, bin) = (at - bin, i * bins + (bin as i32 - first) as usize);
        counts[bin] += 1.0 - part;
        counts[bin + 1] += part;
    }
}

/// Adds the histograms of some bands to `sums`, bin by bin.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn add_histograms(counts: &[f32], sums: &mut [f32]) {
    for band in counts.chunks_exact(sums.len().max(1)) {
        for i in 0..sums.len() {
            sums[i] += band[i];
        }
    }
}

/// Whether any of some bins has frames; most bins of a short series have none.
#[inline(always)]
pub(crate) fn is_counted(counts: &[f32; LANES]) -> bool {
    let mut counted = false;
    for n in counts {
        counted |= *n != 0.0;
    }
    counted
}

/// The sum of some values and that of their squares, each multiplied by its count. Their number is a
/// multiple of [`LANES`].
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn sums(counts: &[f32], values: &[f32]) -> (f64, f64) {
    let (counts, values) = (counts.as_chunks::<LANES>().0, values.as_chunks::<LANES>().0);
    let mut of_lanes = [[0f64; LANES]; 2];
    for i in 0..counts.len().min(values.len()) {
        if is_counted(&counts[i]) {
            for lane in 0..LANES {
                let (n, x) = (f64::from(counts[i][lane]), f64::from(values[i][lane]));
                of_lanes[0][lane] += n * x;
                of_lanes[1][lane] += n * x * x;
            }
        }
    }
    (total(&of_lanes[0]), total(&of_lanes[1]))
}

/// ln(P·scale + [`FLOOR`]) of each power P.
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn ln_relative(powers: &[f64], scale: f64, relative: &mut [f32]) {
    for i in 0..powers.len().min(relative.len()) {
        let power = powers[i] * scale;
        relative[i] = ln(if power < MOST { power } else { MOST } + FLOOR) as f32;
    }
}

/// The first and the last bin that a frame counts in.
fn reached(row: &[f32]) -> (i32, i32) {
    let (least, most) = extremes(row);
    (floor(least * BINS), floor(most * BINS) + 1)
}

/// The bins from the first to the last of two ranges.
fn wider(a: (i32, i32), b: (i32, i32)) -> (i32, i32) {
    (a.0.min(b.0), a.1.max(b.1))
}

/// Without SSE 4.1, `f32::floor` is a function call.
fn floor(x: f32) -> i32 {
    let towards_zero = x as i32;
    towards_zero - i32::from(towards_zero as f32 > x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_whole_series_is_counted_as_if_it_had_grown() {
        for (n, width) in [(0, 6), (1, 6), (2, 6), (7, 2), (240, 6)] {
            // Steps of 1/512, like packed frames, so that counts are the same to the last bit.
            let step = |i: usize| ((i * 7919) % 4096) as f32 / 512.0;
            let off = |i: usize| if i / width % 5 == 3 { 9.0 } else { (i / width % 3) as f32 };
            let values: Vec<f32> = (0..n * width).map(|i| step(i) - off(i)).collect();
            let (mut grown, mut whole) = (Counts::new(2, width), Counts::new(2, width));
            values.chunks(3 * width).for_each(|piece| grown.add(piece));
            whole.add(&values);
            assert_eq!((grown.frames, grown.first), (whole.frames, whole.first), "{n}");
            assert_eq!(grown.ln_mean_power(), whole.ln_mean_power(), "{n}");
            let bins = (grown.bins.max(1), whole.bins.max(1));
            let bands = grown.counts.chunks(bins.0).zip(whole.counts.chunks(bins.1));
            for (grown, whole) in bands {
                let shared = grown.len().min(whole.len());
                assert_eq!(grown[..shared], whole[..shared], "{n}");
                assert!(grown[shared..].iter().chain(&whole[shared..]).all(|x| *x == 0.0));
            }
        }
    }

    #[test]
    fn a_quiet_frame_counts_like_any_other_whatever_the_gain() {
        for gain in [0.0, -12.0, 7.5] {
            let values = [0.0, 0.2, -20.0, -19.8].map(|x: f32| x + gain);
            let mut counts = Counts::new(1, 2);
            counts.add(&values);
            let power: f64 = values.iter().map(|&x| f64::from(x).exp()).sum::<f64>() / 4.0;
            assert_eq!(counts.frames, 2);
            assert!((counts.ln_mean_power()[0] - power.ln()).abs() < 3e-3, "{gain}");
        }
    }

    #[test]
    fn a_scan_that_is_silent_throughout_is_kept() {
        let mut counts = Counts::new(1, 1);
        counts.add(&[-32.2; 7]);
        assert_eq!(counts.frames, 7);
        assert_eq!(Counts::new(1, 1).frames, 0);
    }
}
