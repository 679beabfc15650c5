//! Reads every recording of a library once, and looks for flaws in it.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use crate::evaluate::ProgressFn;
use crate::evaluate::loudness::level_of;
use crate::library::{Entry, Unreadable};
use crate::scene::{Scene, SourceId};
use crate::trial::{Flaw, Signal, Trial, flaws, is_plain};

/// Most bytes of samples that are kept in memory, to save reading them again.
const MOST_KEPT: usize = 1 << 30;

/// One trial with its readable sources, and what was found in them.
pub(super) struct Inspected {
    /// The trial; its signals are kept in memory if there is room.
    pub entry: Entry,
    pub flaws: Vec<(SourceId, Flaw)>,
    /// Sources with a picture of a single colour.
    pub plain: Vec<SourceId>,
    /// The measurements of each series, except of switches such as the metal detector.
    pub series: BTreeMap<SourceId, Measured>,
}

pub(super) struct Measured {
    pub seconds: f64,
    /// ln of the root mean square, after the mean of each channel was subtracted.
    pub level: f64,
    /// Hash of the samples, to find copies; `None` for a constant series.
    pub hash: Option<u64>,
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
    let read: Vec<(Inspected, Vec<Unreadable>)> =
        entries.into_par_iter().enumerate().map(one).collect();
    let (mut inspected, unreadable): (Vec<_>, Vec<_>) = read.into_iter().unzip();
    inspected.retain(|trial: &Inspected| !trial.entry.sources.is_empty());
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
    let (mut flawed, mut plain, mut series) = (Vec::new(), Vec::new(), BTreeMap::new());
    for (id, signal) in &signals {
        let is_switch = scene.get(id.as_str()).is_some_and(|spec| spec.sigma.is_some());
        match signal {
            Signal::Image(image) if is_plain(image) => plain.push(id.clone()),
            Signal::Series(one) if !is_switch => {
                flawed.extend(flaws(one).into_iter().map(|flaw| (id.clone(), flaw)));
                let measured = Measured {
                    seconds: one.duration_s(),
                    level: level_of(one.samples(), one.channels()),
                    hash: (!one.is_constant()).then(|| signal.content_hash()),
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
    (Inspected { entry, flaws: flawed, plain, series }, unreadable)
}

fn bytes(signal: &Signal) -> usize {
    match signal {
        Signal::Series(series) => size_of_val(series.samples()),
        Signal::Image(image) => image.rgb().len(),
    }
}
