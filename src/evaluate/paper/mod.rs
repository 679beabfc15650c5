//! Repeats the paper's evaluation (Tables I and II, and numbers in its text), and compares results.
//!
//! A *stream* is a source sampled in one of several ways, such as in time or in the spectrum. A
//! *shard* is a part of the queries, so that several machines can share a run.
//!
//! ```text
//! rows (settings, published figures) ─► work (scores of each stream, once) ─► part
//! parts of a run split by query ─► merge ─► report (products of sources), figures
//! ```
//!
//! `work` processes one shard, `merge` joins shards. A report holds no timings, so it is the same,
//! byte for byte, from one shard or from many.

mod figure;
mod part;
mod report;
mod rows;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

pub(crate) use self::figure::{bars, confusion};
use self::part::RowPart;
pub(crate) use self::part::{PaperPart, Shard, merge};
use self::report::{LogScores, nearest};
pub(crate) use self::report::{PaperReport, ReportRow};
pub use self::rows::{ALL, rows};
use self::rows::{Row, SampledSource};
use crate::evaluate::{EvaluateError, Evaluation, Fold, ProgressFn, folds};
use crate::library::{Entry, Library};
use crate::recognise::{Model, Reference, ReferenceOptions};
use crate::trial::TrialKey;

/// Names the queries of a shard in all settings of the paper.
///
/// Streams are prepared and compared one after the other. Only the scores stay in memory: 8 bytes for
/// each combination of query, library trial and stream, or 0.8 GB if all of LMT108 is one shard.
///
/// # Errors
/// If a trial cannot be read or compared. Missing data are no error: the setting's result names them.
pub(crate) fn work(
    library: &Library,
    options: &ReferenceOptions,
    shard: Shard,
    progress: ProgressFn<'_>,
) -> Result<PaperPart, EvaluateError> {
    let entries = in_order(library);
    let keys: Vec<TrialKey> = entries.iter().map(|entry| entry.key.clone()).collect();
    let plans = plans(library, &entries);
    let streams: BTreeSet<SampledSource> =
        plans.iter().flat_map(|plan| plan.terms.iter().map(|(_, stream)| *stream)).collect();
    let mut scores: BTreeMap<SampledSource, BTreeMap<usize, LogScores>> = BTreeMap::new();
    // Every score is needed, so no candidate may be dropped early.
    let options = ReferenceOptions { neighbours: 1, halving: Vec::new(), ..options.clone() };
    for (done, stream) in streams.iter().enumerate() {
        progress("comparing source by source", done, streams.len());
        scores.insert(*stream, score(*stream, library, &entries, (&plans, shard), &options)?);
    }
    progress("comparing source by source", streams.len(), streams.len());

    Ok(part(library, &options, shard, keys, &plans, &scores))
}

/// The result of [`work`] without the answers. It tells whether shards belong to the same run.
pub(crate) fn work_head(library: &Library, options: &ReferenceOptions, shard: Shard) -> PaperPart {
    let entries = in_order(library);
    let keys = entries.iter().map(|entry| entry.key.clone()).collect();
    part(library, options, shard, keys, &plans(library, &entries), &BTreeMap::new())
}

/// The entries sorted by key, since a tie goes to the smaller key.
fn in_order(library: &Library) -> Vec<Entry> {
    let mut entries = library.entries.clone();
    entries.sort_by(|a, b| a.key.cmp(&b.key));
    entries
}

fn plans(library: &Library, entries: &[Entry]) -> Vec<PaperPlan> {
    rows().into_iter().map(|row| PaperPlan::new(row, library, entries)).collect()
}

fn part(
    library: &Library,
    options: &ReferenceOptions,
    shard: Shard,
    keys: Vec<TrialKey>,
    plans: &[PaperPlan],
    scores: &BTreeMap<SampledSource, BTreeMap<usize, LogScores>>,
) -> PaperPart {
    let ReferenceOptions { samples, repetitions, positions, seed, precision, tabulate, .. } =
        options;
    let settings = format!(
        "n = {samples}, R = {repetitions}, positions {positions:?}, seed {seed}, sums {precision:?}, \
         tables {tabulate}"
    );
    PaperPart {
        format: 1,
        data: library.name.clone(),
        synthetic: library.synthetic,
        settings,
        shard,
        rows: plans.iter().map(|plan| plan.answers(scores, &keys, shard)).collect(),
        trials: keys.into_iter().map(|key| (key.surface, key.user, key.number)).collect(),
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

    fn answers(
        &self,
        scores: &BTreeMap<SampledSource, BTreeMap<usize, LogScores>>,
        keys: &[TrialKey],
        shard: Shard,
    ) -> RowPart {
        let mut answers = Vec::new();
        for (at, fold) in self.folds.iter().enumerate() {
            for &query in fold.queries.iter().filter(|&&query| shard.has(query)) {
                let terms: Vec<(f64, &LogScores)> = (self.terms.iter())
                    .filter_map(|(weight, s)| Some((*weight, scores.get(s)?.get(&query)?)))
                    .collect();
                if let Some(answer) = nearest(&fold.library, &terms, keys) {
                    answers.push((at, query, answer));
                }
            }
        }
        answers.sort_unstable();
        let labels: BTreeSet<&str> = (self.folds.iter())
            .flat_map(|fold| fold.library.iter().map(|&at| keys[at].surface.as_str()))
            .collect();
        let Row { place, name, protocol, .. } = &self.row;
        RowPart {
            setting: format!("{place} · {} · {name}", protocol.name()),
            missing: self.missing.clone(),
            not_run: self.not_run.clone(),
            folds: self.folds.iter().map(|fold| fold.name.clone()).collect(),
            library_trials: self.folds.iter().map(|fold| fold.library.len()).max().unwrap_or(0),
            labels: labels.into_iter().map(String::from).collect(),
            answers,
        }
    }
}

/// The pairs of trials that the settings compare in a stream, as folds of queries and library
/// trials. Includes only trials for which `has` is true.
fn wanted(
    plans: &[PaperPlan],
    stream: SampledSource,
    shard: Shard,
    has: impl Fn(&&usize) -> bool,
) -> Vec<Fold> {
    let with_stream = plans.iter().filter(|plan| plan.terms.iter().any(|(_, s)| *s == stream));
    // A set, since most settings have the same folds.
    let folds: BTreeSet<(&[usize], &[usize])> = (with_stream.flat_map(|plan| &plan.folds))
        .map(|fold| (&*fold.library, &*fold.queries))
        .collect();
    let mut libraries: BTreeMap<usize, BTreeSet<usize>> = BTreeMap::new();
    for (library, queries) in folds {
        for &query in queries.iter().filter(|query| shard.has(**query) && has(query)) {
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

/// ln of the scores of one stream, for each query.
fn score(
    stream: SampledSource,
    library: &Library,
    entries: &[Entry],
    (plans, shard): (&[PaperPlan], Shard),
    options: &ReferenceOptions,
) -> Result<BTreeMap<usize, LogScores>, EvaluateError> {
    let mut scores = BTreeMap::new();
    let Some(scene) = stream.scene(&library.scene) else { return Ok(scores) };
    let own: Vec<Entry> = entries.iter().map(|entry| stream.entry(entry, &scene)).collect();
    let folds = wanted(plans, stream, shard, |at| !own[**at].sources.is_empty());
    let method = Reference::new(scene.clone(), options.clone());
    let run = Evaluation::new(&scene, &own, &folds).prepare(&method)?;
    for fold in &folds {
        let model = Arc::new(method.model(&run.prepared(&fold.library))?);
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
