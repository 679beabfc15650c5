//! T* and scan durations of a library: for each surface and source, and for the whole scene.

mod rows;
mod table;

use std::collections::BTreeMap;

use super::algorithm1::Search;
use super::pooled::{CORRELATION, VALUES, at_needed_rate};
use super::trials::{CONSTANT, DurationError, Trials};
use crate::library::{Entry, Library, LibraryError};
use crate::scene::{Domain, Phase, SceneError, SourceId, SourceSpec};
use crate::trial::{Series, Signal};
use rows::START_S;
pub use rows::{ByRule, Estimator, PooledRow, PooledSettings, SceneDuration, SourceDuration};
pub(crate) use rows::{SAMPLES, Second, scan_s};

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
    /// n, the number of samples that a scan must yield.
    pub samples: usize,
    /// Time t₀ in a scan at which sampling starts, in seconds.
    pub start_s: Second,
    pub settings: Estimator,
    pub durations: Vec<SourceDuration>,
    /// For each source, the longest scan duration over the surfaces.
    pub scene: Vec<SceneDuration>,
    /// The longest scan duration over all sources; `None` if no source has a T*.
    pub scan_s: Option<Second>,
}

#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// a trial cannot be read
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// the settings are not possible
    #[error(transparent)]
    Duration(#[from] DurationError),
    /// the scene does not have a source
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
        return match (found.is_empty(), is_pooled) {
            (false, _) => Ok(found),
            (true, true) => Err(ReportError::Nothing(
                "this library has no source that is recorded while dragging".into(),
            )),
            (true, false) => Err(ReportError::Nothing(
                "this library has no source of domain `time`, and Algorithm 1 does not apply to \
                 spectra and images; name one with --source and --as-time to treat it as a series \
                 in time"
                    .into(),
            )),
        };
    }
    for id in &question.sources {
        let Some(spec) = library.scene.get(id.as_str()) else {
            return Err(ReportError::Nothing(format!("no source is called `{id}`")));
        };
        if spec.domain == Domain::Image {
            return Err(ReportError::Nothing(format!(
                "`{id}` is an image, not a series in time, so it has no T*"
            )));
        }
        if !takes(spec) {
            return Err(ReportError::Nothing(format!(
                "`{id}` is not of domain `time`: it is compared by the bins of its spectrum, to \
                 which Algorithm 1 does not apply; add --as-time to treat it as a series in time"
            )));
        }
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
    let mut row = SourceDuration {
        surface: surface.into(),
        source: source.clone(),
        trials: series.len(),
        t_star_samples: None,
        t_star_s: None,
        scan_s: None,
        reason: None,
        remarks: Vec::new(),
        rate_hz: None,
        by_rule: ByRule::none(question.estimator),
    };
    let trials = match question.estimator {
        Estimator::Pooled(_) => Trials::pooled(series),
        Estimator::Algorithm1(_) => Trials::new(series),
    };
    let trials = match trials {
        Ok(trials) => trials,
        Err(error) => return Ok(SourceDuration { reason: Some(error.to_string()), ..row }),
    };
    match question.estimator {
        Estimator::Pooled(PooledSettings { dependence }) => {
            if !(dependence > 0.0 && dependence < 1.0) {
                return Err(DurationError::Settings(format!(
                    "a dependence of {dependence}; expected a correlation between 0 and 1"
                )));
            }
            match at_needed_rate(&trials.series, trials.frames, dependence, VALUES) {
                Some(found) => row.set_pooled(found, &trials, question.samples, dependence),
                None => row.reason = Some(CONSTANT.into()),
            }
        }
        Estimator::Algorithm1(settings) => {
            let found = Search::new(&trials, settings)?.find(settings.rule);
            row.set_algorithm1(found, question.samples);
        }
    }
    row.remarks = trials.remarks;
    Ok(row)
}

fn longest(source: &SourceId, durations: &[SourceDuration]) -> Option<SceneDuration> {
    let of_source = || durations.iter().filter(|d| d.source == *source);
    of_source().next()?;
    let longest = of_source()
        .filter(|d| d.scan_s.is_some())
        .max_by(|a, b| a.scan_s.unwrap_or(0.0).total_cmp(&b.scan_s.unwrap_or(0.0)));
    Some(SceneDuration {
        source: source.clone(),
        scan_s: longest.and_then(|d| d.scan_s),
        t_star_s: longest.and_then(|d| d.t_star_s),
        surface: longest.map(|d| d.surface.clone()),
        without: of_source().filter(|d| d.scan_s.is_none()).map(|d| d.surface.clone()).collect(),
    })
}
