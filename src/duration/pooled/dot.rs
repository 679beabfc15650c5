//! The inner product, of which nearly all of the work consists.

/// One AVX-512 register of f32.
const LANES: usize = 16;
type Lane = [f32; LANES];

/// Σ a·b, in four registers of sums, as an addition takes four cycles.
#[inline(always)]
pub(super) fn dot(a: &[f32], b: &[f32]) -> f32 {
    let [mut first, mut second, mut third, mut fourth] = [[0.0f32; LANES]; 4];
    let (a, a_rest) = a.as_chunks::<{ 4 * LANES }>();
    let (b, b_rest) = b.as_chunks::<{ 4 * LANES }>();
    for (a, b) in a.iter().zip(b) {
        let (a, b) = (a.as_chunks::<LANES>().0, b.as_chunks::<LANES>().0);
        first = plus_product(first, &a[0], &b[0]);
        second = plus_product(second, &a[1], &b[1]);
        third = plus_product(third, &a[2], &b[2]);
        fourth = plus_product(fourth, &a[3], &b[3]);
    }
    let mut sum = 0.0;
    for lane in 0..LANES {
        sum += (first[lane] + second[lane]) + (third[lane] + fourth[lane]);
    }
    sum + a_rest.iter().zip(b_rest).map(|(x, y)| x * y).sum::<f32>()
}

/// Not fused, so that every machine gives the same bits.
#[inline(always)]
fn plus_product(mut sum: Lane, a: &Lane, b: &Lane) -> Lane {
    for lane in 0..LANES {
        sum[lane] += a[lane] * b[lane];
    }
    sum
}
