//! `surfaced eval`: measures accuracy under a protocol, such as leave-one-trial-out.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use super::bad_files;
use super::choose::{SplitArgs, Splittable, kept_apart, within};
use super::condition::WhereArgs;
use super::eval_report::{EvalAnswer, EvalReport, EvalTable, Seeds, write_predictions};
use super::figure::can_write;
use super::method::{AnswerArgs, MethodOptions, OneOrAll};
use super::show::{Made, listed, quoted};
use super::{Done, Failure, SourceArgs, one_of, paper, parsed, say, show};
use crate::dataset::feature_tables::{self, FeatureTables};
use crate::evaluate::{
    EnrolmentOutcome, EvaluateError, EvaluatedTrials, Evaluation, Fold, Leaks, Over, Prediction,
    SettledOutcome, Split, UnknownOutcome, better_plain, enrol, still,
};
use crate::features::{FeatureVector, SourceFeatures};
use crate::recognise::{MethodName, MethodSpec, RecogniseError};
use crate::record::edit::LibraryLock;
use crate::replication::Shard;
use crate::scene::{Scene, SourceId};
use crate::trial::TrialKey;

/// Measure how well a method names surfaces
#[derive(clap::Args)]
#[command(
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true,
    after_help = "Examples:\n  surfaced eval LMT_108_SurfaceMaterials_Database \
                  --protocol leave-one-trial-out --sources mi2 --json\n  surfaced eval my-library \
                  --method embedding,svm --group-by tool\n  surfaced eval my-library --split folds.csv \
                  --predictions answers.csv\n  surfaced eval \
                  LMT_108_SurfaceMaterials_Database --paper --out results\n\nTime: 5 s for LMT108's 200 dragging sounds, on two cores; --method reference 10 s, --method all a minute; --paper hours, see --shard"
)]
pub(super) struct Args {
    #[command(subcommand)]
    then: Option<Then>,
    /// Recordings: a library, or the LMT108 database; or feature tables
    #[arg(required = true)]
    data: Option<PathBuf>,
    #[command(flatten)]
    split: SplitArgs,
    /// Compute the paper's tables, each result beside the paper's
    #[arg(long, conflicts_with_all = [
        "protocol", "split", "group_by", "sources", "query_seconds", "method", "neighbours", "halving",
        "enrolled", "seeds"
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
    /// How trials are compared (default: embedding, or the one whose options are given). Several, with
    /// commas between them, name the same queries, and are compared by paired tests
    #[arg(long, value_delimiter = ',', value_name = "METHOD,…", value_parser = one_of(OneOrAll::each()))]
    method: Vec<OneOrAll>,
    #[command(flatten)]
    options: MethodOptions,
    /// Also measure with the next seeds, N in all, and print mean and spread
    #[arg(long, value_name = "N", value_parser = seeds)]
    seeds: Option<u64>,
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

/// Refuses options that would change nothing, and files that must not be written, before any work.
fn check(args: &Args) -> Done {
    let AnswerArgs { settle_loss, false_rejections } = args.answers;
    if settle_loss.is_some() && !args.settle {
        return Err(Failure::usage("--settle-loss goes with --settle"));
    }
    if false_rejections.is_some() && args.leave_surfaces_out.is_none() {
        return Err(Failure::usage("--false-rejections goes with --leave-surfaces-out"));
    }
    args.predictions.as_deref().map_or(Ok(()), |path| can_write(path, &["csv"]))
}

fn groups(text: &str) -> Result<usize, String> {
    parsed(text, |groups| *groups >= 2, "a whole number, 2 or more")
}

fn seeds(text: &str) -> Result<u64, String> {
    parsed(text, |seeds| (2..=1000).contains(seeds), "a whole number from 2 to 1000")
}

pub(super) fn run(args: &Args) -> Done {
    if let Some(Then::Merge(args)) = &args.then {
        return paper::merge(args);
    }
    let data = args.data.as_ref().ok_or_else(|| Failure::usage("name the recordings"))?;
    check(args)?;
    let _lock = LibraryLock::for_reading(data);
    let (mut reports, digest) = match feature_tables::open(data)? {
        Some(tables) => (on_tables(args, &tables)?, tables.digest()),
        None => {
            let mut library = super::open_held(data)?;
            args.only.keep(data, &mut library)?;
            if args.paper {
                return bad_files::work(data, library, |library| {
                    paper::run(library, &args.options, args.shard, args.out.as_deref(), args.json)
                });
            }
            bad_files::work(data, library, |library| {
                let scene = args.sources.narrow(library.scene.clone())?;
                let entries = within(library, &scene)?;
                let cache = (!args.options.no_cache).then_some(data.as_path());
                let on = Evaluation { cache, ..Evaluation::new(&scene, &entries, &[]) };
                let leaks = Leaks::of(&entries, &say::progress);
                let of = (library.name.as_str(), library.synthetic);
                let trials = Splittable::Recordings(data, &entries);
                let (mut reports, keys) = (evaluated(args, of, on, trials, &leaks)?, trials.keys());
                let names: BTreeMap<_, _> = keys.iter().zip(trials.names()).collect();
                reports.iter_mut().for_each(|report| report.name_trials(&names));
                let digest = if args.json { library.digest() } else { String::new() };
                Ok((reports, digest))
            })?
        }
    };
    reports.iter_mut().for_each(|report| report.warnings.extend(bad_files::skipped()));
    if let Some(path) = &args.predictions {
        write_predictions(&reports, path)?;
    }
    let seed = args.options.seed;
    let named = match reports.iter().any(EvalReport::names_any) {
        true => Ok(()),
        false => Err(Failure::Damaged(
            "no query could be named; the warnings above say why: check cables, and drag longer"
                .into(),
        )),
    };
    if reports.len() > 1 {
        let made = Made::new(EvalTable::new(reports), seed, digest);
        show::result(args.json, &made, |made| made.of.print());
        return named;
    }
    // Without several methods, there is one report.
    let Some(report) = reports.pop() else { return Ok(()) };
    show::result(args.json, &Made::new(report, seed, digest), |Made { of: report, .. }| {
        report.print();
        if named.is_err() {
            return;
        }
        let lib = quoted(data);
        show::next(&match report.outcome.method == MethodName::Embedding.as_str() {
            true => format!(
                "surfaced plan {lib} finds the cheapest setting; surfaced replay NEW --library {lib} \
                 names new scans"
            ),
            false => format!("surfaced chart {lib} --out chart.svg compares all methods"),
        });
    });
    named
}

fn on_tables(args: &Args, tables: &FeatureTables) -> Done<Vec<EvalReport>> {
    if args.paper || args.query_seconds.is_some() {
        let problem = "--paper and --query-seconds need recordings; these are feature tables";
        return Err(Failure::usage(problem));
    }
    let trials = vectors(tables, &args.sources.sources)?;
    let keys: Vec<TrialKey> = trials.iter().map(|trial| trial.key.clone()).collect();
    let (scene, trials) = (Scene::lmt108(), EvaluatedTrials::Features(&trials));
    let on = Evaluation { trials, ..Evaluation::new(&scene, &[], &[]) };
    evaluated(args, (&tables.name, false), on, Splittable::Features(&keys), &Leaks::default())
}

/// The trials, with the features of the chosen tables. If no table is chosen, all are used.
fn vectors(tables: &FeatureTables, chosen: &[SourceId]) -> Done<Vec<FeatureVector>> {
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

/// Evaluates the trials of `on` by each method, on the same folds.
fn evaluated(
    args: &Args,
    of: (&str, bool),
    on: Evaluation<'_>,
    trials: Splittable<'_>,
    leaks: &Leaks,
) -> Done<Vec<EvalReport>> {
    let named = OneOrAll::list(&args.method);
    let specs = args.options.specs(&named)?;
    if args.seeds.is_some() && specs.iter().all(|spec| spec.seeded(1).is_none()) {
        return Err(Failure::Usage(format!(
            "--seeds changes nothing: {} draws nothing at random",
            listed(specs.iter().map(|spec| spec.name().as_str()))
        )));
    }
    if args.settle
        && let Some(other) = specs.iter().find(|spec| spec.name() != MethodName::Embedding)
    {
        let other = other.name().as_str();
        return Err(Failure::Usage(format!(
            "--settle follows scans in progress, which {other} cannot; use --method embedding"
        )));
    }
    let keys = trials.keys();
    let surfaces = keys.iter().map(|key| &*key.surface).collect::<BTreeSet<_>>().len();
    if args.leave_surfaces_out.is_some_and(|groups| groups > surfaces) {
        let surfaces = show::counted(surfaces, "surface");
        return Err(Failure::Usage(format!(
            "--leave-surfaces-out takes at most as many groups as there are surfaces: {surfaces}"
        )));
    }
    let mut split = args.split.split(trials)?;
    if args.enrolled > 0 && split.over != Over::People {
        return Err(Failure::Usage(format!(
            "--enrolled goes with expert-vs-users and all-vs-one-user, not with {}",
            split.name
        )));
    }
    let folds = enrol(&split.folds, &keys, args.enrolled)?;
    let (before, _) = kept_apart(split.folds, &keys, leaks);
    let (folds, leak) = kept_apart(folds, &keys, leaks);
    split.folds = folds;
    let still = match on.trials {
        EvaluatedTrials::Recordings(entries) => still(entries, on.scene),
        EvaluatedTrials::Features(_) => Vec::new(),
    };
    let remarks: Vec<String> =
        leak.into_iter().chain(still.iter().map(ToString::to_string)).collect();
    remarks.iter().for_each(|line| say!("warning: {line}"));
    let measured = |spec| {
        let mut report = measured(args, of, on, (&split, &before), spec).map_err(mended)?;
        report.warnings.splice(0..0, remarks.clone());
        report.not_asked = not_asked(&split.folds, &keys);
        if named.len() > 1 {
            let (method, accuracy) = (&report.outcome.method, report.outcome.share.value());
            say!("{method}: {}", show::percent(accuracy));
        }
        Ok(report)
    };
    specs.iter().map(measured).collect()
}

/// Evaluates one method on the folds of `split`; `before` are those without enrolled trials.
fn measured(
    args: &Args,
    (data, synthetic): (&str, bool),
    on: Evaluation<'_>,
    (split, before): (&Split, &[Fold]),
    spec: &MethodSpec,
) -> Result<EvalReport, EvaluateError> {
    let query_seconds = args.query_seconds;
    let on = Evaluation { folds: &split.folds, query_seconds, progress: &say::progress, ..on };
    let method = spec.build(on.scene);
    let run = on.prepare(&*method)?;
    run.library.remarks.iter().for_each(|remark| say!("{remark}"));
    let (loss, rate) = (args.answers.loss(), args.answers.false_rejections);
    let settled = args.settle.then(|| SettledOutcome::of(&run, loss, split.over)).transpose()?;
    let unknown = args.leave_surfaces_out.map(|groups| UnknownOutcome::of(&run, groups, rate));
    let unknown = unknown.transpose()?;
    let measured = run.measure()?;
    let mut warnings = show::left_out(&measured.left_out);
    if args.method.is_empty() && spec.name() == MethodName::Embedding {
        warnings.extend(better_plain(on, &measured.predictions, split.over));
    }
    warnings.iter().for_each(|line| say!("warning: {line}"));
    let enrolled = || EnrolmentOutcome::of(&run, &measured, before, args.enrolled);
    let enrolled = (args.enrolled > 0).then(enrolled).transpose()?;
    let outcome = measured.outcome.over(split.over);
    // Other seeds are not cached, since the cache holds the trials of one seed.
    let of_seed = |seed: u64| -> Result<f64, EvaluateError> {
        let spec = spec.seeded(seed).unwrap_or_else(|| spec.clone());
        let method = spec.build(on.scene);
        let run = Evaluation { cache: None, ..on }.prepare(&*method)?;
        Ok(run.measure()?.outcome.share.value())
    };
    let first = args.options.seed;
    let seeds = args.seeds.filter(|_| spec.seeded(first).is_some());
    let seeds = seeds.map(|count| {
        let others = (1..count).map(|more| of_seed(first.wrapping_add(more)));
        let all = std::iter::once(Ok(outcome.share.value())).chain(others);
        Ok::<_, EvaluateError>(Seeds::new(first, all.collect::<Result<_, _>>()?))
    });
    let answer = |p: Prediction| EvalAnswer::new(split.folds[p.fold].name.clone(), p);
    Ok(EvalReport {
        outcome,
        protocol: split.name.clone(),
        left_out: split.left_out.clone(),
        over: split.over,
        data: data.into(),
        synthetic,
        query_seconds,
        seeds: seeds.transpose()?,
        settled,
        unknown,
        enrolled,
        not_asked: BTreeMap::new(),
        predictions: measured.predictions.into_iter().map(answer).collect(),
        warnings,
    })
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
        EvaluateError::Recognise(RecogniseError::NeedsRecordings(_)) => Failure::usage(error),
        other => other.into(),
    }
}
