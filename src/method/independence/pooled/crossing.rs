//! Finds the lag from which on dependence stays below the threshold, and an upper bound of this lag.

use super::size::Size;

/// The 95 % quantile of the standard normal distribution.
const UPPER: f64 = 1.645;
/// T* moves beyond a later bin if dependence there exceeds the threshold by this number of standard
/// errors. Chance hardly ever causes this in any of about sixty bins.
const SURE: f64 = 4.0;
/// Dependence lasts if it exceeds the threshold by this number of standard errors at a long lag.
const THERE: f64 = 2.0;

/// Dependence of one channel on another, as a function of the lag.
#[derive(Clone, Debug)]
pub(super) struct Curve {
    /// Centre of each bin of lags, in frames.
    pub lags: Vec<f64>,
    pub sizes: Vec<Size>,
    /// Fit of the sizes that never rises with the lag.
    pub fitted: Vec<f64>,
}

/// The lag at which a curve falls below a threshold.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Crossing {
    /// Lag at which the fit crosses the threshold, in frames; `None` if the fit stays above.
    pub estimate: Option<f64>,
    /// Lag at which the fit's upper confidence bound crosses the threshold; `None` if never.
    pub upper: Option<f64>,
}

impl Curve {
    pub(super) fn new(lags: Vec<f64>, sizes: Vec<Size>) -> Self {
        let fitted = antitonic(&sizes.iter().map(|s| s.value).collect::<Vec<_>>());
        Self { lags, sizes, fitted }
    }

    /// Standard error of √size at a bin, for a size `near`, from the jackknife error of the size.
    /// It is at least the largest error of one covariance, since few blocks may agree by chance.
    fn root_error(&self, bin: usize, near: f64) -> f64 {
        let slope = 2.0 * near.sqrt();
        (self.sizes[bin].error / slope).max(self.sizes[bin].entry_error)
    }

    /// The factor by which the data must grow until the upper bound for independent samples is half
    /// the threshold (as a correlation) in the longer half of the lags.
    pub(super) fn lacking(&self, threshold: f64) -> f64 {
        let bins = self.lags.len() / 2..self.lags.len();
        let mut errors: Vec<f64> = bins.map(|bin| self.root_error(bin, threshold)).collect();
        errors.sort_unstable_by(f64::total_cmp);
        let median = errors.get(errors.len() / 2).copied().unwrap_or(0.0);
        (2.0 * UPPER * median / threshold.sqrt()).powi(2)
    }

    /// Half the width of the 90 % interval of √size at a bin.
    pub(super) fn half_width(&self, bin: usize, threshold: f64) -> f64 {
        UPPER * self.root_error(bin, self.fitted[bin].max(threshold))
    }

    /// The lags at which the fit and its upper bound fall below `threshold`, a size. Both lags move
    /// beyond a later bin that is surely above the threshold.
    pub(super) fn crossing(&self, threshold: f64) -> Crossing {
        let root = threshold.sqrt();
        let fit = |bin: usize| self.fitted[bin].max(0.0).sqrt();
        let first = |from: usize, curve: &dyn Fn(usize) -> f64| {
            (from..self.lags.len()).find(|&bin| curve(bin) < root)
        };
        let none = Crossing { estimate: None, upper: None };
        let Some(below) = first(0, &fit) else { return none };
        let mut estimate = self.between(below, root, &fit);
        let mut from = below;
        let surely_above =
            |bin: &usize| self.sizes[*bin].value - SURE * self.sizes[*bin].error >= threshold;
        if let Some(last) = (below..self.lags.len()).rev().find(surely_above) {
            let Some(&lag) = self.lags.get(last + 1) else { return none };
            (estimate, from) = (lag, last + 1);
        }
        let upper = |bin: usize| fit(bin) + UPPER * self.root_error(bin, threshold);
        let upper = first(from, &upper).map(|bin| self.between(bin, root, &upper).max(estimate));
        Crossing { estimate: Some(estimate), upper }
    }

    /// Whether the fit, which never rises, is surely above a threshold at a lag.
    pub(super) fn stays_above(&self, threshold: f64, lag: f64) -> bool {
        let bin = self.lags.partition_point(|&l| l < lag).min(self.lags.len() - 1);
        self.fitted[bin] - THERE * self.sizes[bin].error >= threshold
    }

    /// The lag between the previous bin and `bin` at which `curve` crosses `root`. The logarithm of
    /// the curve is interpolated linearly, as for an exponential decay.
    fn between(&self, bin: usize, root: f64, curve: &dyn Fn(usize) -> f64) -> f64 {
        let Some(before) = bin.checked_sub(1) else { return self.lags[0] };
        let (high, low) = (curve(before), curve(bin).max(0.1 * root));
        if high <= root {
            return self.lags[bin];
        }
        let share = (high / root).ln() / (high / low).ln();
        self.lags[before] + share * (self.lags[bin] - self.lags[before])
    }
}

/// Least-squares fit by a sequence that never rises, found by pooling adjacent violators (M. Ayer et
/// al., Ann. Math. Statist. 26, 1955).
pub(super) fn antitonic(values: &[f64]) -> Vec<f64> {
    // Mean and length of each run of equal values so far.
    let mut levels: Vec<(f64, usize)> = Vec::new();
    for &value in values {
        let mut level = (value, 1);
        while let Some(&(before, length)) = levels.last()
            && before < level.0
        {
            levels.pop();
            let all = length + level.1;
            level = ((before * length as f64 + level.0 * level.1 as f64) / all as f64, all);
        }
        levels.push(level);
    }
    levels.into_iter().flat_map(|(mean, length)| std::iter::repeat_n(mean, length)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(error: f64, size: impl Fn(f64) -> f64) -> Curve {
        let lags: Vec<f64> = (0..60).map(|k| 1.15f64.powi(k)).collect();
        let sizes =
            lags.iter().map(|&t| Size { value: size(t), error, entry_error: 0.0 }).collect();
        Curve::new(lags, sizes)
    }

    #[test]
    fn an_exponential_decay_crosses_where_it_falls_to_the_threshold() {
        let got = curve(0.0, |t| (-2.0 * t / 100.0).exp()).crossing(0.01);
        assert!((got.estimate.unwrap() - 230.26).abs() < 0.1, "{got:?}");
        assert_eq!(got.upper, got.estimate);
    }

    #[test]
    fn the_upper_bound_waits_for_what_is_surely_below() {
        let got = curve(0.005, |t| (-2.0 * t / 100.0).exp()).crossing(0.01);
        assert!(got.upper.unwrap() > 1.1 * got.estimate.unwrap(), "{got:?}");
        assert_eq!(curve(0.02, |t| (-2.0 * t / 100.0).exp()).crossing(0.01).upper, None);
    }

    #[test]
    fn dependence_that_surely_returns_moves_t_star() {
        let back = |t: f64| if (900.0..1100.0).contains(&t) { 0.09 } else { (-t / 10.0).exp() };
        let got = curve(0.001, back).crossing(0.01).estimate.unwrap();
        assert!((1000.0..1300.0).contains(&got), "{got}");
        assert!(curve(0.03, back).crossing(0.01).estimate.unwrap() < 300.0);
    }

    #[test]
    fn dependence_that_stays_has_no_crossing_and_none_at_all_crosses_at_one() {
        let stays = curve(0.001, |_| 0.2);
        assert_eq!(stays.crossing(0.01), Crossing { estimate: None, upper: None });
        assert!(stays.stays_above(0.01, 1e9) && !curve(0.2, |_| 0.2).stays_above(0.01, 1e9));
        // Independence from the first lag on.
        let got = curve(0.0001, |_| 0.0).crossing(0.01);
        assert_eq!(got, Crossing { estimate: Some(1.0), upper: Some(1.0) });
    }

    /// The same fit by a formula: minimum over earlier starts of the largest mean to a later end.
    fn by_minimax(values: &[f64]) -> Vec<f64> {
        let mean = |a: usize, b: usize| values[a..=b].iter().sum::<f64>() / (b - a + 1) as f64;
        let largest = |a: usize, i: usize| {
            (i..values.len()).map(|b| mean(a, b)).fold(f64::NEG_INFINITY, f64::max)
        };
        let least = |i: usize| (0..=i).map(|a| largest(a, i)).fold(f64::INFINITY, f64::min);
        (0..values.len()).map(least).collect()
    }

    #[test]
    fn pooling_gives_the_minimax_fit() {
        let mut rng = crate::seed::rng(1, &[b"antitonic"]);
        for length in [0, 1, 2, 7, 30] {
            let value = |i| crate::seed::uniform(&mut rng) - f64::from(i) * 0.03;
            let values: Vec<f64> = (0..length).map(value).collect();
            let got = antitonic(&values);
            for (g, w) in got.iter().zip(by_minimax(&values)) {
                assert!((g - w).abs() < 1e-12);
            }
            assert!(got.windows(2).all(|w| w[0] >= w[1]) && got.len() == values.len());
        }
    }
}
