//! A trial prepared for the method `reference`: its sources are cut to length and sampled.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use super::sample_set::SampleSet;
use super::sampling::DomainSamples;
use crate::library::Entry;
use crate::recognise::error::{RecogniseError, nothing_in_common, of_known_sources};
use crate::scene::{Scene, SourceId, SourceSpec};
use crate::seed;
use crate::trial::{Signal, Trial, TrialKey};

/// One source of a trial, cut to some length and sampled.
pub struct SampledSource {
    /// One set of samples for each repetition; empty if positions are drawn for each pair of trials.
    pub sets: Vec<Arc<SampleSet>>,
    /// All samples; `None` unless positions are drawn for each pair of trials.
    pub domain: Option<DomainSamples>,
}

/// A source; its rate in Hz and its number of frames if it is a series; and its sets.
type StoredSource = (SourceId, Option<(f64, usize)>, Vec<SampleSet>);

/// Number of lengths of a source kept in memory besides the trial's own; enough for `chart`.
const KEPT_LENGTHS: usize = 3;

/// Each source cut to the lengths used so far, with the length in frames.
type SampledSources = BTreeMap<SourceId, Vec<(usize, Arc<SampledSource>)>>;

/// A trial, prepared for comparison.
pub struct PreparedTrial {
    entry: Entry,
    /// Rate in Hz and frames of each source that the scene describes; `None` for an image.
    shapes: BTreeMap<SourceId, Option<(f64, usize)>>,
    content: u64,
    /// Each source cut to the lengths used so far; the trial's own length comes first.
    cuts: Mutex<SampledSources>,
}

impl PreparedTrial {
    /// Prepares the sources of a trial that the scene describes, at their own lengths. `hashed` says
    /// whether `PreparedTrial::content` is needed.
    pub fn new(
        entry: &Entry,
        trial: &Trial,
        scene: &Scene,
        hashed: bool,
        cut: impl Fn(&SourceSpec, &Signal, usize) -> SampledSource + Sync,
    ) -> Result<Self, RecogniseError> {
        let made = of_known_sources(&entry.key, trial, scene, |spec, signal| {
            let shape = match signal {
                Signal::Image(_) => None,
                Signal::Series(series) => Some((series.rate_hz(), series.frames())),
            };
            let frames = shape.map_or(0, |(_, frames)| frames);
            let content = if hashed { signal.content_hash() } else { 0 };
            (shape, content, (frames, Arc::new(cut(spec, signal, frames))))
        })?;
        let (mut shapes, mut cuts, mut all) = (BTreeMap::new(), BTreeMap::new(), 0);
        for (id, (shape, content, cut)) in made {
            let parts = [all, content].map(u64::to_le_bytes);
            all = seed::stable_hash(&[&parts[0], id.as_str().as_bytes(), &parts[1]]);
            shapes.insert(id.clone(), shape);
            cuts.insert(id, vec![cut]);
        }
        Ok(Self { entry: entry.clone(), shapes, content: all, cuts: Mutex::new(cuts) })
    }

    /// The trial as bytes, for a cache; `None` if positions are drawn for each pair of trials, since
    /// the bytes would then be as large as the recording.
    pub(in crate::recognise) fn encode(&self) -> Option<Vec<u8>> {
        let cuts = self.lock();
        let mut sources = Vec::new();
        for (id, shape) in &self.shapes {
            let (_, cut) = cuts.get(id)?.first()?;
            sources.push((id, shape, cut.sets.iter().map(|set| &**set).collect::<Vec<_>>()));
        }
        let sampled = sources.iter().all(|(_, _, sets)| !sets.is_empty());
        sampled.then(|| postcard::to_allocvec(&sources).ok())?
    }

    /// Decodes the bytes of `encode` for the trial of an entry; `None` if they are not valid.
    pub(in crate::recognise) fn decode(entry: &Entry, bytes: &[u8]) -> Option<Self> {
        let sources: Vec<StoredSource> = postcard::from_bytes(bytes).ok()?;
        let (mut shapes, mut cuts) = (BTreeMap::new(), BTreeMap::new());
        for (id, shape, mut sets) in sources {
            if !sets.iter_mut().all(SampleSet::complete) {
                return None;
            }
            let frames = shape.map_or(0, |(_, frames)| frames);
            let sets = sets.into_iter().map(Arc::new).collect();
            shapes.insert(id.clone(), shape);
            cuts.insert(id, vec![(frames, Arc::new(SampledSource { sets, domain: None }))]);
        }
        Some(Self { entry: entry.clone(), shapes, content: 0, cuts: Mutex::new(cuts) })
    }

    pub fn key(&self) -> &TrialKey {
        &self.entry.key
    }

    /// Hash of all raw samples (0 unless `hashed`). It seeds the draws for a pair of trials, so that
    /// the draws depend neither on names nor on order.
    pub(super) fn content(&self) -> u64 {
        self.content
    }

    fn rate_hz(&self, id: &SourceId) -> Option<f64> {
        self.shapes.get(id)?.map(|(rate_hz, _)| rate_hz)
    }

    /// Number of frames of a source that both trials have: that of the shorter trial; 0 for images;
    /// `None` if a trial lacks the source.
    pub(super) fn common_frames(&self, other: &Self, id: &SourceId) -> Option<usize> {
        match (self.shapes.get(id)?, other.shapes.get(id)?) {
            (Some((_, mine)), Some((_, others))) => Some(*mine.min(others)),
            _ => Some(0),
        }
    }

    /// The source cut to `frames` frames: from memory, or by loading the trial and calling `cut`.
    pub(super) fn at_length(
        &self,
        id: &SourceId,
        frames: usize,
        cut: impl Fn(&Signal) -> SampledSource,
    ) -> Result<Arc<SampledSource>, RecogniseError> {
        if let Some(cuts) = self.lock().get(id)
            && let Some((_, cut)) = cuts.iter().find(|(at, _)| *at == frames)
        {
            return Ok(cut.clone());
        }
        let trial = self.entry.load()?;
        let made = Arc::new(cut(&trial.signals[id]));
        let mut cuts = self.lock();
        let kept = cuts.entry(id.clone()).or_default();
        // Another thread may have made the same cut meanwhile. Waiting for that thread could last for
        // ever: its parallel work may run a task that waits for this very cut.
        if !kept.iter().any(|(at, _)| *at == frames) {
            if kept.len() > KEPT_LENGTHS {
                kept.remove(1);
            }
            kept.push((frames, made.clone()));
        }
        Ok(made)
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, SampledSources> {
        // If a thread panicked while it held the lock, at most one cut was not saved.
        self.cuts.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The sources that a query shares with a library, sorted by name.
///
/// # Errors
/// If there is no shared source, or if a shared source has different rates.
pub fn shared_sources<'a>(
    scene: &'a Scene,
    query: &PreparedTrial,
    library: &[Arc<PreparedTrial>],
) -> Result<Vec<&'a SourceSpec>, RecogniseError> {
    let sources: Vec<&SourceSpec> = (scene.sources())
        .filter(|s| query.shapes.contains_key(&s.id))
        .filter(|s| library.iter().any(|trial| trial.shapes.contains_key(&s.id)))
        .collect();
    if sources.is_empty() {
        let of_library = library.iter().flat_map(|trial| trial.shapes.keys());
        return Err(nothing_in_common(query.shapes.keys(), of_library));
    }
    for spec in &sources {
        let Some(query_hz) = query.rate_hz(&spec.id) else { continue };
        for trial in library {
            if let Some(library_hz) = trial.rate_hz(&spec.id)
                && library_hz != query_hz
            {
                return Err(RecogniseError::Rates {
                    source_name: spec.id.clone(),
                    query_hz,
                    library_hz,
                    trial: trial.entry.key.to_string(),
                });
            }
        }
    }
    Ok(sources)
}
