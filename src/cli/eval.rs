//! `surfaced eval`: accuracy by protocol.

mod features;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use super::answers::AnswerArgs;
use super::bad_files::{self, BadFileArgs};
use super::choose::{Choice, choose};
use super::method::MethodArgs;
use super::{Done, Failure, SourceArgs, paper, show};
use crate::dataset::table;
use crate::evaluate::first_seconds;
use crate::evaluate::paper::Shard;
use crate::evaluate::{
    self, EvaluateError, Fold, Outcome, Prediction, Protocol, SettledOutcome, UnknownOutcome,
};
use crate::library::Entry;
use crate::recognise::{Method, Model, without_flawed};
use crate::scene::Scene;
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
    bad_files: BadFileArgs,
    #[command(flatten)]
    method: MethodArgs,
    /// Use only the first seconds of each query's drag
    #[arg(long, value_name = "X", value_parser = super::parse::seconds)]
    query_seconds: Option<f64>,
    /// Also answer as soon as an answer is settled, and tell accuracy and scan time
    #[arg(long, conflicts_with_all = ["paper", "query_seconds"])]
    settle: bool,
    /// Also leave whole surfaces out of the library, in so many groups, and tell how many of their
    /// queries are called unknown
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
    match text.parse() {
        Ok(groups) if groups >= 2 => Ok(groups),
        _ => Err("expected a whole number, 2 or more".into()),
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
    /// With `--settle`.
    #[serde(skip_serializing_if = "Option::is_none")]
    settled: Option<SettledOutcome>,
    /// With `--leave-surfaces-out`.
    #[serde(skip_serializing_if = "Option::is_none")]
    unknown: Option<UnknownOutcome>,
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

/// What a method is evaluated on.
pub(super) struct Evaluation<'a> {
    pub entries: &'a [Entry],
    pub folds: &'a [Fold],
    pub scene: &'a Scene,
    /// How much of each query's drag is used, one or more.
    pub seconds: &'a [Option<f64>],
    /// The folder whose trials are kept prepared, if they are.
    pub cache: Option<&'a Path>,
    pub also: Also,
}

/// What else is measured.
#[derive(Clone, Copy, Default)]
pub(super) struct Also {
    /// Settled answers, for this loss.
    pub settle: Option<f64>,
    /// Unknown surfaces, left out in so many groups.
    pub leave_out: Option<usize>,
    /// Share of known surfaces that may be called unknown.
    pub false_rejections: f64,
}

/// What came of it.
pub(super) struct Evaluated {
    /// As many as there are [`Evaluation::seconds`].
    pub each: Vec<(Outcome, Vec<Prediction>)>,
    pub settled: Option<SettledOutcome>,
    pub unknown: Option<UnknownOutcome>,
}

impl Evaluation<'_> {
    /// Evaluates a method.
    ///
    /// # Errors
    /// If a trial cannot be read or compared.
    pub fn of(&self, method: &dyn Method) -> Result<Evaluated, EvaluateError> {
        let steps = show::Steps::new();
        let left_out = LeftOut::default();
        let (scene, seconds) = (self.scene, self.seconds);
        let as_query = |model: &Arc<dyn Model>, of: usize, entry: &Entry| {
            left_out.leave_out(first_seconds(entry, scene, seconds[of]), scene, model)
        };
        let progress = |step, done, of| steps.show(step, done, of);
        let prepared =
            evaluate::prepare_folds(method, self.entries, self.folds, self.cache, &progress)?;
        for remark in &prepared.remarks {
            say!("{remark}");
        }
        let (entries, folds, prepared) = (self.entries, self.folds, &prepared);
        let Also { settle, leave_out, false_rejections } = self.also;
        let settled = settle.map(|loss| {
            let limits = (loss, None);
            evaluate::run_settled(method, scene, entries, folds, prepared, limits, &progress)
        });
        let settled = settled.transpose()?;
        let unknown = leave_out.map(|groups| {
            let how = (groups, false_rejections);
            evaluate::run_unknown(
                method,
                entries,
                folds,
                prepared,
                |model: &Arc<dyn Model>, entry: &Entry| as_query(model, 0, entry),
                how,
                &progress,
            )
        });
        let unknown = unknown.transpose()?;
        let variants = seconds.len();
        let each = evaluate::run_variants(
            method, entries, folds, prepared, variants, as_query, &progress,
        )?;
        drop(steps);
        left_out.tell();
        Ok(Evaluated { each, settled, unknown })
    }
}

/// Sources that were left out of queries, with the trials.
#[derive(Clone, Default)]
struct LeftOut(Arc<Mutex<BTreeMap<String, BTreeSet<TrialKey>>>>);

impl LeftOut {
    /// The entry without sources whose sensor is dead or stuck.
    fn leave_out(&self, entry: Entry, scene: &Scene, model: &Arc<dyn Model>) -> Entry {
        let (noted, scene, key) = (self.clone(), scene.clone(), entry.key.clone());
        let model = model.clone();
        entry.changed(move |trial| {
            let (trial, remarks) = without_flawed(trial, &scene, |id, c| model.moves(id, c));
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
                say!("warning: {remark} ({first}{more})");
            }
        }
    }
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
    let (library, skipped) = args.bad_files.open(data, |scene| args.sources.narrow(scene))?;
    if args.paper {
        let out = args.out.as_deref();
        paper::run(&library, &args.method, args.shard, out, args.json)?;
        return skipped.verdict();
    }
    let Some(protocol) = args.protocol else {
        return Err(Failure::Usage("name a protocol, or --paper".into()));
    };
    let scene = args.sources.narrow(library.scene.clone())?;
    let choice = choose(&library, scene, Some(protocol))?;
    let Choice { scene, entries, folds, .. } = &choice;
    let query_seconds = args.query_seconds;
    let cache = args.method.uses_cache().then_some(data.as_path());
    let also = Also {
        settle: args.settle.then_some(args.answers.settle_loss),
        leave_out: args.leave_surfaces_out,
        false_rejections: args.answers.false_rejections(),
    };
    let evaluation = Evaluation { entries, folds, scene, seconds: &[query_seconds], cache, also };
    let done = evaluation.of(&*args.method.spec()?.build(scene));
    let mut done = done.map_err(|error| bad_files::explain(entries, error))?;
    // There is one length, so one outcome.
    let (outcome, predictions) = done.each.swap_remove(0);
    let report = Report {
        outcome,
        protocol: protocol.name(),
        data: library.name.clone(),
        synthetic: library.synthetic,
        query_seconds,
        settled: done.settled,
        unknown: done.unknown,
        predictions: predictions.into_iter().map(Answer::from).collect(),
    };
    finish(args.json, report)?;
    skipped.verdict()
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
    say!();
    say!("{} · {} · {}{mark}", report.protocol, o.method, sources.join(", "));
    say!(
        "accuracy   {} ± {} over {} folds (95 % interval over queries: {} to {})",
        show::percent(o.accuracy_mean),
        show::percent(o.accuracy_std),
        o.folds.len(),
        show::percent(o.accuracy_low),
        show::percent(o.accuracy_high)
    );
    say!("precision  {}", show::percent(o.precision_mean));
    say!(
        "           {} surfaces, {} queries against {} library trials",
        o.classes,
        o.queries,
        o.library_trials
    );
    say!("query      {:.1} ms (median), {:.1} ms (p99)", o.query_ms_p50, o.query_ms_p99);
    for (truth, answer, count) in o.confusion.worst(5) {
        say!("           {count} × {truth} taken for {answer}");
    }
    report.settled.iter().for_each(tell_settled);
    report.unknown.iter().for_each(tell_unknown);
}

fn tell_settled(s: &SettledOutcome) {
    let percent = show::percent;
    say!(
        "settled    {} (95 % interval {} to {}) against {} by whole scans: {} lost, {} gained",
        percent(s.accuracy),
        percent(s.accuracy_low),
        percent(s.accuracy_high),
        percent(s.accuracy_whole),
        s.lost,
        s.gained
    );
    say!(
        "           after {:.2} s in the mean, {:.2} s in the median, of {:.2} s; {} of {} scans \
         settled before their end",
        s.scan_s_mean,
        s.scan_s_p50,
        s.whole_s_mean,
        s.settled,
        s.queries
    );
    let shown = s.rules.iter().filter(|rule| rule.shown).count();
    say!(
        "           stated loss {} at most, shown (at 90 %) by the libraries of {shown} of {} folds",
        percent(s.stated_loss),
        s.rules.len()
    );
    say!("           following takes {} of one core", percent(s.core_share));
}

fn tell_unknown(u: &UnknownOutcome) {
    let percent = show::percent;
    say!(
        "unknown    {} of {} queries of left-out surfaces caught (95 % interval {} to {})",
        percent(u.unknown_caught),
        u.unknown_queries,
        percent(u.unknown_caught_low),
        percent(u.unknown_caught_high)
    );
    say!(
        "           {} of {} queries of known ones rejected ({} to {}); stated {} ({} to {}, by {} \
         left-out trials)",
        percent(u.false_rejections),
        u.known_queries,
        percent(u.false_rejections_low),
        percent(u.false_rejections_high),
        percent(u.stated.rate),
        percent(u.stated.rate_low),
        percent(u.stated.rate_high),
        u.stated.trials
    );
}
