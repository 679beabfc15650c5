//! `surfaced eval`: accuracy by protocol.

use std::path::{Path, PathBuf};

use super::choose::{Choice, choose};
use super::method::{MethodArgs, WithMethod};
use super::{Done, Failure, SourceArgs, paper, show};
use crate::evaluate::paper::Shard;
use crate::evaluate::{self, EvaluateError, Fold, Outcome, Prediction, Protocol};
use crate::library::Entry;
use crate::recognise::Method;
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
    /// Recordings: a library, or the LMT108 database in either of its forms
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
    /// How much of each query's drag is used, one or more.
    pub seconds: &'a [Option<f64>],
    /// The folder whose trials are kept prepared, if they are.
    pub cache: Option<&'a Path>,
}

impl WithMethod for Evaluation<'_> {
    /// As many as there are `seconds`.
    type Output = Result<Vec<(Outcome, Vec<Prediction>)>, EvaluateError>;

    fn with(self, method: impl Method + 'static) -> Self::Output {
        let steps = show::Steps::new();
        let (scene, seconds) = (self.scene, self.seconds);
        let as_query = |of: usize, entry: &Entry| first_seconds(entry, scene, seconds[of]);
        let progress = |step, done, of| steps.tell(step, done, of);
        let prepared =
            evaluate::prepare_folds(&method, self.entries, self.folds, self.cache, &progress)?;
        for remark in &prepared.remarks {
            eprintln!("{remark}");
        }
        let (entries, folds) = (self.entries, self.folds);
        let (trials, variants) = (&prepared.trials, seconds.len());
        evaluate::run_variants(&method, entries, folds, trials, variants, as_query, &progress)
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
    let library = super::open(data)?;
    if args.paper {
        let out = args.out.as_deref();
        return paper::run(&library, &args.method, args.shard, out, args.json);
    }
    let Some(protocol) = args.protocol else {
        return Err(Failure::Usage("name a protocol, or --paper".into()));
    };
    let choice = choose(&library, data, &args.sources, Some(protocol))?;
    let Choice { scene, entries, folds, .. } = &choice;
    let query_seconds = args.query_seconds;
    let cache = args.method.cache_beside(data);
    let evaluation = Evaluation { entries, folds, scene, seconds: &[query_seconds], cache };
    let (outcome, predictions) = args.method.apply(scene, evaluation)?.swap_remove(0);
    let report = Report {
        outcome,
        protocol: protocol.name(),
        data: library.name.clone(),
        synthetic: library.synthetic,
        query_seconds,
        predictions: predictions.into_iter().map(Answer::from).collect(),
    };
    if args.json {
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
