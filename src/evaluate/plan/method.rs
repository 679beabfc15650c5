//! The settings that a plan chooses between, each a method.

use std::path::Path;

use crate::evaluate::{EvaluateError, Evaluation, Fold, Outcome, ProgressFn};
use crate::library::Entry;
use crate::recognise::{Goal, MethodName, MethodSpec, ReferenceOptions, ready_model};
use crate::scene::Scene;

/// Settings of `reference` that may take the place of `embedding`, n and R, the cheapest first.
const CHEAPER: [(usize, usize); 3] = [(100, 1), (400, 1), (100, 10)];

/// They do where they take at most this share of its time: differences of less are noise.
const CHEAPER_BY: f64 = 0.25;

/// Setting of `reference` that is tried where `embedding` does not reach the target.
const SHARPER: (usize, usize) = (400, 10);

/// Queries by which a setting's time is first guessed.
const GLIMPSE: usize = 5;

fn embedding() -> MethodSpec {
    MethodSpec::from(MethodName::Embedding)
}

fn reference((samples, repetitions): (usize, usize)) -> MethodSpec {
    MethodSpec::Reference(ReferenceOptions { samples, repetitions, ..Default::default() })
}

/// What a setting is tried on.
#[derive(Clone, Copy)]
pub(super) struct Trying<'a> {
    pub scene: &'a Scene,
    pub entries: &'a [Entry],
    pub folds: &'a [Fold],
    pub scan_s: Option<f64>,
    /// The folder whose trials are kept prepared, if they are.
    pub cache: Option<&'a Path>,
}

impl<'a> Trying<'a> {
    /// Of whole scans.
    pub fn new(
        scene: &'a Scene,
        entries: &'a [Entry],
        folds: &'a [Fold],
        cache: Option<&'a Path>,
    ) -> Self {
        Self { scene, entries, folds, scan_s: None, cache }
    }

    /// What `embedding` makes of it.
    pub fn embedded(self, progress: ProgressFn<'_>) -> Result<Outcome, EvaluateError> {
        run(&embedding(), self, progress)
    }
}

/// How long scans must last for an accuracy, in seconds, by the left-out trials of the library;
/// `None` where that is not known.
pub(super) fn needed_s(on: Trying<'_>, target: f64, progress: ProgressFn<'_>) -> Option<f64> {
    let within = on.entries.iter().map(|entry| entry.clone().within(on.scene));
    let entries: Vec<Entry> = within.filter(|entry| !entry.sources.is_empty()).collect();
    let method = embedding().build(on.scene);
    let all = (0..entries.len()).collect();
    let step = |done, of| progress("finding the scan time", done, of);
    let ready = ready_model(&*method, &entries, &all, on.cache, &step).ok()?;
    ready.model.left_out_accuracy()?.scan_time(Goal::Accuracy(target)).scan_s()
}

/// The choice of a method, once sources and scan time are chosen.
pub(super) struct ChoosingMethod<'a> {
    pub on: Trying<'a>,
    /// Whether this number of right answers reaches the target.
    pub reaches: &'a dyn Fn(usize) -> bool,
    /// For people: what was done, a line each.
    pub steps: &'a mut Vec<String>,
    pub progress: ProgressFn<'a>,
}

impl ChoosingMethod<'_> {
    /// The setting, and what it does; `embedded` is what `embedding` does.
    pub fn choose(mut self, embedded: Outcome) -> Result<(MethodSpec, Outcome), EvaluateError> {
        match self.cheaper(&embedded)? {
            Some(cheaper) => Ok(cheaper),
            None if (self.reaches)(embedded.right()) => Ok((embedding(), embedded)),
            None => self.sharper(embedded),
        }
    }

    /// A setting that reaches the target and is far cheaper than `embedding`.
    fn cheaper(
        &mut self,
        embedded: &Outcome,
    ) -> Result<Option<(MethodSpec, Outcome)>, EvaluateError> {
        let limit_ms = CHEAPER_BY * embedded.query_ms_p50;
        for setting in CHEAPER.map(reference) {
            let mut glimpse = self.on.folds[..1].to_vec();
            glimpse[0].queries.truncate(GLIMPSE);
            let glimpse = Trying { folds: &glimpse, ..self.on };
            // One that cannot compare these sources is no candidate.
            let Ok(quick) = run(&setting, glimpse, self.progress) else { continue };
            if quick.query_ms_p50 > limit_ms {
                continue;
            }
            let outcome = run(&setting, self.on, self.progress)?;
            if (self.reaches)(outcome.right()) {
                self.steps.push(format!(
                    "{} is as good, and takes {:.2} ms instead of {:.2} ms",
                    shown(&setting),
                    outcome.query_ms_p50,
                    embedded.query_ms_p50
                ));
                return Ok(Some((setting, outcome)));
            }
        }
        Ok(None)
    }

    /// The better of `embedding`, which has missed the target, and of what may yet reach it; of
    /// equals the first.
    fn sharper(&mut self, embedded: Outcome) -> Result<(MethodSpec, Outcome), EvaluateError> {
        let setting = reference(SHARPER);
        let outcome = run(&setting, self.on, self.progress)?;
        let (found, so_far) = (outcome.right(), embedded.right());
        let (its, others) = (shown(&setting), shown(&embedding()));
        self.steps.push(format!("{its} names {found} right, {others} {so_far}"));
        Ok(if found > so_far { (setting, outcome) } else { (embedding(), embedded) })
    }
}

/// A setting for people.
fn shown(setting: &MethodSpec) -> String {
    match setting {
        MethodSpec::Reference(ReferenceOptions { samples, repetitions, .. }) => {
            format!("reference at n = {samples}, R = {repetitions}")
        }
        other => other.name().as_str().into(),
    }
}

/// Names all queries as `surfaced eval` would.
fn run(
    setting: &MethodSpec,
    on: Trying<'_>,
    progress: ProgressFn<'_>,
) -> Result<Outcome, EvaluateError> {
    let entries: Vec<Entry> = on.entries.iter().map(|e| e.clone().within(on.scene)).collect();
    let has_any = |i: &usize| !entries[*i].sources.is_empty();
    let folds = on.folds.iter().map(|fold| Fold {
        name: fold.name.clone(),
        library: fold.library.iter().copied().filter(has_any).collect(),
        queries: fold.queries.iter().copied().filter(has_any).collect(),
    });
    let folds: Vec<Fold> = folds.filter(|fold| !fold.queries.is_empty()).collect();
    let evaluation = Evaluation {
        query_seconds: on.scan_s,
        cache: on.cache,
        progress,
        ..Evaluation::new(on.scene, &entries, &folds)
    };
    Ok(evaluation.prepare(&*setting.build(on.scene))?.measure()?.outcome)
}
