//! The one place with intrinsics: Gaussian sums on AVX-512. Safe twin: `portable_sum` in
//! [`super::lanes`], against which this is tested.
//!
//! Per evaluation 2^(−q/16), q the squared distance: adding 1.5·2²³ rounds −q to a whole number N
//! of sixteenths; 2^(N/16) is a table of 16 and an exponent; the rest |f| ≤ ½ sixteenth is a
//! square, with a relative error below 9e-7 whose mean is next to zero, or a cubic, [`FINE`], below
//! 3e-9 before rounding. With two channels or more, [`NEAR`] sums 2^((2a·b − ‖b‖²)/16) along a row,
//! which takes a step a channel instead of two, and multiplies by the row's 2^(−‖a‖²/16) at its end.

#![cfg(target_arch = "x86_64")]

use std::arch::x86_64::*;

use super::padded_points::LANES;

/// Constant `PATH` of [`sum`]: no ‖x‖² is above [`NEAREST`], and a square will do.
pub(super) const NEAR: u8 = 0;
/// The same, for points anywhere.
pub(super) const FAR: u8 = 1;
/// Points anywhere, and a cubic.
pub(super) const FINE: u8 = 2;

/// Largest squared distance, in the units of this module, that needs no care: 2^(−2016/16) still is
/// a normal number.
const REACH: f32 = 2016.0;
/// Two points that are no farther than this, squared, from the origin are within [`REACH`], no
/// 2^(±‖x‖²/16) is too large or too small for f32, and rounding ‖x‖² changes a value by below 7e-7.
pub(super) const NEAREST: f32 = REACH / 4.0;

const ROUND: f32 = 12_582_912.0;
/// 2^(f/16) ≈ ALPHA·((f + 23)² + BETA) on [−½, ½]: minimax, with the mean error next to zero. The
/// best centre is 23.08; a whole number can be added to N without a step of its own.
const ALPHA: f64 = 9.418_457_442e-4;
const BETA: f32 = 532.744_7;
const CENTRE: f32 = 23.0;
const CUBIC: [f32; 3] = [4.332_17e-2, 9.384_11e-4, 1.354_99e-5];

/// Bits of 2^(j/16), less what the shifted N adds to them.
static TABLE: [u32; 16] = [
    0x3f80_0000,
    0x3f7d_aac3,
    0x3f7b_95c2,
    0x3f79_c3d3,
    0x3f78_37f0,
    0x3f76_f532,
    0x3f75_fed7,
    0x3f75_583f,
    0x3f75_04f3,
    0x3f75_08a4,
    0x3f75_672a,
    0x3f76_248c,
    0x3f77_44fd,
    0x3f78_ccdf,
    0x3f7a_c0c7,
    0x3f7d_257d,
];

/// Whether this machine can run [`sum`].
pub(super) fn is_available() -> bool {
    is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512dq")
}

/// Points as [`sum`] takes them, each slice padded to whole blocks of [`LANES`].
#[derive(Clone, Copy)]
pub(super) struct Points<'a, const C: usize> {
    /// Coordinates, channel by channel.
    pub channels: [&'a [f32]; C],
    /// −‖x‖².
    pub minus_norms: &'a [f32],
}

/// Whether distances come by 2a·b − ‖b‖² and a factor a row.
const fn is_expanded(channels: usize, path: u8) -> bool {
    path == NEAR && channels > 1
}

/// Σᵢⱼ wᵢⱼ 2^(−‖aᵢ − bⱼ‖²/16) over rows i of `a` and columns j of `b`. With `SELF`, a and b are one:
/// blocks right of the diagonal count twice, and those left of it are left out.
///
/// # Safety
/// The machine must have AVX-512F and AVX-512DQ: see [`is_available`].
#[target_feature(enable = "avx512f,avx512dq")]
pub(super) unsafe fn sum<const C: usize, const PATH: u8, const SELF: bool>(
    a: Points<'_, C>,
    rows: usize,
    b: Points<'_, C>,
) -> f64 {
    let mut total = _mm512_setzero_pd();
    let mut row = 0;
    while row + 4 <= rows {
        total = _mm512_add_pd(total, rows_sum::<C, PATH, SELF, 4>(a, row, b));
        row += 4;
    }
    while row < rows {
        total = _mm512_add_pd(total, rows_sum::<C, PATH, SELF, 1>(a, row, b));
        row += 1;
    }
    let unit = if PATH == FINE { 1.0 } else { ALPHA };
    unit * _mm512_reduce_add_pd(total)
}

/// `R` rows at once, which all lie in one block: their sums stay in registers, in f32, and go over
/// to f64 at the end of the row.
#[target_feature(enable = "avx512f,avx512dq")]
#[inline]
fn rows_sum<const C: usize, const PATH: u8, const SELF: bool, const R: usize>(
    a: Points<'_, C>,
    row: usize,
    b: Points<'_, C>,
) -> __m512d {
    let times = if is_expanded(C, PATH) { 2.0 } else { 1.0 };
    let at: [[__m512; C]; R] = std::array::from_fn(|r| {
        std::array::from_fn(|c| _mm512_set1_ps(times * a.channels[c][row + r]))
    });
    let mut sums = [_mm512_setzero_ps(); R];
    let mut block = 0;
    if SELF {
        let diagonal = row / LANES;
        add_block::<C, PATH, R>(&mut sums, &at, b, diagonal);
        // Halved, since all is doubled below.
        sums = sums.map(|sum| _mm512_mul_ps(sum, _mm512_set1_ps(0.5)));
        block = diagonal + 1;
    }
    while block < b.minus_norms.len() / LANES {
        add_block::<C, PATH, R>(&mut sums, &at, b, block);
        block += 1;
    }
    let factors = if is_expanded(C, PATH) { row_factors(a.minus_norms, row) } else { [1.0; LANES] };
    let mut total = _mm512_setzero_pd();
    for (r, sum) in sums.into_iter().enumerate() {
        let low = _mm512_cvtps_pd(_mm512_castps512_ps256(sum));
        let high = _mm512_cvtps_pd(_mm512_extractf32x8_ps::<1>(sum));
        let factor = _mm512_set1_pd(f64::from(factors[row % LANES + r]));
        total = _mm512_fmadd_pd(_mm512_add_pd(low, high), factor, total);
    }
    if SELF { _mm512_add_pd(total, total) } else { total }
}

/// 2^(−‖a‖²/16) of the rows in the block of `row`.
#[target_feature(enable = "avx512f,avx512dq")]
#[inline]
fn row_factors(minus_norms: &[f32], row: usize) -> [f32; LANES] {
    let power = load(minus_norms, row / LANES);
    let of_block = add_power::<FINE>(_mm512_setzero_ps(), power);
    let mut factors = [0.0; LANES];
    // SAFETY: the pointer is that of an array of LANES = 16 f32, all of which are written, unaligned.
    unsafe { _mm512_storeu_ps(factors.as_mut_ptr(), of_block) };
    factors
}

/// A block of some channel.
#[target_feature(enable = "avx512f,avx512dq")]
#[inline]
fn load(channel: &[f32], block: usize) -> __m512 {
    let values = channel.as_chunks::<LANES>().0[block];
    // SAFETY: the pointer is that of an array of LANES = 16 f32, all of which are read, unaligned.
    unsafe { _mm512_loadu_ps(values.as_ptr()) }
}

#[target_feature(enable = "avx512f,avx512dq")]
#[inline]
fn add_block<const C: usize, const PATH: u8, const R: usize>(
    sums: &mut [__m512; R],
    at: &[[__m512; C]; R],
    b: Points<'_, C>,
    block: usize,
) {
    let other: [__m512; C] = std::array::from_fn(|c| load(b.channels[c], block));
    let minus_norm = load(b.minus_norms, block);
    for (sum, at) in sums.iter_mut().zip(at) {
        *sum = add_kernel::<C, PATH>(*sum, at, &other, minus_norm);
    }
}

/// `sum` + 2^(−‖at − other‖²/16), without the factor [`ALPHA`] where a square is used, and without
/// that of the row where distances are expanded.
#[target_feature(enable = "avx512f,avx512dq")]
#[inline]
fn add_kernel<const C: usize, const PATH: u8>(
    sum: __m512,
    at: &[__m512; C],
    other: &[__m512; C],
    minus_norm: __m512,
) -> __m512 {
    let set = _mm512_set1_ps;
    if is_expanded(C, PATH) {
        let mut power = minus_norm;
        for c in 0..C {
            power = _mm512_fmadd_ps(at[c], other[c], power);
        }
        return add_power::<PATH>(sum, power);
    }
    let mut d = _mm512_sub_ps(other[0], at[0]);
    if C == 1 {
        if PATH != NEAR {
            // The smaller absolute value, with a positive sign.
            d = _mm512_range_ps::<0b1010>(d, set(44.8));
        }
        let rounded = _mm512_fnmadd_ps(d, d, set(ROUND));
        let f = _mm512_fnmadd_ps(d, d, _mm512_sub_ps(set(ROUND + centre(PATH)), rounded));
        return add_rounded::<PATH>(sum, rounded, f);
    }
    let mut power = _mm512_fnmadd_ps(d, d, _mm512_setzero_ps());
    for c in 1..C {
        d = _mm512_sub_ps(other[c], at[c]);
        power = _mm512_fnmadd_ps(d, d, power);
    }
    add_power::<PATH>(sum, _mm512_max_ps(power, set(-REACH)))
}

/// Added to the rounded power, which takes it away again: N exactly, moved to the square's centre.
const fn centre(path: u8) -> f32 {
    if path == FINE { 0.0 } else { CENTRE }
}

/// `sum` + 2^(power/16).
#[target_feature(enable = "avx512f,avx512dq")]
#[inline]
fn add_power<const PATH: u8>(sum: __m512, power: __m512) -> __m512 {
    let set = _mm512_set1_ps;
    let rounded = _mm512_add_ps(set(ROUND), power);
    let f = _mm512_add_ps(_mm512_sub_ps(set(ROUND + centre(PATH)), rounded), power);
    add_rounded::<PATH>(sum, rounded, f)
}

/// `sum` + 2^((N + f)/16), from [`ROUND`] + N and f, which is moved to the square's centre.
#[target_feature(enable = "avx512f,avx512dq")]
#[inline]
fn add_rounded<const PATH: u8>(sum: __m512, rounded: __m512, f: __m512) -> __m512 {
    let set = _mm512_set1_ps;
    let n = _mm512_castps_si512(rounded);
    // SAFETY: the pointer is that of an array of 16 u32, all of which are read, unaligned.
    let table = unsafe { _mm512_loadu_si512(TABLE.as_ptr().cast()) };
    let power = _mm512_add_epi32(_mm512_permutexvar_epi32(n, table), _mm512_slli_epi32::<19>(n));
    let rest = if PATH == FINE {
        let p = _mm512_fmadd_ps(set(CUBIC[2]), f, set(CUBIC[1]));
        let p = _mm512_fmadd_ps(p, f, set(CUBIC[0]));
        _mm512_fmadd_ps(p, f, set(1.0))
    } else {
        _mm512_fmadd_ps(f, f, set(BETA))
    };
    _mm512_fmadd_ps(_mm512_castsi512_ps(power), rest, sum)
}
