//! T* and scan durations of a library: for each surface and source, and for the whole scene.

mod table;

use std::collections::{BTreeMap, BTreeSet};

use super::algorithm1::{Algorithm1Settings, CurvePoint, Estimate, Rule, Search, SearchOutcome};
use super::pooled::{
    CORRELATION, PooledAnswer, PooledDependence, PooledEstimate, VALUES, at_needed_rate,
};
use super::trials::{CONSTANT, DurationError, Trials};
use crate::library::{Entry, Library, LibraryError};
use crate::printable::counted;
use crate::scene::{Domain, Phase, SceneError, SourceId, SourceSpec};
use crate::trial::{Series, Signal};

/// Number of samples that the kernel two-sample test compares (the paper's n).
pub const SAMPLES: usize = 400;

/// Latest start of the sampling in a scan of 4.8 s, in seconds: 1.15 % of the scan.
pub(super) const START_S: f64 = 0.0115 * 4.8;

/// How long a scan must last to hold n = `samples` samples T* apart: `START_S` + (n − 1)·T*.
pub fn scan_s(t_star_s: f64, samples: usize) -> f64 {
    START_S + samples.saturating_sub(1) as f64 * t_star_s
}

/// Effective number of independent samples among n = `samples` samples spread evenly over a scan:
/// n·tanh(n_eff/n). n_eff = `effective` is the effective number of all samples of the scan.
///
/// The result exceeds neither n nor n_eff. It is exact for an Ornstein–Uhlenbeck process, whose
/// variance inflation is 2τ for all samples, and coth(Δ/2τ) for samples Δ apart.
pub(super) fn worth(samples: usize, effective: f64) -> f64 {
    let n = samples as f64;
    n * (effective / n).tanh()
}

#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
#[serde(untagged)]
pub enum Estimator {
    /// The rule `pooled`: T* from the size of the dependence, over all pairs of samples.
    Pooled(PooledSettings),
    Algorithm1(Algorithm1Settings),
}

#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
#[serde(tag = "rule", rename = "pooled")]
pub struct PooledSettings {
    /// Threshold, as a correlation from 0 to 1: below it, two samples count as independent.
    pub dependence: f64,
}

#[derive(Clone, Debug, serde::Serialize)]
pub struct SourceDuration {
    pub surface: String,
    pub source: SourceId,
    /// Q, the number of trials.
    pub trials: usize,
    /// T* in samples; if `None`, `reason` says why.
    pub t_star_samples: Option<usize>,
    pub t_star_s: Option<f64>,
    /// Length of a scan that holds n samples T* (or its upper bound, where there is one) apart, in seconds.
    pub scan_s: Option<f64>,
    pub reason: Option<String>,
    pub remarks: Vec<String>,
    pub rate_hz: Option<f64>,
    /// Results that only the chosen rule gives.
    #[serde(flatten)]
    pub by_rule: ByRule,
}

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

#[derive(Clone, Debug, Default, serde::Serialize)]
#[serde(tag = "rule", rename = "pooled")]
pub struct PooledRow {
    /// Upper bound of T* in samples; use it as the distance between samples.
    pub t_star_upper_samples: Option<usize>,
    pub t_star_upper_s: Option<f64>,
    /// Length of the shortest trial, in seconds.
    pub trial_s: Option<f64>,
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
    pub scan_s: Option<f64>,
    /// T* of the surface that needs the longest scan.
    pub t_star_s: Option<f64>,
    pub surface: Option<String>,
    /// Surfaces without a T*, so that their scan duration is unknown.
    pub without: Vec<String>,
}

/// The surfaces and sources to compute T* for, and the estimator.
#[derive(Clone, Debug)]
pub struct Question {
    /// Sources to use; empty means all sources that suit the estimator.
    pub sources: Vec<SourceId>,
    /// Surfaces to use; empty means all.
    pub surfaces: Vec<String>,
    /// The user whose trials are used. `None` means the user with the most trials of a surface.
    /// Trials of several users differ in loudness, which would look like endless dependence.
    pub user: Option<String>,
    /// Whether Algorithm 1 also takes sources of domain `spectrum`, as `pooled` always does.
    pub as_time: bool,
    /// n, the number of samples that a scan must yield.
    pub samples: usize,
    pub estimator: Estimator,
}

impl Default for Question {
    fn default() -> Self {
        Self {
            sources: Vec::new(),
            surfaces: Vec::new(),
            user: None,
            as_time: false,
            samples: SAMPLES,
            estimator: Estimator::Pooled(PooledSettings { dependence: CORRELATION }),
        }
    }
}

#[derive(Clone, Debug, serde::Serialize)]
pub struct DurationReport {
    pub library: String,
    pub synthetic: bool,
    pub samples: usize,
    /// Time t₀ in a scan at which sampling starts, in seconds.
    pub start_s: f64,
    pub settings: Estimator,
    pub durations: Vec<SourceDuration>,
    /// For each source, the longest scan duration over the surfaces.
    pub scene: Vec<SceneDuration>,
    /// The longest scan duration over all sources; `None` if no source has a T*.
    pub scan_s: Option<f64>,
}

#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    #[error(transparent)]
    Library(#[from] LibraryError),
    #[error(transparent)]
    Duration(#[from] DurationError),
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// no such surface or source, no trial with the source, or a source that the rule cannot use
    #[error("{0}")]
    Nothing(String),
}

/// T* and scan durations of a library. `progress` gets the number of surfaces done and the total.
///
/// # Errors
/// If a trial cannot be read, the settings are not possible, or the library has no such surface or
/// no source for this rule. A source without a T* is no error: its row says why.
pub fn report(
    library: &Library,
    question: &Question,
    mut progress: impl FnMut(usize, usize),
) -> Result<DurationReport, ReportError> {
    let sources = sources(library, question)?;
    let surfaces: Vec<&str> = match question.surfaces.is_empty() {
        true => library.surfaces(),
        false => question.surfaces.iter().map(String::as_str).collect(),
    };
    let known = library.surfaces();
    if let Some(unknown) = surfaces.iter().find(|s| !known.contains(s)) {
        let list = known.join(", ");
        return Err(ReportError::Nothing(format!(
            "no surface is called `{unknown}`; there are: {list}"
        )));
    }
    if let Some(user) = &question.user {
        let users: BTreeSet<&str> = library.entries.iter().map(|e| e.key.user.as_str()).collect();
        if !users.contains(user.as_str()) {
            let list = users.into_iter().collect::<Vec<_>>().join(", ");
            return Err(ReportError::Nothing(format!(
                "no trial is by a user `{user}`; there are: {list}"
            )));
        }
    }
    let mut durations = Vec::new();
    // Sources that were not asked for are not read.
    let wanted = library.scene.clone().only(&sources)?;
    for (done, surface) in surfaces.iter().enumerate() {
        progress(done, surfaces.len());
        let mut series: BTreeMap<&SourceId, Vec<Series>> = BTreeMap::new();
        for entry in entries(library, surface, question.user.as_deref()) {
            let mut trial = entry.clone().within(&wanted).load()?;
            for source in &sources {
                if let Some(Signal::Series(one)) = trial.signals.remove(source) {
                    series.entry(source).or_default().push(one);
                }
            }
        }
        for source in &sources {
            if let Some(series) = series.remove(source) {
                durations.push(one(surface, source, series, question)?);
            }
        }
    }
    progress(surfaces.len(), surfaces.len());
    if durations.is_empty() {
        let names = sources.iter().map(SourceId::as_str).collect::<Vec<_>>().join(", ");
        return Err(ReportError::Nothing(format!("no trial has any of the sources {names}")));
    }
    let scene: Vec<_> = sources.iter().filter_map(|s| longest(s, &durations)).collect();
    Ok(DurationReport {
        library: library.name.clone(),
        synthetic: library.synthetic,
        samples: question.samples,
        start_s: START_S,
        settings: question.estimator,
        scan_s: scene.iter().filter_map(|s| s.scan_s).max_by(f64::total_cmp),
        durations,
        scene,
    })
}

fn sources(library: &Library, question: &Question) -> Result<Vec<SourceId>, ReportError> {
    let is_pooled = matches!(question.estimator, Estimator::Pooled(_));
    let takes = |spec: &SourceSpec| match spec.domain {
        Domain::Time { .. } => true,
        Domain::Spectrum { .. } => is_pooled || question.as_time,
        // An image is never a series, not even with `as_time`.
        Domain::Image => false,
    };
    if question.sources.is_empty() {
        // `pooled` takes drags only, since a tap is too short. Algorithm 1 takes taps, too.
        let dragged = |spec: &SourceSpec| spec.phase == Phase::Drag || !is_pooled;
        let found: Vec<_> = (library.scene.sources())
            .filter(|spec| takes(spec) && dragged(spec))
            .map(|spec| spec.id.clone())
            .filter(|id| library.entries.iter().any(|e| e.sources.contains(id)))
            .collect();
        let none = match is_pooled {
            true => "this library has no source that is recorded while dragging",
            false => {
                "this library has no source of domain `time`, and Algorithm 1 does not apply to \
                 spectra and images; name one with --source and --as-time to treat it as a series \
                 in time"
            }
        };
        return if found.is_empty() { Err(ReportError::Nothing(none.into())) } else { Ok(found) };
    }
    for id in &question.sources {
        return Err(ReportError::Nothing(match library.scene.get(id.as_str()) {
            None => format!("no source is called `{id}`"),
            Some(spec) if spec.domain == Domain::Image => {
                format!("`{id}` is an image, not a series in time, so it has no T*")
            }
            Some(spec) if !takes(spec) => format!(
                "`{id}` is not of domain `time`: it is compared by the bins of its spectrum, to \
                 which Algorithm 1 does not apply; add --as-time to treat it as a series in time"
            ),
            Some(_) => continue,
        }));
    }
    Ok(question.sources.clone())
}

/// Trials of one surface by `user`; if `None`, by the user with the most trials of the surface.
fn entries<'a>(library: &'a Library, surface: &str, user: Option<&str>) -> Vec<&'a Entry> {
    let mut of_user: BTreeMap<&str, Vec<&Entry>> = BTreeMap::new();
    for entry in library.entries.iter().filter(|e| e.key.surface == surface) {
        of_user.entry(&entry.key.user).or_default().push(entry);
    }
    match user {
        Some(user) => of_user.remove(user).unwrap_or_default(),
        // A tie goes to the first user by name: `max_by_key` takes the last of the reversed list.
        None => of_user.into_values().rev().max_by_key(Vec::len).unwrap_or_default(),
    }
}

fn one(
    surface: &str,
    source: &SourceId,
    series: Vec<Series>,
    question: &Question,
) -> Result<SourceDuration, DurationError> {
    let none = SourceDuration {
        surface: surface.into(),
        source: source.clone(),
        trials: series.len(),
        t_star_samples: None,
        t_star_s: None,
        scan_s: None,
        reason: None,
        remarks: Vec::new(),
        rate_hz: None,
        by_rule: match question.estimator {
            Estimator::Pooled(PooledSettings { dependence: threshold }) => {
                ByRule::Pooled(PooledRow { threshold, ..PooledRow::default() })
            }
            Estimator::Algorithm1(Algorithm1Settings { rule, .. }) => {
                ByRule::Algorithm1 { rule, latest_start: None, curve: Vec::new() }
            }
        },
    };
    let trials = match question.estimator {
        Estimator::Pooled(_) => Trials::pooled(series),
        Estimator::Algorithm1(_) => Trials::new(series),
    };
    let trials = match trials {
        Ok(trials) => trials,
        Err(error) => return Ok(SourceDuration { reason: Some(error.to_string()), ..none }),
    };
    // A scan takes its samples at the distance `apart`: the upper bound of T* if the rule gives one.
    let (t_star, apart, reason, by_rule) = match question.estimator {
        Estimator::Pooled(PooledSettings { dependence }) => {
            if !(dependence > 0.0 && dependence < 1.0) {
                return Err(DurationError::Settings(format!(
                    "a dependence of {dependence}; expected a correlation between 0 and 1"
                )));
            }
            let found = at_needed_rate(&trials.series, trials.frames, dependence, VALUES);
            let Some(found) = found else {
                let (reason, remarks) = (Some(CONSTANT.into()), trials.remarks);
                return Ok(SourceDuration { reason, remarks, ..none });
            };
            let (t_star, upper) = (found.t_star_samples(), found.upper_samples());
            let reason = pooled_reason(&found, &trials);
            let row = PooledRow::of(found, &trials, question.samples, dependence);
            (t_star, upper, reason, ByRule::Pooled(row))
        }
        Estimator::Algorithm1(settings) => {
            let found = Search::new(&trials, settings)?.find(settings.rule);
            let (t_star, latest_start) = (found.t_star(), Some(found.latest_start));
            let (rule, reason, curve) = (settings.rule, reason(&found), found.curve);
            (t_star, t_star, reason, ByRule::Algorithm1 { rule, latest_start, curve })
        }
    };
    let seconds = |samples: usize| samples as f64 / trials.rate_hz();
    Ok(SourceDuration {
        t_star_samples: t_star,
        t_star_s: t_star.map(seconds),
        scan_s: apart.map(|samples| scan_s(seconds(samples), question.samples)),
        reason,
        rate_hz: Some(trials.rate_hz()),
        remarks: trials.remarks,
        by_rule,
        ..none
    })
}

fn longest(source: &SourceId, durations: &[SourceDuration]) -> Option<SceneDuration> {
    let of_source = || durations.iter().filter(|d| d.source == *source);
    of_source().next()?;
    let with = of_source().filter_map(|d| Some((d.scan_s?, d)));
    let longest = with.max_by(|a, b| a.0.total_cmp(&b.0));
    Some(SceneDuration {
        source: source.clone(),
        scan_s: longest.map(|(scan_s, _)| scan_s),
        t_star_s: longest.and_then(|(_, d)| d.t_star_s),
        surface: longest.map(|(_, d)| d.surface.clone()),
        without: of_source().filter(|d| d.scan_s.is_none()).map(|d| d.surface.clone()).collect(),
    })
}

impl SourceDuration {
    /// Time between samples for planning scans: the upper bound of T*; for Algorithm 1, T* itself.
    pub(crate) fn spacing_s(&self) -> Option<f64> {
        match &self.by_rule {
            ByRule::Pooled(row) => row.t_star_upper_s,
            ByRule::Algorithm1 { .. } => self.t_star_s,
        }
    }
}

impl PooledRow {
    /// The result of `pooled` on `trials`, for scans of n samples.
    fn of(estimate: PooledEstimate, trials: &Trials, n: usize, threshold: f64) -> Self {
        let seconds = |samples: usize| samples as f64 / trials.rate_hz();
        let effective = estimate.effective_samples(trials.frames);
        Self {
            t_star_upper_samples: estimate.upper_samples(),
            t_star_upper_s: estimate.upper_samples().map(seconds),
            trial_s: Some(seconds(trials.frames)),
            effective_samples: effective,
            effective_of_n: effective.map(|effective| worth(n, effective)),
            lasting_share: estimate.lasting_share,
            more_trials: match estimate.answer {
                PooledAnswer::TooLittleData { more_trials } => Some(more_trials),
                _ => None,
            },
            threshold,
            dependence: estimate.curve,
        }
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
            "too little data: {} of this length cannot show it; record about {more_trials} more, or \
             longer ones",
            counted(trials.count(), "trial")
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
