//! The plan of a scene: the cheapest setting that names its surfaces well enough.
//!
//! A scene of five surfaces needs less than a scene of a hundred. [`search()`] cross-validates
//! within the library and returns a [`Plan`]: sources, method and scan time. Cheapest means fewest
//! sources, then least scan time, then fewest samples to process. These costs are counted, not
//! timed, so that the same library gives the same plan. The search compares by `embedding`: a
//! distance is a sum over sources, so distances of single sources give those of all sets of
//! sources. The scan time is computed as in all commands ([`crate::recognise::LeftOutAccuracy`]),
//! and the plan's expected accuracy is measured at that scan time. The search never changes weights
//! of sources. Plans of version 0.2 that name `reference` can still be read.
//!
//! A set of sources reaches the target accuracy if its posterior median accuracy under Jeffreys'
//! prior does. With too few queries for that, all queries must be named correctly. Whether the plan
//! reaches its target follows from the accuracies that it states: of whole scans, and at its scan time.
//! A plan says that its target is not shown if the 95 % interval of the accuracy begins below it. The
//! accuracy of the best of several settings looks too good; the interval does not cover this.
//!
//! # Results
//! For a target of 99 %, one source is enough in every library with a camera or a microphone that
//! was tried. Without its camera, the synthetic scene of 108 surfaces needs several sources;
//! `tests/it/plan.rs` checks their accuracy.

mod file;

use rayon::prelude::*;
use serde::Serialize;

pub use self::file::{Expected, Plan};
use crate::evaluate::{
    EvaluateError, Evaluation, Fold, Interval, Leaks, Outcome, ProgressFn, Protocol, Share, folds,
    percentile, within,
};
use crate::library::{Entry, Library};
use crate::recognise::{
    FollowOptions, MethodName, MethodSpec, QueryVector, RecogniseError, ScanTime, if_enough,
    reaches, ready_model,
};
use crate::scene::{Phase, Scene, SourceId};
use crate::trial::{Image, Signal, Trial, TrialKey};

/// The accuracy that a plan must reach, and the folds that measure it.
#[derive(Clone, Copy, Debug)]
pub struct PlanOptions {
    /// The accuracy that whole scans of the chosen sources must reach, a fraction.
    pub target: f64,
    /// The accuracy that scans of the planned time must reach; `None` allows at most one percentage
    /// point less than from whole scans.
    pub accuracy: Option<f64>,
    pub protocol: Protocol,
}

impl PlanOptions {
    /// Whether the accuracies of whole scans and at the scan time are those that were wanted.
    fn reached(self, whole: f64, at_time: f64) -> bool {
        let wanted = self.accuracy.unwrap_or(whole - FollowOptions::default().loss);
        whole >= self.target && at_time >= wanted - 1e-9
    }
}

/// The cost of one source, and the accuracy when this source is used alone.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SourceCost {
    pub source: SourceId,
    /// Median time to compare this source alone with the library by `embedding`, in milliseconds.
    pub latency_ms: f64,
    /// Length of a whole recording, in seconds; 0 for pictures.
    pub scan_s: f64,
    pub values: f64,
    /// Share of queries that this source alone names correctly, by `embedding`.
    pub accuracy: f64,
    #[serde(skip)]
    phase: Phase,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Planned {
    pub plan: Plan,
    /// All sources, the cheapest first.
    pub sources: Vec<SourceCost>,
    pub steps: Vec<String>,
}

pub fn search(
    library: &Library,
    options: PlanOptions,
    progress: ProgressFn<'_>,
) -> Result<Planned, EvaluateError> {
    let PlanOptions { target, accuracy, protocol } = options;
    let entries = within(&library.entries, &library.scene);
    let keys: Vec<TrialKey> = entries.iter().map(|entry| entry.key.clone()).collect();
    let leaks = Leaks::of(&entries, progress);
    let folds = folds(protocol, &keys)?;
    let folds = leaks.apart(&folds, &keys).unwrap_or(folds);
    // Finds how long scans of these sources must last, by leaving out trials of the library.
    let scan_time = |sources: &[SourceId]| -> Option<ScanTime> {
        let scene = library.scene.clone().only(sources).ok()?;
        let entries = within(&entries, &scene);
        let method = MethodSpec::from(MethodName::Embedding).build(&scene);
        let all = (0..entries.len()).collect();
        let step = |done, of| progress("finding the scan time", done, of);
        let ready = ready_model(&*method, &entries, &all, None, &step).ok()?;
        ready.model.scan_time(accuracy)
    };
    let (sources, queries) = study(&library.scene, &entries, &folds, progress)?;
    let scan_time = &scan_time;
    let mut search = PlanSearch { sources, queries, target, scan_time, steps: Vec::new() };
    let choice = search.choose();
    let sources = search.ids(&choice.sources);
    let found = search.scan_time(&choice.sources);
    let scan_s = found.as_ref().and_then(ScanTime::scan_s);
    let scene = library.scene.clone().only(&sources)?;
    let (whole, outcome) = outcomes(&scene, &entries, (protocol, &leaks), scan_s, progress)?;
    let accuracy_whole = whole.share.value();
    let Share { right, of } = outcome.share;
    search.steps.extend(found.as_ref().map(ScanTime::line));
    search.steps.extend(scan_s.map(|s| format!("a scan of {s:.1} s: {right} of {of} right")));
    let Interval { low: accuracy_low, high: accuracy_high, .. } =
        Interval::of(&outcome.folds, protocol.over());
    let expected = Expected {
        target,
        reached: options.reached(accuracy_whole, outcome.share.value()),
        shown: accuracy_low >= target,
        accuracy_whole: Some(accuracy_whole),
        accuracy: outcome.share.value(),
        accuracy_low,
        accuracy_high,
        queries: of,
        surfaces: outcome.classes,
        protocol: protocol.name().into(),
        latency_ms: outcome.query_ms_p50,
        scan_s: scan_s.unwrap_or_else(|| search.scan_s(&choice.sources)),
    };
    let (method, synthetic) = (MethodName::Embedding.into(), library.synthetic);
    let library = library.name.clone();
    let plan = Plan { library, synthetic, sources, method, scan_s, expected };
    Ok(Planned { plan, sources: search.sources, steps: search.steps })
}

/// Names all queries by `embedding`, as `surfaced eval` does, from whole drags, and from the first
/// `scan_s` seconds of each; `None` for whole drags again.
fn outcomes(
    scene: &Scene,
    entries: &[Entry],
    (protocol, leaks): (Protocol, &Leaks),
    scan_s: Option<f64>,
    progress: ProgressFn<'_>,
) -> Result<(Outcome, Outcome), EvaluateError> {
    let holds = |entry: &Entry| entry.sources.iter().any(|id| scene.get(id.as_str()).is_some());
    let held: Vec<usize> = (0..entries.len()).filter(|&i| holds(&entries[i])).collect();
    let entries = within(entries, scene);
    let keys: Vec<TrialKey> = entries.iter().map(|entry| entry.key.clone()).collect();
    let folds = folds(protocol, &keys)?;
    let folds = leaks.among(&held).apart(&folds, &keys).unwrap_or(folds);
    let evaluation = Evaluation { progress, ..Evaluation::new(scene, &entries, &folds) };
    let method = MethodSpec::from(MethodName::Embedding).build(scene);
    let run = evaluation.prepare(&*method)?;
    let both = if scan_s.is_some() { &[None, scan_s][..] } else { &[None] };
    let mut measured = run.measure_by(&folds, both)?.into_iter().map(|one| one.outcome);
    // There is a result for each of the lengths.
    let whole = measured.next().expect("a result for whole drags");
    Ok((whole.clone(), measured.next().unwrap_or(whole)))
}

/// Indices of sources, and how many queries their whole scans name correctly.
#[derive(Clone, Debug, PartialEq)]
struct SourceChoice {
    sources: Vec<usize>,
    right: usize,
}

/// One query: its true surface, and its embedding by source; `None` if it holds too little data.
type StudyQuery = (String, Option<QueryVector>);

struct PlanSearch<'a> {
    /// The sources, the cheapest first.
    sources: Vec<SourceCost>,
    queries: Vec<StudyQuery>,
    target: f64,
    scan_time: &'a dyn Fn(&[SourceId]) -> Option<ScanTime>,
    steps: Vec<String>,
}

impl PlanSearch<'_> {
    fn ids(&self, sources: &[usize]) -> Vec<SourceId> {
        sources.iter().map(|&s| self.sources[s].source.clone()).collect()
    }

    /// The scan time that the sources need; `None` if none is dragged or no time can be found.
    fn scan_time(&self, sources: &[usize]) -> Option<ScanTime> {
        let is_dragged = sources.iter().any(|&s| self.sources[s].phase == Phase::Drag);
        is_dragged.then(|| (self.scan_time)(&self.ids(sources))).flatten()
    }

    fn scan_s(&self, sources: &[usize]) -> f64 {
        sources.iter().map(|&s| self.sources[s].scan_s).fold(0.0, f64::max)
    }

    fn choice(&self, sources: &[usize]) -> SourceChoice {
        let right = right(&self.sources, &self.queries, sources);
        SourceChoice { sources: sources.to_vec(), right }
    }

    fn reaches(&self, right: usize) -> bool {
        reaches(right, self.queries.len(), self.target)
    }

    fn choose(&mut self) -> SourceChoice {
        if let Some(single) = self.cheapest_single() {
            self.note(&single, "one source is enough:");
            return single;
        }
        let grown = self.grow();
        let least = if self.reaches(grown.right) { None } else { Some(grown.right) };
        self.prune(grown, least)
    }

    /// The cheapest source that reaches the target alone: the one with the least scan time or,
    /// among equals, with the fewest values to process. `None` if no source reaches the target.
    fn cheapest_single(&self) -> Option<SourceChoice> {
        let all = (0..self.sources.len()).map(|s| self.choice(&[s]));
        let enough = all.filter(|choice| self.reaches(choice.right));
        let cost = |choice: &SourceChoice| {
            let drag_s = self.scan_time(&choice.sources).and_then(|found| found.scan_s());
            self.sources[choice.sources[0]].cost(drag_s)
        };
        let costs = enough.map(|choice| (cost(&choice), choice));
        costs.min_by(|a, b| compare(a.0, b.0)).map(|(_, choice)| choice)
    }

    /// Adds one source after another, each time the one that helps most (among equals the cheapest),
    /// until the target is reached or no source helps. If the target is missed, takes all sources if
    /// they do better.
    fn grow(&mut self) -> SourceChoice {
        let all: Vec<usize> = (0..self.sources.len()).collect();
        let mut chosen = SourceChoice { sources: Vec::new(), right: 0 };
        while !self.reaches(chosen.right) {
            let others = all.iter().filter(|s| !chosen.sources.contains(s));
            let tried = others.map(|&s| self.choice(&[&chosen.sources[..], &[s]].concat()));
            // The last of the reversed list is the cheapest among equals.
            match tried.rev().max_by_key(|tried| tried.right) {
                // A plan has at least one source, even if none names a query correctly.
                Some(better) if better.right > chosen.right || chosen.sources.is_empty() => {
                    self.note(&better, "added the source that helps most:");
                    chosen = better;
                }
                _ => break,
            }
        }
        if !self.reaches(chosen.right) {
            let all = self.choice(&all);
            if all.right > chosen.right {
                self.note(&all, "all sources together do better:");
                return all;
            }
        }
        chosen
    }

    /// Removes sources that are not needed, trying the most expensive first. A source is not needed
    /// if the remaining ones still reach the target or, with `least`, name that many queries right.
    fn prune(&mut self, mut chosen: SourceChoice, least: Option<usize>) -> SourceChoice {
        for s in (0..self.sources.len()).rev() {
            let others: Vec<usize> = chosen.sources.iter().copied().filter(|o| *o != s).collect();
            if others.is_empty() || others.len() == chosen.sources.len() {
                continue;
            }
            let tried = self.choice(&others);
            if least.map_or_else(|| self.reaches(tried.right), |least| tried.right >= least) {
                self.note(&tried, &format!("{} is not needed:", self.sources[s].source));
                chosen = tried;
            }
        }
        chosen
    }

    fn note(&mut self, choice: &SourceChoice, what: &str) {
        let names = choice.sources.iter().map(|&s| self.sources[s].source.as_str());
        let names: Vec<&str> = names.collect();
        self.steps.push(format!(
            "{what} {}, {:.1} s of scan: {} of {} right",
            names.join(" + "),
            self.scan_s(&choice.sources),
            choice.right,
            self.queries.len()
        ));
    }
}

impl SourceCost {
    /// The scan time in seconds, where `drag_s` limits a drag, and the number of values to process.
    fn cost(&self, drag_s: Option<f64>) -> (f64, f64) {
        let limit_s = drag_s.filter(|_| self.phase == Phase::Drag);
        let scan_s = limit_s.map_or(self.scan_s, |limit_s| limit_s.min(self.scan_s));
        let is_picture = self.scan_s == 0.0;
        (scan_s, if is_picture { self.values } else { self.values * scan_s / self.scan_s })
    }
}

/// Orders (scan time, values to process) by scan time first.
fn compare(a: (f64, f64), b: (f64, f64)) -> std::cmp::Ordering {
    a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1))
}

/// The median latency of a source is over at most this many queries.
const TIMED: usize = 15;

/// Measures the cost of every source, and embeds every query. Returns the cheapest source first.
fn study(
    scene: &Scene,
    entries: &[Entry],
    folds: &[Fold],
    progress: ProgressFn<'_>,
) -> Result<(Vec<SourceCost>, Vec<StudyQuery>), EvaluateError> {
    let method = MethodSpec::from(MethodName::Embedding).build(scene);
    let evaluation = Evaluation { progress, ..Evaluation::new(scene, entries, folds) };
    let run = evaluation.prepare(&*method)?;
    let mut sources = studied(scene, entries)?;
    sources.sort_by(|a, b| compare(a.cost(None), b.cost(None)));
    let total = folds.iter().map(|fold| fold.queries.len()).sum();
    let mut queries: Vec<StudyQuery> = Vec::with_capacity(total);
    let mut latencies: Vec<Vec<f64>> = vec![Vec::new(); sources.len()];
    for fold in folds {
        let model = run.fit(&fold.library)?;
        let embedding = model.clone().embedding();
        for &i in &fold.queries {
            let trial = run.recording(i)?;
            let query = run.query_of(&model, trial.clone())?.prepared;
            let named = embedding.clone().map(|model| if_enough(model.by_sources(&query)));
            queries.push((trial.key.surface.clone(), named.transpose()?.flatten()));
            // Milliseconds from the raw samples of one source to its answer, if it gives one.
            let time_alone = |id: &SourceId| {
                let signals = [(id.clone(), trial.signals.get(id)?.clone())].into();
                let query = run.query_of(&model, Trial { key: trial.key.clone(), signals }).ok()?;
                model.rank(&query.prepared).ok()?;
                Some(query.started.elapsed().as_secs_f64() * 1e3)
            };
            if queries.len() <= TIMED {
                for (source, latencies) in sources.iter().zip(&mut latencies) {
                    latencies.extend(time_alone(&source.source));
                }
            }
            progress("trying sources", queries.len(), total);
        }
    }
    for (at, latencies) in latencies.into_iter().enumerate() {
        sources[at].latency_ms = percentile(latencies, 0.5);
        let right = right(&sources, &queries, &[at]);
        sources[at].accuracy = right as f64 / queries.len() as f64;
    }
    Ok((sources, queries))
}

/// How many queries the sources with indices `chosen` name correctly from whole scans, by `embedding`
/// with these sources alone.
fn right(sources: &[SourceCost], queries: &[StudyQuery], chosen: &[usize]) -> usize {
    let ids: Vec<&SourceId> = chosen.iter().map(|&s| &sources[s].source).collect();
    let is_right = |(truth, by_sources): &&StudyQuery| {
        let named = by_sources.as_ref().and_then(|query| query.surface(&ids));
        named == Some(truth.as_str())
    };
    queries.par_iter().filter(is_right).count()
}

/// The sources that at least one trial has. Scan time and values are measured on the first trial with
/// the source; latency and accuracy are still 0.
fn studied(scene: &Scene, entries: &[Entry]) -> Result<Vec<SourceCost>, RecogniseError> {
    let mut sources = Vec::new();
    for spec in scene.sources() {
        let id = &spec.id;
        let Some(entry) = entries.iter().find(|entry| entry.sources.contains(id)) else {
            continue;
        };
        let (scan_s, values) = match entry.with_only(id).load()?.signals.get(id) {
            Some(Signal::Series(series)) => (series.duration_s(), series.samples().len()),
            Some(Signal::Image(_)) => (0.0, Image::ROWS * Image::COLS * 3),
            None => continue,
        };
        let (source, values, phase) = (id.clone(), values as f64, spec.phase);
        let (latency_ms, accuracy) = (0.0, 0.0);
        sources.push(SourceCost { source, latency_ms, scan_s, values, accuracy, phase });
    }
    Ok(sources)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whether_a_plan_reaches_its_target_follows_from_the_accuracies_that_it_states() {
        let protocol = Protocol::LeaveOneTrialOut;
        let asked = PlanOptions { target: 0.9, accuracy: Some(0.9), protocol };
        assert!(asked.reached(29.0 / 32.0, 29.0 / 32.0));
        assert!(!asked.reached(0.95, 0.89) && !asked.reached(0.89, 0.95));
        let usual = PlanOptions { accuracy: None, ..asked };
        assert!(usual.reached(0.99, 0.98) && !usual.reached(0.99, 0.97));
    }
}
