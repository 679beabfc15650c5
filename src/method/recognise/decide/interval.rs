//! Confidence intervals of a success rate, given k successes in n trials.

use statrs::distribution::{Beta, ContinuousCDF, StudentsT};

/// The 97.5 % quantile of the normal distribution.
const Z: f64 = 1.959_963_984_540_054;

/// Quantile of the Beta distribution. Both parameters must be positive.
pub(crate) fn beta_quantile(a: f64, b: f64, level: f64) -> f64 {
    // Fails only if a parameter is not positive.
    Beta::new(a, b).map_or(f64::NAN, |beta| beta.inverse_cdf(level))
}

/// Quantile of the success rate under Jeffreys' prior, Beta(k + ½, n − k + ½), given k `successes` in
/// n `trials` (Brown, Cai & DasGupta 2001, "Interval estimation for a binomial proportion").
///
/// # Panics
/// If there are more successes than trials.
pub(crate) fn jeffreys_quantile(successes: usize, trials: usize, level: f64) -> f64 {
    assert!(successes <= trials, "{successes} of {trials}");
    beta_quantile(successes as f64 + 0.5, (trials - successes) as f64 + 0.5, level)
}

/// 95 % confidence interval of a share found in `trials` trials, (0, 1) if there are none. `trials`
/// may be fractional (Wilson 1927, "Probable inference, the law of succession, and statistical
/// inference").
pub(crate) fn wilson(share: f64, trials: f64) -> (f64, f64) {
    if trials <= 0.0 {
        return (0.0, 1.0);
    }
    let centre = share + Z * Z / (2.0 * trials);
    let spread = Z * (share * (1.0 - share) / trials + Z * Z / (4.0 * trials * trials)).sqrt();
    let scale = 1.0 + Z * Z / trials;
    (((centre - spread) / scale).max(0.0), ((centre + spread) / scale).min(1.0))
}

/// The share that is named right if the most frequent of some surfaces is always named, from how often each
/// occurs; 0 if none does.
pub(crate) fn chance(counts: impl Iterator<Item = usize> + Clone) -> f64 {
    counts.clone().max().unwrap_or(0) as f64 / counts.sum::<usize>().max(1) as f64
}

/// 95 % confidence interval of a success rate (Wilson 1927); (0, 1) if there are no trials.
pub fn wilson_interval(successes: usize, trials: usize) -> (f64, f64) {
    wilson(successes as f64 / trials.max(1) as f64, trials as f64)
}

/// 95 % confidence interval of a success rate, from (successes, trials) of several groups, such as
/// people. It is Wilson's interval for an effective number of trials. That number is smaller the more
/// the groups differ and the fewer groups there are (Korn & Graubard 1998, "Confidence intervals for
/// proportions with small expected number of positive counts estimated from survey data").
pub(crate) fn wilson_of_groups(groups: &[(usize, usize)]) -> (f64, f64) {
    let count = groups.len() as f64;
    let (right, all) = groups.iter().fold((0, 0), |(r, n), group| (r + group.0, n + group.1));
    if count < 2.0 || all == 0 {
        return (0.0, 1.0);
    }
    let n = all as f64;
    let share = right as f64 / n;
    let residual = |&(right, all): &(usize, usize)| (right as f64 - share * all as f64).powi(2);
    let variance = groups.iter().map(residual).sum::<f64>() * count / (count - 1.0) / (n * n);
    let binomial = share * (1.0 - share) / n;
    // Groups that are more alike than chance predicts do not count as more than their trials.
    let effect = if binomial > 0.0 { (variance / binomial).max(1.0) } else { 1.0 };
    // There are at least two groups here, so the degrees of freedom are positive.
    let t = StudentsT::new(0.0, 1.0, count - 1.0).map_or(f64::NAN, |t| t.inverse_cdf(0.975));
    wilson(share, n / effect * (Z / t).powi(2))
}

/// Whether `right` of `trials` show a success rate of `share`: the median of the posterior under
/// Jeffreys' prior must reach it, which is slightly stricter than `right / trials`. If there are too
/// few trials to show the share even without a mistake, all of them must be right.
pub(crate) fn reaches(right: usize, trials: usize, share: f64) -> bool {
    trials > 0
        && (right == trials && !can_show(trials, share)
            || jeffreys_quantile(right, trials, 0.5) >= share)
}

/// Whether `trials` trials show a success rate of `share` if all of them are right.
pub(crate) fn can_show(trials: usize, share: f64) -> bool {
    jeffreys_quantile(trials, trials, 0.5) >= share
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_that_differ_widen_the_interval_and_so_do_few_groups() {
        let width = |groups: &[(usize, usize)]| {
            let (low, high) = wilson_of_groups(groups);
            high - low
        };
        let (low, high) = wilson(0.9, 400.0);
        let alike = [(90, 100); 4];
        let differ = [(80, 100), (100, 100), (82, 100), (98, 100)];
        assert!(width(&alike) > high - low && width(&differ) > 1.5 * width(&alike));
        assert!(width(&[(180, 200); 2]) > width(&alike));
        // With very many similar groups, the result is Wilson's interval.
        let (many_low, many_high) = wilson_of_groups(&[(9, 10); 4000]);
        let (low, high) = wilson(0.9, 40_000.0);
        assert!((many_low - low).abs() < 1e-5 && (many_high - high).abs() < 1e-5);
        assert_eq!(wilson_of_groups(&[(9, 10)]), (0.0, 1.0), "one person says nothing of another");
    }

    #[test]
    fn a_share_asks_for_a_margin_and_few_trials_for_perfection() {
        assert!(reaches(991, 1000, 0.99) && !reaches(989, 1000, 0.99));
        assert!(reaches(20, 20, 0.99) && !reaches(19, 20, 0.99) && !can_show(20, 0.99));
        assert!(can_show(200, 0.99) && reaches(199, 200, 0.99) && !reaches(197, 200, 0.99));
        assert!(!reaches(0, 0, 0.5));
    }

    #[test]
    fn quantiles_of_jeffreys_are_those_of_the_beta_distribution() {
        // R: qbeta(0.9, 0.5, 180.5), qbeta(0.9, 1.5, 179.5).
        assert!((jeffreys_quantile(0, 180, 0.9) - 0.007_470).abs() < 2e-5);
        assert!((jeffreys_quantile(1, 180, 0.9) - 0.017_21).abs() < 2e-4);
        let both = jeffreys_quantile(3, 10, 0.2) + jeffreys_quantile(7, 10, 0.8);
        assert!((both - 1.0).abs() < 1e-6, "symmetric: {both}");
    }
}
