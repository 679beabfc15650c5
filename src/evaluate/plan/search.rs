//! The search for the cheapest setting.

use serde::Serialize;

use super::file::{Expected, Plan};
use super::study::Study;
use crate::evaluate::{
    EvaluateError, Evaluation, Fold, Outcome, ProgressFn, Protocol, Share, folds,
};
use crate::library::{Entry, Library};
use crate::recognise::{MethodName, MethodSpec, ScanTime, reaches, ready_model};
use crate::scene::{Phase, Scene, SourceId};
use crate::trial::TrialKey;

/// The accuracy that a plan must reach, and the folds that measure it.
#[derive(Clone, Copy, Debug)]
pub struct PlanOptions {
    /// The accuracy that whole scans of the chosen sources must reach, a fraction.
    pub target: f64,
    /// The accuracy that scans of the planned time must reach; if `None`, they may lose at most one
    /// percentage point against whole scans.
    pub accuracy: Option<f64>,
    /// How trials are split into queries and library.
    pub protocol: Protocol,
}

/// One source, with its cost and its accuracy alone.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SourceCost {
    pub source: SourceId,
    /// Median time to compare this source alone with the library by `embedding`, in milliseconds.
    pub latency_ms: f64,
    /// Length of a whole recording, in seconds.
    pub scan_s: f64,
    /// Number of values in a whole recording.
    pub values: f64,
    /// Share of queries that this source alone names correctly, by `embedding`.
    pub accuracy: f64,
}

/// A plan, and how it was found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Planned {
    pub plan: Plan,
    /// All sources, the cheapest first.
    pub sources: Vec<SourceCost>,
    /// The steps of the search, a line each.
    pub steps: Vec<String>,
}

/// Indices of sources in the study, and how many queries their whole scans name correctly.
#[derive(Clone, Debug, PartialEq)]
struct SourceChoice {
    sources: Vec<usize>,
    right: usize,
}

struct PlanSearch<'a> {
    study: &'a Study,
    target: f64,
    /// The scan time that some sources need.
    scan_time: &'a dyn Fn(&[usize]) -> Option<ScanTime>,
    /// Indices of the sources, the cheapest first.
    by_cost: Vec<usize>,
    steps: Vec<String>,
}

/// Finds the cheapest plan for a library.
///
/// # Errors
/// If the library is too small to be cross-validated, or a trial cannot be read or compared.
pub fn search(
    library: &Library,
    options: PlanOptions,
    progress: ProgressFn<'_>,
) -> Result<Planned, EvaluateError> {
    let entries: Vec<Entry> =
        library.entries.iter().filter(|entry| !entry.sources.is_empty()).cloned().collect();
    let keys: Vec<TrialKey> = entries.iter().map(|entry| entry.key.clone()).collect();
    let folds = folds(options.protocol, &keys)?;
    let study = Study::new(&library.scene, &entries, &folds, progress)?;
    let ids = |sources: &[usize]| -> Vec<SourceId> {
        sources.iter().map(|&s| study.sources[s].id.clone()).collect()
    };
    let scan_time = |sources: &[usize]| -> Option<ScanTime> {
        let scene = library.scene.clone().only(&ids(sources)).ok()?;
        let on = Trying { scene: &scene, entries: &entries, folds: &folds, scan_s: None };
        on.scan_time(options.accuracy, progress)
    };
    let mut search = PlanSearch::new(&study, options.target, &scan_time);
    let choice = search.choose();
    let scene = library.scene.clone().only(&ids(&choice.sources))?;
    let is_dragged = search.is_dragged(&choice.sources);
    let found = if is_dragged { scan_time(&choice.sources) } else { None };
    let scan_s = found.as_ref().and_then(ScanTime::scan_s);
    let outcome =
        Trying { scene: &scene, entries: &entries, folds: &folds, scan_s }.outcome(progress)?;
    let Share { right, of } = outcome.share;
    search.steps.extend(found.as_ref().map(ScanTime::line));
    search.steps.extend(scan_s.map(|s| format!("a scan of {s:.1} s: {right} of {of} right")));
    let mut expected = search.expected(&outcome, &choice, scan_s, options.protocol);
    // If no scan time has the requested accuracy, the target is missed, whatever these folds say.
    expected.reached &= found.is_none_or(|found| found.scan_s().is_some());
    let plan = Plan {
        library: library.name.clone(),
        synthetic: library.synthetic,
        sources: ids(&choice.sources),
        method: MethodName::Embedding.into(),
        scan_s,
        expected,
    };
    let sources = search.costs();
    Ok(Planned { plan, sources, steps: search.steps })
}

/// A setting of `embedding` to try.
#[derive(Clone, Copy)]
struct Trying<'a> {
    scene: &'a Scene,
    entries: &'a [Entry],
    folds: &'a [Fold],
    /// Seconds of each drag that are used; `None` for all of it.
    scan_s: Option<f64>,
}

impl Trying<'_> {
    /// Names all queries as `surfaced eval` would.
    fn outcome(self, progress: ProgressFn<'_>) -> Result<Outcome, EvaluateError> {
        let entries: Vec<Entry> =
            self.entries.iter().map(|entry| entry.clone().within(self.scene)).collect();
        let has_any = |i: &usize| !entries[*i].sources.is_empty();
        let folds = self.folds.iter().map(|fold| Fold {
            name: fold.name.clone(),
            library: fold.library.iter().copied().filter(has_any).collect(),
            queries: fold.queries.iter().copied().filter(has_any).collect(),
        });
        let folds: Vec<Fold> = folds.filter(|fold| !fold.queries.is_empty()).collect();
        let on = Evaluation::new(self.scene, &entries, &folds);
        let evaluation = Evaluation { query_seconds: self.scan_s, progress, ..on };
        let method = MethodSpec::from(MethodName::Embedding).build(self.scene);
        Ok(evaluation.prepare(&*method)?.measure()?.outcome)
    }

    /// How long scans must last, from leaving out trials of the whole library.
    fn scan_time(self, accuracy: Option<f64>, progress: ProgressFn<'_>) -> Option<ScanTime> {
        let within = self.entries.iter().map(|entry| entry.clone().within(self.scene));
        let entries: Vec<Entry> = within.filter(|entry| !entry.sources.is_empty()).collect();
        let method = MethodSpec::from(MethodName::Embedding).build(self.scene);
        let all = (0..entries.len()).collect();
        let step = |done, of| progress("finding the scan time", done, of);
        let ready = ready_model(&*method, &entries, &all, None, &step).ok()?;
        ready.model.scan_time(accuracy)
    }
}

impl<'a> PlanSearch<'a> {
    fn new(
        study: &'a Study,
        target: f64,
        scan_time: &'a dyn Fn(&[usize]) -> Option<ScanTime>,
    ) -> Self {
        let mut search = Self { study, target, scan_time, by_cost: Vec::new(), steps: Vec::new() };
        let mut by_cost: Vec<usize> = (0..study.sources.len()).collect();
        let cost = |s: usize| (search.scan_s(&[s], None), study.sources[s].values);
        by_cost.sort_by(|&a, &b| compare(cost(a), cost(b)));
        search.by_cost = by_cost;
        search
    }

    fn is_dragged(&self, sources: &[usize]) -> bool {
        sources.iter().any(|&s| self.study.sources[s].phase == Phase::Drag)
    }

    fn scan_s(&self, sources: &[usize], drag_s: Option<f64>) -> f64 {
        sources.iter().map(|&s| self.study.sources[s].scan_s(drag_s)).fold(0.0, f64::max)
    }

    fn choice(&self, sources: &[usize]) -> SourceChoice {
        SourceChoice { sources: sources.to_vec(), right: self.study.right(sources) }
    }

    fn reaches(&self, right: usize) -> bool {
        reaches(right, self.study.queries(), self.target)
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

    /// Of the sources that reach the target alone, the one with the least scan time, then with the
    /// fewest values to process.
    fn cheapest_single(&self) -> Option<SourceChoice> {
        let all = self.by_cost.iter().map(|&s| self.choice(&[s]));
        let enough = all.filter(|choice| self.reaches(choice.right));
        let cost = |choice: &SourceChoice| {
            let dragged = self.is_dragged(&choice.sources);
            let found = if dragged { (self.scan_time)(&choice.sources) } else { None };
            let drag_s = found.and_then(|found| found.scan_s());
            let source = &self.study.sources[choice.sources[0]];
            (self.scan_s(&choice.sources, drag_s), source.work(drag_s))
        };
        let costs: Vec<((f64, f64), SourceChoice)> =
            enough.map(|choice| (cost(&choice), choice)).collect();
        costs.into_iter().min_by(|a, b| compare(a.0, b.0)).map(|(_, choice)| choice)
    }

    /// Adds the source that helps most (of equals the cheapest), one after another, until the
    /// target is reached or none helps. If the target is missed, takes all sources if they do
    /// better.
    fn grow(&mut self) -> SourceChoice {
        let mut chosen = SourceChoice { sources: Vec::new(), right: 0 };
        while !self.reaches(chosen.right) {
            let mut best: Option<SourceChoice> = None;
            for &s in self.by_cost.iter().filter(|s| !chosen.sources.contains(s)) {
                let mut sources = chosen.sources.clone();
                sources.push(s);
                let tried = self.choice(&sources);
                if best.as_ref().is_none_or(|best| tried.right > best.right) {
                    best = Some(tried);
                }
            }
            match best {
                // A plan has at least one source, even if none names a query correctly.
                Some(better) if better.right > chosen.right || chosen.sources.is_empty() => {
                    self.note(&better, "added the source that helps most:");
                    chosen = better;
                }
                _ => break,
            }
        }
        if !self.reaches(chosen.right) {
            let all = self.choice(&self.by_cost);
            if all.right > chosen.right {
                self.note(&all, "all sources together do better:");
                return all;
            }
        }
        chosen
    }

    /// Removes sources that are not needed, trying the most expensive first.
    fn prune(&mut self, mut chosen: SourceChoice, least: Option<usize>) -> SourceChoice {
        for s in self.by_cost.clone().into_iter().rev() {
            let others: Vec<usize> = chosen.sources.iter().copied().filter(|o| *o != s).collect();
            if others.is_empty() || others.len() == chosen.sources.len() {
                continue;
            }
            let tried = self.choice(&others);
            if self.is_enough(tried.right, least) {
                self.note(&tried, &format!("{} is not needed:", self.study.sources[s].id));
                chosen = tried;
            }
        }
        chosen
    }

    /// Whether the target is reached or, if `least` is given, at least that many queries are right.
    fn is_enough(&self, right: usize, least: Option<usize>) -> bool {
        least.map_or_else(|| self.reaches(right), |least| right >= least)
    }

    fn expected(
        &self,
        outcome: &Outcome,
        choice: &SourceChoice,
        drag_s: Option<f64>,
        protocol: Protocol,
    ) -> Expected {
        let (accuracy_low, accuracy_high) = outcome.share.interval();
        Expected {
            target: self.target,
            reached: self.reaches(choice.right),
            shown: accuracy_low >= self.target,
            accuracy: outcome.share.value(),
            accuracy_low,
            accuracy_high,
            queries: outcome.share.of,
            surfaces: outcome.classes,
            protocol: protocol.name().into(),
            latency_ms: outcome.query_ms_p50,
            scan_s: drag_s.unwrap_or_else(|| self.scan_s(&choice.sources, None)),
        }
    }

    fn costs(&self) -> Vec<SourceCost> {
        let cost = |&s: &usize| {
            let source = &self.study.sources[s];
            SourceCost {
                source: source.id.clone(),
                latency_ms: source.latency_ms,
                scan_s: source.whole_s,
                values: source.values,
                accuracy: self.study.right(&[s]) as f64 / self.study.queries() as f64,
            }
        };
        self.by_cost.iter().map(cost).collect()
    }

    fn note(&mut self, choice: &SourceChoice, what: &str) {
        let names: Vec<&str> =
            choice.sources.iter().map(|&s| self.study.sources[s].id.as_str()).collect();
        self.steps.push(format!(
            "{what} {}, {:.1} s of scan: {} of {} right",
            names.join(" + "),
            self.scan_s(&choice.sources, None),
            choice.right,
            self.study.queries()
        ));
    }
}

/// Orders (scan time, values to process) by scan time first.
fn compare(a: (f64, f64), b: (f64, f64)) -> std::cmp::Ordering {
    a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1))
}
