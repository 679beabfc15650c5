//! Gaussian kernel sums with vector instructions, in f32 and f64: fast versions of
//! [`kernel_sum`](super::kernel_sum).
//!
//! Coordinates are centred and scaled in f64, then rounded. The kernel of two points is then
//! 2^(−q/16), where q is their squared distance. In f32 on AVX-512, the intrinsics of module `simd`
//! take half as long as plain Rust. Elsewhere the compiler vectorises a polynomial, with AVX2 and
//! FMA or NEON if possible. Kernel values of a row are added in 16 lanes, rows in f64. A sum is
//! never NaN.
//!
//! Relative error in f32, apart from rounding of coordinates: below 3e-7 + 4e-9·q for one kernel
//! value. Its sign varies, so sums over spread-out samples have errors below 2e-7. f64 takes ten times
//! as long, with errors below 1e-14. Tests check these bounds.

use std::ops::{Add, Mul, Sub};

use multiversion::multiversion;
use multiversion::target::target_cfg_f;

/// Number of kernel values that are computed together.
pub(super) const LANES: usize = 16;

/// The number type in which a sum is computed.
pub trait Number:
    Copy + Default + Into<f64> + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self>
{
    /// Coordinate of padding points. Its square is finite, but their kernel values vanish.
    const FAR: Self;
    /// Greatest magnitude of a point's coordinate, so that no point is near the padding points.
    const FARTHEST: f64;

    /// Converts `x` to the nearest number of this type.
    fn nearest(x: f64) -> Self;

    /// a·b + c, rounded once.
    fn fused(a: Self, b: Self, c: Self) -> Self;

    /// 2^(−q/16) for q ≥ 0.
    fn kernel<const FUSED: bool>(q: Self) -> Self;

    /// The kernel sum over all pairs of a point of `a` and a point of `b`, by the fastest
    /// instructions that this machine has. `of_self` says that `a` and `b` are the same points.
    fn sum(a: &Points<Self>, b: &Points<Self>, of_self: bool) -> f64;
}

impl Number for f32 {
    const FAR: Self = 1e18;
    const FARTHEST: f64 = 1e17;

    fn nearest(x: f64) -> Self {
        x as Self
    }

    #[inline(always)]
    fn fused(a: Self, b: Self, c: Self) -> Self {
        a.mul_add(b, c)
    }

    /// The relative error is below 2e-7 for q ≤ 2016; for larger q, the result stays at about 1e-38.
    #[inline(always)]
    fn kernel<const FUSED: bool>(q: Self) -> Self {
        // Adding 1.5·2²⁷ rounds y to a multiple of 16; the low bits hold this multiple/16.
        const ROUND: f32 = 201_326_592.0;
        // Minimax polynomial for 2^f on [−½, ½], with the constant term fixed at 1.
        const MINIMAX: [f32; 7] = [
            1.0,
            6.931_472e-1,
            2.402_264_8e-1,
            5.550_332_4e-2,
            9.618_437e-3,
            1.339_887_4e-3,
            1.535_336_2e-4,
        ];
        let y = (-q).max(-2016.0);
        let rounded = y + ROUND;
        let f = (y - (rounded - ROUND)) * (1.0 / 16.0);
        let exponent = (rounded.to_bits() << 23).wrapping_add(0x3f80_0000);
        polynomial::<f32, FUSED, 7>(&MINIMAX, f) * f32::from_bits(exponent)
    }

    fn sum(a: &Points<Self>, b: &Points<Self>, of_self: bool) -> f64 {
        #[cfg(target_arch = "x86_64")]
        if super::simd::is_available() {
            match a.channels {
                1 => return by_intrinsics::<1>(a, b, of_self),
                2 => return by_intrinsics::<2>(a, b, of_self),
                3 => return by_intrinsics::<3>(a, b, of_self),
                4 => return by_intrinsics::<4>(a, b, of_self),
                _ => {}
            }
        }
        sum_f32(a, b, of_self)
    }
}

impl Number for f64 {
    const FAR: Self = 1e152;
    const FARTHEST: f64 = 1e150;

    fn nearest(x: f64) -> Self {
        x
    }

    #[inline(always)]
    fn fused(a: Self, b: Self, c: Self) -> Self {
        a.mul_add(b, c)
    }

    #[inline(always)]
    fn kernel<const FUSED: bool>(q: Self) -> Self {
        exp2_of_minus::<FUSED>(q * (1.0 / 16.0))
    }

    fn sum(a: &Points<Self>, b: &Points<Self>, of_self: bool) -> f64 {
        sum_f64(a, b, of_self)
    }
}

/// 2^(−x) for x from 0 to 1000, with a relative error below 1e-15·(1 + x); 2⁻¹⁰⁰⁰ for larger x.
#[inline(always)]
pub(super) fn exp2_of_minus<const FUSED: bool>(x: f64) -> f64 {
    // Adding 1.5·2⁵² rounds y to an integer, which is then in the low bits of the sum.
    const ROUND: f64 = 6_755_399_441_055_744.0;
    // Taylor coefficients of 2^f for |f| ≤ ½. The first omitted term is below 1e-17.
    const SERIES: [f64; 14] = [
        1.0,
        std::f64::consts::LN_2,
        0.240_226_506_959_100_7,
        0.055_504_108_664_821_576,
        0.009_618_129_107_628_477,
        0.001_333_355_814_642_844_2,
        1.540_353_039_338_160_6e-4,
        1.525_273_380_405_983_8e-5,
        1.321_548_679_014_430_5e-6,
        1.017_808_600_923_969_7e-7,
        7.054_911_620_801_121e-9,
        4.445_538_271_870_81e-10,
        2.567_843_599_348_819_6e-11,
        1.369_148_885_390_412_4e-12,
    ];
    let y = if x > 1000.0 { -1000.0 } else { -x };
    let rounded = y + ROUND;
    let f = y - (rounded - ROUND);
    let power = (rounded.to_bits() << 52).wrapping_add(0x3ff0_0000_0000_0000);
    polynomial::<f64, FUSED, 14>(&SERIES, f) * f64::from_bits(power)
}

/// Σ terms[k]·xᵏ.
#[inline(always)]
fn polynomial<T: Number, const FUSED: bool, const N: usize>(terms: &[T; N], x: T) -> T {
    let horner = |sum, term: &T| multiply_add::<T, FUSED>(sum, x, *term);
    terms[..N - 1].iter().rev().fold(terms[N - 1], horner)
}

#[inline(always)]
fn multiply_add<T: Number, const FUSED: bool>(a: T, b: T, c: T) -> T {
    if FUSED { T::fused(a, b, c) } else { a * b + c }
}

/// Centred, scaled points of a kernel sum: channel after channel, each padded to a multiple of 16.
#[derive(Clone, Debug, Default)]
pub struct Points<T> {
    points: usize,
    channels: usize,
    values: Vec<T>,
}

impl<T: Number> Points<T> {
    /// Replaces the points, for a kernel of length scale `sigma`. `of_channel` gives the centred but
    /// not yet scaled coordinates of all points in one channel.
    ///
    /// # Panics
    /// If the channels differ in length.
    pub fn fill<I: ExactSizeIterator<Item = f64>>(
        &mut self,
        channels: usize,
        sigma: f64,
        mut of_channel: impl FnMut(usize) -> I,
    ) {
        // Scales distances d so that exp(−d²/(2σ²)) becomes 2^(−d²/16).
        let scale = (8.0 * std::f64::consts::LOG2_E).sqrt() / sigma;
        self.channels = channels;
        self.values.clear();
        for channel in 0..channels {
            let coordinates = of_channel(channel);
            if channel == 0 {
                self.points = coordinates.len();
            }
            assert_eq!(self.points, coordinates.len(), "channels of one length");
            let scaled = |x: f64| T::nearest((x * scale).clamp(-T::FARTHEST, T::FARTHEST));
            self.values.extend(coordinates.map(scaled));
            self.values.resize((channel + 1) * self.padded(), T::FAR);
        }
    }

    fn padded(&self) -> usize {
        self.points.next_multiple_of(LANES)
    }

    #[cfg(target_arch = "x86_64")]
    fn slices<const C: usize>(&self) -> [&[T]; C] {
        std::array::from_fn(|c| &self.values[c * self.padded()..][..self.padded()])
    }

    /// The kernel sum over all pairs of a point of `self` and a point of `other`.
    ///
    /// # Panics
    /// If `self` and `other` have different numbers of channels.
    pub fn sum(&self, other: &Self) -> f64 {
        assert_eq!(self.channels, other.channels, "points of equal channels");
        T::sum(self, other, false)
    }

    /// The kernel sum over all pairs of points of `self`, in little more than half of `sum`'s time.
    pub fn self_sum(&self) -> f64 {
        T::sum(self, self, true)
    }
}

macro_rules! dispatched_sum {
    ($name:ident, $number:ty) => {
        #[multiversion(targets(
            "x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma",
            "x86_64+avx2+fma",
            "aarch64+neon"
        ))]
        fn $name(a: &Points<$number>, b: &Points<$number>, of_self: bool) -> f64 {
            // Without an FMA instruction, a fused multiplication would be a slow library call.
            if target_cfg_f!(any(target_feature = "fma", target_feature = "neon")) {
                by_channels::<$number, true>(a, b, of_self)
            } else {
                by_channels::<$number, false>(a, b, of_self)
            }
        }
    };
}
dispatched_sum!(sum_f32, f32);
dispatched_sum!(sum_f64, f64);

#[cfg(target_arch = "x86_64")]
fn by_intrinsics<const C: usize>(a: &Points<f32>, b: &Points<f32>, of_self: bool) -> f64 {
    use super::simd::{is_available, sum};
    const { assert!(LANES == super::simd::LANES) };
    assert!(is_available(), "a machine with AVX-512");
    let (from, rows, to) = (a.slices::<C>(), a.points, b.slices::<C>());
    // SAFETY: `is_available` has just found the instructions that `sum` requires.
    unsafe {
        if of_self { sum::<C, true>(from, rows, to) } else { sum::<C, false>(from, rows, to) }
    }
}

/// Calls `sum` with a constant number of channels, so that its loop over channels is unrolled.
#[inline(always)]
fn by_channels<T: Number, const FUSED: bool>(a: &Points<T>, b: &Points<T>, of_self: bool) -> f64 {
    match a.channels {
        1 => sum::<T, FUSED>(a, b, 1, of_self),
        2 => sum::<T, FUSED>(a, b, 2, of_self),
        3 => sum::<T, FUSED>(a, b, 3, of_self),
        4 => sum::<T, FUSED>(a, b, 4, of_self),
        channels => sum::<T, FUSED>(a, b, channels, of_self),
    }
}

/// The kernel sum. With `of_self`, blocks right of the diagonal count twice, and left ones never.
#[inline(always)]
fn sum<T: Number, const FUSED: bool>(
    a: &Points<T>,
    b: &Points<T>,
    channels: usize,
    of_self: bool,
) -> f64 {
    let mut total = 0.0;
    for row in 0..a.points {
        let mut lanes = [T::default(); LANES];
        let mut first = 0;
        if of_self {
            first = row / LANES;
            add_block::<T, FUSED>(&mut lanes, a, row, b, first, channels);
            for lane in &mut lanes {
                *lane = T::nearest(0.5) * *lane;
            }
            first += 1;
        }
        for block in first..b.padded() / LANES {
            add_block::<T, FUSED>(&mut lanes, a, row, b, block, channels);
        }
        let mut of_row = 0.0;
        for lane in lanes {
            of_row += lane.into();
        }
        total += of_row;
    }
    if of_self { 2.0 * total } else { total }
}

#[inline(always)]
fn add_block<T: Number, const FUSED: bool>(
    lanes: &mut [T; LANES],
    a: &Points<T>,
    row: usize,
    b: &Points<T>,
    block: usize,
    channels: usize,
) {
    let (of_a, of_b) = (a.padded(), b.padded());
    let mut q = [T::default(); LANES];
    for c in 0..channels {
        let at = a.values[c * of_a + row];
        let other = &b.values[c * of_b + block * LANES..][..LANES];
        for lane in 0..LANES {
            let d = other[lane] - at;
            q[lane] = multiply_add::<T, FUSED>(d, d, q[lane]);
        }
    }
    for lane in 0..LANES {
        lanes[lane] = lanes[lane] + T::kernel::<FUSED>(q[lane]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::kernel_sum;
    use ndarray::Array2;

    /// The length scale at which [`Points::fill`] leaves coordinates unscaled.
    fn unit() -> f64 {
        (8.0 * std::f64::consts::LOG2_E).sqrt()
    }

    /// Repeatable points: spread evenly, or on a lattice if `step` > 0.
    fn lanes(points: usize, channels: usize, spread: f64, step: f64) -> Points<f32> {
        let mut lanes = Points::default();
        lanes.fill(channels, unit(), |c| {
            (0..points).map(move |i| {
                let x = ((i * (7 + 2 * c) + 3 * c) as f64 * 0.618_033_988_7).fract() * spread;
                if step > 0.0 { (x / step).round() * step } else { x }
            })
        });
        lanes
    }

    /// The kernel sum by its definition, in f64.
    fn plain_sum(a: &Points<f32>, b: &Points<f32>) -> f64 {
        let mut total = 0.0;
        for i in 0..a.points {
            for j in 0..b.points {
                let q: f64 = (0..a.channels)
                    .map(|c| {
                        let (x, y) = (a.values[c * a.padded() + i], b.values[c * b.padded() + j]);
                        (f64::from(x) - f64::from(y)).powi(2)
                    })
                    .sum();
                total += (-q / 16.0).exp2();
            }
        }
        total
    }

    /// The kernel sum, computed in three ways: by this machine's fastest instructions, by the
    /// compiler's vectorisation, and without fused multiplications.
    fn sums(a: &Points<f32>, b: &Points<f32>) -> [f64; 3] {
        [a.sum(b), sum_f32(a, b, false), by_channels::<f32, false>(a, b, false)]
    }

    #[test]
    fn exp2_is_good_to_rounding() {
        for i in 0..1_260_000 {
            let q = i as f32 * 1.6e-3;
            let exact = (-f64::from(q) / 16.0).exp2();
            let error = (f64::from(f32::kernel::<false>(q)) - exact).abs() / exact;
            assert!(error < 2e-7, "2^-{q}/16: {error}");
        }
        for i in 0..200_000 {
            let x = f64::from(i) * 0.005;
            let error = (exp2_of_minus::<false>(x) / (-x).exp2() - 1.0).abs();
            assert!(error < 1e-15 * (1.0 + x), "2^-{x}: {error:e}");
        }
        assert!(exp2_of_minus::<false>(1e300) < 1e-300);
    }

    #[test]
    fn every_single_value_is_good_to_3e_7() {
        for i in 0..40_000 {
            let (mut a, mut b) = (Points::default(), Points::default());
            let x = f64::from(i as f32 * 1.1e-3);
            a.fill(1, unit(), |_| [0.0].into_iter());
            b.fill(1, unit(), |_| [x; 16].into_iter());
            for sum in sums(&a, &b) {
                let error = sum / plain_sum(&a, &b) - 1.0;
                // For large x, rounding q = x² to f32 causes more error than the polynomial does.
                let bound = 3e-7 + 4e-9 * x * x;
                assert!(error.abs() < bound, "at {x}: {error:e}");
            }
        }
    }

    #[test]
    fn with_several_channels_every_value_is_good_to_what_its_distance_from_the_centre_allows() {
        for channels in 2..=4 {
            for i in 0..4_000 {
                let place = |k: usize, c: usize| {
                    let x = ((i * (3 + 2 * c) + k) as f64 * 0.618_033_988_7).fract() - 0.5;
                    x * (i % 40) as f64
                };
                let (mut a, mut b) = (Points::default(), Points::default());
                a.fill(channels, unit(), |c| [place(0, c); 16].into_iter());
                b.fill(channels, unit(), |c| [place(0, c) + 0.4 * place(7, c); 16].into_iter());
                let squared: f64 = (0..channels)
                    .map(|c| place(0, c).powi(2) + (place(0, c) + 0.4 * place(7, c)).powi(2))
                    .sum();
                for sum in sums(&a, &b) {
                    let error = sum / plain_sum(&a, &b) - 1.0;
                    let bound = 9e-7 + 5e-9 * squared;
                    assert!(error.abs() < bound, "{channels} at {squared}: {error:e}");
                }
            }
        }
    }

    #[test]
    fn sums_over_spread_out_points_are_good_to_2e_7() {
        for channels in 1..=4 {
            // At a spread of 400 only a few pairs are near, so errors hardly average out.
            for (spread, bound) in
                [(3.0, 2e-7), (9.0, 2e-7), (14.0, 2e-7), (30.0, 2e-7), (400.0, 6e-7)]
            {
                let (a, b) = (lanes(400, channels, spread, 0.0), lanes(384, channels, spread, 0.0));
                for sum in sums(&a, &b) {
                    let error = sum / plain_sum(&a, &b) - 1.0;
                    assert!(error.abs() < bound, "{channels} × {spread}: {error:e}");
                }
            }
        }
    }

    #[test]
    fn a_self_sum_is_the_sum_with_itself() {
        for points in [1, 15, 16, 17, 90, 400] {
            for channels in 1..=4 {
                let a = lanes(points, channels, 9.0, 0.0);
                let plain = by_channels::<f32, false>(&a, &a, true);
                for half in [a.self_sum(), sum_f32(&a, &a, true), plain] {
                    let error = half / plain_sum(&a, &a) - 1.0;
                    assert!(error.abs() < 4e-7, "{points} × {channels}: {error:e}");
                }
            }
        }
    }

    #[test]
    fn intrinsics_agree_with_plain_rust_on_lattices_and_outliers() {
        for channels in 1..=4 {
            for step in [0.1, 0.5, 1.0] {
                let mut a = lanes(400, channels, 20.0, step);
                let b = lanes(399, channels, 20.0, step);
                let all = sums(&a, &b);
                assert!(all.iter().all(|x| (x / all[0] - 1.0).abs() < 1e-6), "{all:?}");
                a.fill(channels, unit(), |_| [1e30, -1e300, 5.0, 1e9].into_iter());
                let all = sums(&a, &b);
                assert!(all.iter().all(|x| x.is_finite() && (x / all[0] - 1.0).abs() < 1e-6));
            }
        }
    }

    #[test]
    fn a_sum_in_f64_equals_the_plain_one() {
        for channels in 1..=5 {
            let value = |i: usize, c: usize| ((i * (3 + c)) as f64 * 0.618).sin() * 3.0;
            let a = Array2::from_shape_fn((77, channels), |(i, c)| value(i, c));
            let b = Array2::from_shape_fn((50, channels), |(i, c)| value(i + 5, c) * 1.1);
            let filled = |of: &Array2<f64>| {
                let mut points = Points::<f64>::default();
                points.fill(channels, 0.7, |c| of.column(c).to_vec().into_iter());
                points
            };
            let error = filled(&a).sum(&filled(&b)) / kernel_sum(a.view(), b.view(), 0.7) - 1.0;
            assert!(error.abs() < 1e-14, "{channels}: {error:e}");
            let error = filled(&a).self_sum() / filled(&a).sum(&filled(&a)) - 1.0;
            assert!(error.abs() < 1e-14, "{channels}, with itself: {error:e}");
        }
    }
}
