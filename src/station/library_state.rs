//! What a station says of the library that it compares scans with.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;

use crate::library::Entry;
use crate::scene::SourceId;

/// The library that scans are compared with.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct LibraryState {
    /// Its name, or its folder's.
    pub name: String,
    /// Its surfaces, sorted, with the number of trials of each.
    pub surfaces: Vec<(String, usize)>,
    /// Its sources.
    pub sources: Vec<SourceId>,
    /// Made by a generator, not measured.
    pub synthetic: bool,
    /// For people: why scans cannot be named with it, if they cannot.
    pub problem: Option<String>,
    /// For people: what answers rest on, a line each.
    pub remarks: Vec<String>,
}

impl LibraryState {
    /// The state of a library of these trials.
    pub fn of(name: &str, entries: &[Entry], synthetic: bool) -> Self {
        let (mut surfaces, mut sources) = (BTreeMap::new(), BTreeSet::new());
        for entry in entries {
            *surfaces.entry(entry.key.surface.clone()).or_insert(0) += 1;
            sources.extend(entry.sources.iter().cloned());
        }
        Self {
            name: name.to_string(),
            surfaces: surfaces.into_iter().collect(),
            sources: sources.into_iter().collect(),
            synthetic,
            problem: None,
            remarks: Vec::new(),
        }
    }
}
