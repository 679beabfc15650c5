//! The search for the cheapest setting.

use std::path::Path;

use serde::Serialize;

use super::file::{Expected, Plan};
use super::method::{ChoosingMethod, Trying};
use super::study::Study;
use crate::evaluate::{EvaluateError, Outcome, Progress, Protocol, folds, wilson_interval};
use crate::library::{Entry, Library};
use crate::recognise::{can_show, reaches};
use crate::scene::{Phase, SourceId};
use crate::trial::TrialKey;

/// What a plan must reach, and by which folds.
#[derive(Clone, Copy, Debug)]
pub struct PlanOptions<'a> {
    /// The accuracy to reach, a fraction.
    pub target: f64,
    /// How queries and library are split.
    pub protocol: Protocol,
    /// The folder whose trials are kept prepared, if they are.
    pub cache: Option<&'a Path>,
}

/// One source, what it costs and what it can do alone.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SourceCost {
    /// The source.
    pub source: SourceId,
    /// Time to compare it alone with the library by `embedding`, in milliseconds (median).
    pub latency_ms: f64,
    /// How long a scan lasts that records all of it, in seconds.
    pub scan_s: f64,
    /// Values to work through in that time.
    pub values: f64,
    /// Share of queries that it names right alone, by `embedding`.
    pub accuracy: f64,
}

/// A plan, and what was seen on the way.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Planned {
    /// The plan.
    pub plan: Plan,
    /// All sources, the cheapest first.
    pub sources: Vec<SourceCost>,
    /// For people: what was done, a line each.
    pub steps: Vec<String>,
}

/// Sources and scan time, by their places in the study, and the queries that they name right.
#[derive(Clone, Debug, PartialEq)]
struct Choice {
    sources: Vec<usize>,
    time: usize,
    right: usize,
}

struct Search<'a> {
    study: &'a Study,
    target: f64,
    /// Places of the sources, the cheapest first.
    by_cost: Vec<usize>,
    steps: Vec<String>,
}

/// Finds the cheapest plan for a library.
///
/// # Errors
/// If the library is too small to be cross-validated, or a trial cannot be read or compared.
pub fn search(
    library: &Library,
    options: PlanOptions<'_>,
    progress: Progress<'_>,
) -> Result<Planned, EvaluateError> {
    let entries: Vec<Entry> =
        library.entries.iter().filter(|entry| !entry.sources.is_empty()).cloned().collect();
    let keys: Vec<TrialKey> = entries.iter().map(|entry| entry.key.clone()).collect();
    let folds = folds(options.protocol, &keys)?;
    let study = Study::new(&library.scene, &entries, &folds, progress)?;
    let mut search = Search::new(&study, options.target);
    let choice = search.choose();
    let ids: Vec<SourceId> = choice.sources.iter().map(|&s| study.sources[s].id.clone()).collect();
    let scene = library.scene.clone().only(&ids)?;
    let dragged = choice.sources.iter().any(|&s| search.is_dragged(s));
    let on = Trying {
        scene: &scene,
        entries: &entries,
        folds: &folds,
        scan_s: study.times[choice.time].filter(|_| dragged),
        cache: options.cache,
    };
    let mut steps = Vec::new();
    let reaches = |right| search.reaches(right);
    let (method, outcome) =
        ChoosingMethod { on, reaches: &reaches, steps: &mut steps, progress }.choose()?;
    search.steps.extend(steps);
    let expected = search.expected(&outcome, &choice, options.protocol);
    let plan = Plan {
        library: library.name.clone(),
        synthetic: library.synthetic,
        sources: ids,
        method,
        scan_s: on.scan_s,
        expected,
    };
    let sources = search.costs();
    Ok(Planned { plan, sources, steps: search.steps })
}

impl<'a> Search<'a> {
    fn new(study: &'a Study, target: f64) -> Self {
        let mut search = Self { study, target, by_cost: Vec::new(), steps: Vec::new() };
        let whole = study.times.len() - 1;
        let mut by_cost: Vec<usize> = (0..study.sources.len()).collect();
        by_cost.sort_by(|&a, &b| search.compare_costs(&[a], whole, &[b], whole));
        search.by_cost = by_cost;
        search
    }

    fn is_dragged(&self, source: usize) -> bool {
        self.study.sources[source].phase == Phase::Drag
    }

    fn scan_s(&self, sources: &[usize], time: usize) -> f64 {
        let time = self.study.times[time];
        sources.iter().map(|&s| self.study.sources[s].scan_s(time)).fold(0.0, f64::max)
    }

    fn work(&self, sources: &[usize], time: usize) -> f64 {
        let time = self.study.times[time];
        sources.iter().map(|&s| self.study.sources[s].work(time)).sum()
    }

    /// Fewest sources, then least scan time, then least work.
    fn compare_costs(
        &self,
        a: &[usize],
        time_a: usize,
        b: &[usize],
        time_b: usize,
    ) -> std::cmp::Ordering {
        (a.len().cmp(&b.len()))
            .then(self.scan_s(a, time_a).total_cmp(&self.scan_s(b, time_b)))
            .then(self.work(a, time_a).total_cmp(&self.work(b, time_b)))
    }

    fn choice(&self, sources: &[usize], time: usize) -> Choice {
        let right = self.study.right(sources, time);
        Choice { sources: sources.to_vec(), time, right }
    }

    fn reaches(&self, right: usize) -> bool {
        reaches(right, self.study.queries(), self.target)
    }

    fn choose(&mut self) -> Choice {
        if let Some(single) = self.cheapest_single() {
            self.note(&single, "one source is enough:");
            return single;
        }
        let grown = self.grow();
        let reached = self.reaches(grown.right);
        let least = if reached { None } else { Some(grown.right) };
        let pruned = self.prune(grown, least);
        self.shorten(pruned, least)
    }

    /// The cheapest source and scan time that reach the target alone.
    fn cheapest_single(&self) -> Option<Choice> {
        let last = self.study.times.len() - 1;
        let mut all: Vec<(usize, usize)> = Vec::new();
        for s in 0..self.study.sources.len() {
            let first = if self.is_dragged(s) { 0 } else { last };
            all.extend((first..=last).map(|time| (s, time)));
        }
        all.sort_by(|a, b| self.compare_costs(&[a.0], a.1, &[b.0], b.1));
        all.iter()
            .map(|&(s, time)| self.choice(&[s], time))
            .find(|choice| self.reaches(choice.right))
    }

    /// Adds, one at a time, the source that helps most (of equals the cheapest), until the target
    /// is reached or none helps; all sources together if they do better than that.
    fn grow(&mut self) -> Choice {
        let whole = self.study.times.len() - 1;
        let mut chosen = Choice { sources: Vec::new(), time: whole, right: 0 };
        while !self.reaches(chosen.right) {
            let mut best: Option<Choice> = None;
            for &s in self.by_cost.iter().filter(|s| !chosen.sources.contains(s)) {
                let mut sources = chosen.sources.clone();
                sources.push(s);
                let tried = self.choice(&sources, whole);
                if best.as_ref().is_none_or(|best| tried.right > best.right) {
                    best = Some(tried);
                }
            }
            match best {
                // One there must be, even where none names anything.
                Some(better) if better.right > chosen.right || chosen.sources.is_empty() => {
                    self.note(&better, "added the source that helps most:");
                    chosen = better;
                }
                _ => break,
            }
        }
        if !self.reaches(chosen.right) {
            let all = self.choice(&self.by_cost, whole);
            if all.right > chosen.right {
                self.note(&all, "all sources together do better:");
                return all;
            }
        }
        chosen
    }

    /// Leaves out sources that are not needed, the most expensive first.
    fn prune(&mut self, mut chosen: Choice, least: Option<usize>) -> Choice {
        for s in self.by_cost.clone().into_iter().rev() {
            let others: Vec<usize> = chosen.sources.iter().copied().filter(|o| *o != s).collect();
            if others.is_empty() || others.len() == chosen.sources.len() {
                continue;
            }
            let tried = self.choice(&others, chosen.time);
            if self.is_enough(tried.right, least) {
                self.note(&tried, &format!("{} is not needed:", self.study.sources[s].id));
                chosen = tried;
            }
        }
        chosen
    }

    /// The shortest scan that is enough.
    fn shorten(&mut self, chosen: Choice, least: Option<usize>) -> Choice {
        for time in 0..chosen.time {
            let tried = self.choice(&chosen.sources, time);
            if self.is_enough(tried.right, least) {
                self.note(&tried, "a shorter scan is enough:");
                return tried;
            }
        }
        chosen
    }

    /// Reaches the target or, where nothing does, is no worse than the best.
    fn is_enough(&self, right: usize, least: Option<usize>) -> bool {
        least.map_or_else(|| self.reaches(right), |least| right >= least)
    }

    fn expected(&self, outcome: &Outcome, choice: &Choice, protocol: Protocol) -> Expected {
        let (right, queries) = (outcome.right(), outcome.queries);
        let (accuracy_low, accuracy_high) = wilson_interval(right, queries);
        Expected {
            target: self.target,
            reached: reaches(right, queries, self.target),
            shown: can_show(queries, self.target),
            accuracy: right as f64 / queries as f64,
            accuracy_low,
            accuracy_high,
            queries,
            surfaces: outcome.classes,
            protocol: protocol.name().into(),
            latency_ms: outcome.query_ms_p50,
            scan_s: self.scan_s(&choice.sources, choice.time),
        }
    }

    fn costs(&self) -> Vec<SourceCost> {
        let whole = self.study.times.len() - 1;
        let cost = |&s: &usize| {
            let source = &self.study.sources[s];
            SourceCost {
                source: source.id.clone(),
                latency_ms: source.latency_ms,
                scan_s: source.whole_s,
                values: source.values,
                accuracy: self.study.right(&[s], whole) as f64 / self.study.queries() as f64,
            }
        };
        self.by_cost.iter().map(cost).collect()
    }

    fn note(&mut self, choice: &Choice, what: &str) {
        let names: Vec<&str> =
            choice.sources.iter().map(|&s| self.study.sources[s].id.as_str()).collect();
        self.steps.push(format!(
            "{what} {}, {:.1} s of scan: {} of {} right",
            names.join(" + "),
            self.scan_s(&choice.sources, choice.time),
            choice.right,
            self.study.queries()
        ));
    }
}
