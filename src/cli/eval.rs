//! `surfaced eval`: measures accuracy under a protocol, such as leave-one-trial-out.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use super::bad_files;
use super::choose::{kept_apart, leaks, split, within};
use super::condition::WhereArgs;
use super::eval_report::{EvalAnswer, EvalReport};
use super::method::{AnswerArgs, MethodArgs};
use super::show::{listed, quoted};
use super::{Done, Failure, SourceArgs, paper, parsed, say, show};
use crate::dataset::feature_tables::{self, FeatureTables};
use crate::evaluate::paper::Shard;
use crate::evaluate::{
    EnrolmentOutcome, EvaluateError, EvaluatedTrials, Evaluation, Fold, Leaks, Prediction,
    Protocol, SettledOutcome, UnknownOutcome, better_plain, enrol,
};
use crate::recognise::features::{FeatureVector, SourceFeatures};
use crate::recognise::{MethodName, RecogniseError};
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
pub(super) struct Args {
    #[command(subcommand)]
    then: Option<Then>,
    /// Recordings: a library, or the LMT108 database; or feature tables
    #[arg(required = true)]
    data: Option<PathBuf>,
    /// How queries and library are split (default: the hardest that the data allow: other people, else other sessions, else other trials)
    #[arg(long, value_enum)]
    protocol: Option<Protocol>,
    /// Compute the paper's tables, each result beside the paper's
    #[arg(long, conflicts_with_all = [
        "protocol", "sources", "query_seconds", "method", "neighbours", "halving", "enrolled"
    ])]
    paper: bool,
    /// Do one part of the work, such as 3/64, and write it to the folder that --out names
    #[arg(long, requires = "paper", requires = "out", value_name = "NUMBER/COUNT")]
    shard: Option<Shard>,
    /// Folder for the report, or for the shard
    #[arg(long, requires = "paper", value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    sources: SourceArgs,
    #[command(flatten)]
    method: MethodArgs,
    /// Use only the first seconds of each query's drag
    #[arg(long, value_name = "X", value_parser = super::seconds)]
    query_seconds: Option<f64>,
    /// Add each user's first N trials of every surface to the library (only protocols with users)
    #[arg(long, default_value_t = 0, value_name = "N")]
    enrolled: usize,
    /// Also print accuracy and scan time when each scan ends as soon as its answer is settled
    #[arg(long, conflicts_with_all = ["paper", "query_seconds"])]
    settle: bool,
    /// Also leave whole surfaces out of the library, in this many groups, and print how many of
    /// their queries are called unknown
    #[arg(long, value_name = "GROUPS", conflicts_with = "paper", value_parser = groups)]
    leave_surfaces_out: Option<usize>,
    /// Write a table of all queries: what each is, its answer, and the probability of each surface
    #[arg(long, value_name = "FILE.csv", conflicts_with = "paper")]
    predictions: Option<PathBuf>,
    #[command(flatten)]
    only: WhereArgs,
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
    parsed(text, |groups| *groups >= 2, "a whole number, 2 or more")
}

pub(super) fn run(args: &Args) -> Done {
    if let Some(Then::Merge(args)) = &args.then {
        return paper::merge(args);
    }
    let Some(data) = &args.data else {
        return Err(Failure::Usage("name the recordings".into()));
    };
    let _lock = LibraryLock::for_reading(data);
    let mut report = match feature_tables::open(data)? {
        Some(tables) => on_tables(args, &tables)?,
        None => {
            let mut library = super::open_held(data)?;
            args.only.keep(data, &mut library)?;
            if args.paper {
                return bad_files::work(data, library, |library| {
                    paper::run(library, &args.method, args.shard, args.out.as_deref(), args.json)
                });
            }
            bad_files::work(data, library, |library| {
                let scene = args.sources.narrow(library.scene.clone())?;
                let entries = within(library, &scene)?;
                let keys: Vec<TrialKey> = entries.iter().map(|entry| entry.key.clone()).collect();
                let cache = (!args.method.no_cache).then_some(data.as_path());
                let on = Evaluation { cache, ..Evaluation::new(&scene, &entries, &[]) };
                let leaks = leaks(library, &entries);
                let of = (library.name.as_str(), library.synthetic);
                let mut report = evaluated(args, of, on, &keys, &leaks)?;
                let names =
                    keys.iter().zip(&entries).map(|(key, entry)| (key, entry.name_in(data)));
                report.name_trials(&names.collect());
                Ok(report)
            })?
        }
    };
    report.warnings.extend(bad_files::skipped());
    if let Some(path) = &args.predictions {
        report.write_predictions(path)?;
    }
    show::report(args.json, &report, |report| {
        report.print();
        let lib = quoted(data);
        show::next(&match report.outcome.method == MethodName::Embedding.as_str() {
            true => format!(
                "surfaced plan {lib} finds the cheapest setting; surfaced replay NEW --library {lib} \
                 names new scans"
            ),
            false => format!("surfaced chart {lib} --out chart.svg compares all methods"),
        });
    });
    Ok(())
}

fn on_tables(args: &Args, tables: &FeatureTables) -> Result<EvalReport, Failure> {
    if args.paper || args.query_seconds.is_some() {
        let problem = "--paper and --query-seconds need recordings; these are feature tables";
        return Err(Failure::Usage(problem.into()));
    }
    let trials = vectors(tables, &args.sources.sources)?;
    let keys: Vec<TrialKey> = trials.iter().map(|trial| trial.key.clone()).collect();
    let (scene, trials) = (Scene::lmt108(), EvaluatedTrials::Features(&trials));
    let on = Evaluation { trials, ..Evaluation::new(&scene, &[], &[]) };
    evaluated(args, (&tables.name, false), on, &keys, &Leaks::default())
}

/// The trials, with the features of the chosen tables. If no table is chosen, all are used.
fn vectors(tables: &FeatureTables, chosen: &[SourceId]) -> Result<Vec<FeatureVector>, Failure> {
    if let Some(unknown) = chosen.iter().find(|id| !tables.sources.contains(id)) {
        let known = listed(&tables.sources);
        return Err(Failure::Usage(format!("no table {unknown}; there are {known}")));
    }
    let wanted = |id: &SourceId| chosen.is_empty() || chosen.contains(id);
    let features = |(id, values): (&SourceId, &Vec<f64>)| {
        (id.clone(), SourceFeatures { values: values.clone(), rate_hz: 0.0 })
    };
    let vector = |(key, sources): (&TrialKey, &BTreeMap<SourceId, _>)| FeatureVector {
        key: key.clone(),
        sources: sources.iter().filter(|(id, _)| wanted(id)).map(features).collect(),
    };
    let trials = tables.trials.iter().map(vector).filter(|trial| !trial.sources.is_empty());
    let trials: Vec<FeatureVector> = trials.collect();
    say!("{}: feature tables {}, {} trials", tables.name, listed(&tables.sources), trials.len());
    Ok(trials)
}

/// Evaluates the trials of `on`, which have these keys, on folds of the wanted protocol.
fn evaluated(
    args: &Args,
    (data, synthetic): (&str, bool),
    on: Evaluation<'_>,
    keys: &[TrialKey],
    leaks: &Leaks,
) -> Result<EvalReport, Failure> {
    let (protocol, before) = split(keys, args.protocol)?;
    if args.enrolled > 0 && !protocol.folds_are_users() {
        return Err(Failure::Usage(format!(
            "--enrolled goes with expert-vs-users and all-vs-one-user, not with {}",
            protocol.name()
        )));
    }
    let folds = enrol(&before, keys, args.enrolled)?;
    let (before, _) = kept_apart(before, keys, leaks);
    let (folds, leak) = kept_apart(folds, keys, leaks);
    let method = args.method.spec()?.build(on.scene);
    let query_seconds = args.query_seconds;
    let on = Evaluation { folds: &folds, query_seconds, progress: &say::progress, ..on };
    let measured = || -> Result<EvalReport, EvaluateError> {
        let run = on.prepare(&*method)?;
        run.library.remarks.iter().for_each(|remark| say!("{remark}"));
        let settled = args.settle.then(|| SettledOutcome::of(&run, args.answers.settle_loss));
        let settled = settled.transpose()?;
        let rate = args.answers.false_rejections;
        let unknown = args.leave_surfaces_out.map(|groups| UnknownOutcome::of(&run, groups, rate));
        let unknown = unknown.transpose()?;
        let measured = run.measure()?;
        let mut warnings: Vec<String> = leak.iter().cloned().collect();
        warnings.extend(show::left_out(&measured.left_out));
        if args.method.is_default() {
            warnings.extend(better_plain(on, &measured.predictions));
        }
        warnings.iter().for_each(|line| say!("warning: {line}"));
        let enrolled = match args.enrolled {
            0 => None,
            count => Some(EnrolmentOutcome::of(&run, &measured, &before, count)?),
        };
        let answer = |p: Prediction| EvalAnswer::new(folds[p.fold].name.clone(), p);
        Ok(EvalReport {
            outcome: measured.outcome.over(protocol.over()),
            protocol,
            data: data.into(),
            synthetic,
            query_seconds,
            settled,
            unknown,
            enrolled,
            not_asked: not_asked(&folds, keys),
            predictions: measured.predictions.into_iter().map(answer).collect(),
            warnings,
        })
    };
    measured().map_err(mended)
}

/// The surfaces of trials that no fold asks and no library holds, with how many.
fn not_asked(folds: &[Fold], keys: &[TrialKey]) -> BTreeMap<String, usize> {
    let asked: BTreeSet<usize> = folds.iter().flat_map(|fold| fold.queries.clone()).collect();
    let mut counts = BTreeMap::new();
    for (at, key) in keys.iter().enumerate().filter(|(at, _)| !asked.contains(at)) {
        // By the protocol, `expert` may be the library alone.
        let is_library = folds.iter().all(|fold| fold.library.contains(&at));
        if !is_library {
            *counts.entry(key.surface.clone()).or_default() += 1;
        }
    }
    counts
}

/// Adds the option that avoids the failure to its message.
fn mended(error: EvaluateError) -> Failure {
    match error {
        EvaluateError::Follow { .. } => Failure::Failed(format!("{error}; use --method embedding")),
        EvaluateError::Recognise(RecogniseError::NeedsRecordings(_)) => {
            Failure::Usage(error.to_string())
        }
        other => other.into(),
    }
}
