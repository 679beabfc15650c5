//! The shape of a library: the rates, channels and lengths of its sources.

use std::collections::BTreeMap;

use rayon::prelude::*;

use crate::library::{Entry, LibraryError, Outline, Outlines};
use crate::scene::SourceId;
use crate::seed;

/// The shape of each series source of a library; pictures have none.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LibraryShape {
    sources: BTreeMap<SourceId, SourceShape>,
}

/// The shape of one source.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SourceShape {
    /// Frames a second, of the first trial that has the source.
    pub rate_hz: f64,
    /// Channels of that trial: samples in a frame.
    pub channels: usize,
    /// Median length of a trial in frames; the upper middle one if the number of trials is even.
    pub median_frames: usize,
}

impl LibraryShape {
    /// The shape of some trials. Reads only as much of each file as its format requires.
    ///
    /// # Errors
    /// If one of them cannot be read.
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
        Ok(Self { sources: by_source.into_iter().filter_map(shape).collect() })
    }

    /// The shape of a source; `None` if the source is a picture, or no trial has it.
    pub fn get(&self, id: &SourceId) -> Option<SourceShape> {
        self.sources.get(id).copied()
    }

    /// Hash of the whole shape.
    pub fn key(&self) -> u64 {
        seed::stable_hash(&[format!("{:?}", self.sources).as_bytes()])
    }
}

impl FromIterator<(SourceId, SourceShape)> for LibraryShape {
    fn from_iter<I: IntoIterator<Item = (SourceId, SourceShape)>>(shapes: I) -> Self {
        Self { sources: shapes.into_iter().collect() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trial::{Series, Signal, Trial, TrialKey};

    #[test]
    fn a_shape_has_the_median_length_of_the_trials_that_have_the_source() {
        let trial = |number: u32, ir: Option<usize>| {
            let series = |frames: usize| {
                Signal::Series(Series::new(100.0, 2, vec![0.5; 2 * frames]).unwrap())
            };
            let id = |name: &str| SourceId::new(name).unwrap();
            let mut signals = BTreeMap::from([(id("fr"), series(10 * number as usize))]);
            signals.extend(ir.map(|frames| (id("ir"), series(frames))));
            Entry::in_memory(Trial { key: TrialKey::new("oak", "expert", number), signals })
        };
        let trials = [trial(3, None), trial(1, Some(7)), trial(2, None)];
        let shape = LibraryShape::of(&trials.iter().collect::<Vec<_>>()).unwrap();
        let of = |name: &str| shape.get(&SourceId::new(name).unwrap());
        let fr = SourceShape { rate_hz: 100.0, channels: 2, median_frames: 20 };
        assert_eq!(of("fr"), Some(fr));
        assert_eq!(of("ir"), Some(SourceShape { median_frames: 7, ..fr }));
        assert_eq!(of("mi2"), None);
        assert_ne!(shape.key(), LibraryShape::default().key());
    }
}
