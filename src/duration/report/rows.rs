//! The rows of a report: T* of each surface and source, and the longest scan of each source.

use crate::duration::algorithm1::{Algorithm1Settings, CurvePoint, Estimate, Rule, SearchOutcome};
use crate::duration::need::{ScanNeed, Second, worth};
use crate::duration::pooled::{PooledAnswer, PooledDependence, PooledEstimate};
use crate::duration::trials::Trials;
use crate::scene::SourceId;

/// How T* is computed.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
#[serde(untagged)]
pub enum Estimator {
    /// The rule `pooled`: the size of the dependence, from all pairs of samples of all trials.
    Pooled(PooledSettings),
    /// The paper's Algorithm 1, by one of its two rules.
    Algorithm1(Algorithm1Settings),
}

/// Settings of the rule `pooled`.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
#[serde(tag = "rule", rename = "pooled")]
pub struct PooledSettings {
    /// Threshold: a Gaussian process of this correlation, from 0 to 1, depends little enough.
    pub dependence: f64,
}

/// T* of one surface and source.
#[derive(Clone, Debug, serde::Serialize)]
pub struct SourceDuration {
    /// The surface.
    pub surface: String,
    /// The source.
    pub source: SourceId,
    /// Q, the number of trials.
    pub trials: usize,
    /// T* in samples; if `None`, `reason` says why.
    pub t_star_samples: Option<usize>,
    /// T* in seconds.
    pub t_star_s: Option<Second>,
    /// Length of a scan that holds n samples T* apart, computed with the upper bound of T* if the
    /// rule has one.
    pub scan_s: Option<Second>,
    /// The reason why there is no T*.
    pub reason: Option<String>,
    /// Remarks on how far T* can be trusted, a line each.
    pub remarks: Vec<String>,
    /// Samples a second.
    pub rate_hz: Option<f64>,
    /// Results that only the chosen rule has.
    #[serde(flatten)]
    pub by_rule: ByRule,
}

/// Results of a rule other than T*.
#[derive(Clone, Debug, serde::Serialize)]
#[serde(untagged)]
pub enum ByRule {
    /// Algorithm 1.
    Algorithm1 {
        /// The rule for the upper bound CB+.
        rule: Rule,
        /// The latest start t₁,max that was used, in samples.
        latest_start: Option<usize>,
        /// HSIC, the bounds of HSIC, and κ at each lag that was tested.
        curve: Vec<CurvePoint>,
    },
    /// The rule `pooled`.
    Pooled(PooledRow),
}

/// Results of `pooled` other than T*.
#[derive(Clone, Debug, Default, serde::Serialize)]
#[serde(tag = "rule", rename = "pooled")]
pub struct PooledRow {
    /// Upper bound of T* in samples: the spacing to use.
    pub t_star_upper_samples: Option<usize>,
    /// Upper bound of T* in seconds.
    pub t_star_upper_s: Option<Second>,
    /// Length of the shortest trial.
    pub trial_s: Option<Second>,
    /// Effective number of independent samples in the shortest trial.
    pub effective_samples: Option<f64>,
    /// Effective number of independent samples among n samples spread over the shortest trial.
    pub effective_of_n: Option<f64>,
    /// Share of the variance that is due to lasting differences between trials.
    pub lasting_share: Option<f64>,
    /// About how many more trials like these are needed to find T*.
    pub more_trials: Option<usize>,
    /// Dependence, as a correlation, below which two samples count as independent.
    pub threshold: f64,
    /// Dependence at each lag.
    pub dependence: Vec<PooledDependence>,
}

/// The scan that one source needs, over all surfaces.
#[derive(Clone, Debug, serde::Serialize)]
pub struct SceneDuration {
    /// The source.
    pub source: SourceId,
    /// The longest scan that any surface needs; `None` if no surface has a T*.
    pub scan_s: Option<Second>,
    /// T* of the surface that needs the longest scan.
    pub t_star_s: Option<Second>,
    /// The surface that needs the longest scan.
    pub surface: Option<String>,
    /// Surfaces without a T*, whose scan duration is unknown.
    pub without: Vec<String>,
}

impl SourceDuration {
    /// The time between samples for planning scans: the upper bound of T* if there is one, else T*.
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
        self.scan_s = estimate.t_star_s().map(|t| ScanNeed::new(t, samples).scan_s());
        self.reason = reason(&estimate);
        self.rate_hz = Some(estimate.rate_hz);
        self.by_rule = ByRule::Algorithm1 {
            rule: estimate.rule,
            latest_start: Some(estimate.latest_start),
            curve: estimate.curve,
        };
    }

    /// Fills in the result of `pooled` on `trials`, for scans of n samples.
    pub(super) fn set_pooled(&mut self, estimate: PooledEstimate, trials: &Trials, n: usize) {
        let rate_hz = trials.rate_hz();
        let seconds = |samples: usize| samples as f64 / rate_hz;
        let upper = estimate.upper_samples().map(seconds);
        let effective = estimate.effective_samples(trials.frames());
        self.rate_hz = Some(rate_hz);
        self.t_star_samples = estimate.t_star_samples();
        self.t_star_s = self.t_star_samples.map(seconds);
        self.scan_s = upper.map(|t| ScanNeed::new(t, n).scan_s());
        self.reason = pooled_reason(&estimate, trials);
        let ByRule::Pooled(PooledRow { threshold, .. }) = self.by_rule else { return };
        self.by_rule = ByRule::Pooled(PooledRow {
            threshold,
            t_star_upper_samples: estimate.upper_samples(),
            t_star_upper_s: upper,
            trial_s: Some(seconds(trials.frames())),
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
