//! `surfaced eval`: accuracy by protocol.

mod features;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use super::method::{MethodArgs, WithMethod};
use super::{Done, Failure, SourceArgs, paper, show};
use crate::dataset::table;
use crate::evaluate::paper::Shard;
use crate::evaluate::{self, EvaluateError, Fold, Outcome, Prediction, Protocol};
use crate::library::Entry;
use crate::recognise::{Method, without_flawed};
use crate::scene::{Phase, Scene};
use crate::trial::TrialKey;

/// Measure how well a method names surfaces
#[derive(clap::Args)]
#[command(
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true,
    after_help = "Examples:\n  surfaced eval LMT_108_SurfaceMaterials_Database \
                  --protocol leave-one-trial-out --sources mi2 --json\n  surfaced eval \
                  LMT_108_SurfaceMaterials_Database --paper --out results"
)]
pub struct Args {
    #[command(subcommand)]
    then: Option<Then>,
    /// Recordings: a library, or the LMT108 database in either of its forms; or feature tables
    #[arg(required = true)]
    data: Option<PathBuf>,
    /// How queries and library are split
    #[arg(long, value_enum, required_unless_present = "paper")]
    protocol: Option<Protocol>,
    /// Run the paper's tables, each figure beside the paper's
    #[arg(long, conflicts_with_all = [
        "protocol", "sources", "query_seconds", "method", "neighbours", "halving", "no_discriminant"
    ])]
    paper: bool,
    /// Do one part of the work, such as 3/64, and write it to the folder that --out names
    #[arg(long, requires = "paper", requires = "out", value_name = "NUMBER/COUNT")]
    shard: Option<Shard>,
    /// Folder for the report and the figures, or for the shard
    #[arg(long, requires = "paper", value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    sources: SourceArgs,
    #[command(flatten)]
    method: MethodArgs,
    /// Use only the first seconds of each query's drag
    #[arg(long, value_name = "X", value_parser = seconds)]
    query_seconds: Option<f64>,
    /// Print one JSON document on stdout
    #[arg(long)]
    json: bool,
}

#[derive(clap::Subcommand)]
enum Then {
    Merge(paper::MergeArgs),
}

/// Parses a duration.
pub fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(x) if x.is_finite() && x > 0.0 => Ok(x),
        _ => Err("expected a positive number of seconds".into()),
    }
}

/// The JSON document: the outcome, and what it was measured on.
#[derive(serde::Serialize)]
struct Report {
    #[serde(flatten)]
    outcome: Outcome,
    protocol: &'static str,
    data: String,
    synthetic: bool,
    query_seconds: Option<f64>,
    predictions: Vec<Answer>,
}

/// One query and its answer.
#[derive(serde::Serialize)]
struct Answer {
    truth: String,
    user: String,
    trial: u32,
    answer: String,
    margin: f64,
}

impl From<Prediction> for Answer {
    fn from(p: Prediction) -> Self {
        let TrialKey { surface: truth, user, number: trial } = p.key;
        Self { truth, user, trial, answer: p.surface, margin: p.margin }
    }
}

/// An evaluation, for whichever method it is done with.
pub(super) struct Evaluation<'a> {
    pub entries: &'a [Entry],
    pub folds: &'a [Fold],
    pub scene: &'a Scene,
    pub query_seconds: Option<f64>,
    /// The folder whose trials are kept prepared, if they are.
    pub cache: Option<&'a Path>,
}

impl WithMethod for Evaluation<'_> {
    type Output = Result<(Outcome, Vec<Prediction>), EvaluateError>;

    fn with(self, method: impl Method + 'static) -> Self::Output {
        let steps = show::Steps::new();
        let left_out = LeftOut::default();
        let as_query = |entry: &Entry| {
            left_out.leave_out(first_seconds(entry, self.scene, self.query_seconds), self.scene)
        };
        let progress = |step, done, of| steps.tell(step, done, of);
        let prepared =
            evaluate::prepare_folds(&method, self.entries, self.folds, self.cache, &progress)?;
        for remark in &prepared.remarks {
            eprintln!("{remark}");
        }
        let (entries, folds) = (self.entries, self.folds);
        let done =
            evaluate::run_prepared(&method, entries, folds, &prepared.trials, as_query, &progress);
        drop(steps);
        left_out.tell();
        done
    }
}

/// Sources that were left out of queries, with the trials.
#[derive(Clone, Default)]
struct LeftOut(Arc<Mutex<BTreeMap<String, BTreeSet<TrialKey>>>>);

impl LeftOut {
    /// The entry without sources whose sensor is dead or stuck.
    fn leave_out(&self, entry: Entry, scene: &Scene) -> Entry {
        let (noted, scene, key) = (self.clone(), scene.clone(), entry.key.clone());
        entry.changed(move |trial| {
            let (trial, remarks) = without_flawed(trial, &scene);
            // A thread that panicked while it held the lock left a whole map.
            let mut noted = noted.0.lock().unwrap_or_else(PoisonError::into_inner);
            for remark in remarks {
                noted.entry(remark).or_default().insert(key.clone());
            }
            trial
        })
    }

    fn tell(&self) {
        let noted = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        for (remark, keys) in noted.iter() {
            let more = if keys.len() > 1 {
                format!(" and {} more", keys.len() - 1)
            } else {
                String::new()
            };
            if let Some(first) = keys.first() {
                eprintln!("warning: {remark} ({first}{more})");
            }
        }
    }
}

/// The entry with its drag cut to the first seconds.
pub fn first_seconds(entry: &Entry, scene: &Scene, seconds: Option<f64>) -> Entry {
    let Some(seconds) = seconds else { return entry.clone() };
    let scene = scene.clone();
    entry.clone().changed(move |trial| {
        trial.first_seconds(seconds, |id| {
            scene.get(id.as_str()).is_some_and(|spec| spec.phase == Phase::Drag)
        })
    })
}

/// Runs the command.
pub fn run(args: &Args) -> Done {
    if let Some(Then::Merge(args)) = &args.then {
        return paper::merge(args);
    }
    let Some(data) = &args.data else {
        return Err(Failure::Usage("name the recordings".into()));
    };
    if let Some(tables) = table::open(data)? {
        return features::run(args, &tables);
    }
    let library = super::open(data)?;
    if args.paper {
        let out = args.out.as_deref();
        return paper::run(&library, &args.method, args.shard, out, args.json);
    }
    let Some(protocol) = args.protocol else {
        return Err(Failure::Usage("name a protocol, or --paper".into()));
    };
    let scene = args.sources.narrow(library.scene.clone())?;
    let entries: Vec<Entry> = (library.entries.iter())
        .map(|entry| entry.clone().within(&scene))
        .filter(|entry| !entry.sources.is_empty())
        .collect();
    if entries.is_empty() {
        let asked: Vec<_> = scene.sources().map(|s| s.id.as_str()).collect();
        return Err(Failure::Failed(format!(
            "{}: no trial holds any of the sources {}; see above for what was found",
            super::shown(data),
            asked.join(", ")
        )));
    }
    let keys: Vec<_> = entries.iter().map(|entry| entry.key.clone()).collect();
    let folds = evaluate::folds(protocol, &keys)?;
    let query_seconds = args.query_seconds;
    let cache = args.method.cache_beside(data);
    let evaluation =
        Evaluation { entries: &entries, folds: &folds, scene: &scene, query_seconds, cache };
    let (outcome, predictions) = args.method.apply(&scene, evaluation)?;
    finish(
        args.json,
        Report {
            outcome,
            protocol: protocol.name(),
            data: library.name.clone(),
            synthetic: library.synthetic,
            query_seconds,
            predictions: predictions.into_iter().map(Answer::from).collect(),
        },
    )
}

fn finish(json: bool, report: Report) -> Done {
    if json {
        show::json(&report);
    } else {
        tell(&report);
    }
    Ok(())
}

fn tell(report: &Report) {
    let o = &report.outcome;
    let sources: Vec<_> = o.sources.iter().map(|id| id.as_str()).collect();
    let mark = if report.synthetic { ", on synthetic data" } else { "" };
    eprintln!();
    eprintln!("{} · {} · {}{mark}", report.protocol, o.method, sources.join(", "));
    eprintln!(
        "accuracy   {} ± {} over {} folds (95 % interval over queries: {} to {})",
        show::percent(o.accuracy_mean),
        show::percent(o.accuracy_std),
        o.folds.len(),
        show::percent(o.accuracy_low),
        show::percent(o.accuracy_high)
    );
    eprintln!("precision  {}", show::percent(o.precision_mean));
    eprintln!(
        "           {} surfaces, {} queries against {} library trials",
        o.classes, o.queries, o.library_trials
    );
    eprintln!("query      {:.1} ms (median), {:.1} ms (p99)", o.query_ms_p50, o.query_ms_p99);
    for (truth, answer, count) in o.confusion.worst(5) {
        eprintln!("           {count} × {truth} taken for {answer}");
    }
}
