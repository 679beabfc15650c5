//! Gaussian kernel sums in f32 over fixed lanes: the fast twin of [`kernel_sum`](super::kernel_sum).
//!
//! Coordinates are centred and scaled in f64 before they are rounded to f32, so the kernel is
//! 2^(−q/16) of small numbers q. On AVX-512 intrinsics sum it (module `simd`); elsewhere a
//! polynomial that the compiler vectorises, for AVX2 with FMA, for NEON, or for what the target has.
//! Lanes add up one row at a time and rows in f64.
//!
//! Relative error of a sum, beside that of the coordinates: below 3e-7 for every single kernel value
//! 2^(−q/16), with 4e-9·q more far out; of changing sign, so that sums over spread-out samples are
//! good to 2e-7 (tested). Sums never are NaN.

use multiversion::multiversion;
use multiversion::target::target_cfg_f;

use super::padded_points::{LANES, PaddedPoints};

/// A set of instructions that sums are written for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InstructionSet {
    /// AVX-512, by intrinsics.
    Avx512,
    /// AVX2 with FMA, NEON or wider registers, by the compiler, as found at run time.
    Vectorised,
    /// The instructions that the program was compiled for, by the compiler.
    Portable,
}

impl InstructionSet {
    /// Those that this machine has, the fastest first.
    pub fn available() -> &'static [Self] {
        #[cfg(target_arch = "x86_64")]
        if super::simd::is_available() {
            return &[Self::Avx512, Self::Vectorised, Self::Portable];
        }
        &[Self::Vectorised, Self::Portable]
    }
}

/// Σᵢⱼ 2^(−‖aᵢ − bⱼ‖²/16) over points of equal channels, with the fastest instructions there are.
///
/// # Panics
/// If the sets differ in their number of channels.
pub fn lane_sum(a: &PaddedPoints, b: &PaddedPoints) -> f64 {
    lane_sum_with(InstructionSet::available()[0], a, b)
}

/// The same over all pairs of one set's points, for little more than half the work.
pub fn lane_self_sum(a: &PaddedPoints) -> f64 {
    lane_self_sum_with(InstructionSet::available()[0], a)
}

/// `lane_sum` with given instructions; those that the machine lacks are replaced.
pub fn lane_sum_with(set: InstructionSet, a: &PaddedPoints, b: &PaddedPoints) -> f64 {
    assert_eq!(a.channels, b.channels, "points of equal channels");
    dispatch::<false>(set, a, b)
}

/// `lane_self_sum` with given instructions; those that the machine lacks are replaced.
pub fn lane_self_sum_with(set: InstructionSet, a: &PaddedPoints) -> f64 {
    dispatch::<true>(set, a, a)
}

fn dispatch<const SELF: bool>(set: InstructionSet, a: &PaddedPoints, b: &PaddedPoints) -> f64 {
    match a.channels {
        1 => of_channels::<1, SELF>(set, a, b),
        2 => of_channels::<2, SELF>(set, a, b),
        3 => of_channels::<3, SELF>(set, a, b),
        4 => of_channels::<4, SELF>(set, a, b),
        // Never filled.
        _ => 0.0,
    }
}

fn of_channels<const C: usize, const SELF: bool>(
    set: InstructionSet,
    a: &PaddedPoints,
    b: &PaddedPoints,
) -> f64 {
    let (rows, from, to) = (a.points, a.channels::<C>(), b.channels::<C>());
    #[cfg(target_arch = "x86_64")]
    if set == InstructionSet::Avx512 && super::simd::is_available() {
        // SAFETY: the machine has what `sum` asks for, as `is_available` has just found.
        return unsafe { super::simd::sum::<C, SELF>(from, rows, to) };
    }
    let slices: (&[&[f32]], &[&[f32]]) = (&from, &to);
    match (C, set == InstructionSet::Portable) {
        (1, true) => portable_sum::<1, SELF, false>(narrow(slices.0), rows, narrow(slices.1)),
        (2, true) => portable_sum::<2, SELF, false>(narrow(slices.0), rows, narrow(slices.1)),
        (3, true) => portable_sum::<3, SELF, false>(narrow(slices.0), rows, narrow(slices.1)),
        (_, true) => portable_sum::<4, SELF, false>(narrow(slices.0), rows, narrow(slices.1)),
        (1, false) => sum_1(narrow(slices.0), rows, narrow(slices.1), SELF),
        (2, false) => sum_2(narrow(slices.0), rows, narrow(slices.1), SELF),
        (3, false) => sum_3(narrow(slices.0), rows, narrow(slices.1), SELF),
        (_, false) => sum_4(narrow(slices.0), rows, narrow(slices.1), SELF),
    }
}

/// As many channels as the type says.
fn narrow<'a, const C: usize>(channels: &[&'a [f32]]) -> [&'a [f32]; C] {
    std::array::from_fn(|c| channels[c])
}

macro_rules! dispatched_sum {
    ($name:ident, $channels:literal) => {
        #[multiversion(targets(
            "x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma",
            "x86_64+avx2+fma",
            "aarch64+neon"
        ))]
        fn $name(
            a: [&[f32]; $channels],
            rows: usize,
            b: [&[f32]; $channels],
            of_self: bool,
        ) -> f64 {
            // A fused multiplication where there is one; elsewhere it would be a call.
            let fused = target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
            match (of_self, fused) {
                (true, true) => portable_sum::<$channels, true, true>(a, rows, b),
                (false, true) => portable_sum::<$channels, false, true>(a, rows, b),
                (true, false) => portable_sum::<$channels, true, false>(a, rows, b),
                (false, false) => portable_sum::<$channels, false, false>(a, rows, b),
            }
        }
    };
}
dispatched_sum!(sum_1, 1);
dispatched_sum!(sum_2, 2);
dispatched_sum!(sum_3, 3);
dispatched_sum!(sum_4, 4);

/// The sum in plain Rust. With `SELF`, blocks right of the diagonal count twice.
#[inline(always)]
#[allow(clippy::needless_range_loop)] // `row` runs over all channels at once.
fn portable_sum<const C: usize, const SELF: bool, const FUSED: bool>(
    a: [&[f32]; C],
    rows: usize,
    b: [&[f32]; C],
) -> f64 {
    let blocks = b[0].len() / LANES;
    let mut total = 0.0;
    for row in 0..rows {
        let at: [f32; C] = std::array::from_fn(|c| a[c][row]);
        let mut lanes = [0f32; LANES];
        let mut first = 0;
        if SELF {
            first = row / LANES;
            add_block::<C, FUSED>(&mut lanes, at, b, first);
            lanes = lanes.map(|x| 0.5 * x);
            first += 1;
        }
        for block in first..blocks {
            add_block::<C, FUSED>(&mut lanes, at, b, block);
        }
        total += lanes.iter().map(|&x| f64::from(x)).sum::<f64>();
    }
    if SELF { 2.0 * total } else { total }
}

#[inline(always)]
fn add_block<const C: usize, const FUSED: bool>(
    lanes: &mut [f32; LANES],
    at: [f32; C],
    b: [&[f32]; C],
    block: usize,
) {
    let mut q = [0f32; LANES];
    for c in 0..C {
        let other = &b[c][block * LANES..(block + 1) * LANES];
        for lane in 0..LANES {
            let d = other[lane] - at[c];
            q[lane] = multiply_add::<FUSED>(d, d, q[lane]);
        }
    }
    for lane in 0..LANES {
        lanes[lane] += exp2_of_minus_sixteenths::<FUSED>(q[lane]);
    }
}

/// 2^(−q/16) for q ≥ 0; relative error below 2e-7, and 0 for q > 2016 to within 2e-38.
#[inline(always)]
fn exp2_of_minus_sixteenths<const FUSED: bool>(q: f32) -> f32 {
    // Adding 1.5·2²⁷ rounds to a multiple of 16, whose sixteenth then stands in the low bits.
    const ROUND: f32 = 201_326_592.0;
    let y = (-q).max(-2016.0);
    let rounded = y + ROUND;
    let f = (y - (rounded - ROUND)) * (1.0 / 16.0);
    // Minimax polynomial for 2^f on [−½, ½], with the constant term held at 1.
    let p = 1.535_336_2e-4_f32;
    let p = multiply_add::<FUSED>(p, f, 1.339_887_4e-3);
    let p = multiply_add::<FUSED>(p, f, 9.618_437e-3);
    let p = multiply_add::<FUSED>(p, f, 5.550_332_4e-2);
    let p = multiply_add::<FUSED>(p, f, 2.402_264_8e-1);
    let p = multiply_add::<FUSED>(p, f, 6.931_472e-1);
    let p = multiply_add::<FUSED>(p, f, 1.0);
    let exponent = (rounded.to_bits() << 23).wrapping_add(0x3f80_0000);
    p * f32::from_bits(exponent)
}

/// a·b + c, rounded once where that is one instruction.
#[inline(always)]
fn multiply_add<const FUSED: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FUSED { a.mul_add(b, c) } else { a * b + c }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points on a lattice or spread out, `C` channels, deterministic.
    fn lanes(points: usize, channels: usize, spread: f64, step: f64) -> PaddedPoints {
        let mut lanes = PaddedPoints::default();
        lanes.fill(channels, 1.0, |c| {
            (0..points).map(move |i| {
                let x = ((i * (7 + 2 * c) + 3 * c) as f64 * 0.618_033_988_7).fract() * spread;
                if step > 0.0 { (x / step).round() * step } else { x }
            })
        });
        lanes
    }

    /// The definition, in f64, on the very coordinates that were filled in.
    fn plain_sum(a: &PaddedPoints, b: &PaddedPoints) -> f64 {
        let padded = |l: &PaddedPoints| l.points.next_multiple_of(LANES);
        let mut total = 0.0;
        for i in 0..a.points {
            for j in 0..b.points {
                let q: f64 = (0..a.channels)
                    .map(|c| {
                        let (x, y) = (a.values[c * padded(a) + i], b.values[c * padded(b) + j]);
                        (f64::from(x) - f64::from(y)).powi(2)
                    })
                    .sum();
                total += (-q / 16.0).exp2();
            }
        }
        total
    }

    #[test]
    fn exp2_is_good_to_2e_7() {
        for i in 0..1_260_000 {
            let q = i as f32 * 1.6e-3;
            let exact = (-f64::from(q) / 16.0).exp2();
            let error = (f64::from(exp2_of_minus_sixteenths::<false>(q)) - exact).abs() / exact;
            assert!(error < 2e-7, "2^-{q}/16: {error}");
        }
    }

    #[test]
    fn every_single_value_is_good_to_3e_7() {
        for &set in InstructionSet::available() {
            for i in 0..40_000 {
                let (mut a, mut b) = (PaddedPoints::default(), PaddedPoints::default());
                let x = f64::from(i as f32 * 1.1e-3);
                a.fill(1, 1.0, |_| [0.0].into_iter());
                b.fill(1, 1.0, |_| [x; 16].into_iter());
                let error = lane_sum_with(set, &a, &b) / plain_sum(&a, &b) - 1.0;
                // Far out, rounding q = x² in f32 weighs more than the polynomial.
                let bound = 3e-7 + 4e-9 * x * x;
                assert!(error.abs() < bound, "{set:?} at {x}: {error:e}");
            }
        }
    }

    #[test]
    fn with_several_channels_every_value_is_good_to_what_its_distance_from_the_centre_allows() {
        for &set in InstructionSet::available() {
            for channels in 2..=4 {
                for i in 0..4_000 {
                    let place = |k: usize, c: usize| {
                        let x = ((i * (3 + 2 * c) + k) as f64 * 0.618_033_988_7).fract() - 0.5;
                        x * (i % 40) as f64
                    };
                    let (mut a, mut b) = (PaddedPoints::default(), PaddedPoints::default());
                    a.fill(channels, 1.0, |c| [place(0, c); 16].into_iter());
                    b.fill(channels, 1.0, |c| [place(0, c) + 0.4 * place(7, c); 16].into_iter());
                    let error = lane_sum_with(set, &a, &b) / plain_sum(&a, &b) - 1.0;
                    let squared: f64 = (0..channels)
                        .map(|c| place(0, c).powi(2) + (place(0, c) + 0.4 * place(7, c)).powi(2))
                        .sum();
                    let bound = 9e-7 + 5e-9 * squared;
                    assert!(error.abs() < bound, "{set:?} {channels} at {squared}: {error:e}");
                }
            }
        }
    }

    #[test]
    fn sums_over_spread_out_points_are_good_to_2e_7() {
        for &set in InstructionSet::available() {
            for channels in 1..=4 {
                // At 400 but a few pairs are in reach, and errors hardly average out.
                for (spread, bound) in
                    [(3.0, 2e-7), (9.0, 2e-7), (14.0, 2e-7), (30.0, 2e-7), (400.0, 6e-7)]
                {
                    let (a, b) =
                        (lanes(400, channels, spread, 0.0), lanes(384, channels, spread, 0.0));
                    let error = lane_sum_with(set, &a, &b) / plain_sum(&a, &b) - 1.0;
                    let what = format!("{set:?} {channels} × {spread}: {error:e}");
                    assert!(error.abs() < bound, "{what}");
                }
            }
        }
    }

    #[test]
    fn a_self_sum_is_the_sum_with_itself() {
        for &set in InstructionSet::available() {
            for points in [1, 15, 16, 17, 90, 400] {
                for channels in 1..=4 {
                    let a = lanes(points, channels, 9.0, 0.0);
                    let half = lane_self_sum_with(set, &a);
                    let error = half / plain_sum(&a, &a) - 1.0;
                    assert!(error.abs() < 4e-7, "{set:?} {points} × {channels}: {error:e}");
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
                let all = |a: &PaddedPoints| {
                    let sum = |&set| lane_sum_with(set, a, &b);
                    InstructionSet::available().iter().map(sum).collect::<Vec<f64>>()
                };
                let sums = all(&a);
                assert!(sums.iter().all(|x| (x / sums[0] - 1.0).abs() < 1e-6), "{sums:?}");
                a.fill(channels, 1.0, |_| [1e30, -1e300, 5.0, 1e9].into_iter());
                let sums = all(&a);
                assert!(sums.iter().all(|x| x.is_finite() && (x / sums[0] - 1.0).abs() < 1e-6));
            }
        }
    }

    #[test]
    fn far_points_add_nothing() {
        let one = lanes(1, 1, 0.0, 0.0);
        for &set in InstructionSet::available() {
            let sum = lane_sum_with(set, &one, &one);
            assert!((sum - 1.0).abs() < 1e-9, "{sum}");
        }
    }
}
