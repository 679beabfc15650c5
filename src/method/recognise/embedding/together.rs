//! Finds the trials of a library that share samples, such as copies, or excerpts that overlap. They are left
//! out together, since naming one by the other says nothing of new scans.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use crate::features::frames::{Prints, TrialFrames};

/// Fewest equal windows of two trials, and the least share of the windows that are kept. A few short runs
/// of a sensor at rest are equal by chance.
const FEWEST: usize = 2;
const LEAST_SHARE: f64 = 0.1;

/// For each trial, the first one with which it shares samples, directly or by way of others.
pub(super) fn together(library: &[Arc<TrialFrames>]) -> Vec<usize> {
    let mut first: Vec<usize> = (0..library.len()).collect();
    let mut wholes = HashMap::new();
    let mut windows: HashMap<_, Vec<usize>> = HashMap::new();
    for (trial, frames) in library.iter().enumerate() {
        for (source, Prints(whole, of_windows)) in &frames.prints {
            if let Some(whole) = whole {
                join(&mut first, *wholes.entry((source, whole)).or_insert(trial), trial);
            }
            for window in of_windows {
                windows.entry((source, window)).or_default().push(trial);
            }
        }
    }
    let mut shared: BTreeMap<_, usize> = BTreeMap::new();
    for ((source, _), trials) in &windows {
        for other in &trials[1..] {
            *shared.entry((trials[0], *other, *source)).or_default() += 1;
        }
    }
    for ((one, other, source), count) in shared {
        let kept = [one, other].map(|trial| library[trial].prints[source].1.len());
        let least = (LEAST_SHARE * kept[0].min(kept[1]) as f64).ceil() as usize;
        if count >= least.max(FEWEST) {
            join(&mut first, one, other);
        }
    }
    (0..library.len()).map(|trial| root(&first, trial)).collect()
}

fn root(first: &[usize], mut trial: usize) -> usize {
    while first[trial] != trial {
        trial = first[trial];
    }
    trial
}

fn join(first: &mut [usize], one: usize, other: usize) {
    let (a, b) = (root(first, one), root(first, other));
    first[a.max(b)] = a.min(b);
}
