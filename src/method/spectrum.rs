//! Amplitude spectra, computed as in the program of the paper's authors.

use std::cell::RefCell;

use realfft::RealFftPlanner;
use realfft::num_complex::Complex;

thread_local! {
    /// Plans of Fourier transforms, kept for each thread, since they are slow to make.
    static PLANNER: RefCell<RealFftPlanner<f64>> = RefCell::new(RealFftPlanner::new());
    /// Input, output and scratch buffers of the transform, kept for reuse: megabytes for a drag.
    static BUFFERS: RefCell<Buffers> = RefCell::default();
}

type Buffers = (Vec<f64>, Vec<Complex<f64>>, Vec<Complex<f64>>);

/// Range of the spectral bins within a band (ends included), for `frames` samples at `rate_hz`.
///
/// The transform's length is `frames`, rounded up to a power of two; bin k is at k·rate/length Hz.
pub fn band_bins(frames: usize, rate_hz: f64, band_hz: (f64, f64)) -> std::ops::Range<usize> {
    let points = frames.next_power_of_two();
    let per_hz = points as f64 / rate_hz;
    let first = (band_hz.0 * per_hz).ceil() as usize;
    let last = ((band_hz.1 * per_hz).floor() as usize).min(points / 2);
    first..(last + 1).max(first)
}

/// One-sided amplitude spectrum of one channel within a band.
///
/// # Normalization
/// 2|X(f)|/L, where L is the number of samples. The samples are zero-padded to the next power of
/// two. No window is applied, and the mean is not removed.
///
/// # Output order
/// Ascending frequency, from the first bin of `band_bins` on.
pub fn amplitude_spectrum(
    samples: impl ExactSizeIterator<Item = f64>,
    rate_hz: f64,
    band_hz: (f64, f64),
) -> Vec<f64> {
    let frames = samples.len();
    // A transform needs at least two points, so a single sample is padded.
    let points = frames.next_power_of_two().max(2);
    let plan = PLANNER.with_borrow_mut(|planner| planner.plan_fft_forward(points));
    let bins = band_bins(frames, rate_hz, band_hz);
    let scale = 2.0 / frames as f64;
    BUFFERS.with_borrow_mut(|(input, output, scratch)| {
        input.clear();
        input.extend(samples);
        input.resize(points, 0.0);
        output.resize(points / 2 + 1, Complex::default());
        scratch.resize(plan.get_scratch_len().max(scratch.len()), Complex::default());
        // This cannot fail: all buffers have the lengths that the plan demands.
        plan.process_with_scratch(input, output, scratch).expect("buffers of the plan's lengths");
        let band = &output[bins.start.min(output.len())..bins.end.min(output.len())];
        band.iter().map(|x| scale * x.norm_sqr().sqrt()).collect()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bands_have_the_sizes_of_the_authors_program() {
        assert_eq!(band_bins(10_501, 44_100.0, (0.0, 7500.0)).len(), 2_787);
        assert_eq!(band_bins(211_611, 44_100.0, (0.0, 7500.0)).len(), 44_583);
        assert_eq!(band_bins(48_000, 10_000.0, (0.0, 1000.0)).len(), 6_554);
    }

    #[test]
    fn a_sine_has_its_amplitude_at_its_frequency() {
        let sine = (0..1024).map(|i| 3.0 * (f64::from(i) * 0.25 * std::f64::consts::PI).sin());
        let spectrum = amplitude_spectrum(sine.collect::<Vec<_>>().into_iter(), 8.0, (0.0, 4.0));
        assert!((spectrum[128] - 3.0).abs() < 1e-12);
        assert!(spectrum[100] < 1e-12);
    }

    #[test]
    fn a_band_above_half_the_rate_is_empty() {
        let flat = std::iter::repeat_n(1.0, 64);
        assert!(amplitude_spectrum(flat, 10.0, (6.0, 9.0)).is_empty());
    }
}
