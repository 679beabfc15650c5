//! Eigenvalues and eigenvectors of symmetric matrices, and functions of such matrices.

use multiversion::multiversion;
use ndarray::Array2;

/// Eigenvalues and eigenvectors of a symmetric matrix.
pub(crate) struct EigenPairs {
    values: Vec<f64>,
    /// One eigenvector a row, shape (n, n).
    vectors: Array2<f64>,
}

impl EigenPairs {
    /// Decomposes a matrix of shape (n, n), given row by row, whose eigenvalues count down to `least`:
    /// Householder reflections make it tridiagonal, implicit QR steps diagonal (Golub & Van Loan, §8.3).
    pub(crate) fn new(matrix: Vec<f64>, n: usize, least: f64) -> Self {
        /// The errors of QR are about 1e-15 of the largest eigenvalue.
        const RANGE: f64 = 1e7;
        let largest = (0..n).map(|i| matrix[i * n + i]).fold(0.0, f64::max);
        // False for NaN as well.
        let is_narrow = largest <= RANGE * least;
        if !is_narrow {
            return Self::by_rotations(matrix, n);
        }
        let (mut values, mut beside, mut vectors) = tridiagonal(matrix, n);
        diagonal(&mut values, &mut beside, &mut vectors);
        Self::of(values, vectors)
    }

    fn of(values: Vec<f64>, vectors: Vec<f64>) -> Self {
        let n = values.len();
        // The buffer has n·n values.
        Self { vectors: Array2::from_shape_vec((n, n), vectors).unwrap_or_default(), values }
    }

    /// Decomposes a matrix with cyclic Jacobi rotations (Golub & Van Loan, §8.5). They cost ten times as
    /// much for 60 rows, but find small eigenvalues beside far larger ones.
    fn by_rotations(mut a: Vec<f64>, n: usize) -> Self {
        /// Sweeps converge quadratically; ten are plenty.
        const SWEEPS: usize = 30;
        let mut vectors = vec![0.0; n * n];
        (0..n).for_each(|i| vectors[i * n + i] = 1.0);
        let diagonal: f64 = (0..n).map(|i| a[i * n + i].powi(2)).sum();
        for _ in 0..SWEEPS {
            let off: f64 = (0..n)
                .flat_map(|i| (0..i).map(move |j| (i, j)))
                .map(|(i, j)| a[i * n + j].powi(2))
                .sum();
            if off <= 1e-24 * diagonal {
                break;
            }
            for p in 0..n {
                for q in p + 1..n {
                    rotate(&mut a, &mut vectors, n, (p, q));
                }
            }
        }
        Self::of((0..n).map(|i| a[i * n + i]).collect(), vectors)
    }

    /// The matrix with the same eigenvectors and the eigenvalues `f`(λ), row by row.
    pub(crate) fn map(&self, f: impl Fn(f64) -> f64) -> Vec<f64> {
        let mut scaled = self.vectors.clone();
        for (mut row, &value) in scaled.rows_mut().into_iter().zip(&self.values) {
            row *= f(value);
        }
        self.vectors.t().dot(&scaled).into_iter().collect()
    }
}

/// Makes a symmetric matrix A tridiagonal: T = Qᵀ·A·Q. Gives the diagonal of T, the values beside it,
/// each before its own row, and Qᵀ.
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn tridiagonal(mut a: Vec<f64>, n: usize) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
    let mut q = vec![0.0; n * n];
    (0..n).for_each(|i| q[i * n + i] = 1.0);
    let (mut p, mut beside) = (vec![0.0; n], vec![0.0; n]);
    for k in 0..n.saturating_sub(1) {
        let from = k + 1;
        // The reflection I − 2·v·vᵀ/|v|² that turns row k, right of the diagonal, into (−α, 0, …).
        let mut v = a[k * n + from..(k + 1) * n].to_vec();
        let alpha = inner(&v, &v).sqrt().copysign(v[0]);
        beside[from] = -alpha;
        v[0] += alpha;
        let square = inner(&v, &v);
        if square == 0.0 {
            continue;
        }
        let scale = 2.0 / square;
        for (p, row) in p[from..].iter_mut().zip(a.chunks_exact(n).skip(from)) {
            *p = scale * inner(&row[from..], &v);
        }
        let half = 0.5 * scale * inner(&p[from..], &v);
        add(&mut p[from..], -half, &v);
        for i in from..n {
            let (own_v, own_p) = (v[i - from], p[i]);
            let (row, p) = (&mut a[i * n + from..(i + 1) * n], &p[from..]);
            for j in 0..row.len().min(v.len()).min(p.len()) {
                row[j] -= own_v * p[j] + own_p * v[j];
            }
        }
        // Qᵀ ← (I − 2·v·vᵀ/|v|²)·Qᵀ
        p.fill(0.0);
        for i in from..n {
            add(&mut p, scale * v[i - from], &q[i * n..(i + 1) * n]);
        }
        for i in from..n {
            add(&mut q[i * n..(i + 1) * n], -v[i - from], &p);
        }
    }
    ((0..n).map(|i| a[i * n + i]).collect(), beside, q)
}

/// Makes a tridiagonal matrix diagonal; turns the rows of `vectors` with it.
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn diagonal(values: &mut [f64], beside: &mut [f64], vectors: &mut [f64]) {
    /// Two or three steps an eigenvalue are usual.
    const STEPS: usize = 60;
    let n = values.len();
    let mut last = n.saturating_sub(1);
    for _ in 0..STEPS * n {
        while last > 0 && !joined(last, values, beside) {
            last -= 1;
        }
        if last == 0 {
            return;
        }
        let mut first = last - 1;
        while first > 0 && joined(first, values, beside) {
            first -= 1;
        }
        // The eigenvalue of the last 2 × 2 block that is nearer to its last value (Wilkinson's shift).
        let (off, half) = (beside[last], 0.5 * (values[last - 1] - values[last]));
        let shift = values[last] - off * off / (half + length(half, off).copysign(half));
        let (mut x, mut z) = (values[first] - shift, beside[first + 1]);
        for k in first..last {
            let both = length(x, z);
            let (c, s) = if both == 0.0 { (1.0, 0.0) } else { (x / both, z / both) };
            if k > first {
                beside[k] = both;
            }
            let (a, b, d) = (values[k], beside[k + 1], values[k + 1]);
            values[k] = c * c * a + 2.0 * c * s * b + s * s * d;
            values[k + 1] = s * s * a - 2.0 * c * s * b + c * c * d;
            beside[k + 1] = c * s * (d - a) + (c * c - s * s) * b;
            x = beside[k + 1];
            if k + 1 < last {
                z = s * beside[k + 2];
                beside[k + 2] *= c;
            }
            let (above, below) = vectors.split_at_mut((k + 1) * n);
            let (u, w) = (&mut above[k * n..], &mut below[..n]);
            for i in 0..u.len().min(w.len()) {
                (u[i], w[i]) = (c * u[i] + s * w[i], c * w[i] - s * u[i]);
            }
        }
    }
}

/// Whether the value beside the diagonal, before row `at`, is too large to count as 0.
#[inline(always)]
fn joined(at: usize, values: &[f64], beside: &[f64]) -> bool {
    beside[at].abs() > f64::EPSILON * (values[at - 1].abs() + values[at].abs())
}

/// √(x² + z²) of values that are far from the limits of numbers, without the care of `hypot`.
#[inline(always)]
fn length(x: f64, z: f64) -> f64 {
    (x * x + z * z).sqrt()
}

/// x ← x + factor·y
#[inline(always)]
fn add(x: &mut [f64], factor: f64, y: &[f64]) {
    for i in 0..x.len().min(y.len()) {
        x[i] += factor * y[i];
    }
}

/// Σ a·b, by eight sums, so that no addition waits for the one before.
#[inline(always)]
fn inner(a: &[f64], b: &[f64]) -> f64 {
    const LANES: usize = 8;
    let n = a.len().min(b.len());
    let ((a, rest_a), (b, rest_b)) = (a[..n].as_chunks::<LANES>(), b[..n].as_chunks::<LANES>());
    let mut sums = [0.0; LANES];
    for i in 0..a.len().min(b.len()) {
        for lane in 0..LANES {
            sums[lane] += a[i][lane] * b[i][lane];
        }
    }
    let mut total = 0.0;
    for sum in sums {
        total += sum;
    }
    for i in 0..rest_a.len().min(rest_b.len()) {
        total += rest_a[i] * rest_b[i];
    }
    total
}

/// Appends the upper triangle of a symmetric matrix of shape (n, n). Off-diagonal values are
/// multiplied by √2, so that distances between such lists are Frobenius distances of matrices.
pub(crate) fn push_upper(matrix: &[f64], n: usize, vector: &mut Vec<f32>) {
    for row in 0..n {
        for column in row..n {
            let factor = if row == column { 1.0 } else { std::f64::consts::SQRT_2 };
            vector.push((factor * matrix[row * n + column]) as f32);
        }
    }
}

/// One rotation that makes a_pq zero. Eigenvectors are the rows of `v`.
fn rotate(a: &mut [f64], v: &mut [f64], n: usize, (p, q): (usize, usize)) {
    let off = a[p * n + q];
    if off == 0.0 {
        return;
    }
    let tau = (a[q * n + q] - a[p * n + p]) / (2.0 * off);
    let t = tau.signum() / (tau.abs() + (1.0 + tau * tau).sqrt());
    let c = 1.0 / (1.0 + t * t).sqrt();
    let s = t * c;
    for k in 0..n {
        let (x, y) = (a[k * n + p], a[k * n + q]);
        a[k * n + p] = c * x - s * y;
        a[k * n + q] = s * x + c * y;
        let (x, y) = (v[p * n + k], v[q * n + k]);
        v[p * n + k] = c * x - s * y;
        v[q * n + k] = s * x + c * y;
    }
    for k in 0..n {
        let (x, y) = (a[p * n + k], a[q * n + k]);
        a[p * n + k] = c * x - s * y;
        a[q * n + k] = s * x + c * y;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recognise::embedding::linear::tests::matrix;

    #[test]
    fn eigenvectors_are_orthogonal_and_make_the_matrix_again() {
        let twins = |n: usize| Array2::from_shape_fn((n, n), |(i, j)| f64::from(i % 2 == j % 2));
        let matrices = [1, 2, 3, 21, 60].map(matrix).into_iter();
        for a in matrices.chain([Array2::zeros((4, 4)), Array2::eye(5), twins(8)]) {
            let n = a.nrows();
            let list: Vec<f64> = a.iter().copied().collect();
            let pairs = EigenPairs::new(list.clone(), n, f64::INFINITY);
            let near = |got: &[f64], expected: &Array2<f64>| {
                let size = expected.iter().fold(1.0, |most: f64, x| most.max(x.abs()));
                got.iter().zip(expected).all(|(x, y)| (x - y).abs() < 1e-12 * size)
            };
            assert!(near(&pairs.map(|x| x), &a), "{n}: the matrix");
            assert!(near(&pairs.map(|_| 1.0), &Array2::eye(n)), "{n}: orthogonal");
            let slow = EigenPairs::by_rotations(list, n).map(|x| (x + 0.1).ln());
            let slow = Array2::from_shape_vec((n, n), slow).unwrap();
            assert!(near(&pairs.map(|x| (x + 0.1).ln()), &slow), "{n}: by rotations");
        }
    }

    #[test]
    fn the_logarithm_of_a_matrix_undoes_its_exponential() {
        let n = 6;
        let value = |i: usize, j: usize| ((i * j + i + j) as f64 * 0.7).sin() * 0.3;
        let m = Array2::from_shape_fn((n, n), |(i, j)| value(i.min(j), i.max(j)));
        // e^m by its series, which converges fast since m is small.
        let (mut exponential, mut term) = (Array2::<f64>::eye(n), Array2::<f64>::eye(n));
        for k in 1..40 {
            term = term.dot(&m) / f64::from(k);
            exponential += &term;
        }
        let log = EigenPairs::new(exponential.into_raw_vec_and_offset().0, n, 1.0).map(f64::ln);
        for (got, expected) in log.iter().zip(m.iter()) {
            assert!((got - expected).abs() < 1e-9, "{got} vs {expected}");
        }
        let mut upper = Vec::new();
        push_upper(&[1.0, 2.0, 2.0, 5.0], 2, &mut upper);
        assert_eq!(upper, [1.0, 2.0 * 2f32.sqrt(), 5.0]);
    }
}
