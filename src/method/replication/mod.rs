//! Repeats the paper's evaluation (Tables I and II, and numbers in its text), and compares results.
//!
//! A *stream* is a source sampled in one of several ways, such as in time or in the spectrum. A
//! *shard* is a part of the queries, so that several machines can share a run.
//!
//! ```text
//! rows (settings, published figures) ─► work (scores of each stream, once) ─► part of a run
//! parts of a run split by query ─► merge ─► report (products of sources), figures
//! ```
//!
//! `work` processes one shard, `merge` joins shards. A report holds no timings, so it is the same,
//! byte for byte, from one shard or from many.

mod figure;
mod report;
mod rows;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

pub use self::figure::{bars, confusion};
use self::report::{LogScores, RowPart, nearest};
pub use self::report::{PaperPart, PaperReport, ReportRow, Shard, merge};
pub use self::rows::{ALL, rows};
use self::rows::{Row, SampledSource};
use crate::evaluate::{EvaluateError, Evaluation, Fold, ProgressFn, folds};
use crate::library::{Entry, Library};
use crate::recognise::{Model, Reference, ReferenceOptions};
use crate::trial::{EXPERT, TrialKey};

/// ln of the scores of each stream, for each query.
type StreamScores = BTreeMap<SampledSource, BTreeMap<usize, LogScores>>;

/// Names the queries of a shard in all settings of the paper.
///
/// Streams are prepared and compared one after the other. Only the scores stay in memory: 8 bytes for
/// each combination of query, library trial and stream, or 0.8 GB if all of LMT108 is one shard.
///
/// # Errors
/// If a trial cannot be read or compared. Missing data are no error: the setting's result names them.
pub fn work(
    library: &Library,
    options: &ReferenceOptions,
    shard: Shard,
    progress: ProgressFn<'_>,
) -> Result<PaperPart, EvaluateError> {
    let run = PaperRun::new(library, options, shard);
    let terms = run.plans.iter().flat_map(|plan| &plan.terms);
    let streams: BTreeSet<SampledSource> = terms.map(|(_, stream)| *stream).collect();
    let mut scores = StreamScores::new();
    for (done, stream) in streams.iter().enumerate() {
        progress("comparing source by source", done, streams.len());
        scores.insert(*stream, run.score(*stream)?);
    }
    progress("comparing source by source", streams.len(), streams.len());
    Ok(run.part(&scores))
}

/// The result of [`work`] without the answers. It tells whether shards belong to the same run.
pub fn work_head(library: &Library, options: &ReferenceOptions, shard: Shard) -> PaperPart {
    PaperRun::new(library, options, shard).part(&StreamScores::new())
}

/// The data and settings of a shard; entries are sorted by key, since a tie goes to the smaller key.
struct PaperRun<'a> {
    library: &'a Library,
    options: ReferenceOptions,
    shard: Shard,
    entries: Vec<Entry>,
    keys: Vec<TrialKey>,
    plans: Vec<PaperPlan>,
}

impl<'a> PaperRun<'a> {
    fn new(library: &'a Library, options: &ReferenceOptions, shard: Shard) -> Self {
        let mut entries = library.entries.clone();
        entries.sort_by(|a, b| a.key.cmp(&b.key));
        let keys = entries.iter().map(|entry| entry.key.clone()).collect();
        let plans = rows().into_iter().map(|row| PaperPlan::new(row, library, &entries)).collect();
        // Every score is needed, so no candidate may be dropped early.
        let options = ReferenceOptions { neighbours: 1, halving: Vec::new(), ..options.clone() };
        Self { library, options, shard, entries, keys, plans }
    }

    fn part(&self, scores: &StreamScores) -> PaperPart {
        let ReferenceOptions { samples, repetitions, positions, seed, precision, tabulate, .. } =
            &self.options;
        let settings = format!(
            "n = {samples}, R = {repetitions}, positions {positions:?}, seed {seed}, sums \
             {precision:?}, tables {tabulate}"
        );
        let trial = |key: &TrialKey| (key.surface.clone(), key.user.clone(), key.number);
        PaperPart {
            format: 2,
            data: self.library.name.clone(),
            synthetic: self.library.synthetic,
            settings,
            seed: *seed,
            library: String::new(),
            shard: self.shard,
            rows: self.plans.iter().map(|plan| self.answers(plan, scores)).collect(),
            trials: self.keys.iter().map(trial).collect(),
        }
    }

    fn answers(&self, plan: &PaperPlan, scores: &StreamScores) -> RowPart {
        let keys = &self.keys;
        let mut answers = Vec::new();
        for (at, fold) in plan.folds.iter().enumerate() {
            for &query in fold.queries.iter().filter(|&&query| self.shard.has(query)) {
                let terms: Vec<(f64, &LogScores)> = (plan.terms.iter())
                    .filter_map(|(weight, s)| Some((*weight, scores.get(s)?.get(&query)?)))
                    .collect();
                if let Some(answer) = nearest(&fold.library, &terms, keys) {
                    answers.push((at, query, answer));
                }
            }
        }
        answers.sort_unstable();
        let labels: BTreeSet<&str> = (plan.folds.iter())
            .flat_map(|fold| fold.library.iter().map(|&at| keys[at].surface.as_str()))
            .collect();
        let Row { place, name, protocol, .. } = &plan.row;
        RowPart {
            setting: format!("{place} · {} · {name}", protocol.name()),
            missing: plan.missing.clone(),
            not_run: plan.not_run.clone(),
            folds: plan.folds.iter().map(|fold| fold.name.clone()).collect(),
            library_trials: plan.folds.iter().map(|fold| fold.library.len()).max().unwrap_or(0),
            labels: labels.into_iter().map(String::from).collect(),
            answers,
        }
    }

    /// The pairs of trials that the settings compare in a stream, as folds, where `has` is true of both.
    fn wanted(&self, stream: SampledSource, has: impl Fn(&&usize) -> bool) -> Vec<Fold> {
        let with_stream =
            self.plans.iter().filter(|plan| plan.terms.iter().any(|(_, s)| *s == stream));
        // A set, since most settings have the same folds.
        let folds: BTreeSet<(&[usize], &[usize])> = (with_stream.flat_map(|plan| &plan.folds))
            .map(|fold| (&*fold.library, &*fold.queries))
            .collect();
        let mut libraries: BTreeMap<usize, BTreeSet<usize>> = BTreeMap::new();
        for (library, queries) in folds {
            for &query in queries.iter().filter(|query| self.shard.has(**query) && has(query)) {
                libraries.entry(query).or_default().extend(library.iter().filter(&has));
            }
        }
        let mut groups: BTreeMap<BTreeSet<usize>, Vec<usize>> = BTreeMap::new();
        for (query, library) in libraries.into_iter().filter(|(_, library)| library.len() >= 2) {
            groups.entry(library).or_default().push(query);
        }
        let fold = |(library, queries): (BTreeSet<usize>, _)| Fold {
            name: String::new(),
            library: library.into_iter().collect(),
            queries,
        };
        groups.into_iter().map(fold).collect()
    }

    fn score(&self, stream: SampledSource) -> Result<BTreeMap<usize, LogScores>, EvaluateError> {
        let mut scores = BTreeMap::new();
        let Some(scene) = stream.scene(&self.library.scene) else { return Ok(scores) };
        let own: Vec<_> = self.entries.iter().map(|entry| stream.entry(entry, &scene)).collect();
        let folds = self.wanted(stream, |at| !own[**at].sources.is_empty());
        let method = Reference::new(scene.clone(), self.options.clone());
        let run = Evaluation::new(&scene, &own, &folds).prepare(&method)?;
        for fold in &folds {
            let prepared = fold.library.iter().filter_map(|&i| run.library.trials[i].clone());
            let model = Arc::new(method.model(&prepared.collect::<Vec<_>>())?);
            let any: Arc<dyn Model> = model.clone();
            let library: Arc<[usize]> = fold.library.clone().into();
            for &query in &fold.queries {
                // The scene has one source, which is compared even if its sensor is dead.
                let values = model.log_scores(&run.query(&any, query, None)?.prepared)?;
                let values = values.into_iter().map(|score| score.unwrap_or(f64::NAN)).collect();
                scores.insert(query, LogScores { library: Arc::clone(&library), values });
            }
        }
        Ok(scores)
    }
}

/// A setting of the paper, with the streams and folds that the library has data for.
struct PaperPlan {
    row: Row,
    terms: Vec<(f64, SampledSource)>,
    missing: Vec<String>,
    folds: Vec<Fold>,
    not_run: Option<String>,
}

impl PaperPlan {
    fn new(row: Row, library: &Library, entries: &[Entry]) -> Self {
        let has = |entry: &Entry, stream: &SampledSource| {
            entry.sources.iter().any(|id| id.as_str() == stream.source)
        };
        let (terms, lacking): (Vec<_>, Vec<_>) = row.terms.iter().copied().partition(|(_, s)| {
            s.scene(&library.scene).is_some() && entries.iter().any(|entry| has(entry, s))
        });
        let mut missing: Vec<String> = lacking.iter().map(|(_, s)| s.source.to_string()).collect();
        missing.dedup();
        let used: Vec<usize> = (0..entries.len())
            .filter(|&at| terms.iter().any(|(_, stream)| has(&entries[at], stream)))
            .collect();
        let keys: Vec<TrialKey> = used.iter().map(|&at| entries[at].key.clone()).collect();
        let found = match terms.is_empty() {
            true => Err(format!("the data lack {}", missing.join(", "))),
            false => folds(row.protocol, &keys).map_err(|error| error.to_string()),
        };
        // In the paper, the expert is in every library.
        let found = found.map(|mut folds| {
            folds.retain(|fold| fold.name != EXPERT);
            folds
        });
        let not_run = found.as_ref().err().cloned();
        let back = |of: Vec<usize>| of.into_iter().map(|at| used[at]).collect();
        let fold = |Fold { name, library, queries }: Fold| Fold {
            name,
            library: back(library),
            queries: back(queries),
        };
        let folds = found.into_iter().flatten().map(fold).collect();
        Self { row, terms, missing, folds, not_run }
    }
}
