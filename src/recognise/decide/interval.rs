//! How sure a share is: what k of n tells of the rate behind it.

use statrs::distribution::{Beta, ContinuousCDF};

/// Quantile of the Beta distribution; the parameters are positive.
pub fn beta_quantile(a: f64, b: f64, level: f64) -> f64 {
    // Positive parameters make a distribution.
    Beta::new(a, b).map_or(f64::NAN, |beta| beta.inverse_cdf(level))
}

/// Quantile of the rate behind `successes` of `trials` under Jeffreys' prior, Beta(k + ½, n − k + ½)
/// (Brown, Cai & DasGupta 2001, "Interval estimation for a binomial proportion").
///
/// # Panics
/// If there are more successes than trials.
pub fn jeffreys_quantile(successes: usize, trials: usize, level: f64) -> f64 {
    assert!(successes <= trials, "{successes} of {trials}");
    beta_quantile(successes as f64 + 0.5, (trials - successes) as f64 + 0.5, level)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_of_jeffreys_are_those_of_the_beta_distribution() {
        // R: qbeta(0.9, 0.5, 180.5), qbeta(0.9, 1.5, 179.5).
        assert!((jeffreys_quantile(0, 180, 0.9) - 0.007_470).abs() < 2e-5);
        assert!((jeffreys_quantile(1, 180, 0.9) - 0.017_21).abs() < 2e-4);
        let both = jeffreys_quantile(3, 10, 0.2) + jeffreys_quantile(7, 10, 0.8);
        assert!((both - 1.0).abs() < 1e-6, "symmetric: {both}");
    }
}
