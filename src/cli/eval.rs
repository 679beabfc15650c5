//! `surfaced eval`: measures accuracy under a protocol, such as leave-one-trial-out.

use std::collections::BTreeMap;
use std::path::PathBuf;

use super::bad_files;
use super::choose::{split, within};
use super::condition::WhereArgs;
use super::method::{AnswerArgs, MethodArgs};
use super::show::{listed, quoted};
use super::{Done, Failure, SourceArgs, paper, parsed, say, show};
use crate::dataset::feature_tables::{self, FeatureTables};
use crate::evaluate::paper::Shard;
use crate::evaluate::{
    EnrolmentOutcome, EvaluateError, EvaluatedTrials, Evaluation, Fold, Leaks, Outcome, Prediction,
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
                let leaks = Leaks::of(&entries, &say::progress);
                let found = leaks.text(&keys, |trial| entries[trial].name_in(data));
                let leaks = found.map(|found| (&leaks, found));
                evaluated(args, (&library.name, library.synthetic), on, &keys, leaks)
            })?
        }
    };
    report.warnings.extend(bad_files::skipped());
    show::result(args.json, &report, |report| {
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
    evaluated(args, (&tables.name, false), on, &keys, None)
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
    leaks: Option<(&Leaks, String)>,
) -> Result<EvalReport, Failure> {
    let (protocol, before) = split(keys, args.protocol)?;
    if args.enrolled > 0 && !protocol.folds_are_users() {
        return Err(Failure::Usage(format!(
            "--enrolled goes with expert-vs-users and all-vs-one-user, not with {}",
            protocol.name()
        )));
    }
    let folds = enrol(&before, keys, args.enrolled)?;
    let (before, folds, leak) = kept_apart(before, folds, keys, leaks);
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
        let answer = |p: Prediction| {
            let TrialKey { surface: truth, user, number: trial, session } = p.key;
            EvalAnswer {
                truth,
                user,
                trial,
                session,
                fold: folds[p.fold].name.clone(),
                answer: p.surface,
                margin: p.margin,
                confidence: p.confidence,
                p_value: p.p_value,
                probabilities: p.probabilities.into_iter().collect(),
            }
        };
        Ok(EvalReport {
            outcome: measured.outcome,
            protocol,
            data: data.into(),
            synthetic,
            query_seconds,
            settled,
            unknown,
            enrolled,
            predictions: measured.predictions.into_iter().map(answer).collect(),
            warnings,
        })
    };
    measured().map_err(mended)
}

/// Takes trials that share samples with a query out of the library of its fold, from the folds without
/// and with enrolled trials. Also returns a warning, which says if that cannot be done.
fn kept_apart(
    before: Vec<Fold>,
    folds: Vec<Fold>,
    keys: &[TrialKey],
    leaks: Option<(&Leaks, String)>,
) -> (Vec<Fold>, Vec<Fold>, Option<String>) {
    let Some((leaks, found)) = leaks else { return (before, folds, None) };
    match (leaks.apart(&before, keys), leaks.apart(&folds, keys)) {
        (Some(before), Some(apart)) => {
            let queries = |folds: &[Fold]| folds.iter().map(|fold| fold.queries.len()).sum();
            let (all, asked): (usize, usize) = (queries(&folds), queries(&apart));
            let lost = match all - asked {
                0 => String::new(),
                lost => format!(
                    "; {} not asked, since nothing else of their surface is left",
                    show::counted(lost, "trial")
                ),
            };
            let kept = "kept together: none is named by the samples that it shares";
            (before, apart, Some(format!("{found}; {kept}{lost}")))
        }
        _ => {
            let why = "without these trials no library has two surfaces";
            let warning =
                format!("{found}; they cannot be kept together ({why}): the accuracy is too high");
            (before, folds, Some(warning))
        }
    }
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

/// The JSON document: the outcome, and the data and settings behind it.
#[derive(serde::Serialize)]
struct EvalReport {
    #[serde(flatten)]
    outcome: Outcome,
    protocol: Protocol,
    data: String,
    synthetic: bool,
    query_seconds: Option<f64>,
    /// Present only with `--settle`.
    #[serde(skip_serializing_if = "Option::is_none")]
    settled: Option<SettledOutcome>,
    /// Present only with `--leave-surfaces-out`.
    #[serde(skip_serializing_if = "Option::is_none")]
    unknown: Option<UnknownOutcome>,
    /// Present only with `--enrolled`.
    #[serde(skip_serializing_if = "Option::is_none")]
    enrolled: Option<EnrolmentOutcome>,
    predictions: Vec<EvalAnswer>,
    /// Sources that were left out, and the reasons, a line each.
    warnings: Vec<String>,
}

#[derive(serde::Serialize)]
struct EvalAnswer {
    truth: String,
    user: String,
    trial: u32,
    session: Option<String>,
    /// Name of the person, session or trial that was left out.
    fold: String,
    answer: String,
    margin: f64,
    confidence: Option<f64>,
    p_value: Option<f64>,
    /// Of each surface of the library; empty if the method gives none.
    probabilities: BTreeMap<String, f64>,
}

impl EvalReport {
    fn print(&self) {
        let Outcome { share, method, classes, library_trials, .. } = &self.outcome;
        let Outcome { query_ms_p50, query_ms_p99, confusion, never_queried, .. } = &self.outcome;
        let percent = show::percent;
        let mark = if self.synthetic { ", on synthetic data" } else { "" };
        result!();
        let (accuracy, right, of) = (percent(share.value()), share.right, share.of);
        let interval = show::interval(*share);
        result!("accuracy   {accuracy} ({right} of {of} queries; 95 % interval {interval})");
        let sources = listed(&self.outcome.sources);
        result!("           {} · {method} · {sources}{mark}", self.protocol.name());
        result!("           {}", self.protocol.left_out());
        if self.protocol.folds_are_users() {
            let users = show::counted(self.outcome.folds.len(), "user");
            let std = self.outcome.accuracy_std.map(|std| format!(" ± {}", percent(std)));
            let mean = percent(self.outcome.accuracy_mean);
            result!("           mean over {users}: {mean}{}", std.unwrap_or_default());
        }
        self.enrolled.iter().for_each(print_enrolled);
        let surfaces = show::counted(*classes, "surface");
        let trials = show::counted(*library_trials, "library trial");
        result!("           {surfaces} against {trials}");
        if !never_queried.is_empty() {
            result!("           never queried: {}", never_queried.join(", "));
        }
        if say::is_verbose() {
            result!("precision  {}", percent(self.outcome.precision_mean));
            result!(
                "query      {query_ms_p50:.1} ms from raw samples to the answer (median), \
                 {query_ms_p99:.1} ms (p99)"
            );
        }
        for (truth, answer, count) in confusion.worst(5) {
            result!("           {count} × {truth} taken for {answer}");
        }
        self.settled.iter().for_each(print_settled);
        self.unknown.iter().for_each(print_unknown);
    }
}

fn print_enrolled(e: &EnrolmentOutcome) {
    let (trials, points) = (show::counted(e.trials, "trial"), 100.0 * e.gain);
    let (without, interval) = (show::percent(e.without.value()), show::interval(e.without));
    result!(
        "enrolled   {trials} of each surface by the user: {points:+.1} points; without, {without} of \
         the same queries ({interval})"
    );
}

fn print_settled(s: &SettledOutcome) {
    let SettledOutcome { lost, gained, scan_s_mean, scan_s_p50, whole_s_mean, .. } = s;
    let [share, whole, loss] =
        [s.share.value(), s.accuracy_whole, s.stated_loss].map(show::percent);
    let interval = show::interval(s.share);
    result!(
        "settled    {share} (95 % interval {interval}) against {whole} by whole scans: {lost} lost, \
         {gained} gained"
    );
    result!(
        "           after {scan_s_mean:.2} s on average ({scan_s_p50:.2} s in the median) of \
         {whole_s_mean:.2} s; {} of {} scans settled before they ended",
        s.settled,
        s.queries
    );
    let (shown, folds) = (s.rules.iter().filter(|rule| rule.shown).count(), s.rules.len());
    result!(
        "           stated loss {loss} at most, shown (at 90 %) by the libraries of {shown} of \
         {folds} folds"
    );
    if let Some(share) = s.core_share {
        result!("           following takes {} of one core", show::percent(share));
    }
}

fn print_unknown(u: &UnknownOutcome) {
    let (caught, interval) = (show::percent(u.unknown.value()), show::interval(u.unknown));
    let of = u.unknown.of;
    result!(
        "unknown    {caught} of {of} queries of left-out surfaces caught (95 % interval {interval})"
    );
    let (rejected, interval) = (show::percent(u.known.value()), show::interval(u.known));
    let (of, trials) = (u.known.of, u.stated.trials);
    let [rate, low, high] =
        [u.stated.rate, u.stated.rate_low, u.stated.rate_high].map(show::percent);
    result!(
        "           {rejected} of {of} queries of known ones rejected ({interval}); stated {rate} \
         ({low} to {high}, by {trials} left-out trials)"
    );
    result!(
        "           in {} of {} folds the share rejected lies in the interval stated there",
        u.folds_as_stated,
        u.folds
    );
}
