//! Inner products of columns of f32, several at once, in the lanes of the processor's registers.

/// Number of f32 in one register of AVX-512, in two of AVX2, or in four of NEON.
pub(super) const LANES: usize = 16;
pub(super) type F32Lanes = [f32; LANES];

/// Number of rows of the product matrix that are computed at once.
pub(super) const ROWS: usize = 2;
/// Number of columns that are computed at once. More would not fit the registers of AVX2 and NEON.
pub(super) const COLUMNS: usize = 3;

/// The number of values in a sum, at least one.
#[derive(Clone, Copy)]
pub(super) struct Length {
    /// Number of whole registers before the last register.
    last: usize,
    /// For each value of the last register, 1 if it counts and 0 if not.
    counts: F32Lanes,
}

impl Length {
    #[inline(always)]
    pub(super) fn of(values: usize) -> Self {
        let last = (values - 1) / LANES;
        let mut counts = [0.0; LANES];
        counts[..values - last * LANES].fill(1.0);
        Self { last, counts }
    }
}

/// Σ a·b, lane by lane, for each slice in `a` and each in `b`, so that a value loaded once serves
/// several products. Reads whole registers, so no slice may end before the last one, but values beyond
/// the length do not count.
#[inline(always)]
pub(super) fn dots<const A: usize, const B: usize>(
    a: [&[f32]; A],
    b: [&[f32]; B],
    Length { last, counts }: &Length,
) -> [[F32Lanes; B]; A] {
    let (last, a, b) = (*last, registers(a), registers(b));
    let mut sums = [[[0.0f32; LANES]; B]; A];
    for at in 0..last {
        for i in 0..A {
            for j in 0..B {
                sums[i][j] = plus_product(sums[i][j], &a[i][at], &b[j][at]);
            }
        }
    }
    for i in 0..A {
        let counted = plus_product([0.0; LANES], &a[i][last], counts);
        for j in 0..B {
            sums[i][j] = plus_product(sums[i][j], &counted, &b[j][last]);
        }
    }
    sums
}

// The inner loops use an index: `map` on arrays is not always inlined into a function with a
// `target_feature`, such as AVX2, that the rest of the program lacks.

#[inline(always)]
fn registers<const N: usize>(columns: [&[f32]; N]) -> [&[F32Lanes]; N] {
    let mut registers: [&[F32Lanes]; N] = [&[]; N];
    for i in 0..N {
        registers[i] = columns[i].as_chunks().0;
    }
    registers
}

/// Multiplies and adds with two roundings, not fused, so that every machine gives the same bits.
#[inline(always)]
fn plus_product(mut sum: F32Lanes, a: &F32Lanes, b: &F32Lanes) -> F32Lanes {
    for lane in 0..LANES {
        sum[lane] += a[lane] * b[lane];
    }
    sum
}

/// The sum of the lanes, by halves, so that each step is one addition of registers.
#[inline(always)]
pub(super) fn total(sum: &F32Lanes) -> f32 {
    let (mut eight, mut four) = ([0.0; 8], [0.0; 4]);
    for lane in 0..8 {
        eight[lane] = sum[lane] + sum[lane + 8];
    }
    for lane in 0..4 {
        four[lane] = eight[lane] + eight[lane + 4];
    }
    (four[0] + four[2]) + (four[1] + four[3])
}
