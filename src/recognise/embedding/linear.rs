//! The linear algebra that a discriminant needs: Cholesky factors and triangular solutions, in
//! blocks, so that nearly all work is matrix products (Golub & Van Loan, "Matrix Computations",
//! 4th ed., §4.2.9 and §3.1).

use ndarray::linalg::general_mat_mul;
use ndarray::{Array2, ArrayView2, ArrayViewMut2, Axis, s};

/// Columns that are worked on one by one.
const BLOCK: usize = 48;

/// Turns a symmetric positive definite matrix into its lower Cholesky factor: A = L·Lᵀ. Reads the
/// lower triangle alone; what stands above the diagonal afterwards means nothing.
///
/// Returns `None` if the matrix is not positive definite in f64.
pub fn cholesky(mut a: Array2<f64>) -> Option<Array2<f64>> {
    factor(a.view_mut())?;
    Some(a)
}

/// Halves the matrix until it is a block, so that products are of large matrices, and what they
/// read stays in the caches (Gustavson 1997, "Recursion leads to automatic variable blocking for
/// dense linear-algebra algorithms").
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
    for j in 0..n {
        let left: f64 = a.slice(s![j, ..j]).iter().map(|x| x * x).sum();
        let pivot = a[[j, j]] - left;
        // Written so that NaN is refused as well.
        if !(pivot > 0.0 && pivot.is_finite()) {
            return None;
        }
        let root = pivot.sqrt();
        a[[j, j]] = root;
        let (above, mut below) = a.view_mut().split_at(Axis(0), j + 1);
        let row_j = above.slice(s![j, ..j]);
        for mut row in below.rows_mut() {
            let dot: f64 = row.slice(s![..j]).iter().zip(&row_j).map(|(x, y)| x * y).sum();
            row[j] = (row[j] - dot) / root;
        }
    }
    Some(())
}

/// About half of more than a block, in whole blocks.
fn half_of(n: usize) -> usize {
    (n / 2).next_multiple_of(BLOCK)
}

/// Solves X·Lᵀ = B in place, L lower triangular.
fn solve_from_right(l: &ArrayView2<'_, f64>, mut b: ArrayViewMut2<'_, f64>) {
    let n = l.nrows();
    if n > BLOCK {
        let half = half_of(n);
        let (mut first, mut second) = b.split_at(Axis(1), half);
        solve_from_right(&l.slice(s![..half, ..half]), first.view_mut());
        general_mat_mul(-1.0, &first, &l.slice(s![half.., ..half]).t(), 1.0, &mut second);
        return solve_from_right(&l.slice(s![half.., half..]), second);
    }
    for mut row in b.rows_mut() {
        for j in 0..n {
            let known = row.slice(s![..j]);
            let dot: f64 = known.iter().zip(l.slice(s![j, ..j])).map(|(x, y)| x * y).sum();
            row[j] = (row[j] - dot) / l[[j, j]];
        }
    }
}

/// A ← A − X·Y in the lower triangle of A, at least; X·Y is symmetric.
pub fn subtract_lower_product(
    x: &ArrayView2<'_, f64>,
    y: &ArrayView2<'_, f64>,
    a: &mut ArrayViewMut2<'_, f64>,
) {
    /// Where the half that would be saved costs as much as it saves.
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
    subtract_lower_product(&x1, &y1, &mut above.slice_mut(s![.., ..half]));
    general_mat_mul(-1.0, &x2, &y1, 1.0, &mut below);
    subtract_lower_product(&x2, &y2, &mut last);
}

/// Solves L·X = B in place; `b` holds one column a right-hand side.
pub fn solve_lower(l: &Array2<f64>, b: &mut Array2<f64>) {
    let n = l.nrows();
    for k in (0..n).step_by(BLOCK) {
        let end = (k + BLOCK).min(n);
        for i in k..end {
            let (above, mut below) = b.view_mut().split_at(Axis(0), i);
            let mut row = below.row_mut(0);
            for j in k..i {
                row.scaled_add(-l[[i, j]], &above.row(j));
            }
            row /= l[[i, i]];
        }
        let (solved, mut rest) = b.view_mut().split_at(Axis(0), end);
        general_mat_mul(
            -1.0,
            &l.slice(s![end.., k..end]),
            &solved.slice(s![k.., ..]),
            1.0,
            &mut rest,
        );
    }
}

/// Solves Lᵀ·X = B in place; `b` holds one column a right-hand side.
pub fn solve_lower_transposed(l: &Array2<f64>, b: &mut Array2<f64>) {
    let n = l.nrows();
    for k in (0..n).step_by(BLOCK).rev() {
        let end = (k + BLOCK).min(n);
        let (mut rest, solved) = b.view_mut().split_at(Axis(0), end);
        let mut block = rest.slice_mut(s![k.., ..]);
        general_mat_mul(-1.0, &l.slice(s![end.., k..end]).t(), &solved, 1.0, &mut block);
        for i in (0..end - k).rev() {
            let (mut above, below) = block.view_mut().split_at(Axis(0), i + 1);
            let mut row = above.row_mut(i);
            for j in i + 1..end - k {
                row.scaled_add(-l[[k + j, k + i]], &below.row(j - i - 1));
            }
            row /= l[[k + i, k + i]];
        }
    }
}

/// An orthonormal basis of the span of the rows of `a`, row by row: Gram–Schmidt, done twice
/// ("twice is enough", Giraud et al. 2005). Rows that add less than 1e-9 of the largest are left
/// out.
pub fn orthonormal_rows(a: &Array2<f64>) -> Array2<f64> {
    let norm = |x: &ndarray::Array1<f64>| x.dot(x).sqrt();
    let largest = a.rows().into_iter().map(|row| norm(&row.to_owned())).fold(0.0, f64::max);
    let mut basis: Vec<ndarray::Array1<f64>> = Vec::new();
    for row in a.rows() {
        let mut rest = row.to_owned();
        for _ in 0..2 {
            for e in &basis {
                let along = rest.dot(e);
                rest.scaled_add(-along, e);
            }
        }
        let length = norm(&rest);
        if length > 1e-9 * largest {
            basis.push(rest / length);
        }
    }
    let mut rows = Array2::zeros((basis.len(), a.ncols()));
    rows.rows_mut().into_iter().zip(&basis).for_each(|(mut row, e)| row.assign(e));
    rows
}

/// Eigenvalues of a matrix logarithm's argument are at least this.
const LEAST_EIGENVALUE: f64 = 1e-12;

/// ln of a symmetric matrix of shape (n, n), row by row, by its eigenvalues (those below 1e-12 count
/// as that): cyclic Jacobi rotations (Golub & Van Loan, §8.5), right for small n.
pub fn log_symmetric(mut a: Vec<f64>, n: usize) -> Vec<f64> {
    /// Sweeps converge quadratically: ten are plenty.
    const SWEEPS: usize = 30;
    let mut v = vec![0.0; n * n];
    (0..n).for_each(|i| v[i * n + i] = 1.0);
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
                rotate(&mut a, &mut v, n, (p, q));
            }
        }
    }
    let logs: Vec<f64> = (0..n).map(|i| a[i * n + i].max(LEAST_EIGENVALUE).ln()).collect();
    let entry = |k: usize| {
        let (i, j) = (k / n, k % n);
        (0..n).map(|e| v[i * n + e] * logs[e] * v[j * n + e]).sum()
    };
    (0..n * n).map(entry).collect()
}

/// One rotation that makes a_pq zero.
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
        let (x, y) = (v[k * n + p], v[k * n + q]);
        v[k * n + p] = c * x - s * y;
        v[k * n + q] = s * x + c * y;
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

    /// Symmetric, positive definite, of more than two blocks.
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
    fn dependent_rows_add_nothing_to_a_basis() {
        let mut a = Array2::from_shape_fn((4, 9), |(i, j)| ((i * 9 + j).pow(2) as f64).sin());
        let sum = &a.row(0) + &a.row(1);
        a.row_mut(2).assign(&sum);
        let basis = orthonormal_rows(&a);
        assert_eq!(basis.nrows(), 3);
        let gram = basis.dot(&basis.t());
        assert!((gram - Array2::<f64>::eye(3)).iter().all(|x| x.abs() < 1e-12));
    }

    #[test]
    fn the_logarithm_of_a_matrix_undoes_its_exponential() {
        let n = 6;
        let value = |i: usize, j: usize| ((i * j + i + j) as f64 * 0.7).sin() * 0.3;
        let m = Array2::from_shape_fn((n, n), |(i, j)| value(i.min(j), i.max(j)));
        // e^m by its series: m is small.
        let (mut exponential, mut term) = (Array2::<f64>::eye(n), Array2::<f64>::eye(n));
        for k in 1..40 {
            term = term.dot(&m) / f64::from(k);
            exponential += &term;
        }
        let log = log_symmetric(exponential.into_raw_vec_and_offset().0, n);
        for (got, expected) in log.iter().zip(m.iter()) {
            assert!((got - expected).abs() < 1e-9, "{got} vs {expected}");
        }
        assert_eq!(log_symmetric(vec![0.0], 1), [LEAST_EIGENVALUE.ln()]);
    }
}
