//! Quantiles of the Pearson III distribution: a gamma distribution, shifted and scaled to a given
//! mean, variance and skewness.
//!
//! With skewness g > 0 the shape is k = 4/g², and the standardised quantile is
//! K(g) = (G⁻¹(1 − α; k) − k)/√k, where G is the gamma distribution of scale 1 (N. L. Johnson,
//! S. Kotz, N. Balakrishnan, Continuous Univariate Distributions 1, 1994, chapter 17). K is smooth
//! in g, and normal at g = 0; negative skewness mirrors: K₁₋α(−g) = −K_α(g).

use statrs::distribution::{ContinuousCDF, Normal};
use statrs::function::gamma::{gamma_lr, ln_gamma};

use super::permutation_moments::Moments;

/// Below this skewness the gamma quantile is taken from the Cornish–Fisher expansion.
const NEARLY_NORMAL: f64 = 0.02;
/// Largest skewness of the table; beyond, quantiles are computed one by one.
const LARGEST: f64 = 4.0;
const STEPS: usize = 400;

/// The (1 − α) quantile of standardised Pearson III distributions as a function of their skewness.
///
/// Tabulated for skewness 0 to 4 and interpolated by cubics through four nodes: within 1e-6 of
/// the quantile itself (a test), far inside what the approximation costs.
#[derive(Clone, Debug)]
pub struct Pearson3 {
    alpha: f64,
    table: Vec<f64>,
}

impl Pearson3 {
    /// A table for the (1 − α) quantile, 0 < α < 1.
    pub fn new(alpha: f64) -> Self {
        let step = LARGEST / STEPS as f64;
        // One node on either side of the range, for the cubics at its ends.
        let table = (0..STEPS + 3).map(|i| quantile((i as f64 - 1.0) * step, alpha)).collect();
        Self { alpha, table }
    }

    /// Standardised quantile at this skewness.
    #[inline]
    pub fn standard_quantile(&self, skewness: f64) -> f64 {
        if !(0.0..LARGEST).contains(&skewness) {
            return quantile(skewness, self.alpha);
        }
        let at = skewness * (STEPS as f64 / LARGEST);
        let i = at as usize;
        let x = at - i as f64;
        // Nodes at −1, 0, 1, 2 of x.
        let [a, b, c, d] = [self.table[i], self.table[i + 1], self.table[i + 2], self.table[i + 3]];
        let (p, q, r) = (x + 1.0, x - 1.0, x - 2.0);
        -a * x * q * r / 6.0 + b * p * q * r / 2.0 - c * p * x * r / 2.0 + d * p * x * q / 6.0
    }

    /// The (1 − α) quantile of the Pearson III distribution with these moments.
    #[inline]
    pub fn quantile(&self, moments: &Moments) -> f64 {
        moments.mean + moments.variance.sqrt() * self.standard_quantile(moments.skewness)
    }

    /// The (1 − α) quantile, and the chance of a value of at least `observed`, without a table.
    pub fn test(moments: &Moments, observed: f64, alpha: f64) -> (f64, f64) {
        let sd = moments.variance.sqrt();
        let kappa = moments.mean + sd * quantile(moments.skewness, alpha);
        if sd <= 0.0 {
            return (kappa, 1.0);
        }
        (kappa, tail((observed - moments.mean) / sd, moments.skewness))
    }
}

fn normal() -> Normal {
    // 0 and 1 are a mean and a standard deviation.
    Normal::new(0.0, 1.0).expect("the standard normal distribution exists")
}

/// P(X ≥ z) for a standardised Pearson III variable.
fn tail(z: f64, skewness: f64) -> f64 {
    if skewness < 0.0 {
        return 1.0 - tail(-z, -skewness);
    }
    if skewness < NEARLY_NORMAL {
        return 1.0 - normal().cdf(z);
    }
    let k = 4.0 / (skewness * skewness);
    let x = k + z * k.sqrt();
    if x <= 0.0 { 1.0 } else { 1.0 - gamma_lr(k, x) }
}

/// The (1 − α) quantile of a standardised Pearson III variable.
fn quantile(skewness: f64, alpha: f64) -> f64 {
    if skewness < 0.0 {
        return -quantile(-skewness, 1.0 - alpha);
    }
    let z = normal().inverse_cdf(1.0 - alpha);
    let g = skewness;
    // Cornish–Fisher in powers of g (Johnson et al., 1994, Eq. 17.30, from the Wilson–Hilferty
    // cube and its corrections).
    let expansion = z + (z * z - 1.0) * g / 6.0 + (z.powi(3) - 7.0 * z) * g * g / 144.0
        - (3.0 * z.powi(4) + 7.0 * z * z - 16.0) * g.powi(3) / 6480.0;
    if g < NEARLY_NORMAL {
        return expansion;
    }
    // Newton steps on the logarithm keep the gamma variable positive.
    let k = 4.0 / (g * g);
    let wilson_hilferty = (1.0 - g * g / 36.0 + g / 6.0 * z).max(0.05);
    let mut log_x = (k * wilson_hilferty.powi(3)).ln();
    for _ in 0..60 {
        let x = log_x.exp();
        let log_density = k * log_x - x - ln_gamma(k);
        let step = (gamma_lr(k, x) - (1.0 - alpha)) / log_density.exp();
        log_x -= step.clamp(-0.5, 0.5);
        if step.abs() < 1e-13 {
            break;
        }
    }
    (log_x.exp() - k) / k.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_skewness_of_two_is_the_exponential_distribution() {
        let exact = -(0.05f64).ln() - 1.0;
        assert!((quantile(2.0, 0.05) - exact).abs() < 1e-9);
        assert!((tail(exact, 2.0) - 0.05).abs() < 1e-9);
    }

    #[test]
    fn the_table_is_within_a_millionth_of_the_quantile() {
        let table = Pearson3::new(0.05);
        for i in 0..4000 {
            let g = (f64::from(i) + 0.37) / 1000.0;
            let (got, want) = (table.standard_quantile(g), quantile(g, 0.05));
            assert!((got - want).abs() < 1e-6, "{g}: {got} {want}");
        }
    }

    #[test]
    fn negative_skewness_mirrors() {
        assert!((quantile(-0.7, 0.05) + quantile(0.7, 0.95)).abs() < 1e-12);
    }
}
