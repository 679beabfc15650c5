//! Points as the sums over lanes take them: channel after channel, centred, scaled, in f32, and
//! filled up to whole lanes.

/// Values that are worked on together.
pub(super) const LANES: usize = 16;

/// Points for `lane_sum`: channel after channel, each filled up to whole lanes.
#[derive(Clone, Debug, Default)]
pub struct PaddedPoints {
    /// Number of points.
    pub(super) points: usize,
    pub(super) channels: usize,
    /// Channel-major, `points` rounded up to whole lanes a channel.
    pub(super) values: Vec<f32>,
}

/// A coordinate so far away that the kernel vanishes; its square still is a number.
const FAR: f32 = 1e18;
/// Points lie no farther than this from the centre, so none meets the filling.
const FARTHEST: f64 = 1e17;

impl PaddedPoints {
    /// Refills with points of 1 to 4 channels: `of_channel` gives the unscaled, centred coordinates
    /// of all points in one channel, and `scale` is that of [`lane_scale`].
    ///
    /// # Panics
    /// If `channels` is not 1, 2, 3 or 4, or the channels differ in length.
    pub fn fill<I: ExactSizeIterator<Item = f64>>(
        &mut self,
        channels: usize,
        scale: f64,
        mut of_channel: impl FnMut(usize) -> I,
    ) {
        assert!((1..=4).contains(&channels), "padded points have 1 to 4 channels, not {channels}");
        self.channels = channels;
        self.values.clear();
        for channel in 0..channels {
            let coordinates = of_channel(channel);
            if channel == 0 {
                self.points = coordinates.len();
            }
            assert_eq!(self.points, coordinates.len(), "channels of one length");
            let start = self.values.len();
            let scaled = |x: f64| (x * scale).clamp(-FARTHEST, FARTHEST) as f32;
            self.values.extend(coordinates.map(scaled));
            self.values.resize(start + self.points.next_multiple_of(LANES), FAR);
        }
    }

    pub(super) fn channels<const C: usize>(&self) -> [&[f32]; C] {
        let padded = self.points.next_multiple_of(LANES);
        std::array::from_fn(|c| &self.values[c * padded..(c + 1) * padded])
    }
}

/// The factor on coordinates that turns exp(−d²/(2σ²)) into 2^(−d²/16).
pub fn lane_scale(sigma: f64) -> f64 {
    (8.0 * std::f64::consts::LOG2_E).sqrt() / sigma
}
