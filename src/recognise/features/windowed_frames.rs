//! Log-band frames: the power of a sound or vibration in frequency bands, frame by frame.
//!
//! A source with a spectrum is cut in two ways, called views: long frames (about 46 ms, 40 bands)
//! and short ones (about 12 ms, 24 bands), which overlap by half. Each frame loses its mean, since
//! a sensor's offset would leak into the lowest bands; it is windowed (periodic Hann), transformed,
//! and the power of its bins averaged over bands with edges equally spaced in ln(1 + f/f0), where
//! f0 is a tenth of the highest frequency. The result is A = ln(mean power + 1e-14). Power is
//! 2|X|²/(L·Σw²) with samples in units of full scale, so that 16-bit quantisation amounts to about
//! 8e-14 a bin.

use std::cell::RefCell;
use std::collections::HashMap;
use std::sync::Arc;

use rayon::prelude::*;
use realfft::num_complex::Complex;
use realfft::{RealFftPlanner, RealToComplex};

/// The views of a source: duration of a frame in seconds, and number of bands.
pub(super) const VIEWS: [(f64, usize); 2] = [(0.0464, 40), (0.0116, 24)];

/// Power below which a band counts as silent; keeps the logarithm finite.
const POWER_FLOOR: f32 = 1e-14;

/// Frames that one thread transforms at a time.
const FRAMES_A_TASK: usize = 64;

/// How a source is cut into frames and bands.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct FrameView {
    /// Samples a frame, L: a power of two.
    pub points: usize,
    pub rate_hz: f64,
    pub channels: usize,
    /// The first bin of each band, and the end of the last band.
    pub edges: Vec<usize>,
}

impl FrameView {
    /// A view whose frames last `frame_s` seconds, rounded (in log2) to a power of two of samples,
    /// with at most `bands` bands, each at least a bin wide and none above half the rate.
    pub fn new(
        rate_hz: f64,
        channels: usize,
        band_hz: (f64, f64),
        frame_s: f64,
        bands: usize,
    ) -> Self {
        let exponent = (frame_s * rate_hz).log2().round().clamp(1.0, 24.0);
        Self::of_points(1 << exponent as u32, rate_hz, channels, band_hz, bands)
    }

    /// A view with frames of `points` samples, a power of two.
    pub fn of_points(
        points: usize,
        rate_hz: f64,
        channels: usize,
        band_hz: (f64, f64),
        bands: usize,
    ) -> Self {
        Self { points, rate_hz, channels, edges: band_edges(points, rate_hz, band_hz, bands) }
    }

    /// Samples from the beginning of one frame to that of the next.
    pub fn hop(&self) -> usize {
        self.points / 2
    }

    /// Number of bands of one channel.
    pub fn bands(&self) -> usize {
        self.edges.len() - 1
    }

    /// Values of one frame: all bands of the first channel, then of the second, …
    pub fn width(&self) -> usize {
        self.channels * self.bands()
    }

    /// Number of whole frames in a recording of `samples` a channel.
    pub fn frames_in(&self, samples: usize) -> usize {
        if samples < self.points { 0 } else { (samples - self.points) / self.hop() + 1 }
    }

    /// Whether the bands of two views cover the same frequencies, even at different rates.
    pub fn comparable(&self, other: &Self) -> bool {
        let width_hz = |view: &Self| view.rate_hz / view.points as f64;
        let edge_hz = |view: &Self, i: usize| view.edges[i] as f64 * width_hz(view);
        let tolerance_hz = 1.5 * width_hz(self).max(width_hz(other));
        self.edges.len() == other.edges.len()
            && self.channels == other.channels
            && (0..self.edges.len())
                .all(|i| (edge_hz(self, i) - edge_hz(other, i)).abs() <= tolerance_hz)
    }
}

fn band_edges(points: usize, rate_hz: f64, band_hz: (f64, f64), bands: usize) -> Vec<usize> {
    let (low, high) = band_hz;
    let f0 = high / 10.0;
    let (first, last) = ((low / f0).ln_1p(), (high / f0).ln_1p());
    let per_hz = points as f64 / rate_hz;
    // No band reaches beyond the source's own band, however few bins that has.
    let end = ((high * per_hz).round() as usize).clamp(1, points / 2 + 1);
    let mut edges: Vec<usize> = Vec::with_capacity(bands + 1);
    let mut previous: Option<usize> = None;
    for i in 0..=bands {
        let u = first + (last - first) * i as f64 / bands as f64;
        let edge = (f0 * u.exp_m1() * per_hz).round() as usize;
        let edge = previous.map_or(edge, |previous| edge.max(previous + 1));
        previous = Some(edge);
        edges.push(edge.min(end));
    }
    edges.dedup();
    if low > 0.0 {
        let least = ((low * per_hz).ceil() as usize).max(1);
        edges.retain(|&edge| edge >= least);
    }
    if edges.len() < 2 {
        // Nothing of the band lies below half the rate: the highest bin stands for it.
        return vec![end - 1, end];
    }
    edges
}

/// Frames of one view: `width` values each, one after the other.
#[derive(Clone, Debug, serde::Serialize, serde::Deserialize)]
pub struct ViewFrames {
    pub view: FrameView,
    /// A = ln(mean power + 1e-14), shape (frames, width).
    pub values: Vec<f32>,
}

impl ViewFrames {
    /// The frames of a recording of interleaved samples; a short one is padded with zeros.
    pub fn new(view: FrameView, samples: &[f32]) -> Self {
        let mut frames = Self { view, values: Vec::new() };
        frames.extend(samples);
        if frames.values.is_empty() {
            frames.pad(samples);
        }
        frames
    }

    /// Appends all whole frames; returns how many samples a channel are not needed again.
    pub fn extend(&mut self, samples: &[f32]) -> usize {
        let view = &self.view;
        let new = view.frames_in(samples.len() / view.channels);
        let (width, hop, channels) = (view.width(), view.hop(), view.channels);
        let begin = self.values.len();
        self.values.resize(begin + new * width, 0.0);
        self.values[begin..].par_chunks_mut(width * FRAMES_A_TASK).enumerate().for_each(
            |(task, rows)| {
                with_workspace(view.points, |workspace| {
                    for (i, row) in rows.chunks_exact_mut(width).enumerate() {
                        let start = (task * FRAMES_A_TASK + i) * hop * channels;
                        let frame = &samples[start..start + view.points * channels];
                        workspace.frame(view, frame, row);
                    }
                });
            },
        );
        new * hop
    }

    /// Appends one frame: `samples`, less the mean of each channel, then zeros.
    pub fn pad(&mut self, samples: &[f32]) {
        let channels = self.view.channels;
        let mut padded = vec![0.0; self.view.points * channels];
        for c in 0..channels {
            let of_channel: Vec<f32> = samples.iter().skip(c).step_by(channels).copied().collect();
            let mean = mean(&of_channel);
            let slots = padded.iter_mut().skip(c).step_by(channels);
            slots.zip(&of_channel).for_each(|(slot, x)| *slot = x - mean);
        }
        self.extend(&padded);
    }

    pub fn frames(&self) -> usize {
        self.values.len() / self.view.width()
    }
}

/// An FFT plan and its buffers; each thread keeps its own.
struct Workspace {
    plan: Arc<dyn RealToComplex<f32>>,
    window: Vec<f32>,
    /// Turns |X|² into power: 2/(L·Σw²).
    scale: f32,
    input: Vec<f32>,
    output: Vec<Complex<f32>>,
    scratch: Vec<Complex<f32>>,
}

thread_local! {
    static WORKSPACES: RefCell<HashMap<usize, Workspace>> = RefCell::new(HashMap::new());
}

fn with_workspace(points: usize, work: impl FnOnce(&mut Workspace)) {
    WORKSPACES.with_borrow_mut(|all| {
        work(all.entry(points).or_insert_with(|| Workspace::new(points)));
    });
}

impl Workspace {
    fn new(points: usize) -> Self {
        let plan = RealFftPlanner::<f32>::new().plan_fft_forward(points);
        let hann =
            |n: usize| 0.5 - 0.5 * (2.0 * std::f64::consts::PI * n as f64 / points as f64).cos();
        let power: f64 = (0..points).map(|n| hann(n).powi(2)).sum();
        Self {
            window: (0..points).map(|n| hann(n) as f32).collect(),
            scale: (2.0 / (points as f64 * power)) as f32,
            input: plan.make_input_vec(),
            output: plan.make_output_vec(),
            scratch: plan.make_scratch_vec(),
            plan,
        }
    }

    /// One frame of L interleaved samples a channel; `row` gets the bands, channel by channel.
    fn frame(&mut self, view: &FrameView, samples: &[f32], row: &mut [f32]) {
        for (channel, bands) in row.chunks_exact_mut(view.bands()).enumerate() {
            let of_channel = samples[channel..].iter().step_by(view.channels);
            self.input.iter_mut().zip(of_channel).for_each(|(slot, x)| *slot = *x);
            let mean = mean(&self.input);
            for (slot, w) in self.input.iter_mut().zip(&self.window) {
                *slot = (*slot - mean) * w;
            }
            self.plan
                .process_with_scratch(&mut self.input, &mut self.output, &mut self.scratch)
                // Fails only if a buffer has another length.
                .expect("buffers of the plan's own lengths");
            for (band, slot) in bands.iter_mut().enumerate() {
                let bins = &self.output[view.edges[band]..view.edges[band + 1]];
                let power: f32 = bins.iter().map(Complex::norm_sqr).sum();
                // Samples far beyond full scale must not become infinite.
                let mean = (power * self.scale / bins.len() as f32).min(f32::MAX);
                *slot = (mean + POWER_FLOOR).ln();
            }
        }
    }
}

/// The mean, summed in f64 in eight lanes, so that no addition waits for the one before it.
fn mean(samples: &[f32]) -> f32 {
    let mut lanes = [0f64; 8];
    for chunk in samples.chunks(lanes.len()) {
        lanes.iter_mut().zip(chunk).for_each(|(lane, &x)| *lane += f64::from(x));
    }
    (lanes.iter().sum::<f64>() / samples.len().max(1) as f64) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(index: usize) -> FrameView {
        let (frame_s, bands) = VIEWS[index];
        FrameView::new(44_100.0, 1, (0.0, 7500.0), frame_s, bands)
    }

    #[test]
    fn bands_have_the_edges_of_the_prototype() {
        assert_eq!(
            view(1).edges,
            [
                0, 1, 2, 3, 4, 6, 7, 9, 11, 13, 15, 17, 20, 23, 27, 30, 34, 39, 44, 49, 56, 62, 70,
                78, 87
            ]
        );
        assert_eq!(
            view(0).edges,
            [
                0, 2, 4, 7, 9, 12, 15, 18, 21, 25, 29, 33, 37, 41, 46, 51, 56, 62, 68, 74, 81, 88,
                95, 103, 112, 121, 131, 141, 152, 163, 176, 189, 202, 217, 233, 249, 267, 285, 305,
                326, 348
            ]
        );
        assert_eq!((view(0).points, view(1).points), (2048, 512));
        let slow = FrameView::new(10_000.0, 3, (0.0, 1000.0), VIEWS[1].0, VIEWS[1].1);
        assert_eq!((slow.points, slow.edges.last()), (128, Some(&13)));
    }

    #[test]
    fn a_band_above_half_the_rate_or_of_no_width_still_has_a_bin() {
        assert_eq!(FrameView::new(100.0, 1, (300.0, 400.0), 0.1, 8).bands(), 1);
        assert!(FrameView::new(100.0, 1, (20.0, 20.01), 0.1, 8).edges.len() > 1);
        let narrow = FrameView::new(44_100.0, 1, (0.0, 80.0), 0.0464, 40);
        assert_eq!(narrow.edges.last(), Some(&4), "80 Hz are fewer than four bins of 21.5 Hz");
    }

    #[test]
    fn power_is_the_mean_square_of_a_sine() {
        let view = view(0);
        let hz = view.rate_hz / 2048.0 * 50.0;
        let wave = |i: usize| (2.0 * std::f64::consts::PI * hz * i as f64 / view.rate_hz).sin();
        let samples: Vec<f32> = (0..44_100).map(|i| 0.1 * wave(i) as f32).collect();
        let frames = ViewFrames::new(view.clone(), &samples);
        assert_eq!(frames.frames(), 42);
        let power: f64 = (0..view.bands())
            .map(|b| {
                let bins = (view.edges[b + 1] - view.edges[b]) as f64;
                f64::from(frames.values[b]).exp() * bins
            })
            .sum();
        // Mean square of the windowed sine over that of the window: 0.1²/2.
        assert!((power / 0.005 - 1.0).abs() < 1e-3, "{power}");
    }

    #[test]
    fn a_gain_adds_a_constant_and_silence_is_finite() {
        let samples: Vec<f32> = (0..4096).map(|i| ((i * i) as f32 * 0.37).sin() * 0.2).collect();
        let louder: Vec<f32> = samples.iter().map(|x| x * 2.0).collect();
        let (a, b) = (ViewFrames::new(view(1), &samples), ViewFrames::new(view(1), &louder));
        assert!(a.values.iter().zip(&b.values).all(|(a, b)| (b - a - 4f32.ln()).abs() < 1e-4));
        let silent = ViewFrames::new(view(0), &[0.0; 10]);
        assert_eq!(silent.frames(), 1);
        assert!(silent.values.iter().all(|x| (x - POWER_FLOOR.ln()).abs() < 1e-3));
        assert!(ViewFrames::new(view(0), &[1e30; 4096]).values.iter().all(|x| x.is_finite()));
    }

    #[test]
    fn an_offset_changes_nothing() {
        let samples: Vec<f32> = (0..4096).map(|i| ((i * i) as f32 * 0.37).sin() * 0.2).collect();
        let shifted: Vec<f32> = samples.iter().map(|x| x + 0.5).collect();
        for index in [0, 1] {
            let a = ViewFrames::new(view(index), &samples);
            let b = ViewFrames::new(view(index), &shifted);
            assert!(a.values.iter().zip(&b.values).all(|(a, b)| (b - a).abs() < 1e-3));
        }
    }

    #[test]
    fn channels_stand_beside_each_other() {
        let one: Vec<f32> = (0..4096).map(|i| (i as f32 * 0.5).sin()).collect();
        let two: Vec<f32> = one.iter().flat_map(|&x| [x, 0.5 * x]).collect();
        let mono = ViewFrames::new(view(1), &one);
        let both = ViewFrames::new(FrameView { channels: 2, ..view(1) }, &two);
        assert_eq!(both.frames(), mono.frames());
        assert_eq!(both.values[3 * 48..][..24], mono.values[3 * 24..][..24]);
    }
}
