//! T* and scan durations of a library: for each surface and source, and for the whole scene.

use std::collections::BTreeMap;
use std::fmt::Write;

use super::estimate::{CurvePoint, Estimate, Outcome, Rule, Settings};
use super::need::{SAMPLES, START_S, ScanNeed, Second};
use super::search::Search;
use super::trials::{DurationError, Trials};
use crate::library::{Entry, Library, LibraryError};
use crate::scene::{Domain, SceneError, SourceId};
use crate::trial::{Series, Signal};

/// What is asked of a library.
#[derive(Clone, Debug)]
pub struct Question {
    /// Sources; all of domain `time` if none is named.
    pub sources: Vec<SourceId>,
    /// Surfaces; all if none is named.
    pub surfaces: Vec<String>,
    /// Whose trials; for each surface those of the user with the most, if nobody is named. Trials
    /// of several hands differ in level, and what differs between trials stays dependent for ever.
    pub user: Option<String>,
    /// Take the named sources as series in time, whatever their domain is.
    pub as_time: bool,
    /// n, the samples that a scan must yield.
    pub samples: usize,
    /// How T* is computed.
    pub settings: Settings,
}

impl Default for Question {
    fn default() -> Self {
        Self {
            sources: Vec::new(),
            surfaces: Vec::new(),
            user: None,
            as_time: false,
            samples: SAMPLES,
            settings: Settings::default(),
        }
    }
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
    /// T* in samples; none where there is none, and `reason` says why.
    pub t_star_samples: Option<usize>,
    /// T* in seconds.
    pub t_star_s: Option<Second>,
    /// What a scan must last for n samples that are T* apart.
    pub scan_s: Option<Second>,
    /// Why there is no T*.
    pub reason: Option<String>,
    /// What limits the answer.
    pub remarks: Vec<String>,
    /// What CB+ was.
    pub rule: Rule,
    /// The latest start t₁,max that was used, in samples.
    pub latest_start: Option<usize>,
    /// Samples a second.
    pub rate_hz: Option<f64>,
    /// HSIC, its bounds and κ at each lag that was looked at.
    pub curve: Vec<CurvePoint>,
}

/// What one source asks of a scan, over all surfaces.
#[derive(Clone, Debug, serde::Serialize)]
pub struct SceneDuration {
    /// The source.
    pub source: SourceId,
    /// The longest scan that any surface asks for; none if no surface has a T*.
    pub scan_s: Option<Second>,
    /// T* of that surface.
    pub t_star_s: Option<Second>,
    /// That surface.
    pub surface: Option<String>,
    /// Surfaces without a T*: for them no scan is known to be long enough.
    pub without: Vec<String>,
}

/// The answer.
#[derive(Clone, Debug, serde::Serialize)]
pub struct DurationReport {
    /// The library's name.
    pub library: String,
    /// Made by a generator, not recorded.
    pub synthetic: bool,
    /// n, the samples that a scan must yield.
    pub samples: usize,
    /// Start t₀ of the sampling.
    pub start_s: Second,
    /// How T* was computed.
    pub settings: Settings,
    /// For each surface and source.
    pub durations: Vec<SourceDuration>,
    /// For each source, the longest over the surfaces.
    pub scene: Vec<SceneDuration>,
    /// The longest over all sources; none if nothing has a T*.
    pub scan_s: Option<Second>,
}

/// Why a library gives no answer.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// a trial that cannot be read
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// settings that cannot work
    #[error(transparent)]
    Duration(#[from] DurationError),
    /// a source that there is not
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// nothing to compute
    #[error("{0}")]
    Nothing(String),
}

/// T* and scan durations of a library; `progress` is told surfaces done and their number.
///
/// # Errors
/// If a trial cannot be read, the settings are not possible, or the library has no such surface or
/// no source of domain `time`. What is wrong with one source of one surface is said in its row.
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
    // Only what is asked for is read.
    let asked = library.scene.clone().only(&sources)?;
    for (done, surface) in surfaces.iter().enumerate() {
        progress(done, surfaces.len());
        let mut series: BTreeMap<&SourceId, Vec<Series>> = BTreeMap::new();
        for entry in entries(library, surface, question.user.as_deref()) {
            let mut trial = entry.clone().within(&asked).load()?;
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
        settings: question.settings,
        scan_s: scene.iter().filter_map(|s| s.scan_s).max_by(f64::total_cmp),
        durations,
        scene,
    })
}

fn sources(library: &Library, question: &Question) -> Result<Vec<SourceId>, ReportError> {
    let is_time = |id: &SourceId| {
        library.scene.get(id.as_str()).is_some_and(|spec| spec.domain == Domain::Time)
    };
    if question.sources.is_empty() {
        let all: Vec<_> = library.scene.sources().map(|s| s.id.clone()).filter(is_time).collect();
        let held = |id: &SourceId| library.entries.iter().any(|e| e.sources.contains(id));
        let found: Vec<_> = all.into_iter().filter(held).collect();
        if found.is_empty() {
            return Err(ReportError::Nothing(
                "this library has no source of domain `time`, and T* means nothing for spectra and \
                 images; name one with --source and --as-time to take it as a series in time"
                    .into(),
            ));
        }
        return Ok(found);
    }
    for id in &question.sources {
        if library.scene.get(id.as_str()).is_none() {
            return Err(ReportError::Nothing(format!("no source is called `{id}`")));
        }
        if !is_time(id) && !question.as_time {
            return Err(ReportError::Nothing(format!(
                "`{id}` is not of domain `time`: its samples are bins or pixels, and T* means \
                 nothing for them; --as-time takes it as a series in time all the same"
            )));
        }
    }
    Ok(question.sources.clone())
}

/// Trials of one surface by one user: the one asked for, or the one with the most.
fn entries<'a>(library: &'a Library, surface: &str, user: Option<&str>) -> Vec<&'a Entry> {
    let mut of_user: BTreeMap<&str, Vec<&Entry>> = BTreeMap::new();
    for entry in library.entries.iter().filter(|e| e.key.surface == surface) {
        of_user.entry(&entry.key.user).or_default().push(entry);
    }
    match user {
        Some(user) => of_user.remove(user).unwrap_or_default(),
        // Of several with as many, the first by name.
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
        rule: question.settings.rule,
        latest_start: None,
        rate_hz: None,
        curve: Vec::new(),
    };
    let trials = match Trials::new(series) {
        Ok(trials) => trials,
        Err(error) => {
            row.reason = Some(error.to_string());
            return Ok(row);
        }
    };
    let estimate = Search::new(&trials, question.settings)?.find(question.settings.rule);
    row.remarks = trials.remarks;
    row.t_star_samples = estimate.t_star();
    row.t_star_s = estimate.t_star_s();
    row.scan_s = estimate.t_star_s().map(|t| ScanNeed::new(t, question.samples).scan_s());
    row.reason = reason(&estimate);
    row.latest_start = Some(estimate.latest_start);
    row.rate_hz = Some(estimate.rate_hz);
    row.curve = estimate.curve;
    Ok(row)
}

fn reason(estimate: &Estimate) -> Option<String> {
    let ms = |lag: usize| lag as f64 / estimate.rate_hz * 1e3;
    match estimate.outcome {
        Outcome::Found { .. } => None,
        Outcome::NotInRange { largest_lag } => Some(format!(
            "not within the range: dependent up to {:.1} ms ({largest_lag} samples)",
            ms(largest_lag)
        )),
        Outcome::Returns { first, again_at } => Some(format!(
            "not within the range: below κ at {:.2} ms, but dependent again at {:.2} ms (periodic, \
             or the trials differ in level or loudness)",
            ms(first),
            ms(again_at)
        )),
    }
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

impl DurationReport {
    /// The need of a source for one surface, for a daemon that shows how much longer to drag.
    pub fn need(&self, surface: &str, source: &str) -> Option<ScanNeed> {
        let row = (self.durations.iter())
            .find(|d| d.surface == surface && d.source.as_str() == source)?;
        row.t_star_s.map(|t| ScanNeed::new(t, self.samples))
    }

    /// The need of the scene: the longest over its surfaces and sources.
    pub fn scene_need(&self) -> Option<ScanNeed> {
        let longest = self.scene.iter().filter_map(|s| s.t_star_s).max_by(f64::total_cmp)?;
        Some(ScanNeed::new(longest, self.samples))
    }

    /// A table for people.
    pub fn table(&self) -> String {
        let wide = |f: fn(&SourceDuration) -> usize, least: usize| {
            self.durations.iter().map(f).max().unwrap_or(0).max(least)
        };
        let surface = wide(|d| d.surface.chars().count(), 7);
        let source = wide(|d| d.source.as_str().len(), 6);
        let mut out = String::new();
        let n = self.samples;
        // Writing to a String cannot fail.
        let _ = writeln!(
            out,
            "{:surface$}  {:source$}  {:>3}  {:>9}  {:>8}  {:>10}",
            "surface", "source", "Q", "T* [ms]", "samples", "scan [s]"
        );
        for d in &self.durations {
            let cell = |x: Option<String>| x.unwrap_or_else(|| "–".into());
            let _ = writeln!(
                out,
                "{:surface$}  {:source$}  {:>3}  {:>9}  {:>8}  {:>10}  {}",
                d.surface,
                d.source,
                d.trials,
                cell(d.t_star_s.map(|t| format!("{:.2}", t * 1e3))),
                cell(d.t_star_samples.map(|t| t.to_string())),
                cell(d.scan_s.map(|t| format!("{t:.2}"))),
                d.reason.as_deref().unwrap_or_default()
            );
        }
        for s in &self.scene {
            let _ = match (&s.surface, s.scan_s) {
                (Some(surface), Some(scan)) => writeln!(
                    out,
                    "\n{}: a scan of {scan:.2} s gives {n} samples T* apart on every surface that \
                     has a T*; {surface} asks for the most",
                    s.source
                ),
                _ => writeln!(out, "\n{}: no surface has a T* within the range", s.source),
            };
            if !s.without.is_empty() {
                let _ = writeln!(out, "  without a T*: {}", s.without.join(", "));
            }
        }
        let q = self.durations.iter().map(|d| d.trials).min().unwrap_or(0);
        let _ = writeln!(
            out,
            "\nrule {}, R = {}, α = {}. From Q = {q} trials: no dependence was seen at T*, which is \
             not a proof of independence.",
            self.settings.rule, self.settings.draws, self.settings.alpha
        );
        out
    }
}
