//! The shape of a library: how many trials it has, and the rates, channels and lengths of its sources.

use std::collections::BTreeMap;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::library::{Entry, LibraryError, Outline, Outlines};
use crate::scene::SourceId;
use crate::seed;

/// The number of trials of a library, and the shape of each source except pictures.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LibraryShape {
    /// Number of trials.
    pub(crate) trials: usize,
    pub(crate) sources: BTreeMap<SourceId, SourceShape>,
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SourceShape {
    /// Frames a second, in the first trial that has the source.
    pub rate_hz: f64,
    /// Samples in a frame, in the same trial.
    pub channels: usize,
    /// Median length of a trial in frames; for an even number of trials, the upper middle length.
    pub median_frames: usize,
}

impl LibraryShape {
    /// The shape of some trials. Reads only as much of each file as its format requires.
    ///
    /// # Errors
    /// If a trial cannot be read.
    pub fn of(entries: &[&Entry]) -> Result<Self, LibraryError> {
        let all = entries.par_iter().map(|entry| entry.outlines());
        let all: Vec<Outlines> = all.collect::<Result<_, LibraryError>>()?;
        let mut by_source: BTreeMap<SourceId, Vec<Outline>> = BTreeMap::new();
        for (id, outline) in all.into_iter().flatten() {
            by_source.entry(id).or_default().push(outline);
        }
        let shape = |(id, outlines): (SourceId, Vec<Outline>)| {
            let mut lengths: Vec<usize> = outlines.iter().map(|outline| outline.frames).collect();
            lengths.sort_unstable();
            let Outline { rate_hz, channels, .. } = *outlines.first()?;
            Some((id, SourceShape { rate_hz, channels, median_frames: lengths[lengths.len() / 2] }))
        };
        let sources = by_source.into_iter().filter_map(shape).collect();
        Ok(Self { trials: entries.len(), sources })
    }

    /// The shape of a source; `None` if the source is a picture, or no trial has it.
    pub fn get(&self, id: &SourceId) -> Option<SourceShape> {
        self.sources.get(id).copied()
    }

    /// Share of the trials that some work is done for, if about `most` of them are enough. It changes in
    /// steps, since trials that were prepared by another share are of no use.
    pub(crate) fn share(&self, most: usize) -> f64 {
        (most as f64 / self.trials.next_multiple_of(100).max(1) as f64).min(1.0)
    }

    pub fn key(&self) -> u64 {
        seed::stable_hash(&[format!("{self:?}").as_bytes()])
    }
}
