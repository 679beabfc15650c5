//! Finds the recordings of a library that cannot be read, by reading all of them.

use rayon::prelude::*;

use super::{Entry, LibraryError};
use crate::scene::SourceId;

/// A source of a trial that cannot be read.
#[derive(Debug)]
pub struct Unreadable {
    /// Index of the trial among the entries.
    pub entry: usize,
    pub source: SourceId,
    /// Why it cannot be read.
    pub error: LibraryError,
}

/// Reads every source of every trial, and returns those that cannot be read, in order of trials.
pub fn unreadable(entries: &[Entry]) -> Vec<Unreadable> {
    let of_entry = |(at, entry): (usize, &Entry)| {
        let read = |source: &SourceId| {
            let error = entry.with_only(source).load().err()?;
            Some(Unreadable { entry: at, source: source.clone(), error })
        };
        entry.sources.iter().filter_map(read).collect::<Vec<_>>()
    };
    entries.par_iter().enumerate().flat_map_iter(of_entry).collect()
}

/// The `entries` without the `unreadable` sources; trials that lose all sources are dropped.
pub fn without(mut entries: Vec<Entry>, unreadable: &[Unreadable]) -> Vec<Entry> {
    for Unreadable { entry, source, .. } in unreadable {
        entries[*entry].sources.retain(|id| id != source);
    }
    entries.retain(|entry| !entry.sources.is_empty());
    entries
}
