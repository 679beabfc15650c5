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
    let mut upper: Vec<f64> = a.t().iter().copied().collect();
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
    let solved = b.dot(&inverse(l).t());
    b.assign(&solved);
}

/// The inverse of a lower triangular block. A product with it takes less time than a solution, value
/// after value.
fn inverse(l: &ArrayView2<'_, f64>) -> Array2<f64> {
    let n = l.nrows();
    let mut inverse = Array2::zeros((n, BLOCK));
    let rows = inverse.as_slice_mut().unwrap_or_default().as_chunks_mut().0;
    invert(&l.iter().copied().collect::<Vec<_>>(), rows);
    inverse.slice_move(s![.., ..n])
}

/// Sets the rows of the inverse of L, which is given row by row. Whole rows stay in registers.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn invert(lower: &[f64], rows: &mut [[f64; BLOCK]]) {
    let n = rows.len();
    for i in 0..n {
        let (above, below) = rows.split_at_mut(i);
        let mut row = [0.0; BLOCK];
        row[i] = 1.0;
        for j in 0..i {
            for k in 0..BLOCK {
                row[k] -= lower[i * n + j] * above[j][k];
            }
        }
        for k in 0..BLOCK {
            below[0][k] = row[k] / lower[i * n + i];
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
pub(crate) fn solve_lower(l: &ArrayView2<'_, f64>, mut b: ArrayViewMut2<'_, f64>) {
    let n = l.nrows();
    if n > BLOCK {
        let half = half_of(n);
        let (mut first, mut second) = b.split_at(Axis(0), half);
        solve_lower(&l.slice(s![..half, ..half]), first.view_mut());
        general_mat_mul(-1.0, &l.slice(s![half.., ..half]), &first, 1.0, &mut second);
        return solve_lower(&l.slice(s![half.., half..]), second);
    }
    let solved = inverse(l).dot(&b);
    b.assign(&solved);
}

/// Solves Lᵀ·X = B in place; each column of `b` is a right-hand side.
pub(crate) fn solve_lower_transposed(l: &ArrayView2<'_, f64>, mut b: ArrayViewMut2<'_, f64>) {
    let n = l.nrows();
    if n > BLOCK {
        let half = half_of(n);
        let (mut first, mut second) = b.split_at(Axis(0), half);
        solve_lower_transposed(&l.slice(s![half.., half..]), second.view_mut());
        general_mat_mul(-1.0, &l.slice(s![half.., ..half]).t(), &second, 1.0, &mut first);
        return solve_lower_transposed(&l.slice(s![..half, ..half]), first);
    }
    let solved = inverse(l).t().dot(&b);
    b.assign(&solved);
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
            for (mut sums, product) in below.rows_mut().into_iter().zip(product.rows()) {
                sums.zip_mut_with(&product, |sum, &x| *sum += f64::from(x));
            }
        }
    });
    gram
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// A symmetric matrix of positive eigenvalues.
    pub(crate) fn matrix(n: usize) -> Array2<f64> {
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
            solve_lower(&l.view(), b.view_mut());
            solve_lower_transposed(&l.view(), b.view_mut());
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
}
