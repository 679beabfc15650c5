//! Embeds every query of every fold once, so that any subset of its sources can then name it.

use std::sync::Arc;

use rayon::prelude::*;

use crate::evaluate::{EvaluateError, Evaluation, Fold, ProgressFn, Run};
use crate::library::Entry;
use crate::recognise::{MethodName, MethodSpec, Model, QueryVector, RecogniseError};
use crate::scene::{Phase, Scene, SourceId};
use crate::trial::{Image, Signal, Trial};

/// Most queries for the median latency of a source.
const TIMED: usize = 15;

/// The cost of one source.
#[derive(Clone, Debug)]
pub(super) struct StudiedSource {
    pub id: SourceId,
    pub phase: Phase,
    /// Length of a whole recording in seconds; 0 for pictures.
    pub whole_s: f64,
    /// Number of values in a whole recording.
    pub values: f64,
    /// Median time to compare this source alone, in milliseconds.
    pub latency_ms: f64,
}

impl StudiedSource {
    /// How long a scan must last to record this source, in seconds; `time` limits the drag.
    pub fn scan_s(&self, time: Option<f64>) -> f64 {
        match (self.phase, time) {
            (Phase::Drag, Some(time)) => time.min(self.whole_s),
            _ => self.whole_s,
        }
    }

    /// Number of values to process.
    pub fn work(&self, time: Option<f64>) -> f64 {
        if self.whole_s > 0.0 {
            self.values * self.scan_s(time) / self.whole_s
        } else {
            self.values
        }
    }
}

/// One query: its true surface, and its embedding by source; `None` if it holds too little.
struct StudyQuery {
    truth: String,
    by_sources: Option<QueryVector>,
}

impl StudyQuery {
    fn new(
        run: &Run<'_, '_>,
        model: &Arc<dyn Model>,
        trial: &Trial,
    ) -> Result<Self, RecogniseError> {
        let query = run.query_of(model, trial.clone(), None)?;
        let embedding = model.clone().embedding();
        let by_sources = match embedding.map(|model| model.by_sources(&query.prepared)).transpose()
        {
            Err(RecogniseError::TooLittle) => None,
            other => other?,
        };
        Ok(Self { truth: trial.key.surface.clone(), by_sources })
    }
}

/// The costs of all sources, and all queries.
pub(super) struct Study {
    pub sources: Vec<StudiedSource>,
    queries: Vec<StudyQuery>,
}

impl Study {
    pub fn new(
        scene: &Scene,
        entries: &[Entry],
        folds: &[Fold],
        progress: ProgressFn<'_>,
    ) -> Result<Self, EvaluateError> {
        let method = MethodSpec::from(MethodName::Embedding).build(scene);
        let evaluation = Evaluation { progress, ..Evaluation::new(scene, entries, folds) };
        let run = evaluation.prepare(&*method)?;
        let mut sources = studied(scene, entries)?;
        let total = folds.iter().map(|fold| fold.queries.len()).sum();
        let mut queries = Vec::with_capacity(total);
        let mut latencies: Vec<Vec<f64>> = vec![Vec::new(); sources.len()];
        for fold in folds {
            let model = run.fit(&fold.library)?;
            for &i in &fold.queries {
                let trial = run.recording(i)?;
                queries.push(StudyQuery::new(&run, &model, &trial)?);
                if queries.len() <= TIMED {
                    for (source, latencies) in sources.iter().zip(&mut latencies) {
                        latencies.extend(time_alone(&run, &model, &trial, &source.id));
                    }
                }
                progress("trying sources", queries.len(), total);
            }
        }
        for (source, latencies) in sources.iter_mut().zip(&mut latencies) {
            latencies.sort_by(f64::total_cmp);
            source.latency_ms = latencies.get(latencies.len() / 2).copied().unwrap_or(0.0);
        }
        Ok(Self { sources, queries })
    }

    /// Number of queries.
    pub fn queries(&self) -> usize {
        self.queries.len()
    }

    /// How many queries some sources, given by index, name correctly from whole scans: as many as
    /// `embedding` with these sources alone.
    pub fn right(&self, sources: &[usize]) -> usize {
        let ids: Vec<&SourceId> = sources.iter().map(|&s| &self.sources[s].id).collect();
        let is_right = |query: &&StudyQuery| {
            let named = query.by_sources.as_ref().and_then(|query| query.surface(&ids));
            named == Some(query.truth.as_str())
        };
        self.queries.par_iter().filter(is_right).count()
    }
}

/// Milliseconds from the raw samples of one source to the answer of this source alone.
fn time_alone(
    run: &Run<'_, '_>,
    model: &Arc<dyn Model>,
    trial: &Trial,
    id: &SourceId,
) -> Option<f64> {
    let signal = trial.signals.get(id)?.clone();
    let alone = Trial { key: trial.key.clone(), signals: [(id.clone(), signal)].into() };
    let query = run.query_of(model, alone, None).ok()?;
    model.rank(&query.prepared).ok()?;
    Some(query.started.elapsed().as_secs_f64() * 1e3)
}

/// The sources that some trial has, each measured on the first such trial.
fn studied(scene: &Scene, entries: &[Entry]) -> Result<Vec<StudiedSource>, RecogniseError> {
    let mut sources = Vec::new();
    for spec in scene.sources() {
        let Some(entry) = entries.iter().find(|entry| entry.sources.contains(&spec.id)) else {
            continue;
        };
        let alone = scene.clone().only(std::slice::from_ref(&spec.id));
        // The scene has this source, so this always succeeds.
        let Ok(alone) = alone else { continue };
        let trial = entry.clone().within(&alone).load()?;
        let (whole_s, values) = match trial.signals.get(&spec.id) {
            Some(Signal::Series(series)) => (series.duration_s(), series.samples().len()),
            Some(Signal::Image(_)) => (0.0, Image::ROWS * Image::COLS * 3),
            None => continue,
        };
        sources.push(StudiedSource {
            id: spec.id.clone(),
            phase: spec.phase,
            whole_s,
            values: values as f64,
            latency_ms: 0.0,
        });
    }
    Ok(sources)
}
