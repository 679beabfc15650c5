//! What the signals of trials show without any comparison: flaws, plain pictures, copies.

use std::collections::{BTreeMap, BTreeSet};

use crate::library::Entry;
use crate::scene::{Scene, SourceId};
use crate::trial::{Flaw, Signal, TrialKey, flaws, is_plain};

/// What the signals of one trial show.
pub(super) struct Inspected {
    pub flaws: Vec<(SourceId, Flaw)>,
    pub plain: Vec<SourceId>,
    /// A number for each series that changes.
    pub hashes: Vec<(SourceId, u64)>,
}

/// Reads a trial.
pub(super) fn inspect(entry: &Entry, scene: &Scene) -> Inspected {
    let mut found = Inspected { flaws: Vec::new(), plain: Vec::new(), hashes: Vec::new() };
    // All of it could be read a moment ago.
    let Ok(trial) = entry.load() else { return found };
    for (id, signal) in &trial.signals {
        let is_switch = scene.get(id.as_str()).is_some_and(|spec| spec.sigma.is_some());
        match signal {
            Signal::Image(image) if is_plain(image) => found.plain.push(id.clone()),
            Signal::Series(series) if !is_switch => {
                found.flaws.extend(flaws(series).into_iter().map(|flaw| (id.clone(), flaw)));
                if !series.is_constant() {
                    found.hashes.push((id.clone(), signal.content_hash()));
                }
            }
            Signal::Image(_) | Signal::Series(_) => {}
        }
    }
    found
}

/// Channels that rest in half of the trials or more: that is how they are.
pub(super) fn resting(inspected: &[Inspected]) -> BTreeSet<(&SourceId, usize)> {
    let mut counts: BTreeMap<(&SourceId, usize), usize> = BTreeMap::new();
    for (id, flaw) in inspected.iter().flat_map(|inspected| &inspected.flaws) {
        if let Flaw::Constant { channel, .. } = flaw {
            *counts.entry((id, *channel)).or_default() += 1;
        }
    }
    counts.retain(|_, count| *count * 2 >= inspected.len());
    counts.into_keys().collect()
}

/// Trials with a series that another one has.
pub(super) fn duplicates(keys: &[TrialKey], inspected: &[Inspected]) -> Vec<String> {
    let mut seen: BTreeMap<(&SourceId, u64), &TrialKey> = BTreeMap::new();
    let mut twice: BTreeMap<(&TrialKey, &TrialKey), Vec<&str>> = BTreeMap::new();
    for (key, inspected) in keys.iter().zip(inspected) {
        for (id, hash) in &inspected.hashes {
            match seen.get(&(id, *hash)) {
                Some(first) => twice.entry((first, key)).or_default().push(id.as_str()),
                None => drop(seen.insert((id, *hash), key)),
            }
        }
    }
    let say = |((first, second), sources): ((&TrialKey, &TrialKey), Vec<&str>)| {
        format!("{second} is a copy of {first} ({}); remove one", sources.join(", "))
    };
    twice.into_iter().map(say).collect()
}
