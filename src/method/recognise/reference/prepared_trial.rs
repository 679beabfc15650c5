//! A trial prepared for the method `reference`: its sources are cut to length and sampled.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::sample_set::SampleSet;
use super::sampling::DomainSamples;
use crate::features::sources::of_known_sources;
use crate::library::Entry;
use crate::recognise::error::{RecogniseError, Result, nothing_in_common};
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

pub struct PreparedTrial {
    entry: Entry,
    sources: BTreeMap<SourceId, PreparedSource>,
    /// Hash of all raw samples (0 unless `hashed`). It seeds the draws for a pair of trials, so that
    /// the draws depend neither on names nor on order.
    pub(super) content: u64,
}

/// A source of a trial, at several lengths.
struct PreparedSource {
    /// Rate in Hz and number of frames; `None` for an image.
    series: Option<(f64, usize)>,
    /// The source cut to the lengths used so far (in frames); the trial's own length comes first.
    cuts: Mutex<Vec<(usize, Arc<SampledSource>)>>,
}

impl PreparedSource {
    fn new(series: Option<(f64, usize)>, whole: SampledSource) -> Self {
        let frames = series.map_or(0, |(_, frames)| frames);
        Self { series, cuts: Mutex::new(vec![(frames, Arc::new(whole))]) }
    }

    fn lock(&self) -> MutexGuard<'_, Vec<(usize, Arc<SampledSource>)>> {
        // If a thread panicked while it held the lock, at most one cut was not saved.
        self.cuts.lock().unwrap_or_else(PoisonError::into_inner)
    }
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
    ) -> Result<Self> {
        let made = of_known_sources(&entry.key, trial, scene, |spec, signal| {
            let series = match signal {
                Signal::Image(_) => None,
                Signal::Series(series) => Some((series.rate_hz(), series.frames())),
            };
            let content = if hashed { signal.content_hash() } else { 0 };
            let whole = cut(spec, signal, series.map_or(0, |(_, frames)| frames));
            (content, PreparedSource::new(series, whole))
        })?;
        let (mut sources, mut all) = (BTreeMap::new(), 0);
        for (id, (content, source)) in made {
            let parts = [all, content].map(u64::to_le_bytes);
            all = seed::stable_hash(&[&parts[0], id.as_str().as_bytes(), &parts[1]]);
            sources.insert(id, source);
        }
        Ok(Self { entry: entry.clone(), sources, content: all })
    }

    /// The trial as bytes, for a cache; `None` if positions are drawn for each pair of trials, since
    /// the bytes would then be as large as the recording.
    pub(in crate::recognise) fn encode(&self) -> Option<Vec<u8>> {
        let whole = |source: &PreparedSource| Some(source.lock().first()?.1.clone());
        let wholes: Vec<_> = self.sources.values().map(whole).collect::<Option<_>>()?;
        let stored = self.sources.iter().zip(&wholes).map(|((id, source), whole)| {
            let sets = whole.sets.iter().map(|set| &**set).collect::<Vec<_>>();
            (!sets.is_empty()).then_some((id, source.series, sets))
        });
        postcard::to_allocvec(&stored.collect::<Option<Vec<_>>>()?).ok()
    }

    /// Decodes the bytes of `encode` for the trial of an entry; `None` if they are not valid.
    pub(in crate::recognise) fn decode(entry: &Entry, bytes: &[u8]) -> Option<Self> {
        let stored: Vec<StoredSource> = postcard::from_bytes(bytes).ok()?;
        let source = |(id, series, mut sets): StoredSource| {
            let is_sound = sets.iter_mut().all(SampleSet::complete);
            let sets = sets.into_iter().map(Arc::new).collect();
            let whole = SampledSource { sets, domain: None };
            is_sound.then(|| (id, PreparedSource::new(series, whole)))
        };
        let sources = stored.into_iter().map(source).collect::<Option<_>>()?;
        Some(Self { entry: entry.clone(), sources, content: 0 })
    }

    pub fn key(&self) -> &TrialKey {
        &self.entry.key
    }

    fn rate_hz(&self, id: &SourceId) -> Option<f64> {
        self.sources.get(id)?.series.map(|(rate_hz, _)| rate_hz)
    }

    /// Number of frames of a source that both trials have: that of the shorter trial; 0 for images;
    /// `None` if a trial lacks the source.
    pub(super) fn common_frames(&self, other: &Self, id: &SourceId) -> Option<usize> {
        match (self.sources.get(id)?.series, other.sources.get(id)?.series) {
            (Some((_, mine)), Some((_, others))) => Some(mine.min(others)),
            _ => Some(0),
        }
    }

    /// The source cut to `frames` frames: from memory, or by loading the trial and calling `cut`.
    pub(super) fn at_length(
        &self,
        id: &SourceId,
        frames: usize,
        cut: impl Fn(&Signal) -> SampledSource,
    ) -> Result<Arc<SampledSource>> {
        let source = &self.sources[id];
        if let Some((_, cut)) = source.lock().iter().find(|(at, _)| *at == frames) {
            return Ok(cut.clone());
        }
        let trial = self.entry.load()?;
        let made = Arc::new(cut(&trial.signals[id]));
        let mut kept = source.lock();
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
}

/// The sources that a query shares with a library, sorted by name.
///
/// # Errors
/// If there is no shared source, or if a shared source has different rates.
pub(crate) fn shared_sources<'a>(
    scene: &'a Scene,
    query: &PreparedTrial,
    library: &[Arc<PreparedTrial>],
) -> Result<Vec<&'a SourceSpec>> {
    let sources: Vec<&SourceSpec> = (scene.sources())
        .filter(|s| query.sources.contains_key(&s.id))
        .filter(|s| library.iter().any(|trial| trial.sources.contains_key(&s.id)))
        .collect();
    if sources.is_empty() {
        let of_library = library.iter().flat_map(|trial| trial.sources.keys());
        return Err(nothing_in_common(query.sources.keys(), of_library));
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
