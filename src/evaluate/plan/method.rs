//! The settings that a plan chooses between, each a method.

use std::path::Path;

use serde::Serialize;

use crate::evaluate::run::{Progress, first_seconds, prepare_folds, run_prepared};
use crate::evaluate::{EvaluateError, Fold, Outcome};
use crate::library::Entry;
use crate::recognise::{
    Embedding, EmbeddingOptions, Joint, Method, MethodName, Reference, ReferenceOptions,
};
use crate::scene::Scene;

/// A method and its settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "method", rename_all = "lowercase")]
pub enum Setting {
    /// The method `embedding`.
    Embedding,
    /// The method `joint`.
    Joint,
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
            Self::Joint => MethodName::Joint,
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
        match self {
            Self::Embedding => {
                run(&Embedding::new(scene, EmbeddingOptions::default()), on, progress)
            }
            Self::Joint => run(&Joint::new(scene), on, progress),
            Self::Reference { n, repetitions } => {
                let options = ReferenceOptions { samples: n, repetitions, ..Default::default() };
                run(&Reference::new(scene, options), on, progress)
            }
        }
    }
}

fn run<M: Method>(
    method: &M,
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
