//! Gaussian kernel sums in f32 over fixed lanes: the fast twin of [`kernel_sum`](super::kernel_sum).
//!
//! Coordinates are centred and scaled in f64 before they are rounded to f32, so the kernel is
//! exp2(−‖a − b‖²) of small numbers; exp2 is a polynomial that the compiler vectorises; lanes add
//! up one row at a time and rows in f64. Relative error of a sum: below 4e-7 (tested).

use multiversion::multiversion;

const LANES: usize = 16;

/// Points for [`lane_sum`]: channel after channel, each filled up to whole lanes.
#[derive(Clone, Debug, Default)]
pub struct Lanes {
    points: usize,
    /// Channel-major, `padded()` values a channel.
    values: Vec<f32>,
}

/// A coordinate so far away that the kernel vanishes; its square still is a number.
const FAR: f32 = 1e18;

impl Lanes {
    /// Refills with `points` points of `channels` channels, whose coordinates `value` gives by
    /// channel and point: already scaled by [`lane_scale`].
    pub fn fill(
        &mut self,
        points: usize,
        channels: usize,
        mut value: impl FnMut(usize, usize) -> f32,
    ) {
        let padded = points.next_multiple_of(LANES);
        self.points = points;
        self.values.clear();
        self.values.reserve(padded * channels);
        for channel in 0..channels {
            self.values.extend((0..points).map(|point| value(channel, point)));
            self.values.resize(padded * (channel + 1), FAR);
        }
    }

    fn channels<const C: usize>(&self) -> [&[f32]; C] {
        let padded = self.points.next_multiple_of(LANES);
        std::array::from_fn(|c| &self.values[c * padded..(c + 1) * padded])
    }
}

/// The factor on coordinates that turns exp(−d²/(2σ²)) into exp2(−d²).
pub fn lane_scale(sigma: f64) -> f64 {
    (0.5 * std::f64::consts::LOG2_E).sqrt() / sigma
}

/// Σᵢⱼ exp2(−‖aᵢ − bⱼ‖²) over points of 1 to 4 channels.
///
/// # Panics
/// If `channels` is not 1, 2, 3 or 4, or the points were filled with fewer.
pub fn lane_sum(a: &Lanes, b: &Lanes, channels: usize) -> f64 {
    match channels {
        1 => sum_1(a.channels(), a.points, b.channels()),
        2 => sum_2(a.channels(), a.points, b.channels()),
        3 => sum_3(a.channels(), a.points, b.channels()),
        4 => sum_4(a.channels(), a.points, b.channels()),
        _ => panic!("lane sums take 1 to 4 channels, not {channels}"),
    }
}

macro_rules! dispatched_sum {
    ($name:ident, $channels:literal) => {
        #[multiversion(targets(
            "x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma",
            "x86_64+avx2+fma",
            "aarch64+neon"
        ))]
        fn $name(a: [&[f32]; $channels], points: usize, b: [&[f32]; $channels]) -> f64 {
            sum(a, points, b)
        }
    };
}
dispatched_sum!(sum_1, 1);
dispatched_sum!(sum_2, 2);
dispatched_sum!(sum_3, 3);
dispatched_sum!(sum_4, 4);

#[inline(always)]
fn sum<const C: usize>(a: [&[f32]; C], points: usize, b: [&[f32]; C]) -> f64 {
    let blocks = b[0].len() / LANES;
    let mut total = 0.0;
    for i in 0..points {
        let mut row = [0f32; LANES];
        for block in 0..blocks {
            let mut d2 = [0f32; LANES];
            for c in 0..C {
                let at = a[c][i];
                let other = &b[c][block * LANES..(block + 1) * LANES];
                for lane in 0..LANES {
                    let d = other[lane] - at;
                    d2[lane] += d * d;
                }
            }
            for lane in 0..LANES {
                row[lane] += exp2_of_minus(d2[lane]);
            }
        }
        total += row.iter().map(|&x| f64::from(x)).sum::<f64>();
    }
    total
}

/// 2^(−x) for x ≥ 0; relative error below 2e-7, and 0 for x > 126 to within 2e-38.
#[inline(always)]
fn exp2_of_minus(x: f32) -> f32 {
    // Adding 1.5·2²³ rounds to an integer, which then stands in the low bits of the sum.
    const ROUND: f32 = 12_582_912.0;
    let y = (-x).max(-126.0);
    let rounded = y + ROUND;
    let f = y - (rounded - ROUND);
    // Minimax polynomial for 2^f on [−½, ½], with the constant term held at 1.
    let p = 1.535_336_2e-4_f32;
    let p = p * f + 1.339_887_4e-3;
    let p = p * f + 9.618_437e-3;
    let p = p * f + 5.550_332_4e-2;
    let p = p * f + 2.402_264_8e-1;
    let p = p * f + 6.931_472e-1;
    let p = p * f + 1.0;
    let exponent = (rounded.to_bits() << 23).wrapping_add(0x3f80_0000);
    p * f32::from_bits(exponent)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp2_is_good_to_2e_7() {
        for i in 0..1_260_000 {
            let x = i as f32 * 1e-4;
            let exact = (-f64::from(x)).exp2();
            let error = (f64::from(exp2_of_minus(x)) - exact).abs() / exact;
            assert!(error < 2e-7, "2^-{x}: {error}");
        }
    }

    #[test]
    fn far_points_add_nothing() {
        let mut lanes = Lanes::default();
        lanes.fill(1, 1, |_, _| 0.0);
        assert_eq!(lane_sum(&lanes, &lanes, 1), 1.0);
    }
}
