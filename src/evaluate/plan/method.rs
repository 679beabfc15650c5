//! The settings that a plan chooses between, each a method.

use std::path::Path;

use serde::Serialize;

use crate::evaluate::run::{Progress, first_seconds, prepare_folds, run_prepared};
use crate::evaluate::{EvaluateError, Fold, Outcome};
use crate::library::Entry;
use crate::recognise::{
    AnyMethod, Embedding, EmbeddingOptions, MethodName, Reference, ReferenceOptions,
};
use crate::scene::Scene;

/// Settings of `reference` that may take the place of `embedding`, the cheapest first.
const CHEAPER: [Setting; 3] = [
    Setting::Reference { n: 100, repetitions: 1 },
    Setting::Reference { n: 400, repetitions: 1 },
    Setting::Reference { n: 100, repetitions: 10 },
];

/// They do where they take at most this share of its time: differences of less are noise.
const CHEAPER_BY: f64 = 0.25;

/// Settings that are tried where `embedding` does not reach the target.
const SHARPER: [Setting; 1] = [Setting::Reference { n: 400, repetitions: 10 }];

/// Queries by which a setting's time is first guessed.
const GLIMPSE: usize = 5;

/// A method and its settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "method", rename_all = "lowercase")]
pub enum Setting {
    /// The method `embedding`.
    Embedding,
    /// The method `reference`.
    Reference {
        /// samples drawn from a source
        n: usize,
        /// repetitions whose scores are averaged
        repetitions: usize,
    },
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

impl Setting {
    /// The method's name.
    pub fn method(self) -> MethodName {
        match self {
            Self::Embedding => MethodName::Embedding,
            Self::Reference { .. } => MethodName::Reference,
        }
    }

    /// Names all queries as `surfaced eval` would.
    pub(super) fn run(
        self,
        on: Trying<'_>,
        progress: Progress<'_>,
    ) -> Result<Outcome, EvaluateError> {
        let scene = on.scene.clone();
        let method = match self {
            Self::Embedding => AnyMethod::new(Embedding::new(scene, EmbeddingOptions::default())),
            Self::Reference { n, repetitions } => {
                let options = ReferenceOptions { samples: n, repetitions, ..Default::default() };
                AnyMethod::new(Reference::new(scene, options))
            }
        };
        run(&method, on, progress)
    }
}

/// How many queries were named right.
pub(super) fn right(outcome: &Outcome) -> usize {
    outcome.folds.iter().map(|f| (f.accuracy * f.queries as f64).round() as usize).sum()
}

/// The choice of a method, once sources and scan time are chosen.
pub(super) struct ChoosingMethod<'a> {
    pub on: Trying<'a>,
    /// Whether so many right ones reach the target.
    pub reaches: &'a dyn Fn(usize) -> bool,
    /// For people: what was done, a line each.
    pub told: &'a mut Vec<String>,
    pub progress: Progress<'a>,
}

impl ChoosingMethod<'_> {
    /// The setting, and what it does.
    pub fn choose(mut self) -> Result<(Setting, Outcome), EvaluateError> {
        let embedded = Setting::Embedding.run(self.on, self.progress)?;
        match self.cheaper(&embedded)? {
            Some(cheaper) => Ok(cheaper),
            None if (self.reaches)(right(&embedded)) => Ok((Setting::Embedding, embedded)),
            None => self.sharper(embedded),
        }
    }

    /// A setting that reaches the target and is far cheaper than `embedding`.
    fn cheaper(&mut self, embedded: &Outcome) -> Result<Option<(Setting, Outcome)>, EvaluateError> {
        let limit_ms = CHEAPER_BY * embedded.query_ms_p50;
        for setting in CHEAPER {
            let mut glimpse = self.on.folds[..1].to_vec();
            glimpse[0].queries.truncate(GLIMPSE);
            let glimpse = Trying { folds: &glimpse, ..self.on };
            // One that cannot compare these sources is no candidate.
            let Ok(quick) = setting.run(glimpse, self.progress) else { continue };
            if quick.query_ms_p50 > limit_ms {
                continue;
            }
            let outcome = setting.run(self.on, self.progress)?;
            if (self.reaches)(right(&outcome)) {
                self.told.push(format!(
                    "{setting:?} is as good, and takes {:.2} ms instead of {:.2} ms",
                    outcome.query_ms_p50, embedded.query_ms_p50
                ));
                return Ok(Some((setting, outcome)));
            }
        }
        Ok(None)
    }

    /// The best of `embedding`, which has missed the target, and of what may yet reach it; of
    /// equals the first.
    fn sharper(&mut self, embedded: Outcome) -> Result<(Setting, Outcome), EvaluateError> {
        let mut best = (Setting::Embedding, embedded);
        for setting in SHARPER {
            let outcome = setting.run(self.on, self.progress)?;
            let (found, so_far) = (right(&outcome), right(&best.1));
            self.told.push(format!("{setting:?} names {found} right, {:?} {so_far}", best.0));
            if found > so_far {
                best = (setting, outcome);
            }
            if (self.reaches)(right(&best.1)) {
                break;
            }
        }
        Ok(best)
    }
}

fn run(
    method: &AnyMethod,
    on: Trying<'_>,
    progress: Progress<'_>,
) -> Result<Outcome, EvaluateError> {
    let entries: Vec<Entry> = on.entries.iter().map(|e| e.clone().within(on.scene)).collect();
    let has_any = |i: &usize| !entries[*i].sources.is_empty();
    let folds = on.folds.iter().map(|fold| Fold {
        name: fold.name.clone(),
        library: fold.library.iter().copied().filter(has_any).collect(),
        queries: fold.queries.iter().copied().filter(has_any).collect(),
    });
    let folds: Vec<Fold> = folds.filter(|fold| !fold.queries.is_empty()).collect();
    let as_query = |entry: &Entry| first_seconds(entry, on.scene, on.scan_s);
    let prepared = prepare_folds(method, &entries, &folds, on.cache, progress)?;
    let (outcome, _) =
        run_prepared(method, &entries, &folds, &prepared.trials, as_query, progress)?;
    Ok(outcome)
}
