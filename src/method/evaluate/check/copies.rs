//! Findings on trials that have samples of other trials.

use std::collections::BTreeSet;

use super::Audited;
use super::finding::{Fault, FaultKind, Finding, SHOWN, look};
use super::inspect::Inspected;
use crate::evaluate::leak::{Leaks, Shared};
use crate::library::Entry;
use crate::printable::some_of;
use crate::trial::TrialKey;

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
pub(super) fn of_one_label(
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
pub(super) fn of_two_labels(
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
