//! Sums, extremes and channels of samples; sums are in lanes that the processor adds at once.
//!
//! The loops use an index. Iterators with closures are not always inlined into a function with a
//! `target_feature`, such as AVX2, that the rest of the program lacks; they then take twice the time.

use multiversion::multiversion;

/// Number of partial sums of each sum.
const LANES: usize = 8;

/// The whole chunks of `x`, and the rest, filled up with `padding`.
#[inline(always)]
pub(crate) fn chunks<const N: usize>(x: &[f32], padding: f32) -> (&[[f32; N]], [f32; N]) {
    let (whole, rest) = x.as_chunks();
    let mut last = [padding; N];
    for lane in 0..N {
        if lane < rest.len() {
            last[lane] = rest[lane];
        }
    }
    (whole, last)
}

/// The sum of all lanes: halves are added until one is left, so that no addition waits for all others.
#[inline(always)]
pub(crate) fn total<const N: usize, T: Copy + Into<f64>>(lanes: &[T; N]) -> f64 {
    let mut sums = [0f64; N];
    for lane in 0..N {
        sums[lane] = lanes[lane].into();
    }
    let mut half = N / 2;
    while half > 0 {
        for lane in 0..half {
            sums[lane] += sums[lane + half];
        }
        half /= 2;
    }
    sums[0]
}

/// One channel of interleaved samples, minus `reference`.
pub(crate) fn less(
    samples: &[f32],
    (channels, channel): (usize, usize),
    reference: f32,
) -> Vec<f32> {
    if channels == 1 {
        return samples.iter().map(|x| x - reference).collect();
    }
    samples.chunks_exact(channels).map(|frame| frame[channel] - reference).collect()
}

/// Sum of the samples, by several sums in f64, so that no addition waits for the one before.
#[inline(always)]
pub(crate) fn sum(samples: &[f32]) -> f64 {
    let mut lanes = [0f64; LANES];
    let (chunks, rest) = samples.as_chunks::<LANES>();
    for chunk in chunks {
        for lane in 0..LANES {
            lanes[lane] += f64::from(chunk[lane]);
        }
    }
    for lane in 0..rest.len() {
        lanes[lane] += f64::from(rest[lane]);
    }
    lanes.iter().sum()
}

/// Σ a·b over two lists of equal length.
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
pub(crate) fn dot(a: &[f32], b: &[f32]) -> f64 {
    let ((a, last_a), (b, last_b)) = (chunks(a, 0.0), chunks(b, 0.0));
    let mut sums = [0f64; LANES];
    for i in 0..a.len().min(b.len()) {
        add_products(&mut sums, &a[i], &b[i]);
    }
    add_products(&mut sums, &last_a, &last_b);
    total(&sums)
}

/// The inner product of each row of a matrix with a vector, summed in f32; none for an empty vector.
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
pub(crate) fn products<T: Copy + Into<f32>>(rows: &[T], vector: &[f32]) -> Vec<f64> {
    /// Wider arrays are not kept in whole registers.
    const WIDE: usize = 16;
    let (b, rest_b) = vector.as_chunks::<WIDE>();
    let columns = vector.len().max(1);
    let mut all = Vec::with_capacity(rows.len() / columns);
    for row in rows.chunks_exact(columns) {
        let (a, rest_a) = row.as_chunks::<WIDE>();
        let mut sums = [0f32; WIDE];
        for lane in 0..rest_a.len().min(rest_b.len()) {
            sums[lane] = rest_a[lane].into() * rest_b[lane];
        }
        for i in 0..a.len().min(b.len()) {
            for lane in 0..WIDE {
                sums[lane] += a[i][lane].into() * b[i][lane];
            }
        }
        all.push(total(&sums));
    }
    all
}

#[inline(always)]
fn add_products(sums: &mut [f64; LANES], a: &[f32; LANES], b: &[f32; LANES]) {
    for lane in 0..LANES {
        sums[lane] += f64::from(a[lane]) * f64::from(b[lane]);
    }
}

/// Σ x, Σ x³ and Σ x⁴.
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
pub(crate) fn powers(x: &[f32]) -> [f64; 3] {
    let (whole, last) = chunks(x, 0.0);
    let mut sums = [[0f64; LANES]; 3];
    for chunk in whole {
        add_powers(&mut sums, chunk);
    }
    add_powers(&mut sums, &last);
    [total(&sums[0]), total(&sums[1]), total(&sums[2])]
}

#[inline(always)]
fn add_powers(sums: &mut [[f64; LANES]; 3], x: &[f32; LANES]) {
    for lane in 0..LANES {
        let x = f64::from(x[lane]);
        let square = x * x;
        sums[0][lane] += x;
        sums[1][lane] += square * x;
        sums[2][lane] += square * square;
    }
}

/// Σ |x − m|, Σ √|x − m| and the number of crossings of m.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
pub(crate) fn about(x: &[f32], m: f32) -> [f64; 3] {
    let (whole, last) = chunks(x, m);
    let mut sums = [[0f32; LANES]; 2];
    for chunk in whole {
        add_distances(&mut sums, chunk, m);
    }
    add_distances(&mut sums, &last, m);
    let mut crossings = 0u32;
    for i in 1..x.len() {
        crossings += u32::from((x[i - 1] < m) != (x[i] < m));
    }
    let [magnitudes, roots] = sums;
    [total(&magnitudes), total(&roots), f64::from(crossings)]
}

#[inline(always)]
fn add_distances(sums: &mut [[f32; LANES]; 2], x: &[f32; LANES], m: f32) {
    for lane in 0..LANES {
        let distance = (x[lane] - m).abs();
        sums[0][lane] += distance;
        sums[1][lane] += distance.sqrt();
    }
}

/// The least and the greatest value; 0 and 0 if there are none.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
pub(crate) fn extremes(x: &[f32]) -> (f32, f32) {
    let first = if x.is_empty() { 0.0 } else { x[0] };
    let (whole, last) = chunks::<LANES>(x, first);
    let (mut least, mut greatest) = (last, last);
    for chunk in whole {
        for lane in 0..LANES {
            least[lane] = lesser(least[lane], chunk[lane]);
            greatest[lane] = -lesser(-greatest[lane], -chunk[lane]);
        }
    }
    for lane in 1..LANES {
        least[0] = lesser(least[0], least[lane]);
        greatest[0] = -lesser(-greatest[0], -greatest[lane]);
    }
    (least[0], greatest[0])
}

/// Unlike `f32::min`, this is one instruction.
#[inline(always)]
fn lesser(a: f32, b: f32) -> f32 {
    if b < a { b } else { a }
}
