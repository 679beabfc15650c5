//! From T* to the required scan duration, and from samples to the number of independent ones.

pub type Second = f64;

/// Samples that the kernel two-sample test compares (the paper's n).
pub const SAMPLES: usize = 400;

/// Latest start of the sampling in a scan of 4.8 s, in seconds: 1.15 % of the scan.
pub const START_S: Second = 0.0115 * 4.8;

/// The scan that one source needs to yield a number of samples T* apart.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct ScanNeed {
    /// T*: minimum time between independent samples.
    pub t_star_s: Second,
    /// Start t₀ of the sampling after the drag has begun.
    pub start_s: Second,
    pub samples: usize,
}

impl ScanNeed {
    /// The scan that yields `samples` samples with this T*, sampled from [`START_S`] on.
    pub fn new(t_star_s: Second, samples: usize) -> Self {
        Self { t_star_s, start_s: START_S, samples }
    }

    /// Duration that a scan must have: t₀ + (n − 1)·T*.
    pub fn scan_s(&self) -> Second {
        self.start_s + self.samples.saturating_sub(1) as f64 * self.t_star_s
    }
}

/// Effective number of independent samples among n = `samples`, spread evenly over a scan whose
/// samples together have the effective number n_eff = `effective`: n·tanh(n_eff/n).
///
/// Never more than n or n_eff. Exact for an Ornstein–Uhlenbeck process, whose variance inflation is
/// 2τ for all its samples and coth(Δ/2τ) for samples Δ apart.
pub fn worth(samples: usize, effective: f64) -> f64 {
    let n = samples as f64;
    n * (effective / n).tanh()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_worth_no_more_than_they_are_and_no_more_than_the_scan() {
        assert!((worth(400, 1e6) - 400.0).abs() < 1e-6);
        assert!((worth(400, 10.0) - 10.0).abs() < 0.01);
        // From the variance of the mean of 50 samples, 30 apart, of an AR(1) process with τ = 20.
        let rho = |lag: f64| (-lag / 20.0f64).exp();
        let sum = (1..50).map(|k| 2.0 * (1.0 - f64::from(k) / 50.0) * rho(30.0 * f64::from(k)));
        let want = 50.0 / (1.0 + sum.sum::<f64>());
        assert!((worth(50, 50.0 * 30.0 / 40.0) / want - 1.0).abs() < 0.03);
    }
}
