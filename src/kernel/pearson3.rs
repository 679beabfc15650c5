//! Quantiles of the Pearson III distribution: a gamma distribution, shifted and scaled to a given
//! mean, variance and skewness.
//!
//! With skewness g > 0 the shape is k = 4/g², and the standardised quantile is
//! K(g) = (G⁻¹(1 − α; k) − k)/√k, where G is the gamma distribution of scale 1 (N. L. Johnson,
//! S. Kotz, N. Balakrishnan, Continuous Univariate Distributions 1, 1994, chapter 17). K is smooth
//! in g, and at g = 0 the normal quantile. Negative skewness mirrors it: K₁₋α(−g) = −K_α(g).

use statrs::distribution::{ContinuousCDF, Normal};
use statrs::function::gamma::{gamma_lr, ln_gamma};

use super::permutation_moments::Moments;

/// Below this skewness the quantile comes from the Cornish–Fisher expansion, the tail from the
/// normal distribution.
const NEARLY_NORMAL: f64 = 0.02;
/// The (1 − α) quantile of the Pearson III distribution with these moments, and the probability of
/// a value of at least `observed`.
pub fn pearson3_test(moments: &Moments, observed: f64, alpha: f64) -> (f64, f64) {
    let sd = moments.variance.sqrt();
    let kappa = moments.mean + sd * quantile(moments.skewness, alpha);
    if sd <= 0.0 {
        return (kappa, 1.0);
    }
    (kappa, tail((observed - moments.mean) / sd, moments.skewness))
}

fn normal() -> Normal {
    // A mean of 0 and a standard deviation of 1 are valid.
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
    // Newton's method on the logarithm keeps the gamma variable positive.
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
    fn negative_skewness_mirrors() {
        assert!((quantile(-0.7, 0.05) + quantile(0.7, 0.95)).abs() < 1e-12);
    }
}
