//! The rows of a report: T* of each surface and source, and the longest scan of each source.

use crate::duration::algorithm1::{Algorithm1Settings, CurvePoint, Estimate, Rule, SearchOutcome};
use crate::duration::pooled::{PooledAnswer, PooledDependence, PooledEstimate};
use crate::duration::trials::Trials;
use crate::scene::SourceId;

pub type Second = f64;

/// Number of samples that the kernel two-sample test compares (the paper's n).
pub const SAMPLES: usize = 400;

/// Latest start of the sampling in a scan of 4.8 s, in seconds: 1.15 % of the scan.
pub const START_S: Second = 0.0115 * 4.8;

/// How long a scan must last to hold n = `samples` samples T* apart: t₀ + (n − 1)·T*, where t₀ is
/// [`START_S`].
pub fn scan_s(t_star_s: Second, samples: usize) -> Second {
    START_S + samples.saturating_sub(1) as f64 * t_star_s
}

/// Effective number of independent samples among n = `samples` samples spread evenly over a scan:
/// n·tanh(n_eff/n). n_eff = `effective` is the effective number of all samples of the scan.
///
/// The result exceeds neither n nor n_eff. It is exact for an Ornstein–Uhlenbeck process, whose
/// variance inflation is 2τ for all samples, and coth(Δ/2τ) for samples Δ apart.
pub fn worth(samples: usize, effective: f64) -> f64 {
    let n = samples as f64;
    n * (effective / n).tanh()
}

#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
#[serde(untagged)]
pub enum Estimator {
    /// The rule `pooled`: T* from the size of the dependence, over all pairs of samples.
    Pooled(PooledSettings),
    /// The paper's Algorithm 1, by one of its two rules.
    Algorithm1(Algorithm1Settings),
}

#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
#[serde(tag = "rule", rename = "pooled")]
pub struct PooledSettings {
    /// Threshold, as a correlation from 0 to 1: below it, two samples count as independent.
    pub dependence: f64,
}

/// T* of one surface and source.
#[derive(Clone, Debug, serde::Serialize)]
pub struct SourceDuration {
    pub surface: String,
    pub source: SourceId,
    /// Q, the number of trials.
    pub trials: usize,
    /// T* in samples; if `None`, `reason` says why.
    pub t_star_samples: Option<usize>,
    pub t_star_s: Option<Second>,
    /// How long a scan must last to hold n samples T* apart, in seconds. Uses the upper bound of T* if
    /// the rule gives one.
    pub scan_s: Option<Second>,
    pub reason: Option<String>,
    pub remarks: Vec<String>,
    pub rate_hz: Option<f64>,
    /// Results that only the chosen rule gives.
    #[serde(flatten)]
    pub by_rule: ByRule,
}

/// Results of a rule besides T*.
#[derive(Clone, Debug, serde::Serialize)]
#[serde(untagged)]
pub enum ByRule {
    Algorithm1 {
        /// How the upper bound CB+ was computed.
        rule: Rule,
        /// t₁,max, the latest start from which pairs of samples were drawn, in samples.
        latest_start: Option<usize>,
        /// HSIC, the bounds of HSIC, and the threshold κ at each lag that was tested.
        curve: Vec<CurvePoint>,
    },
    Pooled(PooledRow),
}

/// Results of `pooled` besides T*.
#[derive(Clone, Debug, Default, serde::Serialize)]
#[serde(tag = "rule", rename = "pooled")]
pub struct PooledRow {
    /// Upper bound of T* in samples; use it as the distance between samples.
    pub t_star_upper_samples: Option<usize>,
    pub t_star_upper_s: Option<Second>,
    /// Length of the shortest trial, in seconds.
    pub trial_s: Option<Second>,
    /// Effective number of independent samples in the shortest trial.
    pub effective_samples: Option<f64>,
    /// Effective number of independent samples among n samples spread over the shortest trial.
    pub effective_of_n: Option<f64>,
    /// Share of the variance that comes from lasting differences between trials.
    pub lasting_share: Option<f64>,
    /// About how many more trials like these are needed to find T*.
    pub more_trials: Option<usize>,
    /// Dependence, as a correlation, below which two samples count as independent.
    pub threshold: f64,
    pub dependence: Vec<PooledDependence>,
}

/// The longest scan that one source needs on any surface.
#[derive(Clone, Debug, serde::Serialize)]
pub struct SceneDuration {
    pub source: SourceId,
    /// The longest scan that any surface needs, in seconds; `None` if no surface has a T*.
    pub scan_s: Option<Second>,
    /// T* of the surface that needs the longest scan.
    pub t_star_s: Option<Second>,
    pub surface: Option<String>,
    /// Surfaces without a T*, so that their scan duration is unknown.
    pub without: Vec<String>,
}

impl ByRule {
    /// Empty results, for a source that could not be analysed.
    pub(super) fn none(estimator: Estimator) -> Self {
        match estimator {
            Estimator::Pooled(PooledSettings { dependence: threshold }) => {
                Self::Pooled(PooledRow { threshold, ..PooledRow::default() })
            }
            Estimator::Algorithm1(Algorithm1Settings { rule, .. }) => {
                Self::Algorithm1 { rule, latest_start: None, curve: Vec::new() }
            }
        }
    }
}

impl SourceDuration {
    /// Time between samples for planning scans: the upper bound of T*; for Algorithm 1, T* itself.
    pub(crate) fn spacing_s(&self) -> Option<Second> {
        match &self.by_rule {
            ByRule::Pooled(row) => row.t_star_upper_s,
            ByRule::Algorithm1 { .. } => self.t_star_s,
        }
    }

    /// Fills in the result of Algorithm 1, for scans of n = `samples` samples.
    pub(super) fn set_algorithm1(&mut self, estimate: Estimate, samples: usize) {
        self.t_star_samples = estimate.t_star();
        self.t_star_s = estimate.t_star_s();
        self.scan_s = estimate.t_star_s().map(|t| scan_s(t, samples));
        self.reason = reason(&estimate);
        self.rate_hz = Some(estimate.rate_hz);
        self.by_rule = ByRule::Algorithm1 {
            rule: estimate.rule,
            latest_start: Some(estimate.latest_start),
            curve: estimate.curve,
        };
    }

    /// Fills in the result of `pooled` on `trials`, for scans of n samples.
    pub(super) fn set_pooled(
        &mut self,
        estimate: PooledEstimate,
        trials: &Trials,
        n: usize,
        threshold: f64,
    ) {
        let rate_hz = trials.rate_hz();
        let seconds = |samples: usize| samples as f64 / rate_hz;
        let upper = estimate.upper_samples().map(seconds);
        let effective = estimate.effective_samples(trials.frames);
        self.rate_hz = Some(rate_hz);
        self.t_star_samples = estimate.t_star_samples();
        self.t_star_s = self.t_star_samples.map(seconds);
        self.scan_s = upper.map(|t| scan_s(t, n));
        self.reason = pooled_reason(&estimate, trials);
        self.by_rule = ByRule::Pooled(PooledRow {
            threshold,
            t_star_upper_samples: estimate.upper_samples(),
            t_star_upper_s: upper,
            trial_s: Some(seconds(trials.frames)),
            effective_samples: effective,
            effective_of_n: effective.map(|effective| worth(n, effective)),
            lasting_share: estimate.lasting_share,
            more_trials: match estimate.answer {
                PooledAnswer::TooLittleData { more_trials } => Some(more_trials),
                _ => None,
            },
            dependence: estimate.curve,
        });
    }
}

fn reason(estimate: &Estimate) -> Option<String> {
    let ms = |lag: usize| lag as f64 / estimate.rate_hz * 1e3;
    match estimate.outcome {
        SearchOutcome::Found { .. } => None,
        SearchOutcome::NotInRange { largest_lag } => Some(format!(
            "not within the range: dependent up to {:.1} ms ({largest_lag} samples)",
            ms(largest_lag)
        )),
        SearchOutcome::Returns { first, again_at } => Some(format!(
            "not within the range: below κ at {:.2} ms, but dependent again at {:.2} ms (periodic, \
             or the trials differ in level or loudness)",
            ms(first),
            ms(again_at)
        )),
    }
}

fn pooled_reason(estimate: &PooledEstimate, trials: &Trials) -> Option<String> {
    let range_s = estimate.range / trials.rate_hz();
    let count = trials.count();
    match estimate.answer {
        PooledAnswer::Found { .. } => None,
        PooledAnswer::Never => Some(format!(
            "never: moments {:.2} s apart still depend on each other (it repeats itself, or drifts \
             through the whole trial)",
            1.5 * range_s
        )),
        PooledAnswer::NotWithinRange => Some(format!(
            "not within the range: longer than the {range_s:.2} s that trials of this length can \
             show; record longer ones"
        )),
        PooledAnswer::TooLittleData { more_trials } => Some(format!(
            "too little data: {count} {} of this length cannot show it; record about {more_trials} \
             more, or longer ones",
            if count == 1 { "trial" } else { "trials" }
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_worth_no_more_than_they_are_and_no_more_than_the_scan() {
        assert!((worth(400, 1e6) - 400.0).abs() < 1e-6);
        assert!((worth(400, 10.0) - 10.0).abs() < 0.01);
        // `want` comes from the mean of 50 samples, 30 apart, of an AR(1) process with τ = 20.
        let rho = |lag: f64| (-lag / 20.0f64).exp();
        let sum = (1..50).map(|k| 2.0 * (1.0 - f64::from(k) / 50.0) * rho(30.0 * f64::from(k)));
        let want = 50.0 / (1.0 + sum.sum::<f64>());
        assert!((worth(50, 50.0 * 30.0 / 40.0) / want - 1.0).abs() < 0.03);
    }
}
