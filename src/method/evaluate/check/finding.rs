//! The faults of a library: one finding for each source and kind of fault, with the command that fixes it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use super::Audited;
use super::inspect::{FEWEST, Inspected, Measured, levels, usual};
use crate::evaluate::leak::{Leaks, Shared};
use crate::evaluate::still::Still;
use crate::library::{Entry, LibraryError, Unreadable};
use crate::printable::{counted, quoted, some_of};
use crate::scene::SourceId;
use crate::trial::{Doubt, TrialKey};

/// A trial is silent if ln of its loudness is this far below its source's median: 40 dB.
const SILENT: f64 = 2.0 * std::f64::consts::LN_10;
/// A trial is too short if its length is below this share of the source's median length.
const SHORT: f64 = 1.0 / 3.0;
/// The fault of a trial that only another name or number mends, so that it should not be removed.
const NOT_USED: &str = "is not used";
/// Most trials that a finding names.
const SHOWN: usize = 3;

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

struct Fault {
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
    let mut faults = copies_of_one_label(inspected, leaks, audited);
    let usual = |id: &SourceId, of: fn(&Measured) -> f64| usual(inspected.iter(), id, None, of);
    let sources: BTreeSet<&SourceId> = inspected.iter().flat_map(|i| i.series.keys()).collect();
    let is_flawed =
        |one: &Inspected, id: &SourceId| one.doubts.iter().any(|doubt| doubt.source() == Some(id));
    // If a constant series is usual, a level says nothing.
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
            let Some(source) = doubt.source() else { continue };
            let percent = |share: &f64| format!("{:.0} %", 100.0 * share);
            let (kind, what, detail) = match doubt {
                Doubt::Clipped { channel, share, .. } => {
                    let detail = format!("{} of channel {channel} at its limit", percent(share));
                    (FaultKind::Clipped, "is clipped", detail)
                }
                Doubt::AtZero { channel, share, .. } => {
                    let detail = format!("channel {channel} for {}", percent(share));
                    (FaultKind::Stuck, "is at 0", detail)
                }
                Doubt::Stuck { channel, .. } => {
                    (FaultKind::Stuck, "is stuck", format!("channel {channel}"))
                }
                Doubt::OneColour { .. } => (FaultKind::Stuck, "is of one colour", String::new()),
                _ => continue,
            };
            add(kind, source, what, detail);
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
fn look(trials: &[String]) -> String {
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
        let text = format!("{subject} {what} in {}: {each}", counted(count, "trial"));
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

/// The copies among trials of one label, or of two.
fn copies<'l>(
    inspected: &'l [Inspected],
    leaks: &'l Leaks,
    of_one: bool,
) -> impl Iterator<Item = &'l Shared> {
    let is_of_one =
        |[a, b]: [usize; 2]| inspected[a].entry.key.surface == inspected[b].entry.key.surface;
    leaks.shared.values().filter(move |one| one.is_copy && is_of_one(one.trials) == of_one)
}

/// A fault for each trial that has a series with the same samples as in an earlier trial of its surface.
fn copies_of_one_label(
    inspected: &[Inspected],
    leaks: &Leaks,
    audited: &Audited<'_>,
) -> Vec<Fault> {
    let name = |trial: usize| inspected[trial].entry.name_in(audited.root);
    let copies = copies(inspected, leaks, true);
    let fault = |shared: &Shared| Fault {
        kind: FaultKind::Copy,
        source: None,
        what: "is a copy of another",
        trial: name(shared.trials[1]),
        detail: format!("that of {}", name(shared.trials[0])),
    };
    copies.map(fault).collect()
}

/// The finding that trials are copies of each other under two labels. Those of them that look mislabelled are
/// taken out of `wrong`, and are to be removed: with its right label, such a trial would still be a copy.
pub(super) fn copies_of_two_labels(
    inspected: &[Inspected],
    leaks: &Leaks,
    wrong: &mut Vec<(String, String)>,
    audited: &Audited<'_>,
) -> Option<Finding> {
    let name = |trial: usize| inspected[trial].entry.name_in(audited.root);
    let pairs = copies(inspected, leaks, false).map(|one| one.trials.map(name));
    let pairs: Vec<[String; 2]> = pairs.collect();
    let trials: BTreeSet<String> = pairs.iter().flatten().cloned().collect();
    if pairs.is_empty() {
        return None;
    }
    let shown: Vec<String> = pairs.iter().map(|pair| pair.join(" and ")).collect();
    let mislabelled = wrong.extract_if(.., |(trial, _)| trials.contains(trial));
    let mislabelled: Vec<String> = mislabelled.map(|(trial, _)| trial).collect();
    let which = match mislabelled.is_empty() {
        true => "see which label is right".into(),
        false => format!("{} mislabelled", look(&mislabelled)),
    };
    let text = format!("copies under two labels: {}; {which}", some_of(&shown, SHOWN, "; "));
    let command = audited.command("remove", &mislabelled);
    Some(Finding { command, ..Finding::new(FaultKind::Copy, trials.into_iter().collect(), text) })
}

/// The finding that trials share samples without being copies of each other.
pub(super) fn shared(
    leaks: &Leaks,
    keys: &[TrialKey],
    entries: &[Entry],
    audited: &Audited<'_>,
) -> Option<Finding> {
    let parts = leaks.shared.values().filter(|shared| !shared.is_copy);
    let trials: BTreeSet<usize> = parts.flat_map(|shared| shared.trials).collect();
    let trials: Vec<usize> = trials.into_iter().collect();
    let keys: Vec<TrialKey> = trials.iter().map(|&i| keys[i].clone()).collect();
    let name = |i: usize| entries[trials[i]].name_in(audited.root);
    let text = leaks.among(&trials).text(&keys, name)?;
    let (names, text) =
        ((0..trials.len()).map(name), format!("{text}; cut recordings without overlap"));
    Some(Finding::new(FaultKind::Shared, names.collect(), text))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recognise::{MethodName, MethodSpec};
    use crate::scene::Scene;
    use crate::trial::Trial;

    fn audited<T>(work: impl FnOnce(&Audited<'_>) -> T) -> T {
        let scene = &Scene::lmt108();
        let method = &*MethodSpec::from(MethodName::Knn).build(scene);
        work(&Audited { root: Path::new("lib"), editable: true, scene, method, cache: None })
    }

    /// The findings about the levels of trials `a/1`, `a/2` and so on.
    fn said(levels: &[f64], is_constant: impl Fn(usize) -> bool) -> Vec<String> {
        let one = |(at, &level): (usize, &f64)| {
            let key = TrialKey::new("a", "anna", at as u32 + 1);
            let signals = BTreeMap::new();
            let is_constant = is_constant(at);
            let measured = Measured { seconds: 1.0, level, is_constant, ..Measured::default() };
            Inspected {
                entry: Entry::in_memory(Trial { key, signals }),
                doubts: Vec::new(),
                series: [(SourceId::new("vel").unwrap(), measured)].into(),
            }
        };
        let all: Vec<Inspected> = levels.iter().enumerate().map(one).collect();
        let (findings, advice) =
            audited(|audited| of_signals(&all, &Leaks::default(), &[], audited));
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
        let three = |kind, source: Option<SourceId>, what| {
            let fault = |n| Fault {
                kind,
                source: source.clone(),
                what,
                trial: format!("a/{n}"),
                detail: String::new(),
            };
            audited(|audited| grouped((1..=3).map(fault).collect(), 6, audited))
        };
        let (findings, advice) = three(FaultKind::Stuck, SourceId::new("ir").ok(), "is stuck");
        assert!(findings.is_empty() && advice[0].contains("3 of 6 trials: check its sensor"));
        let (findings, advice) = three(FaultKind::Copy, None, "is a copy of another");
        let command = findings[0].command.as_deref();
        assert_eq!((command, advice), (Some("surfaced library remove lib a/1 a/2 a/3"), vec![]));
    }
}
