//! Log-band frames: the power of a sound or vibration in frequency bands, frame by frame.
//!
//! A [`FrameView`] is one way to cut a source into frames. Successive frames overlap by half. The mean of
//! each frame is subtracted first, since a sensor's offset would leak into the lowest bands. The frame
//! is windowed (periodic Hann) and transformed. Its power is averaged over bands with edges equally
//! spaced in ln(1 + f/f0); f0 is a tenth of the highest frequency. The value of a band is A = ln(mean
//! power + 1e-14). The power of a bin is 2|X|²/(L·Σw²) for samples in units of full scale, so 16-bit
//! quantisation adds about 8e-14 a bin.

use std::borrow::Cow;
use std::cell::RefCell;
use std::collections::HashMap;
use std::ops::Range;
use std::sync::Arc;

use multiversion::multiversion;
use rayon::prelude::*;
use realfft::{ComplexToReal, RealFftPlanner};
use rustfft::num_complex::Complex;
use rustfft::{Fft, FftPlanner};

use crate::lanes::{less, sum};

/// Added to the power of each band, so that the logarithm of a silent band is finite.
const POWER_FLOOR: f32 = 1e-14;

const FRAMES_A_TASK: usize = 64;

/// Fewest samples in a frame.
pub(crate) const FEWEST: usize = 4;

#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct FrameView {
    /// Number of samples in a frame, L: a power of two.
    pub points: usize,
    pub rate_hz: f64,
    pub channels: usize,
    /// The first bin of each band, and the end of the last band.
    pub edges: Vec<usize>,
    /// Whether the mean of a frame belongs to the bands. It holds the frequencies below half a bin, most
    /// of which must lie above the lower end.
    pub holds_mean: bool,
}

/// The number of samples in a frame of `frame_s` seconds, rounded (in log2) to a power of two.
pub(super) fn points(frame_s: f64, rate_hz: f64) -> usize {
    1 << (frame_s * rate_hz).log2().round().clamp(1.0, 24.0) as u32
}

impl FrameView {
    /// A view with frames of `points` samples, a power of two. It has at most `bands` bands; each band is
    /// at least one bin wide, and none lies above half the rate.
    pub fn of_points(
        points: usize,
        rate_hz: f64,
        channels: usize,
        band_hz: (f64, f64),
        bands: usize,
    ) -> Self {
        let edges = band_edges(points, rate_hz, band_hz, bands);
        let holds_mean = band_hz.0 * points as f64 / rate_hz < 0.25;
        Self { points, rate_hz, channels, edges, holds_mean }
    }

    /// Frames of about the same duration and with the same bands at another rate. Frames are longer where the
    /// bins would else be wider than a band. Bands above half the rate are left out.
    pub fn at_rate(&self, rate_hz: f64) -> Self {
        let points = (self.points as f64 * rate_hz / self.rate_hz).log2().round().exp2();
        let mut points = points.max(FEWEST as f64);
        loop {
            let bins = self.rate_hz / self.points as f64 / (rate_hz / points);
            let end = points as usize / 2 + 1;
            let edges: Vec<usize> =
                self.edges.iter().map(|edge| (*edge as f64 * bins).round() as usize).collect();
            let is_narrow = edges.windows(2).any(|two| two[0] >= two[1]);
            if is_narrow && points < self.points as f64 * 4.0 * (rate_hz / self.rate_hz).max(1.0) {
                points *= 2.0;
                continue;
            }
            let edges = edges.into_iter().filter(|edge| *edge <= end).collect();
            return Self { points: points as usize, rate_hz, edges, ..self.clone() };
        }
    }

    /// Samples from the beginning of one frame to the beginning of the next.
    pub fn hop(&self) -> usize {
        self.points / 2
    }

    pub fn bands(&self) -> usize {
        self.edges.len() - 1
    }

    /// Number of values in a frame: all bands of the first channel, then of the second, …
    pub fn width(&self) -> usize {
        self.channels * self.bands()
    }

    /// Number of whole frames in a recording of `samples` samples a channel.
    pub fn frames_in(&self, samples: usize) -> usize {
        if samples < self.points { 0 } else { (samples - self.points) / self.hop() + 1 }
    }

    /// The frames of a recording of interleaved samples: A = ln(mean power + 1e-14), shape (frames,
    /// width). A recording shorter than a frame gives one frame: mean subtracted, padded with zeros.
    pub fn frames(&self, samples: &[f32]) -> Vec<f32> {
        let channels = self.channels;
        if self.frames_in(samples.len() / channels) > 0 {
            return self.whole_frames(samples);
        }
        let mut padded = vec![0.0; self.points * channels];
        for c in 0..channels {
            let own = less(samples, (channels, c), 0.0);
            let mean = mean(&own);
            let slots = padded.iter_mut().skip(c).step_by(channels);
            slots.zip(&own).for_each(|(slot, x)| *slot = x - mean);
        }
        self.whole_frames(&padded)
    }

    /// Like [`Self::frames`], but gives no frame if the recording is shorter than a frame.
    pub fn whole_frames(&self, samples: &[f32]) -> Vec<f32> {
        self.transform(samples, None).0
    }

    /// The whole frames, and the part of each frame that lies within the bands: windowed samples at a
    /// lower rate, shape (frames, [`Self::passed_points`], channels).
    pub fn whole_frames_and_passed(&self, samples: &[f32]) -> (Vec<f32>, Vec<f32>) {
        self.transform(samples, Some(self.passed_points()))
    }

    /// Number of samples that a frame takes once it is limited to the bands: a power of two.
    pub fn passed_points(&self) -> usize {
        let end = self.edges[self.edges.len() - 1];
        (2 * end).next_power_of_two().clamp(2.min(self.points), self.points)
    }

    fn transform(&self, samples: &[f32], passed: Option<usize>) -> (Vec<f32>, Vec<f32>) {
        let (width, hop, channels) = (self.width(), self.hop(), self.channels);
        let frames = self.frames_in(samples.len() / channels);
        let mut values = vec![0.0; frames * width];
        let block = passed.unwrap_or(0) * channels;
        let mut parts = vec![0.0; frames * block];
        // Each channel in one piece, since every sample is read twice.
        let planes: Vec<Cow<'_, [f32]>> = match channels {
            1 => vec![samples.into()],
            _ => (0..channels).map(|c| less(samples, (channels, c), 0.0).into()).collect(),
        };
        let task = |task: usize, rows: &mut [f32], parts: &mut [f32]| {
            WORKSPACES.with_borrow_mut(|all| {
                let new = || Workspace::new(self.points);
                let workspace = all.entry(self.points).or_insert_with(new);
                for (i, row) in rows.chunks_exact_mut(width).enumerate() {
                    let start = (task * FRAMES_A_TASK + i) * hop;
                    let frame = planes.iter().map(|plane| &plane[start..start + self.points]);
                    workspace.frame(self, frame, row, &mut parts[i * block..(i + 1) * block]);
                }
            });
        };
        if block == 0 {
            let rows = values.par_chunks_mut(width * FRAMES_A_TASK).enumerate();
            rows.for_each(|(number, rows)| task(number, rows, &mut []));
        } else {
            let parts = parts.par_chunks_mut(block * FRAMES_A_TASK);
            let rows = values.par_chunks_mut(width * FRAMES_A_TASK).zip(parts).enumerate();
            rows.for_each(|(number, (rows, parts))| task(number, rows, parts));
        }
        (values, parts)
    }

    /// Whether the bands of two views cover the same frequencies; their rates may differ.
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
    // No band ends above the highest frequency of `band_hz`, even if fewer than `bands` bands fit.
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
        // The whole band lies above half the rate; the highest bin is used instead.
        return vec![end - 1, end];
    }
    edges
}

/// An FFT plan and its buffers. Each thread has its own.
///
/// A frame is transformed as half as many complex numbers: even samples are their real parts, odd ones the
/// imaginary. Only the bins that are asked for are then told apart.
struct Workspace {
    /// The transform of L/2 complex numbers.
    plan: Arc<dyn Fft<f32>>,
    window: Vec<f32>,
    /// −i/2·e^(−2πik/L) of each bin k.
    turns: Vec<Complex<f32>>,
    /// Factor from |X|² to power: 2/(L·Σw²).
    scale: f32,
    /// The transformed numbers, and the first once more.
    half: Vec<Complex<f32>>,
    /// The bins, as far as asked for.
    bins: Vec<Complex<f32>>,
    scratch: Vec<Complex<f32>>,
    /// The transform back to a number of samples, made when first needed.
    back: HashMap<usize, Back>,
}

/// Bins, samples, scratch memory and plan of a transform back.
type Back = (Vec<Complex<f32>>, Vec<f32>, Vec<Complex<f32>>, Arc<dyn ComplexToReal<f32>>);

thread_local! {
    static WORKSPACES: RefCell<HashMap<usize, Workspace>> = RefCell::new(HashMap::new());
}

impl Workspace {
    fn new(points: usize) -> Self {
        let plan = FftPlanner::<f32>::new().plan_fft_forward(points / 2);
        let angle = |n: usize| 2.0 * std::f64::consts::PI * n as f64 / points as f64;
        let hann = |n: usize| 0.5 - 0.5 * angle(n).cos();
        let power: f64 = (0..points).map(|n| hann(n).powi(2)).sum();
        let turn = |k| Complex::new((-0.5 * angle(k).sin()) as f32, (-0.5 * angle(k).cos()) as f32);
        Self {
            window: (0..points).map(|n| hann(n) as f32).collect(),
            turns: (0..=points / 2).map(turn).collect(),
            scale: (2.0 / (points as f64 * power)) as f32,
            half: vec![Complex::default(); points / 2 + 1],
            bins: vec![Complex::default(); points / 2 + 1],
            scratch: vec![Complex::default(); plan.get_inplace_scratch_len()],
            back: HashMap::new(),
            plan,
        }
    }

    /// Transforms one frame, the L samples of each channel. Fills `row`, channel by channel, and
    /// `part`, interleaved, with what lies within the bands; `part` may be empty.
    fn frame<'s>(
        &mut self,
        view: &FrameView,
        samples: impl Iterator<Item = &'s [f32]>,
        row: &mut [f32],
        part: &mut [f32],
    ) {
        let within = view.edges[0]..view.edges[view.edges.len() - 1];
        let channels = row.chunks_exact_mut(view.bands()).zip(samples);
        for (channel, (bands, samples)) in channels.enumerate() {
            let mean = self.transform(samples, within.clone());
            for (band, slot) in bands.iter_mut().enumerate() {
                let bins = &self.bins[view.edges[band]..view.edges[band + 1]];
                let power = power(bins);
                // Samples far above full scale must not give infinite values.
                *slot = (power * self.scale / bins.len() as f32).min(f32::MAX);
            }
            logarithms(bands);
            if !part.is_empty() {
                self.pass_back(view, mean, part, channel);
            }
        }
    }

    /// Transforms L samples, without their mean and windowed, into the bins `within`; the mean is given.
    fn transform(&mut self, samples: &[f32], within: Range<usize>) -> f32 {
        let last = self.half.len() - 1;
        let mean = windowed(samples, &self.window, &mut self.half[..last]);
        self.plan.process_with_scratch(&mut self.half[..last], &mut self.scratch);
        self.half[last] = self.half[0];
        tell_apart(&self.half, &self.turns, within, &mut self.bins);
        mean
    }

    /// Writes the samples of one channel within the bands, from the spectrum in `bins` and the mean of
    /// the frame.
    fn pass_back(&mut self, view: &FrameView, mean: f32, part: &mut [f32], channel: usize) {
        let points = part.len() / view.channels;
        let back = self.back.entry(points).or_insert_with(|| {
            let plan = RealFftPlanner::new().plan_fft_inverse(points);
            (plan.make_input_vec(), plan.make_output_vec(), plan.make_scratch_vec(), plan)
        });
        let (bins, samples, scratch, plan) = back;
        let (first, end) = (view.edges[0], view.edges[view.edges.len() - 1].min(bins.len()));
        let scale = 1.0 / view.points as f32;
        bins.fill(Complex::default());
        let within = bins[first..end].iter_mut().zip(&self.bins[first..end]);
        within.for_each(|(bin, x)| *bin = x * scale);
        // The transform of real samples has real ends.
        bins[0].im = 0.0;
        bins[points / 2].im = 0.0;
        plan.process_with_scratch(bins, samples, scratch)
            // Fails only if a buffer has another length.
            .expect("buffers of the plan's own lengths");
        let mean = if view.holds_mean { mean } else { 0.0 };
        let step = view.points / points;
        let slots = part[channel..].iter_mut().step_by(view.channels);
        let window = self.window.iter().step_by(step);
        slots.zip(samples.iter()).zip(window).for_each(|((slot, x), w)| *slot = x + mean * w);
    }
}

/// Subtracts the mean of a frame, which is given, and multiplies the frame by a window. Even samples become
/// real parts, odd ones imaginary parts.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn windowed(samples: &[f32], window: &[f32], half: &mut [Complex<f32>]) -> f32 {
    let mean = mean(samples);
    let ((samples, _), (window, _)) = (samples.as_chunks::<2>(), window.as_chunks::<2>());
    for i in 0..half.len().min(samples.len()).min(window.len()) {
        half[i].re = (samples[i][0] - mean) * window[i][0];
        half[i].im = (samples[i][1] - mean) * window[i][1];
    }
    mean
}

/// The bins `within` of the transform of real samples, from that of pairs of them: with Z of the pairs, Z* its
/// conjugate and `turns` as in [`Workspace`], X_k = (Z_k + Z*_(L/2−k))/2 + turn_k·(Z_k − Z*_(L/2−k)).
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn tell_apart(
    half: &[Complex<f32>],
    turns: &[Complex<f32>],
    within: Range<usize>,
    bins: &mut [Complex<f32>],
) {
    let mirrored = &half[half.len() - within.end..half.len() - within.start];
    let (half, turns) = (&half[within.clone()], &turns[within.clone()]);
    let bins = &mut bins[within];
    let count = bins.len().min(half.len()).min(turns.len()).min(mirrored.len());
    for k in 0..count {
        let (here, there, turn) = (half[k], mirrored[count - 1 - k], turns[k]);
        let (re, im) = (here.re - there.re, here.im + there.im);
        bins[k].re = 0.5 * (here.re + there.re) + turn.re * re - turn.im * im;
        bins[k].im = 0.5 * (here.im - there.im) + turn.re * im + turn.im * re;
    }
}

/// Σ |X|², by eight sums, so that no addition waits for the one before.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn power(bins: &[Complex<f32>]) -> f32 {
    let (chunks, rest) = bins.as_chunks::<8>();
    let mut lanes = [0f32; 8];
    for chunk in chunks {
        for lane in 0..8 {
            lanes[lane] += chunk[lane].norm_sqr();
        }
    }
    lanes.iter().sum::<f32>() + rest.iter().map(Complex::norm_sqr).sum::<f32>()
}

#[inline(always)]
fn mean(samples: &[f32]) -> f32 {
    (sum(samples) / samples.len().max(1) as f64) as f32
}

/// ln x of a positive normal number, with an error of 1e-15 or of as much of ln x; NaN of what is not
/// finite. Unlike `f64::ln`, it is no function call.
#[inline(always)]
pub(crate) fn ln(x: f64) -> f64 {
    const ROOT_HALF: u64 = std::f64::consts::FRAC_1_SQRT_2.to_bits();
    // x = 2^exponent·m, with m from √½ to √2.
    let exponent = (x.to_bits().wrapping_sub(ROOT_HALF) as i64 >> 52) as i32;
    let m = f64::from_bits(x.to_bits().wrapping_sub((exponent as u64) << 52));
    // ln m = 2·artanh s
    let s = (m - 1.0) / (m + 1.0);
    let z = s * s;
    let odd = 1.0 / 3.0
        + z * (1.0 / 5.0
            + z * (1.0 / 7.0
                + z * (1.0 / 9.0
                    + z * (1.0 / 11.0
                        + z * (1.0 / 13.0
                            + z * (1.0 / 15.0 + z * (1.0 / 17.0 + z * (1.0 / 19.0))))))));
    // 0, or NaN
    let not_finite = 0.0 * x;
    f64::from(exponent) * std::f64::consts::LN_2 + 2.0 * (s + s * z * odd) + not_finite
}

/// The ln of each power, to which [`POWER_FLOOR`] is added.
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn logarithms(powers: &mut [f32]) {
    for power in powers {
        *power = ln(f64::from(*power + POWER_FLOOR)) as f32;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_logarithm_is_that_of_the_standard_library() {
        let near_one = (-2000..2000).map(|i| 1.0 + f64::from(i) * 1e-4);
        let all = (-3000..3000).map(|i| (f64::from(i) * 0.037).exp());
        for x in near_one.chain(all).chain([1.0, f64::MIN_POSITIVE, f64::MAX]) {
            let error = (ln(x) - x.ln()).abs();
            assert!(error <= 1e-15 * x.ln().abs().max(1.0), "{x}: {error}");
        }
        assert!(ln(f64::NAN).is_nan() && ln(f64::INFINITY).is_nan());
    }

    /// Duration of a frame in seconds, and number of bands.
    const VIEWS: [(f64, usize); 2] = [(0.0464, 40), (0.0116, 24)];

    fn view(index: usize) -> FrameView {
        let (frame_s, bands) = VIEWS[index];
        FrameView::of_points(points(frame_s, 44_100.0), 44_100.0, 1, (0.0, 7500.0), bands)
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
        let (points, bands) = (points(VIEWS[1].0, 10_000.0), VIEWS[1].1);
        let slow = FrameView::of_points(points, 10_000.0, 3, (0.0, 1000.0), bands);
        assert_eq!((slow.points, slow.edges.last()), (128, Some(&13)));
    }

    #[test]
    fn a_band_above_half_the_rate_or_of_no_width_still_has_a_bin() {
        assert_eq!(FrameView::of_points(8, 100.0, 1, (300.0, 400.0), 8).bands(), 1);
        assert!(FrameView::of_points(8, 100.0, 1, (20.0, 20.01), 8).edges.len() > 1);
        let narrow = FrameView::of_points(2048, 44_100.0, 1, (0.0, 80.0), 40);
        assert_eq!(narrow.edges.last(), Some(&4), "80 Hz are fewer than four bins of 21.5 Hz");
    }

    #[test]
    fn power_is_the_mean_square_of_a_sine() {
        let view = view(0);
        let hz = view.rate_hz / 2048.0 * 50.0;
        let wave = |i: usize| (2.0 * std::f64::consts::PI * hz * i as f64 / view.rate_hz).sin();
        let samples: Vec<f32> = (0..44_100).map(|i| 0.1 * wave(i) as f32).collect();
        let frames = view.frames(&samples);
        assert_eq!(frames.len(), 42 * view.width());
        let power: f64 = (0..view.bands())
            .map(|b| {
                let bins = (view.edges[b + 1] - view.edges[b]) as f64;
                f64::from(frames[b]).exp() * bins
            })
            .sum();
        // Mean square of the windowed sine over that of the window: 0.1²/2.
        assert!((power / 0.005 - 1.0).abs() < 1e-3, "{power}");
    }

    #[test]
    fn bins_are_those_of_the_transform_by_its_definition() {
        for points in [4, 32] {
            let samples: Vec<f32> =
                (0..points).map(|i| ((i * i) as f32 * 0.7).sin() + 0.3).collect();
            let mut workspace = Workspace::new(points);
            for within in [0..points / 2 + 1, 1..points / 2] {
                workspace.bins.fill(Complex::default());
                let mean = workspace.transform(&samples, within.clone());
                let Workspace { bins, window, .. } = &workspace;
                for (k, bin) in bins.iter().enumerate() {
                    let term = |n: usize| {
                        let angle = std::f32::consts::TAU * (n * k % points) as f32 / points as f32;
                        Complex::from_polar((samples[n] - mean) * window[n], -angle)
                    };
                    let exact: Complex<f32> = (0..points).map(term).sum();
                    let wanted = if within.contains(&k) { exact } else { Complex::default() };
                    assert!((bin - wanted).norm() < 1e-5, "{k} of {points}");
                }
            }
        }
    }

    #[test]
    fn a_gain_adds_a_constant_and_silence_is_finite() {
        let samples: Vec<f32> = (0..4096).map(|i| ((i * i) as f32 * 0.37).sin() * 0.2).collect();
        let louder: Vec<f32> = samples.iter().map(|x| x * 2.0).collect();
        let (a, b) = (view(1).frames(&samples), view(1).frames(&louder));
        assert!(a.iter().zip(&b).all(|(a, b)| (b - a - 4f32.ln()).abs() < 1e-4));
        let silent = view(0).frames(&[0.0; 10]);
        assert_eq!(silent.len(), view(0).width());
        assert!(silent.iter().all(|x| (x - POWER_FLOOR.ln()).abs() < 1e-3));
        assert!(view(0).frames(&[1e30; 4096]).iter().all(|x| x.is_finite()));
    }

    #[test]
    fn an_offset_changes_nothing() {
        let samples: Vec<f32> = (0..4096).map(|i| ((i * i) as f32 * 0.37).sin() * 0.2).collect();
        let shifted: Vec<f32> = samples.iter().map(|x| x + 0.5).collect();
        for index in [0, 1] {
            let (a, b) = (view(index).frames(&samples), view(index).frames(&shifted));
            assert!(a.iter().zip(&b).all(|(a, b)| (b - a).abs() < 1e-3));
        }
    }

    #[test]
    fn channels_stand_beside_each_other() {
        let one: Vec<f32> = (0..4096).map(|i| (i as f32 * 0.5).sin()).collect();
        let two: Vec<f32> = one.iter().flat_map(|&x| [x, 0.5 * x]).collect();
        let mono = view(1).frames(&one);
        let both = FrameView { channels: 2, ..view(1) }.frames(&two);
        assert_eq!(both.len(), 2 * mono.len());
        assert_eq!(both[3 * 48..][..24], mono[3 * 24..][..24]);
    }
}
