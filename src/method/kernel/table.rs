//! A table of the mean kernel value over all pairs of a trial's samples, for a few length scales.
//!
//! The mean of exp(−d²/(2σ²)) is an entire function of ln σ, so interpolation at Chebyshev nodes
//! converges faster than any power. [`NODES`] nodes over a [`FOLD`]-fold range keep the error of
//! n·MMD² below 3e-5. The last coefficients estimate this error; no table is made if it is large.

/// Number of length scales at which the mean is computed.
pub(crate) const NODES: usize = 32;
/// Largest length scale of a table, divided by the smallest. The middle is their geometric mean.
pub(crate) const FOLD: f64 = 64.0;

/// Mean kernel value over all pairs of one set of samples, as a function of the length scale.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub(crate) struct SelfMean {
    /// ln of the length scale in the middle of the range.
    middle: f64,
    /// Mean kernel values at the Chebyshev nodes of the first kind, the largest length scale first.
    values: [f64; NODES],
}

impl SelfMean {
    /// Tabulates the `mean` kernel value around `sigma`; `None` if its error may exceed `tolerance`.
    pub(crate) fn new(
        sigma: f64,
        tolerance: f64,
        mut mean: impl FnMut(f64) -> f64,
    ) -> Option<Self> {
        let middle = sigma.ln();
        let values = std::array::from_fn(|k| mean((middle + half_range() * angle(k).cos()).exp()));
        let table = Self { middle, values };
        (table.middle.is_finite() && table.last_coefficients() <= tolerance).then_some(table)
    }

    /// The mean kernel value at `sigma`, by the barycentric formula (Berrut & Trefethen 2004, Eq. 5.3);
    /// `None` outside the range of the table.
    pub(crate) fn at(&self, sigma: f64) -> Option<f64> {
        let x = (sigma.ln() - self.middle) / half_range();
        if !(-1.0..=1.0).contains(&x) {
            return None;
        }
        let (mut above, mut below) = (0.0, 0.0);
        for (&(node, weight), value) in nodes().iter().zip(&self.values) {
            let distance = x - node;
            if distance == 0.0 {
                return Some(*value);
            }
            above += weight / distance * value;
            below += weight / distance;
        }
        Some(above / below)
    }

    /// Sum of the magnitudes of the last three Chebyshev coefficients. Coefficients fall off so fast
    /// that this sum bounds the sum of all later coefficients.
    fn last_coefficients(&self) -> f64 {
        let coefficient = |j: usize| {
            let term = |(k, value): (usize, &f64)| value * (j as f64 * angle(k)).cos();
            2.0 / NODES as f64 * self.values.iter().enumerate().map(term).sum::<f64>()
        };
        (NODES - 3..NODES).map(|j| coefficient(j).abs()).sum()
    }
}

fn half_range() -> f64 {
    0.5 * FOLD.ln()
}

fn angle(k: usize) -> f64 {
    (2 * k + 1) as f64 * std::f64::consts::PI / (2 * NODES) as f64
}

/// Chebyshev nodes of the first kind with their barycentric weights.
fn nodes() -> &'static [(f64, f64); NODES] {
    static ALL: std::sync::OnceLock<[(f64, f64); NODES]> = std::sync::OnceLock::new();
    ALL.get_or_init(|| {
        std::array::from_fn(|k| {
            let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
            (angle(k).cos(), sign * angle(k).sin())
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::kernel_sum;
    use crate::seed::rng;
    use ndarray::Array2;
    use rand::RngExt;

    fn mean(y: &Array2<f64>, sigma: f64) -> f64 {
        kernel_sum(y.view(), y.view(), sigma) / (y.nrows() as f64).powi(2)
    }

    #[test]
    fn a_table_meets_its_tolerance_or_is_absent() {
        let uniform = |key: &str, channels| {
            let mut rng = rng(1, &[key.as_bytes()]);
            Array2::from_shape_fn((120, channels), |_| rng.random::<f64>() - 0.5)
        };
        let cases = [
            uniform("flat", 1),
            uniform("peaked", 1).mapv(|x| (8.0 * x).exp()),
            uniform("tails", 1).mapv(|x| (3.1 * x).tan()),
            uniform("three", 3),
            uniform("two values", 1).mapv(f64::signum),
            uniform("few values", 1).mapv(|x| (x * 9.0).round()),
        ];
        let mut tables = 0;
        for (case, y) in cases.iter().enumerate() {
            let sigma = crate::kernel::length_scale(y.view());
            let tolerance = 1e-7;
            let Some(table) = SelfMean::new(sigma, tolerance, |sigma| mean(y, sigma)) else {
                continue;
            };
            tables += 1;
            for i in 0..=100 {
                let sigma = sigma * (half_range() * (f64::from(i) / 50.0 - 1.0) * 0.999).exp();
                let error = table.at(sigma).unwrap() - mean(y, sigma);
                assert!(error.abs() < tolerance, "case {case} at {sigma}: {error:e}");
            }
        }
        assert!(tables >= 4, "{tables}");
    }

    #[test]
    fn there_is_nothing_outside_the_range() {
        let table = SelfMean::new(2.0, 1.0, |_| 0.5).unwrap();
        assert_eq!(table.at(2.0 * 8.1), None);
        assert_eq!(table.at(2.0 / 8.1), None);
        assert!((table.at(2.0).unwrap() - 0.5).abs() < 1e-15);
    }
}
