//! Gaussian kernel sums with AVX-512 intrinsics, tested against the safe [`super::sums`].
//!
//! Computes 2^(−q/16), where q is a squared distance. Adding 1.5·2²³ rounds −q to an integer N.
//! 2^(N/16) comes from a table of 16 values and an exponent. For the remainder f = −q − N, 2^(f/16)
//! is a cubic polynomial with an error below 3e-9 before rounding.

#![cfg(target_arch = "x86_64")]

use std::arch::x86_64::*;

/// Number of f32 values in a register.
pub(super) const LANES: usize = 16;

/// A larger squared distance q counts as this one; 2^(−2016/16) is the smallest normal f32.
const REACH: f32 = 2016.0;
const ROUND: f32 = 12_582_912.0;
/// 2^(f/16) ≈ 1 + f·(CUBIC[0] + f·(CUBIC[1] + f·CUBIC[2])) on [−½, ½].
const CUBIC: [f32; 3] = [4.332_17e-2, 9.384_11e-4, 1.354_99e-5];

/// Bits of 2^(j/16) minus j·2¹⁹. Adding N·2¹⁹, for N = 16·e + j, then gives the bits of 2^(N/16).
static TABLE: [u32; 16] = [
    0x3f800000, 0x3f7daac3, 0x3f7b95c2, 0x3f79c3d3, 0x3f7837f0, 0x3f76f532, 0x3f75fed7, 0x3f75583f,
    0x3f7504f3, 0x3f7508a4, 0x3f75672a, 0x3f76248c, 0x3f7744fd, 0x3f78ccdf, 0x3f7ac0c7, 0x3f7d257d,
];

/// Whether this machine can run [`sum`].
pub(super) fn is_available() -> bool {
    is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512dq")
}

/// Coordinates of points: one slice for each channel, padded to a multiple of [`LANES`].
pub(super) type Points<'a, const C: usize> = [&'a [f32]; C];

/// Σᵢⱼ 2^(−‖aᵢ − bⱼ‖²/16) over points i < `rows` of `a` and all points j of `b`. With `SELF`, a and b
/// are the same points: blocks right of the diagonal count twice, blocks left of it are skipped.
///
/// # Safety
/// The machine must have AVX-512F and AVX-512DQ, see [`is_available`].
#[target_feature(enable = "avx512f,avx512dq")]
pub(super) unsafe fn sum<const C: usize, const SELF: bool>(
    a: Points<'_, C>,
    rows: usize,
    b: Points<'_, C>,
) -> f64 {
    let mut total = _mm512_setzero_pd();
    let mut row = 0;
    while row + 4 <= rows {
        total = _mm512_add_pd(total, rows_sum::<C, SELF, 4>(a, row, b));
        row += 4;
    }
    while row < rows {
        total = _mm512_add_pd(total, rows_sum::<C, SELF, 1>(a, row, b));
        row += 1;
    }
    _mm512_reduce_add_pd(total)
}

/// The kernel sum over `R` successive points of `a`, from `row` on and all in one block of 16, and
/// all points of `b`. Adds in f32 registers up to the last point of `b`, and then in f64.
#[target_feature(enable = "avx512f,avx512dq")]
#[inline]
fn rows_sum<const C: usize, const SELF: bool, const R: usize>(
    a: Points<'_, C>,
    row: usize,
    b: Points<'_, C>,
) -> __m512d {
    let mut at = [[_mm512_setzero_ps(); C]; R];
    for r in 0..R {
        for c in 0..C {
            at[r][c] = _mm512_set1_ps(a[c][row + r]);
        }
    }
    let mut sums = [_mm512_setzero_ps(); R];
    let mut block = 0;
    if SELF {
        let diagonal = row / LANES;
        add_block::<C, R>(&mut sums, &at, b, diagonal);
        // Halves the diagonal block: it counts once, and the total is doubled below.
        for sum in &mut sums {
            *sum = _mm512_mul_ps(*sum, _mm512_set1_ps(0.5));
        }
        block = diagonal + 1;
    }
    while block < b[0].len() / LANES {
        add_block::<C, R>(&mut sums, &at, b, block);
        block += 1;
    }
    let mut total = _mm512_setzero_pd();
    for sum in sums {
        let low = _mm512_cvtps_pd(_mm512_castps512_ps256(sum));
        let high = _mm512_cvtps_pd(_mm512_extractf32x8_ps::<1>(sum));
        total = _mm512_add_pd(total, _mm512_add_pd(low, high));
    }
    if SELF { _mm512_add_pd(total, total) } else { total }
}

/// Loads block number `block` of a channel.
#[target_feature(enable = "avx512f,avx512dq")]
#[inline]
fn load(channel: &[f32], block: usize) -> __m512 {
    let values = channel.as_chunks::<LANES>().0[block];
    // SAFETY: the pointer is to an array of LANES = 16 f32; the unaligned load reads only these.
    unsafe { _mm512_loadu_ps(values.as_ptr()) }
}

#[target_feature(enable = "avx512f,avx512dq")]
#[inline]
fn add_block<const C: usize, const R: usize>(
    sums: &mut [__m512; R],
    at: &[[__m512; C]; R],
    b: Points<'_, C>,
    block: usize,
) {
    let mut other = [_mm512_setzero_ps(); C];
    for c in 0..C {
        other[c] = load(b[c], block);
    }
    for r in 0..R {
        sums[r] = add_kernel(sums[r], &at[r], &other);
    }
}

/// `sum` + 2^(−‖at − other‖²/16).
#[target_feature(enable = "avx512f,avx512dq")]
#[inline]
fn add_kernel<const C: usize>(sum: __m512, at: &[__m512; C], other: &[__m512; C]) -> __m512 {
    let set = _mm512_set1_ps;
    let mut power = _mm512_setzero_ps();
    for c in 0..C {
        let d = _mm512_sub_ps(other[c], at[c]);
        power = _mm512_fnmadd_ps(d, d, power);
    }
    power = _mm512_max_ps(power, set(-REACH));
    let n = _mm512_castps_si512(_mm512_add_ps(set(ROUND), power));
    // The difference between −q and its rounded value.
    let f = _mm512_reduce_ps::<0>(power);
    // SAFETY: the pointer is to an array of 16 u32; the unaligned load reads only these.
    let table = unsafe { _mm512_loadu_si512(TABLE.as_ptr().cast()) };
    let whole = _mm512_add_epi32(_mm512_permutexvar_epi32(n, table), _mm512_slli_epi32::<19>(n));
    let rest = _mm512_fmadd_ps(set(CUBIC[2]), f, set(CUBIC[1]));
    let rest = _mm512_fmadd_ps(rest, f, set(CUBIC[0]));
    let rest = _mm512_fmadd_ps(rest, f, set(1.0));
    _mm512_fmadd_ps(_mm512_castsi512_ps(whole), rest, sum)
}
