//! Gaussian kernel sums in f64 over lanes: where f32 does not suffice, at a tenth of its speed.
//! Relative error below 1e-14 of [`kernel_sum`](super::kernel_sum) (tested).

use multiversion::multiversion;
use multiversion::target::target_cfg_f;

/// Values that are worked on together.
const LANES: usize = 8;
/// Coordinates lie no farther than this; their squares still are numbers.
const FARTHEST: f64 = 1e150;
const FAR: f64 = 1e152;

/// Points for [`f64_sum`]: channel after channel, each filled up to whole lanes.
#[derive(Clone, Debug, Default)]
pub struct F64Points {
    points: usize,
    channels: usize,
    values: Vec<f64>,
}

impl F64Points {
    /// Refills with points: `of_channel` gives the centred coordinates of all points in one
    /// channel, `sigma` is the kernel's length scale.
    pub fn fill<I: ExactSizeIterator<Item = f64>>(
        &mut self,
        channels: usize,
        sigma: f64,
        mut of_channel: impl FnMut(usize) -> I,
    ) {
        let scale = (0.5 * std::f64::consts::LOG2_E).sqrt();
        self.channels = channels;
        self.values.clear();
        for channel in 0..channels {
            let coordinates = of_channel(channel);
            self.points = coordinates.len();
            let scaled = |x: f64| (x / sigma * scale).clamp(-FARTHEST, FARTHEST);
            self.values.extend(coordinates.map(scaled));
            let filled = (channel + 1) * self.points.next_multiple_of(LANES);
            self.values.resize(filled, FAR);
        }
    }
}

/// Σᵢⱼ exp(−‖aᵢ − bⱼ‖²/(2σ²)) over points of any number of channels, the same for both.
pub fn f64_sum(a: &F64Points, b: &F64Points) -> f64 {
    debug_assert_eq!(a.channels, b.channels);
    sum(a, b, false)
}

/// The same over all pairs of one set's points, for little more than half the work.
pub fn f64_self_sum(a: &F64Points) -> f64 {
    sum(a, a, true)
}

#[multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn sum(a: &F64Points, b: &F64Points, of_self: bool) -> f64 {
    // A fused multiplication where there is one; elsewhere it would be a call.
    if target_cfg_f!(any(target_feature = "fma", target_feature = "neon")) {
        plain_sum::<true>(a, b, of_self)
    } else {
        plain_sum::<false>(a, b, of_self)
    }
}

/// Row by row; of one set, blocks right of the diagonal count twice.
#[inline(always)]
fn plain_sum<const FUSED: bool>(a: &F64Points, b: &F64Points, of_self: bool) -> f64 {
    let blocks = b.points.div_ceil(LANES);
    let mut total = 0.0;
    for row in 0..a.points {
        let mut lanes = [0f64; LANES];
        let mut first = 0;
        if of_self {
            first = row / LANES;
            add_block::<FUSED>(&mut lanes, a, row, b, first);
            lanes = lanes.map(|x| 0.5 * x);
            first += 1;
        }
        for block in first..blocks {
            add_block::<FUSED>(&mut lanes, a, row, b, block);
        }
        total += lanes.iter().sum::<f64>();
    }
    if of_self { 2.0 * total } else { total }
}

#[inline(always)]
fn add_block<const FUSED: bool>(
    lanes: &mut [f64; LANES],
    a: &F64Points,
    row: usize,
    b: &F64Points,
    block: usize,
) {
    let (of_a, of_b) = (a.points.next_multiple_of(LANES), b.points.next_multiple_of(LANES));
    let mut q = [0f64; LANES];
    for c in 0..a.channels {
        let at = a.values[c * of_a + row];
        let other = &b.values[c * of_b + block * LANES..][..LANES];
        for lane in 0..LANES {
            let d = other[lane] - at;
            q[lane] = multiply_add::<FUSED>(d, d, q[lane]);
        }
    }
    for lane in 0..LANES {
        lanes[lane] += exp2_of_minus::<FUSED>(q[lane]);
    }
}

/// a·b + c, rounded once where that is one instruction.
#[inline(always)]
fn multiply_add<const FUSED: bool>(a: f64, b: f64, c: f64) -> f64 {
    if FUSED { a.mul_add(b, c) } else { a * b + c }
}

/// 2^(−x) for x ≥ 0; relative error below 1e-15·(1 + x), and 0 for x > 1000 to within 1e-300.
#[inline(always)]
pub(super) fn exp2_of_minus<const FUSED: bool>(x: f64) -> f64 {
    // Adding 1.5·2⁵² rounds to an integer, which then stands in the low bits of the sum.
    const ROUND: f64 = 6_755_399_441_055_744.0;
    // Terms of the exponential series in f·ln 2, |f| ≤ ½: the first left out is 4e-17.
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
    let mut p = SERIES[13];
    for term in SERIES[..13].iter().rev() {
        p = multiply_add::<FUSED>(p, f, *term);
    }
    p * f64::from_bits((rounded.to_bits() << 52).wrapping_add(0x3ff0_0000_0000_0000))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::kernel_sum;
    use ndarray::Array2;

    #[test]
    fn exp2_is_good_to_rounding() {
        for i in 0..200_000 {
            let x = f64::from(i) * 0.005;
            let error = (exp2_of_minus::<false>(x) / (-x).exp2() - 1.0).abs();
            assert!(error < 1e-15 * (1.0 + x), "2^-{x}: {error:e}");
        }
        assert!(exp2_of_minus::<false>(1e300) < 1e-300);
    }

    #[test]
    fn a_sum_equals_the_plain_one() {
        for channels in 1..=5 {
            let value = |i: usize, c: usize| ((i * (3 + c)) as f64 * 0.618).sin() * 3.0;
            let a = Array2::from_shape_fn((77, channels), |(i, c)| value(i, c));
            let b = Array2::from_shape_fn((50, channels), |(i, c)| value(i + 5, c) * 1.1);
            let filled = |of: &Array2<f64>| {
                let mut points = F64Points::default();
                points.fill(channels, 0.7, |c| of.column(c).to_vec().into_iter());
                points
            };
            let error =
                f64_sum(&filled(&a), &filled(&b)) / kernel_sum(a.view(), b.view(), 0.7) - 1.0;
            assert!(error.abs() < 1e-14, "{channels}: {error:e}");
            let half = f64_self_sum(&filled(&a));
            let error = half / f64_sum(&filled(&a), &filled(&a)) - 1.0;
            assert!(error.abs() < 1e-14, "{channels}, with itself: {error:e}");
        }
    }
}
