//! Reads every recording of a library once, and finds the library's faults: one finding for each source
//! and kind of fault, with the command that fixes it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::usual::{FEWEST, levels, usual};
use super::{Audited, copies};
use crate::evaluate::ProgressFn;
use crate::evaluate::leak::Leaks;
use crate::evaluate::loudness::{edge_hz, level_of};
use crate::evaluate::still::Still;
use crate::library::{Entry, LibraryError, Unreadable};
use crate::printable::{quoted, some_of};
use crate::scene::{Scene, SourceId};
use crate::trial::{Doubt, SeriesFlaws, Signal, Trial, is_plain, usual_rests};

/// A trial is silent if ln of its loudness is this far below its source's median: 40 dB.
const SILENT: f64 = 2.0 * std::f64::consts::LN_10;
/// A trial is too short if its length is below this share of the source's median length.
const SHORT: f64 = 1.0 / 3.0;
/// The fault of a trial that only another name or number mends, so that it should not be removed.
const NOT_USED: &str = "is not used";
/// Most trials that a finding names.
pub(super) const SHOWN: usize = 3;

/// Most bytes of samples that are kept in memory, to save reading them again.
const MOST_KEPT: usize = 1 << 30;

/// Kinds of faults, the worst first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum FaultKind {
    Unreadable,
    /// A series or picture has the same samples as in another trial.
    Copy,
    /// A series never changes, or is 40 dB below the other trials.
    Silent,
    /// A series is shorter than a third of the usual length.
    Short,
    Clipped,
    /// A channel is stuck, or a picture is of one colour.
    Stuck,
    /// A trial was clearly named another surface when it was left out.
    Mislabelled,
    /// Many trials of one person or session were clearly named other surfaces.
    Session,
    /// A series is 20 dB or more above or below the other trials of its surface, and outside their spread.
    Level,
    /// A part of a series is also in another trial.
    Shared,
}

#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Finding {
    pub kind: FaultKind,
    pub source: Option<SourceId>,
    pub trials: Vec<String>,
    pub text: String,
    pub command: Option<String>,
}

impl Finding {
    /// A finding that is of no source, and that no command mends.
    pub(super) fn new(kind: FaultKind, trials: Vec<String>, text: String) -> Self {
        Self { kind, source: None, trials, text, command: None }
    }
}

/// Findings, and advice in lines.
type Found = (Vec<Finding>, Vec<String>);

pub(super) struct Fault {
    pub kind: FaultKind,
    pub source: Option<SourceId>,
    /// The fault in words, without the source and the trial, such as `is silent`.
    pub what: &'static str,
    pub trial: String,
    /// Details of this trial to show, such as its length.
    pub detail: String,
}

impl Audited<'_> {
    pub(super) fn command(&self, edit: &str, trials: &[String]) -> Option<String> {
        let library = quoted(&self.root.display().to_string());
        let names = trials.iter().map(|name| quoted(name)).collect::<Vec<_>>().join(" ");
        let dash = trials.iter().chain([&library]).any(|name| name.starts_with('-'));
        let dashes = if dash { "-- " } else { "" };
        let is_editable = self.editable && !trials.is_empty();
        is_editable.then(|| format!("surfaced library {edit} {dashes}{library} {names}"))
    }

    /// The trial that the file of an error belongs to, if any, and why the file cannot be used.
    fn unreadable(&self, error: &LibraryError) -> (Option<String>, String) {
        let Some(path) = error.path() else { return (None, error.to_string()) };
        let within = path.strip_prefix(self.root).unwrap_or(path);
        let parts: Vec<_> = within.iter().map(|part| part.to_string_lossy()).collect();
        let trial = match &parts[..] {
            [surface, trial] | [surface, trial, _] => Some(format!("{surface}/{trial}")),
            _ => None,
        };
        let said = error.to_string();
        let why = said.strip_prefix(&format!("{}: ", path.display())).unwrap_or(&said);
        let file = parts.get(2).map(|file| format!("{file}: ")).unwrap_or_default();
        (trial, format!("{file}{why}"))
    }
}

/// One trial with its readable sources, and what was found in them.
pub(super) struct Inspected {
    /// The trial; its signals are kept in memory if there is room.
    pub entry: Entry,
    /// The faults of its sensors, judged by how long each channel rests in the whole library.
    pub doubts: Vec<Doubt>,
    /// The measurements of each series, except of switches such as the metal detector.
    pub series: BTreeMap<SourceId, Measured>,
}

pub(super) struct Measured {
    pub seconds: f64,
    /// ln of the root mean square, after the mean of each channel was subtracted.
    pub level: f64,
    pub rate_hz: f64,
    /// The frequency below which 95 % of the power lies.
    pub edge_hz: f64,
    pub is_constant: bool,
    /// For each channel, the largest share of the samples that rests at one value.
    rests: Vec<f32>,
}

/// Reads all trials. Returns the trials with a readable source, and the sources that cannot be read.
pub(super) fn inspect(
    entries: Vec<Entry>,
    scene: &Scene,
    progress: ProgressFn<'_>,
) -> (Vec<Inspected>, Vec<Unreadable>) {
    let (kept, done, all) = (AtomicUsize::new(0), AtomicUsize::new(0), entries.len());
    let one = |(at, entry): (usize, Entry)| {
        let inspected = of_entry(at, entry, scene, &kept);
        progress("reading all recordings", done.fetch_add(1, Ordering::Relaxed) + 1, all);
        inspected
    };
    let read: Vec<_> = entries.into_par_iter().enumerate().map(one).collect();
    let (mut inspected, unreadable): (Vec<_>, Vec<_>) = read.into_iter().unzip();
    inspected.retain(|trial: &Inspected| !trial.entry.sources.is_empty());
    forget_usual(&mut inspected);
    (inspected, unreadable.into_iter().flatten().collect())
}

fn of_entry(
    at: usize,
    mut entry: Entry,
    scene: &Scene,
    kept: &AtomicUsize,
) -> (Inspected, Vec<Unreadable>) {
    let (mut signals, mut unreadable) = (BTreeMap::new(), Vec::new());
    for source in &entry.sources {
        match entry.with_only(source).load() {
            Ok(trial) => signals.extend(trial.signals),
            Err(error) => unreadable.push(Unreadable { entry: at, source: source.clone(), error }),
        }
    }
    entry.sources.retain(|source| signals.contains_key(source));
    let (mut doubts, mut series) = (Vec::new(), BTreeMap::new());
    for (id, signal) in &signals {
        match signal {
            Signal::Image(image) if is_plain(image) => {
                doubts.push(Doubt::OneColour { source: id.clone() });
            }
            Signal::Series(one) if !scene.is_switch(id) => {
                let flaws = SeriesFlaws::of(one);
                doubts.extend(flaws.doubts(id, &[]));
                let measured = Measured {
                    seconds: one.duration_s(),
                    level: level_of(one),
                    rate_hz: one.rate_hz(),
                    edge_hz: edge_hz(one),
                    is_constant: one.is_constant(),
                    rests: flaws.rests(),
                };
                series.insert(id.clone(), measured);
            }
            Signal::Image(_) | Signal::Series(_) => {}
        }
    }
    let bytes: usize = signals.values().map(bytes).sum();
    if kept.fetch_add(bytes, Ordering::Relaxed) + bytes <= MOST_KEPT {
        let key = entry.key.clone();
        entry = entry.held(Arc::new(Trial { key, signals }));
    }
    (Inspected { entry, doubts, series }, unreadable)
}

fn bytes(signal: &Signal) -> usize {
    match signal {
        Signal::Series(series) => size_of_val(series.samples()),
        Signal::Image(image) => image.rgb().len(),
    }
}

/// Findings on the files and sources that cannot be read.
pub(super) fn unreadable(
    bad: &[LibraryError],
    unreadable: &[Unreadable],
    audited: &Audited<'_>,
) -> Vec<Finding> {
    let errors = bad.iter().map(|error| (None, error));
    let errors = errors.chain(unreadable.iter().map(|u| (Some(&u.source), &u.error)));
    let (mut faults, mut others) = (Vec::new(), Vec::new());
    for (source, error) in errors {
        let (kind, source) = (FaultKind::Unreadable, source.cloned());
        match audited.unreadable(error) {
            (Some(trial), detail) => {
                let is_whole = error.path().is_some_and(Path::is_dir);
                let what = if is_whole { NOT_USED } else { "cannot be read" };
                faults.push(Fault { kind, source, what, trial, detail });
            }
            (None, _) => {
                others.push(Finding { source, ..Finding::new(kind, vec![], error.to_string()) });
            }
        }
    }
    let mut found = grouped(faults, usize::MAX, audited).0;
    found.extend(others);
    found
}

/// Findings on the signals, and advice on each fault that half of the trials or more have.
/// The faults of `still` channels are findings of their own, see [`never_moving`].
pub(super) fn of_signals(
    inspected: &[Inspected],
    leaks: &Leaks,
    still: &[Still],
    audited: &Audited<'_>,
) -> Found {
    let mut faults = copies::of_one_label(inspected, leaks, audited);
    let usual = |id: &SourceId, of: fn(&Measured) -> f64| usual(inspected.iter(), id, None, of);
    let sources: BTreeSet<&SourceId> = inspected.iter().flat_map(|i| i.series.keys()).collect();
    let is_flawed =
        |one: &Inspected, id: &SourceId| one.doubts.iter().any(|doubt| doubt.source() == Some(id));
    // Where a constant series is usual, a level says nothing.
    let has_level = |id: &SourceId| {
        let rests = |one: &Inspected| one.series.get(id).is_some_and(|of| of.is_constant);
        !inspected.iter().any(|one| rests(one) && !is_flawed(one, id))
    };
    let of_source = |id| {
        let level = usual(id, |m| m.level).filter(|_| has_level(id));
        (id, (usual(id, |m| m.seconds), level))
    };
    let of_sources: BTreeMap<&SourceId, _> = sources.into_iter().map(of_source).collect();
    for one in inspected {
        let surface = &*one.entry.key.surface;
        let trial = one.entry.name_in(audited.root);
        let mut add = |kind, source: &SourceId, what, detail: String| {
            let (source, trial) = (Some(source.clone()), trial.clone());
            faults.push(Fault { kind, source, what, trial, detail });
        };
        let is_still = |id: &SourceId| {
            still.iter().any(|s| s.source == *id && s.surface.as_deref() == Some(surface))
        };
        for (id, of) in one.series.iter().filter(|(id, _)| !is_still(id)) {
            let (usual_s, usual_level) = of_sources[id];
            let is_silent = usual_level.is_some_and(|usual| of.level < usual - SILENT);
            let of_surface = usual_level.and_then(|_| levels(inspected, id, surface));
            let [low, middle, high] = of_surface.unwrap_or([of.level; 3]);
            if (of.is_constant && is_flawed(one, id)) || is_silent {
                add(FaultKind::Silent, id, "is silent", String::new());
            } else if let Some(usual_s) = usual_s.filter(|usual_s| of.seconds < SHORT * usual_s) {
                let detail = format!("{:.1} s, usually {usual_s:.1} s", of.seconds);
                add(FaultKind::Short, id, "is far shorter than usual", detail);
            } else if !(low..=high).contains(&of.level) {
                let db = 20.0 / std::f64::consts::LN_10 * (of.level - middle);
                let detail = format!("{db:+.0} dB");
                add(FaultKind::Level, id, "is too loud or too quiet for its surface", detail);
            }
        }
        let is_own = |doubt: &&Doubt| doubt.source().is_none_or(|id| !is_still(id));
        for doubt in one.doubts.iter().filter(is_own) {
            match doubt {
                Doubt::Clipped { source, channel, share, .. } => {
                    let detail =
                        format!("{:.0} % of channel {channel} at its limit", 100.0 * share);
                    add(FaultKind::Clipped, source, "is clipped", detail);
                }
                Doubt::AtZero { source, channel, share } => {
                    let detail = format!("channel {channel} for {:.0} %", 100.0 * share);
                    add(FaultKind::Stuck, source, "is at 0", detail);
                }
                Doubt::Stuck { source, channel, .. } => {
                    add(FaultKind::Stuck, source, "is stuck", format!("channel {channel}"));
                }
                Doubt::OneColour { source } => {
                    add(FaultKind::Stuck, source, "is of one colour", String::new());
                }
                _ => {}
            }
        }
    }
    grouped(faults, inspected.len(), audited)
}

/// A finding for each source with channels that never move, in the library or on a surface.
pub(super) fn never_moving(
    still: &[Still],
    inspected: &[Inspected],
    audited: &Audited<'_>,
) -> Vec<Finding> {
    let finding = |one: &Still| {
        let is_of = |trial: &&Inspected| {
            Some(&trial.entry.key.surface) == one.surface.as_ref()
                && trial.entry.sources.contains(&one.source)
        };
        let trials = inspected.iter().filter(is_of).map(|trial| trial.entry.name_in(audited.root));
        let trials: Vec<String> = trials.collect();
        let (source, command) = (Some(one.source.clone()), audited.command("remove", &trials));
        let stuck = Finding::new(FaultKind::Stuck, trials, one.to_string());
        Finding { source, command, ..stuck }
    };
    still.iter().map(finding).collect()
}

/// Findings on trials that look mislabelled, given as pairs: the trial, and the surface it was named.
pub(super) fn mislabelled(found: &[(String, String)], audited: &Audited<'_>) -> Vec<Finding> {
    let mut by_label: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    for (trial, named) in found {
        by_label.entry(named).or_default().push(trial.clone());
    }
    let finding = |(label, trials): (&str, Vec<String>)| {
        let command = audited.command(&format!("move --to={}", quoted(label)), &trials);
        let text = format!("{} mislabelled: left out, clearly named {label}", look(&trials));
        Finding { command, ..Finding::new(FaultKind::Mislabelled, trials, text) }
    };
    by_label.into_iter().map(finding).collect()
}

/// Text such as `a looks`, `2 trials (a, b) look` or `4 trials (a, b, c and 1 more) look`.
pub(super) fn look(trials: &[String]) -> String {
    let shown = some_of(trials, SHOWN, ", ");
    match trials.len() {
        1 => format!("{shown} looks"),
        n => format!("{n} trials ({shown}) look"),
    }
}

/// Makes a finding for each source and kind of fault, the worst first. If a source of a trial has
/// several faults, only the worst counts. A fault of half of `all` trials becomes advice on the sensor.
fn grouped(mut faults: Vec<Fault>, all: usize, audited: &Audited<'_>) -> Found {
    faults.sort_by(|a, b| (a.kind, &a.source).cmp(&(b.kind, &b.source)));
    let mut seen = BTreeSet::new();
    faults.retain(|fault| seen.insert((fault.source.clone(), fault.trial.clone())));
    let mut groups: BTreeMap<(FaultKind, Option<SourceId>, &str), Vec<Fault>> = BTreeMap::new();
    for fault in faults {
        let key = (fault.kind, fault.source.clone(), fault.what);
        groups.entry(key).or_default().push(fault);
    }
    let (mut findings, mut advice) = (Vec::new(), Vec::new());
    for ((kind, source, what), faults) in groups {
        let subject = source.as_ref().map_or_else(|| "a recording".into(), ToString::to_string);
        let count = faults.len();
        let each = faults.iter().map(|fault| match fault.detail.as_str() {
            "" => fault.trial.clone(),
            detail => format!("{} ({detail})", fault.trial),
        });
        let each = some_of(&each.collect::<Vec<_>>(), SHOWN, "; ");
        let trials = if count == 1 { "trial" } else { "trials" };
        let text = format!("{subject} {what} in {count} {trials}: {each}");
        // A copy says nothing about a sensor, however many there are.
        if source.is_some() && count >= FEWEST && count.saturating_mul(2) >= all {
            advice.push(format!("{subject} {what} in {count} of {all} trials: check its sensor"));
            continue;
        }
        let trials: BTreeSet<String> = faults.into_iter().map(|fault| fault.trial).collect();
        let trials: Vec<String> = trials.into_iter().collect();
        let command = audited.command("remove", &trials).filter(|_| what != NOT_USED);
        findings.push(Finding { kind, source, trials, text, command });
    }
    (findings, advice)
}

/// Forgets doubts about channels that rest no longer than they usually do in the library.
fn forget_usual(inspected: &mut [Inspected]) {
    let mut of_trials: BTreeMap<&SourceId, Vec<&[f32]>> = BTreeMap::new();
    for (id, of) in inspected.iter().flat_map(|one| &one.series) {
        of_trials.entry(id).or_default().push(&of.rests);
    }
    let usual = |(id, rests): (&SourceId, Vec<&[f32]>)| (id.clone(), usual_rests(&rests));
    let usual: BTreeMap<SourceId, Vec<f32>> = of_trials.into_iter().map(usual).collect();
    for one in inspected {
        one.doubts.retain(|doubt| {
            let rests = doubt.source().and_then(|id| usual.get(id));
            !doubt.is_usual(rests.map_or(&[], Vec::as_slice))
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recognise::{MethodName, MethodSpec};
    use crate::trial::TrialKey;

    /// What is said of the levels of trials `a/1`, `a/2` and so on.
    fn said(levels: &[f64], is_constant: impl Fn(usize) -> bool) -> Vec<String> {
        let scene = Scene::lmt108();
        let method = &*MethodSpec::from(MethodName::Knn).build(&scene);
        let root = std::path::Path::new("lib");
        let audited = Audited { root, editable: true, scene: &scene, method, cache: None };
        let one = |(at, &level): (usize, &f64)| {
            let key = TrialKey::new("a", "anna", at as u32 + 1);
            let signals = BTreeMap::new();
            let is_constant = is_constant(at);
            let measured = Measured {
                seconds: 1.0,
                level,
                rate_hz: 1e3,
                edge_hz: 9.0,
                is_constant,
                rests: vec![],
            };
            Inspected {
                entry: Entry::in_memory(Trial { key, signals }),
                doubts: Vec::new(),
                series: [(SourceId::new("vel").unwrap(), measured)].into(),
            }
        };
        let all: Vec<Inspected> = levels.iter().enumerate().map(one).collect();
        let (findings, advice) = of_signals(&all, &Leaks::default(), &[], &audited);
        findings.into_iter().map(|finding| finding.text).chain(advice).collect()
    }

    #[test]
    fn a_level_is_judged_by_the_spread_of_its_surface_and_not_where_constancy_is_usual() {
        let (usual, low, silence) = (0.0, -3.0, -27.0);
        let one = said(&[usual, low, usual, usual, usual], |_| false);
        assert!(one.len() == 1 && one[0].contains("too loud or too quiet"), "{one:?}");
        let spread = [usual, low, usual, usual, low, usual, low, usual];
        assert_eq!(said(&spread, |_| false), [""; 0]);
        assert_eq!(said(&[usual, silence, usual, usual, usual], |at| at == 1), [""; 0]);
    }

    #[test]
    fn half_of_the_trials_blame_a_sensor_but_copies_are_to_be_removed_however_many() {
        let scene = Scene::lmt108();
        let method = &*MethodSpec::from(MethodName::Knn).build(&scene);
        let root = std::path::Path::new("lib");
        let audited = Audited { root, editable: true, scene: &scene, method, cache: None };
        let three = |kind, source: Option<SourceId>, what| {
            let fault = |n| Fault {
                kind,
                source: source.clone(),
                what,
                trial: format!("a/{n}"),
                detail: String::new(),
            };
            grouped((1..=3).map(fault).collect(), 6, &audited)
        };
        let (findings, advice) = three(FaultKind::Stuck, SourceId::new("ir").ok(), "is stuck");
        assert!(findings.is_empty() && advice[0].contains("3 of 6 trials: check its sensor"));
        let (findings, advice) = three(FaultKind::Copy, None, "is a copy of another");
        let command = findings[0].command.as_deref();
        assert_eq!((command, advice), (Some("surfaced library remove lib a/1 a/2 a/3"), vec![]));
    }
}
