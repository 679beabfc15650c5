//! `surfaced replay`: plays recordings through the rings as if they were live, and names them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use super::method::{MethodArgs, WithMethod};
use super::{Done, Failure, SourceArgs, show};
use crate::dataset::synth;
use crate::device::{Replay, Speed};
use crate::evaluate::{self, Fold, Protocol, wilson_interval};
use crate::library::{Entry, Library};
use crate::recognise::{Method, RankedSurface, Ranking, RecogniseError};
use crate::scan::{Event, Options, Scan, Session};
use crate::scene::{Scene, SourceId};
use crate::trial::{EXPERT, TrialKey, flaws};

/// Play recordings as if they were live, and name their surfaces
///
/// Without DATA, plays the embedded synthetic scene. Without --library, each trial of DATA is
/// named against the others by the protocol: users against the expert where DATA has users, else
/// each trial against the same person's other trials.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced replay\n  \
                        surfaced replay LMT_108_SurfaceMaterials_Database --sources mi2 --speed max\n  \
                        surfaced replay new-scans --library my-library --json")]
pub struct Args {
    /// Recordings to play: a library, or the LMT108 database
    data: Option<PathBuf>,
    /// Labelled trials to compare with
    #[arg(long, value_name = "LIB", requires = "data")]
    library: Option<PathBuf>,
    /// How fast to play: a multiple of real time, or `max`
    #[arg(long, default_value = "max", value_name = "SPEED")]
    speed: Speed,
    /// Which trials are named against which, where no library is given
    #[arg(long, value_enum, conflicts_with = "library")]
    protocol: Option<Protocol>,
    #[command(flatten)]
    sources: SourceArgs,
    #[command(flatten)]
    method: MethodArgs,
    /// Use only the first seconds of each drag
    #[arg(long, value_name = "X", value_parser = super::eval::seconds)]
    query_seconds: Option<f64>,
    /// Print one line of JSON a scan on stdout
    #[arg(long)]
    json: bool,
}

/// One line of JSON: a scan and its answer.
#[derive(serde::Serialize)]
struct Line<'a> {
    scan: u32,
    surface: &'a str,
    truth: Option<&'a str>,
    user: Option<&'a str>,
    trial: Option<u32>,
    synthetic: bool,
    ranked: &'a [RankedSurface],
    margin: f64,
    latency_ms: f64,
    scan_s: f64,
    lost_samples: u64,
    sources: &'a [SourceId],
    spoiled: &'a [String],
}

/// What is played, and what it is compared with.
struct Stage {
    scene: Scene,
    /// All trials, of data and library.
    entries: Vec<Entry>,
    folds: Vec<Fold>,
    synthetic: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Done {
    let stage = match (&args.data, &args.library) {
        (None, _) => {
            let scene = synth::embedded();
            show::library(&scene);
            by_protocol(args, scene, Some(Protocol::ExpertVsUsers))?
        }
        (Some(data), None) => by_protocol(args, super::open(data)?, args.protocol)?,
        (Some(data), Some(library)) => against(args, data, library)?,
    };
    args.method.apply(&stage.scene, Player { args, stage: &stage })
}

fn usable(args: &Args, library: &Library) -> Result<(Scene, Vec<Entry>), Failure> {
    let scene = args.sources.narrow(library.scene.clone())?;
    let entries = (library.entries.iter())
        .map(|entry| entry.clone().within(&scene))
        .filter(|entry| !entry.sources.is_empty())
        .collect();
    Ok((scene, entries))
}

fn by_protocol(args: &Args, data: Library, protocol: Option<Protocol>) -> Result<Stage, Failure> {
    let (scene, entries) = usable(args, &data)?;
    let keys: Vec<TrialKey> = entries.iter().map(|entry| entry.key.clone()).collect();
    let has = |of_expert: bool| keys.iter().any(|key| (key.user == EXPERT) == of_expert);
    let protocol = protocol.unwrap_or(if has(true) && has(false) {
        Protocol::ExpertVsUsers
    } else {
        Protocol::LeaveOneTrialOut
    });
    let folds = evaluate::folds(protocol, &keys)?;
    eprintln!("each trial is named by {}", protocol.name());
    Ok(Stage { scene, entries, folds, synthetic: data.synthetic })
}

fn against(args: &Args, data: &PathBuf, library: &PathBuf) -> Result<Stage, Failure> {
    let same = |path: &PathBuf| path.canonicalize().ok();
    if same(data).is_some() && same(data) == same(library) {
        return Err(Failure::Usage(format!(
            "{}: data and library are one folder, so each trial would meet itself; leave --library \
             off, and each is named against the others",
            data.display()
        )));
    }
    let (data, library) = (super::open(data)?, super::open(library)?);
    let synthetic = data.synthetic || library.synthetic;
    let (scene, mut entries) = usable(args, &library)?;
    let (of_data, queries) = usable(args, &data)?;
    let fold = Fold {
        name: "library".into(),
        library: (0..entries.len()).collect(),
        queries: (entries.len()..entries.len() + queries.len()).collect(),
    };
    entries.extend(queries);
    Ok(Stage { scene: of_data.with(scene), entries, folds: vec![fold], synthetic })
}

struct Player<'a> {
    args: &'a Args,
    stage: &'a Stage,
}

impl WithMethod for Player<'_> {
    type Output = Done;

    fn with(self, method: impl Method + 'static) -> Done {
        let Self { args, stage } = self;
        let models = models(&method, stage)?;
        let mut fold_of = BTreeMap::new();
        let mut queries = Vec::new();
        for (index, fold) in stage.folds.iter().enumerate() {
            for &query in &fold.queries {
                fold_of.insert(stage.entries[query].key.clone(), index);
                let entry = &stage.entries[query];
                queries.push(super::eval::first_seconds(entry, &stage.scene, args.query_seconds));
            }
        }
        let total = queries.len();
        let device =
            Replay::new(&stage.scene, queries).speed(args.speed).synthetic(stage.synthetic);
        let session = Session::start(vec![Box::new(device)], Options::default())?;
        let mut tally = Tally { total, ..Tally::default() };
        let mut free_since = Instant::now();
        for event in session.events() {
            match event {
                Event::Scan(scan) => {
                    let fold = scan.truth.as_ref().and_then(|key| fold_of.get(key)).copied();
                    let model = &models[fold.unwrap_or(0)];
                    // A scan that waited for its turn behind others is not slow to name.
                    let from = scan.ended_at.max(free_since);
                    match recognise(&method, model, &scan) {
                        Ok(ranking) => tally.answer(args, &scan, &ranking, from),
                        Err(error) => tally.damage(&format!("scan {}: {error}", scan.number)),
                    }
                    free_since = Instant::now();
                }
                Event::Warning(text) => tally.damage(&text),
                Event::Device { .. } | Event::Progress(_) | Event::Trace(_) => {}
                Event::Finished(_) => break,
            }
        }
        let totals = session.wait()?;
        tally.sum_up(stage.synthetic);
        if let Some((name, error)) = totals.failed.first() {
            return Err(Failure::Failed(format!("{name}: {error}")));
        }
        tally.verdict(totals.lost())
    }
}

fn models<M: Method>(method: &M, stage: &Stage) -> Result<Vec<M::Model>, RecogniseError> {
    let steps = show::Steps::new();
    let wanted: BTreeSet<usize> = stage.folds.iter().flat_map(|f| f.library.clone()).collect();
    let progress = |step, done, of| steps.tell(step, done, of);
    let prepared = evaluate::prepare(method, &stage.entries, &wanted, &progress)?;
    let fit = |fold: &Fold| {
        method.fit(fold.library.iter().filter_map(|&i| prepared[i].clone()).collect())
    };
    stage.folds.iter().map(fit).collect()
}

/// Names a scan: what came out of the rings, and nothing else.
fn recognise<M: Method>(
    method: &M,
    model: &M::Model,
    scan: &Scan,
) -> Result<Ranking, RecogniseError> {
    let trial = Arc::new(scan.trial.clone());
    let query = method.prepare(&Entry::in_memory(trial.clone()), &trial)?;
    method.rank(model, &query)
}

/// What has been named so far.
#[derive(Default)]
struct Tally {
    total: usize,
    answers: usize,
    with_truth: usize,
    right: usize,
    latencies_ms: Vec<f64>,
    damages: usize,
    spoiled: usize,
}

impl Tally {
    fn answer(&mut self, args: &Args, scan: &Scan, ranking: &Ranking, from: Instant) {
        let latency_ms = from.elapsed().as_secs_f64() * 1e3;
        self.answers += 1;
        self.latencies_ms.push(latency_ms);
        self.spoiled += usize::from(!scan.spoiled.is_empty());
        let truth = scan.truth.as_ref();
        let right = truth.map(|key| key.surface == ranking.surface());
        self.with_truth += usize::from(right.is_some());
        self.right += usize::from(right == Some(true));
        for (id, signal) in &scan.trial.signals {
            self.tell_flaws(scan, id, signal);
        }
        for reason in &scan.spoiled {
            eprintln!("warning: scan {}: {reason}", scan.number);
        }
        if args.json {
            show::json(&Line {
                scan: scan.number,
                surface: ranking.surface(),
                truth: truth.map(|key| key.surface.as_str()),
                user: truth.map(|key| key.user.as_str()),
                trial: truth.map(|key| key.number),
                synthetic: scan.synthetic,
                ranked: &ranking.ranked,
                margin: ranking.margin,
                latency_ms,
                scan_s: scan.scan_s,
                lost_samples: scan.lost_samples,
                sources: &ranking.sources,
                spoiled: &scan.spoiled,
            });
        } else {
            self.tell(ranking, right, truth, latency_ms);
        }
    }

    fn tell(&self, ranking: &Ranking, right: Option<bool>, truth: Option<&TrialKey>, ms: f64) {
        let verdict = match (right, truth) {
            (Some(true), _) => "right".to_string(),
            (Some(false), Some(key)) => format!("wrong, it was {}", key.surface),
            _ => String::new(),
        };
        eprintln!(
            "{:>4}/{}  {:<28} margin {:<6.2} {:>7.1} ms  {verdict}",
            self.answers,
            self.total,
            ranking.surface(),
            ranking.margin,
            ms
        );
    }

    fn tell_flaws(&mut self, scan: &Scan, id: &SourceId, signal: &crate::trial::Signal) {
        // A switch such as the metal detector is constant most of the time.
        let crate::trial::Signal::Series(series) = signal else { return };
        if id.as_str() == "me" {
            return;
        }
        for flaw in flaws(series) {
            eprintln!("warning: scan {}: {id}: {flaw}", scan.number);
        }
    }

    fn damage(&mut self, text: &str) {
        self.damages += 1;
        eprintln!("warning: {text}");
    }

    fn sum_up(&mut self, synthetic: bool) {
        if self.answers == 0 {
            return;
        }
        let mark = if synthetic { " (synthetic scene)" } else { "" };
        let (low, high) = wilson_interval(self.right, self.with_truth);
        self.latencies_ms.sort_by(f64::total_cmp);
        let median = self.latencies_ms[self.latencies_ms.len() / 2];
        eprintln!();
        if self.with_truth > 0 {
            eprintln!(
                "accuracy {} of {} scans (95 % interval {} to {}){mark}",
                show::percent(self.right as f64 / self.with_truth as f64),
                self.with_truth,
                show::percent(low),
                show::percent(high)
            );
        }
        eprintln!("latency  {median:.1} ms from the end of a scan to its name (median)");
    }

    fn verdict(&self, lost: u64) -> Done {
        if self.answers == 0 {
            return Err(Failure::Failed("no scan was named; see the warnings above".into()));
        }
        if self.damages + self.spoiled > 0 || lost > 0 {
            return Err(Failure::Damaged(format!(
                "{} of {} scans named; {} warning(s), {} scan(s) spoiled, {lost} sample(s) lost",
                self.answers, self.total, self.damages, self.spoiled
            )));
        }
        Ok(())
    }
}
