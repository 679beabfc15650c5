//! Libraries that are small, wrong, or full of look-alikes.

use std::collections::BTreeMap;

use rand_chacha::ChaCha8Rng;

use super::timing::stretch;
use crate::library::Entry;
use crate::seed::uniform;
use crate::trial::{Signal, Trial};

/// A library, changed; the generator belongs to the disturbance and level.
pub type LibraryChange = fn(Vec<Entry>, f64, &mut ChaCha8Rng) -> Vec<Entry>;

/// At most `most` trials of each surface, picked at random.
pub fn few(library: Vec<Entry>, most: f64, rng: &mut ChaCha8Rng) -> Vec<Entry> {
    let mut drawn: Vec<(f64, Entry)> =
        library.into_iter().map(|entry| (uniform(rng), entry)).collect();
    drawn.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut kept: BTreeMap<String, usize> = BTreeMap::new();
    drawn.retain(|(_, entry)| {
        let count = kept.entry(entry.key.surface.clone()).or_insert(0);
        *count += 1;
        *count as f64 <= most
    });
    drawn.into_iter().map(|(_, entry)| entry).collect()
}

/// A share of the trials carries the name of another surface.
pub fn mislabelled(mut library: Vec<Entry>, share: f64, rng: &mut ChaCha8Rng) -> Vec<Entry> {
    let mut surfaces: Vec<String> = library.iter().map(|e| e.key.surface.clone()).collect();
    surfaces.sort();
    surfaces.dedup();
    for (at, entry) in library.iter_mut().enumerate() {
        if uniform(rng) < share {
            let own = surfaces.partition_point(|surface| *surface < entry.key.surface);
            let by = 1 + (uniform(rng) * (surfaces.len() - 1) as f64) as usize;
            entry.key.surface = surfaces[(own + by) % surfaces.len()].clone();
            // Its number may be taken there.
            entry.key.number += 1000 * (at as u32 + 1);
        }
    }
    library
}

/// Every surface has a twin, whose trials are the surface's own at a pitch that is `percent` %
/// higher.
pub fn twins(mut library: Vec<Entry>, percent: f64, _: &mut ChaCha8Rng) -> Vec<Entry> {
    let twin = |entry: &Entry| {
        let mut twin = entry.clone().changed(move |mut trial: Trial| {
            for signal in trial.signals.values_mut() {
                if let Signal::Series(series) = signal {
                    stretch(series, 1.0 + percent / 100.0);
                }
            }
            trial
        });
        twin.key.surface.push_str(" (twin)");
        twin
    };
    let all: Vec<Entry> = library.iter().map(twin).collect();
    library.extend(all);
    library
}
