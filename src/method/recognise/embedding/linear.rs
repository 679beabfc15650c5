//! Linear algebra for the discriminant: Cholesky factors and triangular solutions, in blocks, so that
//! nearly all work is matrix products (Golub & Van Loan, "Matrix Computations", 4th ed., §4.2.9 and
//! §3.1).

use multiversion::multiversion;
use ndarray::linalg::general_mat_mul;
use ndarray::{Array2, ArrayView2, ArrayViewMut2, Axis, s};
use rayon::prelude::*;

/// Size of the blocks that are factored column by column.
const BLOCK: usize = 48;

/// Number of vectors that are summed in f32 before the sum is added in f64.
const ROWS_A_SUM: usize = 512;

/// Number of columns of a matrix of sums that one thread computes at a time.
const COLUMNS_A_SUM: usize = 256;

/// Number of rows that is worth its own thread.
const ROWS_A_THREAD: usize = 512;

/// Turns a symmetric positive definite matrix into its lower Cholesky factor: A = L·Lᵀ. Reads only the
/// lower triangle; the values above the diagonal are meaningless afterwards.
///
/// Returns `None` if the matrix is not positive definite in f64.
pub(crate) fn cholesky(mut a: Array2<f64>) -> Option<Array2<f64>> {
    factor(a.view_mut())?;
    Some(a)
}

/// Halves the matrix until it is a block, so that most work is products of large matrices with data
/// that stay in the caches (Gustavson 1997, "Recursion leads to automatic variable blocking for dense
/// linear-algebra algorithms").
fn factor(mut a: ArrayViewMut2<'_, f64>) -> Option<()> {
    let n = a.nrows();
    if n > BLOCK {
        let half = half_of(n);
        let (mut above, below) = a.split_at(Axis(0), half);
        let (mut l21, mut a22) = below.split_at(Axis(1), half);
        factor(above.slice_mut(s![.., ..half]))?;
        solve_from_right(&above.slice(s![.., ..half]), l21.view_mut());
        subtract_lower_product(&l21.view(), &l21.t(), &mut a22);
        return factor(a22);
    }
    let mut upper = transposed(&a.view());
    for j in 0..n {
        let pivot = upper[j * n + j];
        // Written so that NaN fails as well.
        if !(pivot > 0.0 && pivot.is_finite()) {
            return None;
        }
        let root = pivot.sqrt();
        let (above, below) = upper.split_at_mut((j + 1) * n);
        let row = &mut above[j * n + j..];
        row[0] = root;
        row[1..].iter_mut().for_each(|x| *x /= root);
        for (i, below) in below.chunks_exact_mut(n).enumerate() {
            let own = row[1 + i];
            below[j + 1 + i..].iter_mut().zip(&row[1 + i..]).for_each(|(x, of)| *x -= own * of);
        }
    }
    for ((i, j), x) in a.indexed_iter_mut().filter(|((i, j), _)| j <= i) {
        *x = upper[j * n + i];
    }
    Some(())
}

/// The transpose of a block, row by row.
fn transposed(block: &ArrayView2<'_, f64>) -> Vec<f64> {
    block.t().iter().copied().collect()
}

fn half_of(n: usize) -> usize {
    (n / 2).next_multiple_of(BLOCK)
}

/// Solves X·Lᵀ = B in place, where L is lower triangular.
fn solve_from_right(l: &ArrayView2<'_, f64>, mut b: ArrayViewMut2<'_, f64>) {
    let (n, rows) = (l.nrows(), b.nrows());
    if rows > 2 * ROWS_A_THREAD {
        let (above, below) = b.split_at(Axis(0), rows / 2);
        rayon::join(|| solve_from_right(l, above), || solve_from_right(l, below));
        return;
    }
    if n > BLOCK {
        let half = half_of(n);
        let (mut first, mut second) = b.split_at(Axis(1), half);
        solve_from_right(&l.slice(s![..half, ..half]), first.view_mut());
        general_mat_mul(-1.0, &first, &l.slice(s![half.., ..half]).t(), 1.0, &mut second);
        return solve_from_right(&l.slice(s![half.., half..]), second);
    }
    let upper = transposed(l);
    for mut row in b.rows_mut() {
        match row.as_slice_mut() {
            Some(row) => solve_row(&upper, row),
            None => {
                let mut own = row.to_vec();
                solve_row(&upper, &mut own);
                row.iter_mut().zip(own).for_each(|(x, own)| *x = own);
            }
        }
    }
}

/// Solves x·U = b in place; U is upper triangular, row by row.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn solve_row(upper: &[f64], b: &mut [f64]) {
    let n = b.len();
    for j in 0..n {
        let of_u = &upper[j * n..][..n];
        let x = b[j] / of_u[j];
        b[j] = x;
        for k in j + 1..n {
            b[k] -= x * of_u[k];
        }
    }
}

/// A ← A − X·Y for a symmetric X·Y. Values of A above the diagonal may stay unchanged.
fn subtract_lower_product(
    x: &ArrayView2<'_, f64>,
    y: &ArrayView2<'_, f64>,
    a: &mut ArrayViewMut2<'_, f64>,
) {
    /// Below this size, skipping the upper half costs as much as it saves.
    const ENOUGH: usize = 4 * BLOCK;
    let n = a.nrows();
    if n <= ENOUGH {
        return general_mat_mul(-1.0, x, y, 1.0, a);
    }
    let half = half_of(n);
    let (x1, x2) = x.split_at(Axis(0), half);
    let (y1, y2) = y.split_at(Axis(1), half);
    let (mut above, below) = a.view_mut().split_at(Axis(0), half);
    let (mut below, mut last) = below.split_at(Axis(1), half);
    rayon::join(
        || general_mat_mul(-1.0, &x2, &y1, 1.0, &mut below),
        || {
            subtract_lower_product(&x1, &y1, &mut above.slice_mut(s![.., ..half]));
            subtract_lower_product(&x2, &y2, &mut last);
        },
    );
}

/// Solves L·X = B in place; each column of `b` is a right-hand side.
pub(crate) fn solve_lower(l: &Array2<f64>, b: &mut Array2<f64>) {
    solve_from_left(&l.view(), b.view_mut());
}

fn solve_from_left(l: &ArrayView2<'_, f64>, mut b: ArrayViewMut2<'_, f64>) {
    let n = l.nrows();
    if n > BLOCK {
        let half = half_of(n);
        let (mut first, mut second) = b.split_at(Axis(0), half);
        solve_from_left(&l.slice(s![..half, ..half]), first.view_mut());
        general_mat_mul(-1.0, &l.slice(s![half.., ..half]), &first, 1.0, &mut second);
        return solve_from_left(&l.slice(s![half.., half..]), second);
    }
    for i in 0..n {
        let (above, mut below) = b.view_mut().split_at(Axis(0), i);
        let mut row = below.row_mut(0);
        for (j, solved) in above.rows().into_iter().enumerate() {
            row.scaled_add(-l[[i, j]], &solved);
        }
        row /= l[[i, i]];
    }
}

/// Solves Lᵀ·X = B in place; each column of `b` is a right-hand side.
pub(crate) fn solve_lower_transposed(l: &Array2<f64>, b: &mut Array2<f64>) {
    solve_transposed_from_left(&l.view(), b.view_mut());
}

fn solve_transposed_from_left(l: &ArrayView2<'_, f64>, mut b: ArrayViewMut2<'_, f64>) {
    let n = l.nrows();
    if n > BLOCK {
        let half = half_of(n);
        let (mut first, mut second) = b.split_at(Axis(0), half);
        solve_transposed_from_left(&l.slice(s![half.., half..]), second.view_mut());
        general_mat_mul(-1.0, &l.slice(s![half.., ..half]).t(), &second, 1.0, &mut first);
        return solve_transposed_from_left(&l.slice(s![..half, ..half]), first);
    }
    for i in (0..n).rev() {
        let (mut above, below) = b.view_mut().split_at(Axis(0), i + 1);
        let mut row = above.row_mut(i);
        for (j, solved) in below.rows().into_iter().enumerate() {
            row.scaled_add(-l[[i + 1 + j, i]], &solved);
        }
        row /= l[[i, i]];
    }
}

/// Σ z·zᵀ over the rows of a matrix of shape (n, D). The result has shape (D, D); only its lower
/// triangle is filled.
pub(crate) fn lower_gram(vectors: &ArrayView2<'_, f32>) -> Array2<f64> {
    let (n, dims) = vectors.dim();
    let mut gram = Array2::zeros((dims, dims));
    let blocks: Vec<_> = gram.axis_chunks_iter_mut(Axis(1), COLUMNS_A_SUM).enumerate().collect();
    blocks.into_par_iter().for_each(|(block, mut columns)| {
        let from = block * COLUMNS_A_SUM;
        let to = from + columns.ncols();
        let mut below = columns.slice_mut(s![from.., ..]);
        for begin in (0..n).step_by(ROWS_A_SUM) {
            let rows = vectors.slice(s![begin..(begin + ROWS_A_SUM).min(n), from..]);
            let product = rows.t().dot(&rows.slice(s![.., ..to - from]));
            below.zip_mut_with(&product, |sum, &x| *sum += f64::from(x));
        }
    });
    gram
}

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
        p[from..].iter_mut().zip(&v).for_each(|(p, v)| *p -= half * v);
        for (i, row) in a.chunks_exact_mut(n).skip(from).enumerate() {
            let (own_v, own_p) = (v[i], p[from + i]);
            for ((x, v), p) in row[from..].iter_mut().zip(&v).zip(&p[from..]) {
                *x -= own_v * p + own_p * v;
            }
        }
        // Qᵀ ← (I − 2·v·vᵀ/|v|²)·Qᵀ
        p.fill(0.0);
        for (v, row) in v.iter().zip(q.chunks_exact(n).skip(from)) {
            p.iter_mut().zip(row).for_each(|(p, x)| *p += scale * v * x);
        }
        for (v, row) in v.iter().zip(q.chunks_exact_mut(n).skip(from)) {
            row.iter_mut().zip(&p).for_each(|(x, p)| *x -= v * p);
        }
    }
    ((0..n).map(|i| a[i * n + i]).collect(), beside, q)
}

/// Makes a tridiagonal matrix diagonal; turns the rows of `vectors` with it.
fn diagonal(values: &mut [f64], beside: &mut [f64], vectors: &mut [f64]) {
    /// Two or three steps an eigenvalue are usual.
    const STEPS: usize = 60;
    let n = values.len();
    let mut last = n.saturating_sub(1);
    for _ in 0..STEPS * n {
        let joined = |at: usize, values: &[f64], beside: &[f64]| {
            beside[at].abs() > f64::EPSILON * (values[at - 1].abs() + values[at].abs())
        };
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
        let shift = values[last] - off * off / (half + half.hypot(off).copysign(half));
        let (mut x, mut z) = (values[first] - shift, beside[first + 1]);
        for k in first..last {
            let length = x.hypot(z);
            let (c, s) = if length == 0.0 { (1.0, 0.0) } else { (x / length, z / length) };
            if k > first {
                beside[k] = length;
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
            for (u, w) in above[k * n..].iter_mut().zip(&mut below[..n]) {
                (*u, *w) = (c * *u + s * *w, c * *w - s * *u);
            }
        }
    }
}

/// Σ a·b, by four sums, so that no addition waits for the one before.
fn inner(a: &[f64], b: &[f64]) -> f64 {
    const LANES: usize = 4;
    let ((a, rest_a), (b, rest_b)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    let mut sums = [0.0; LANES];
    for (a, b) in a.iter().zip(b) {
        for lane in 0..LANES {
            sums[lane] += a[lane] * b[lane];
        }
    }
    sums.iter().sum::<f64>() + rest_a.iter().zip(rest_b).map(|(a, b)| a * b).sum::<f64>()
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

    fn matrix(n: usize) -> Array2<f64> {
        let b = Array2::from_shape_fn((n, n), |(i, j)| ((i * 31 + j * 17) as f64).sin());
        b.t().dot(&b) + Array2::<f64>::eye(n) * 0.5
    }

    #[test]
    fn factors_and_solutions_undo_each_other() {
        for n in [1, 47, 48, 49, 131] {
            let a = matrix(n);
            let l = cholesky(a.clone()).unwrap();
            let x = Array2::from_shape_fn((n, 3), |(i, j)| (i as f64 - 2.0 * j as f64).cos());
            let mut b = a.dot(&x);
            solve_lower(&l, &mut b);
            solve_lower_transposed(&l, &mut b);
            assert!((&b - &x).iter().all(|d| d.abs() < 1e-8), "{n}");
        }
    }

    #[test]
    fn what_is_not_positive_definite_is_refused() {
        assert!(cholesky(Array2::from_elem((3, 3), 1.0)).is_none());
        assert!(cholesky(Array2::from_elem((2, 2), f64::NAN)).is_none());
    }

    #[test]
    fn the_lower_triangle_of_the_sums_is_that_of_the_product() {
        let (n, dims) = (ROWS_A_SUM + 60, COLUMNS_A_SUM + 30);
        let value = |(i, j)| (((i * 31 + j * 17) % 97) as f32 - 48.0) / 16.0;
        let vectors = Array2::from_shape_fn((n, dims), value);
        let wide = vectors.mapv(f64::from);
        let full = wide.t().dot(&wide);
        let lower = lower_gram(&vectors.view());
        for ((i, j), expected) in full.indexed_iter().filter(|((i, j), _)| j <= i) {
            assert!((lower[[i, j]] - expected).abs() < 1e-5 * full[[i, i]], "{i}, {j}");
        }
    }

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
