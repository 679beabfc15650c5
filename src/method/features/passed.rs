//! The part of a series within its configured band, from the frames of its long view.
//!
//! Moments, quantiles and covariances respond to all frequencies. If a source is compared in only part
//! of its spectrum, they are taken from this signal, so that excluded frequencies do not count through
//! them. The frames of a view overlap by half, and their windows add up to 1 (periodic Hann). So the
//! band-limited frames, added where they overlap, are the band-limited series. Before the middle of
//! the first frame and after that of the last one, a single window covers the series; its outer half is
//! left out, and the rest divided by the window.

use std::ops::Range;

use super::moments::means;
use super::windowed_frames::FrameView;

/// A band-limited series that grows frame by frame.
#[derive(Clone, Debug)]
pub(super) struct Passed {
    /// Samples a channel of one frame.
    points: usize,
    channels: usize,
    /// The second half of the last frame; empty before the first frame.
    tail: Vec<f32>,
}

impl Passed {
    pub(super) fn new(view: &FrameView) -> Self {
        let (points, channels) = (view.passed_points(), view.channels);
        Self { points, channels, tail: Vec::new() }
    }

    /// Adds frames of [`FrameView::whole_frames_and_passed`]. Gives the samples, interleaved, that later
    /// frames do not change.
    pub(super) fn add(&mut self, frames: &[f32]) -> Vec<f32> {
        let mut samples = Vec::with_capacity(frames.len() / 2);
        for frame in frames.chunks_exact(self.points * self.channels) {
            let (first, second) = frame.split_at(frame.len() / 2);
            if self.tail.is_empty() {
                samples.extend(self.of_one_window(first, 0, self.points / 4..self.points / 2));
            } else {
                samples.extend(self.tail.iter().zip(first).map(|(a, b)| a + b));
            }
            self.tail = second.to_vec();
        }
        samples
    }

    /// The samples after those of `add`, if the series ends here.
    pub(super) fn edge(&self) -> Vec<f32> {
        if self.tail.is_empty() {
            return Vec::new();
        }
        let half = self.points / 2;
        self.of_one_window(&self.tail, half, half..self.points - self.points / 4)
    }

    /// The samples at places `within` a frame that one window covers; `half` begins at place `first`.
    fn of_one_window(&self, half: &[f32], first: usize, within: Range<usize>) -> Vec<f32> {
        let of_place = |place: usize| {
            let window = window(place, self.points);
            let at = (place - first) * self.channels;
            half[at..at + self.channels].iter().map(move |x| x / window)
        };
        within.flat_map(of_place).collect()
    }
}

/// A series shorter than a frame, limited to the bands: in the middle of a frame of zeros.
pub(super) fn short(view: &FrameView, samples: &[f32]) -> Vec<f32> {
    let (channels, points) = (view.channels, view.passed_points());
    let frames = samples.len() / channels;
    let first = (view.points - frames) / 2;
    let mut padded = vec![0.0; view.points * channels];
    let means = means(samples, channels);
    for (i, x) in samples.iter().enumerate() {
        padded[first * channels + i] = x - means[i % channels];
    }
    let passed = view.whole_frames_and_passed(&padded).1;
    let from = first * points / view.points;
    let end = (from + frames * points / view.points).clamp(from + 1, points);
    let of_place = |place: usize| {
        let window = window(place, points);
        passed[place * channels..(place + 1) * channels].iter().map(move |x| x / window)
    };
    (from..end).flat_map(of_place).collect()
}

/// The window at a place of a frame; not so small that dividing by it would magnify errors.
fn window(place: usize, points: usize) -> f32 {
    let turn = std::f64::consts::TAU * place as f64 / points as f64;
    (0.5 - 0.5 * turn.cos()).max(0.25) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tones(frames: usize, hz: &[f64]) -> Vec<f32> {
        let value = |i: usize| hz.iter().map(|hz| (i as f64 * hz * 0.006_283).sin()).sum::<f64>();
        (0..frames).map(|i| value(i) as f32).collect()
    }

    fn passed(samples: &[f32]) -> Vec<f32> {
        let view = FrameView::of_points(256, 1000.0, 1, (20.0, 120.0), 40);
        let mut passed = Passed::new(&view);
        let frames = view.whole_frames_and_passed(samples).1;
        let parts = frames.chunks(3 * view.passed_points());
        let mut samples: Vec<f32> = parts.flat_map(|part| passed.add(part)).collect();
        samples.extend(passed.edge());
        samples
    }

    fn deviation(x: &[f32]) -> f32 {
        (x.iter().map(|x| x * x).sum::<f32>() / x.len() as f32).sqrt()
    }

    #[test]
    fn what_lies_in_the_band_passes_and_what_lies_outside_does_not() {
        let inside = passed(&tones(4000, &[50.0, 90.0]));
        let expected = deviation(&tones(4000, &[50.0, 90.0]));
        assert!((deviation(&inside) / expected - 1.0).abs() < 0.02, "{}", deviation(&inside));
        let outside = passed(&tones(4000, &[5.0, 300.0]));
        assert!(deviation(&outside) < 2e-3, "{}", deviation(&outside));
        let both = passed(&tones(4000, &[50.0, 300.0]));
        let one = passed(&tones(4000, &[50.0]));
        assert!(both.iter().zip(&one).all(|(a, b)| (a - b).abs() < 1e-2));
    }

    #[test]
    fn what_is_slower_than_a_frame_passes_if_the_band_begins_near_0_hz() {
        let slow = tones(4000, &[0.5]);
        let passed = |from_hz: f64| {
            let view = FrameView::of_points(256, 1000.0, 1, (from_hz, 120.0), 40);
            let mut passed = Passed::new(&view);
            passed.add(&view.whole_frames_and_passed(&slow).1)
        };
        // A bin is 3.9 Hz wide, so the tone is in the means of frames.
        let expected = deviation(&slow);
        assert!((deviation(&passed(0.1)) / expected - 1.0).abs() < 0.1);
        assert!(deviation(&passed(2.0)) < 0.1 * expected);
    }

    #[test]
    fn a_series_shorter_than_a_frame_is_limited_too() {
        let view = FrameView::of_points(256, 1000.0, 1, (20.0, 120.0), 40);
        let inside = short(&view, &tones(150, &[60.0]));
        assert!((deviation(&inside) / 0.707 - 1.0).abs() < 0.2, "{}", deviation(&inside));
        assert!(deviation(&short(&view, &tones(150, &[300.0]))) < 0.05);
        assert_eq!(short(&view, &[1.0]).len(), 1);
    }
}
