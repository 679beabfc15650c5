//! `surfaced eval`: measures accuracy by a protocol, such as leave-one-trial-out.

mod report;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use self::report::{EvalAnswer, EvalReport};
use super::answers::AnswerArgs;
use super::bad_files;
use super::choose::{split, within};
use super::method::{MethodArgs, at_least_one};
use super::show::quoted;
use super::{Done, Failure, SourceArgs, paper, show};
use crate::dataset::table::{self, FeatureTables};
use crate::evaluate::paper::Shard;
use crate::evaluate::{
    EnrolmentOutcome, EvaluateError, EvaluatedTrials, Evaluation, Fold, Protocol, SettledOutcome,
    UnknownOutcome, better_plain, enrol,
};
use crate::recognise::features::{FeatureVector, SourceFeatures};
use crate::recognise::{Method, MethodName, RecogniseError};
use crate::record::edit::LibraryLock;
use crate::scene::{Scene, SourceId};
use crate::trial::TrialKey;

/// Measure how well a method names surfaces
#[derive(clap::Args)]
#[command(
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true,
    after_help = "Examples:\n  surfaced eval LMT_108_SurfaceMaterials_Database \
                  --protocol leave-one-trial-out --sources mi2 --json\n  surfaced eval my-library \
                  --enrolled 1\n  surfaced eval \
                  LMT_108_SurfaceMaterials_Database --paper --out results\n\nTime: 5 s for LMT108's 200 dragging sounds, on two cores; --method reference 10 s; --paper hours, see --shard"
)]
pub struct Args {
    #[command(subcommand)]
    then: Option<Then>,
    /// Recordings: a library, or the LMT108 database; or feature tables
    #[arg(required = true)]
    data: Option<PathBuf>,
    /// How queries and library are split (default: the first of these that fits)
    #[arg(long, value_enum)]
    protocol: Option<Protocol>,
    /// Run the paper's tables, each figure beside the paper's
    #[arg(long, conflicts_with_all = [
        "protocol", "sources", "query_seconds", "method", "neighbours", "halving", "enrolled"
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
    #[arg(long, value_name = "X", value_parser = super::common::seconds)]
    query_seconds: Option<f64>,
    /// Add each user's first N trials of every surface to the library (protocols of users)
    #[arg(long, default_value_t = 0, value_name = "N")]
    enrolled: usize,
    /// Also answer as soon as an answer is settled, and print accuracy and scan time
    #[arg(long, conflicts_with_all = ["paper", "query_seconds"])]
    settle: bool,
    /// Also leave whole surfaces out of the library, in this many groups, and print how many of
    /// their queries are called unknown
    #[arg(long, value_name = "GROUPS", conflicts_with = "paper", value_parser = groups)]
    leave_surfaces_out: Option<usize>,
    #[command(flatten)]
    answers: AnswerArgs,
    /// Print one JSON document on stdout
    #[arg(long)]
    json: bool,
}

#[derive(clap::Subcommand)]
enum Then {
    Merge(paper::MergeArgs),
}

fn groups(text: &str) -> Result<usize, String> {
    match at_least_one(text) {
        Ok(groups) if groups >= 2 => Ok(groups),
        _ => Err("expected a whole number, 2 or more".into()),
    }
}

/// The data to evaluate, and their name.
struct EvalData<'a> {
    name: &'a str,
    synthetic: bool,
    scene: &'a Scene,
    trials: EvaluatedTrials<'a>,
    keys: Vec<TrialKey>,
    cache: Option<&'a Path>,
}

/// Runs the command.
pub fn run(args: &Args) -> Done {
    if let Some(Then::Merge(args)) = &args.then {
        return paper::merge(args);
    }
    let Some(data) = &args.data else {
        return Err(Failure::Usage("name the recordings".into()));
    };
    let _lock = LibraryLock::for_reading(data);
    let mut report = match table::open(data)? {
        Some(tables) => on_tables(args, &tables)?,
        None => {
            let library = super::open_held(data)?;
            if args.paper {
                let out = args.out.as_deref();
                return bad_files::work(data, library, |library| {
                    paper::run(library, &args.method, args.shard, out, args.json)
                });
            }
            bad_files::work(data, library, |library| {
                let scene = args.sources.narrow(library.scene.clone())?;
                let entries = within(library, &scene)?;
                let data = EvalData {
                    name: &library.name,
                    synthetic: library.synthetic,
                    scene: &scene,
                    keys: entries.iter().map(|entry| entry.key.clone()).collect(),
                    trials: EvaluatedTrials::Recordings(&entries),
                    cache: args.method.uses_cache().then_some(data.as_path()),
                };
                evaluated(args, data)
            })?
        }
    };
    report.warnings.extend(bad_files::skipped());
    if args.json {
        show::json(&report);
    } else {
        report.print();
        advise(data, &report);
    }
    Ok(())
}

/// Says what to do next with the recordings.
fn advise(data: &Path, report: &EvalReport) {
    let lib = quoted(data);
    if report.outcome.method == MethodName::Embedding.as_str() {
        show::next(&format!(
            "surfaced plan {lib} finds the cheapest setting; surfaced replay NEW --library {lib} \
             names new scans"
        ));
    } else {
        show::next(&format!("surfaced chart {lib} --out chart.svg compares all methods"));
    }
}

fn on_tables(args: &Args, tables: &FeatureTables) -> Result<EvalReport, Failure> {
    if args.paper {
        return Err(Failure::Usage("--paper needs recordings; these are feature tables".into()));
    }
    if args.query_seconds.is_some() {
        return Err(Failure::Usage("--query-seconds needs recordings; these are features".into()));
    }
    let trials = vectors(tables, &args.sources.sources)?;
    let data = EvalData {
        name: &tables.name,
        synthetic: false,
        scene: &Scene::lmt108(),
        keys: trials.iter().map(|trial| trial.key.clone()).collect(),
        trials: EvaluatedTrials::Features(&trials),
        cache: None,
    };
    evaluated(args, data)
}

/// The trials with the features of the chosen tables, or of all tables if none is chosen.
///
/// # Errors
/// Wrong usage, if there is no such table.
fn vectors(tables: &FeatureTables, chosen: &[SourceId]) -> Result<Vec<FeatureVector>, Failure> {
    if let Some(unknown) = chosen.iter().find(|id| !tables.sources.contains(id)) {
        let known: Vec<_> = tables.sources.iter().map(SourceId::as_str).collect();
        return Err(Failure::Usage(format!("no table {unknown}; there are {}", known.join(", "))));
    }
    let wanted = |id: &SourceId| chosen.is_empty() || chosen.contains(id);
    let vector = |(key, sources): (&TrialKey, _)| FeatureVector {
        key: key.clone(),
        sources: features(sources, &wanted),
    };
    let trials = tables.trials.iter().map(vector).filter(|trial| !trial.sources.is_empty());
    let trials: Vec<FeatureVector> = trials.collect();
    say!(
        "{}: feature tables {}, {} trials",
        tables.name,
        tables.sources.iter().map(SourceId::as_str).collect::<Vec<_>>().join(", "),
        trials.len()
    );
    Ok(trials)
}

fn features(
    of_trial: &BTreeMap<SourceId, Vec<f64>>,
    wanted: &dyn Fn(&SourceId) -> bool,
) -> BTreeMap<SourceId, SourceFeatures> {
    let kept = of_trial.iter().filter(|(id, _)| wanted(id));
    kept.map(|(id, values)| (id.clone(), SourceFeatures { values: values.clone(), rate_hz: 0.0 }))
        .collect()
}

fn evaluated(args: &Args, data: EvalData<'_>) -> Result<EvalReport, Failure> {
    let (protocol, before) = split(&data.keys, args.protocol)?;
    let folds = enrolled(args, protocol, &before, &data.keys)?;
    let method = args.method.spec()?.build(data.scene);
    let steps = show::Steps::new();
    let evaluation = Evaluation {
        scene: data.scene,
        trials: data.trials,
        folds: &folds,
        query_seconds: args.query_seconds,
        keep_dead_sources: false,
        cache: data.cache,
        progress: &|step, done, of| steps.show(step, done, of),
    };
    let measured = measured(args, (&data, protocol), &*method, evaluation, &before);
    drop(steps);
    measured.map_err(mended)
}

/// Measures all that was requested.
fn measured(
    args: &Args,
    (data, protocol): (&EvalData<'_>, Protocol),
    method: &dyn Method,
    evaluation: Evaluation<'_>,
    before: &[Fold],
) -> Result<EvalReport, EvaluateError> {
    let run = evaluation.prepare(method)?;
    run.cache_remarks().iter().for_each(|remark| say!("{remark}"));
    let settled = args.settle.then(|| SettledOutcome::of(&run, args.answers.settle_loss));
    let settled = settled.transpose()?;
    let rate = args.answers.false_rejections();
    let unknown = args.leave_surfaces_out.map(|groups| UnknownOutcome::of(&run, groups, rate));
    let unknown = unknown.transpose()?;
    let measured = run.measure()?;
    let mut warnings = show::left_out(&measured.left_out);
    if args.method.is_default() {
        warnings.extend(better_plain(evaluation, &measured.predictions));
    }
    let enrolled = match args.enrolled {
        0 => None,
        count => Some(EnrolmentOutcome::of(&run, &measured, before, count)?),
    };
    Ok(EvalReport {
        outcome: measured.outcome,
        protocol,
        data: data.name.into(),
        synthetic: data.synthetic,
        query_seconds: args.query_seconds,
        settled,
        unknown,
        enrolled,
        predictions: measured.predictions.into_iter().map(EvalAnswer::from).collect(),
        warnings,
    })
}

/// The folds with each user's own first trials in the library.
fn enrolled(
    args: &Args,
    protocol: Protocol,
    folds: &[Fold],
    keys: &[TrialKey],
) -> Result<Vec<Fold>, Failure> {
    if args.enrolled > 0 && !protocol.folds_are_users() {
        return Err(Failure::Usage(format!(
            "--enrolled goes with expert-vs-users and all-vs-one-user, not with {}",
            protocol.name()
        )));
    }
    Ok(enrol(folds, keys, args.enrolled)?)
}

/// The failure, with the option that avoids it.
fn mended(error: EvaluateError) -> Failure {
    match error {
        EvaluateError::Follow { .. } => Failure::Failed(format!("{error}; use --method embedding")),
        EvaluateError::Recognise(RecogniseError::NeedsRecordings(_)) => {
            Failure::Usage(error.to_string())
        }
        other => other.into(),
    }
}
