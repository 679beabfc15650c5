//! Inner products, of which nearly all of the work consists.

/// f32 in a register of AVX-512, in two of AVX2 and in four of NEON.
pub(super) const LANES: usize = 16;
pub(super) type F32Lanes = [f32; LANES];

/// Rows of a tile of products that are made at once.
pub(super) const ROWS: usize = 2;
/// Its columns: with more of them, the sums would not fit into the registers of AVX2 and of NEON.
pub(super) const COLUMNS: usize = 3;

/// Σ a·b, in four registers of sums, as an addition takes four cycles.
pub(super) fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [[0.0f32; LANES]; 4];
    let (a, a_rest) = a.as_chunks::<{ 4 * LANES }>();
    let (b, b_rest) = b.as_chunks::<{ 4 * LANES }>();
    for (a, b) in a.iter().zip(b) {
        let (a, b) = (a.as_chunks::<LANES>().0, b.as_chunks::<LANES>().0);
        for part in 0..4 {
            sums[part] = plus_product(sums[part], &a[part], &b[part]);
        }
    }
    let [first, second, third, fourth] = sums;
    let rest: f32 = a_rest.iter().zip(b_rest).map(|(x, y)| x * y).sum();
    (total(&first) + total(&second)) + (total(&third) + total(&fourth)) + rest
}

/// How many values a sum goes over, at least one.
#[derive(Clone, Copy)]
pub(super) struct Length {
    /// Whole registers before the last one.
    last: usize,
    /// 1 for each value of the last register that counts, 0 for the others.
    counts: F32Lanes,
}

impl Length {
    /// # Panics
    /// If it is 0.
    #[inline(always)]
    pub(super) fn of(values: usize) -> Self {
        let last = (values - 1) / LANES;
        let mut counts = [0.0; LANES];
        counts[..values - last * LANES].fill(1.0);
        Self { last, counts }
    }
}

/// Σ a·b of each of some a and each of some b over their first values, lane by lane: each value that
/// is loaded serves several products. Of what lies behind, as much as fills the last register is
/// read too, and does not count.
///
/// # Panics
/// If a slice is shorter than that.
#[inline(always)]
pub(super) fn dots<const A: usize, const B: usize>(
    a: [&[f32]; A],
    b: [&[f32]; B],
    Length { last, counts }: &Length,
) -> [[F32Lanes; B]; A] {
    let last = *last;
    let a = a.map(|a| &a.as_chunks::<LANES>().0[..=last]);
    let b = b.map(|b| &b.as_chunks::<LANES>().0[..=last]);
    let mut sums = [[[0.0f32; LANES]; B]; A];
    for at in 0..last {
        sums = plus_products(sums, a.map(|a| a[at]), b.map(|b| b[at]));
    }
    let mut counted = [[0.0; LANES]; A];
    for i in 0..A {
        counted[i] = plus_product([0.0; LANES], &a[i][last], counts);
    }
    plus_products(sums, counted, b.map(|b| b[last]))
}

#[inline(always)]
fn plus_products<const A: usize, const B: usize>(
    mut sums: [[F32Lanes; B]; A],
    a: [F32Lanes; A],
    b: [F32Lanes; B],
) -> [[F32Lanes; B]; A] {
    for i in 0..A {
        for j in 0..B {
            sums[i][j] = plus_product(sums[i][j], &a[i], &b[j]);
        }
    }
    sums
}

/// Not fused, so that every machine gives the same bits.
#[inline(always)]
fn plus_product(mut sum: F32Lanes, a: &F32Lanes, b: &F32Lanes) -> F32Lanes {
    for lane in 0..LANES {
        sum[lane] += a[lane] * b[lane];
    }
    sum
}

/// The sum of the lanes, by halves: each step is one addition of registers.
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

#[cfg(test)]
mod tests {
    use super::*;

    fn column(seed: usize) -> Vec<f32> {
        (0..200).map(|i| ((i * 37 + seed * 101) % 89) as f32 / 89.0 - 0.5).collect()
    }

    fn plain(a: &[f32], b: &[f32], length: usize) -> f64 {
        a[..length].iter().zip(b).map(|(x, y)| f64::from(*x) * f64::from(*y)).sum()
    }

    #[test]
    fn products_made_at_once_are_those_made_one_by_one_and_end_where_they_should() {
        let columns = [0, 1, 2, 3, 4].map(column);
        let [a, b, c, d, e] = columns.each_ref().map(Vec::as_slice);
        for length in [1, 2, 15, 16, 17, 31, 32, 64, 90, 176] {
            let got = dots([a, b], [&c[7..], &d[7..], &e[7..]], &Length::of(length));
            for (x, row) in [a, b].iter().zip(&got) {
                for (y, lanes) in [c, d, e].iter().zip(row) {
                    let want = plain(x, &y[7..], length);
                    assert!((f64::from(total(lanes)) - want).abs() < 1e-4, "{length}");
                }
            }
            let alone = f64::from(dot(&a[..length], &b[..length]));
            assert!((alone - plain(a, b, length)).abs() < 1e-4, "{length}");
        }
    }
}
