//! `surfaced replay`: plays recordings through the live pipeline, and names their surfaces.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::choose::{Choice, SplitArgs, protocols, within};
use super::condition::WhereArgs;
use super::json_lines::JsonLines;
use super::keys::watch_signals;
use super::method::{AccuracyArgs, AnswerArgs, Comparing, ComparingArgs, not_with_model};
use super::naming::{self, Ready};
use super::serve::{Page, ServeArgs};
use super::show::{self, quoted};
use super::tally::Tally;
use super::{Done, Failure, bad_files, live, one_of, say};
use crate::dataset::synth;
use crate::device::{Replay, Speed};
use crate::evaluate::{Evaluation, Fold, Protocol, first_seconds, in_libraries};
use crate::library::{Entry, Library};
use crate::recognise::{
    LOOK_S, Method, MethodName, Model, ReadyModel, RecogniseError, ready_model,
};
use crate::record::edit::LibraryLock;
use crate::record::reference::references;
use crate::scan::Options;
use crate::scene::Scene;
use crate::serve::{LibraryFolder, Settings};
use crate::station::{LibraryState, Recogniser, ScanStore, Station, StationEvent};
use crate::trial::EXPERT;

/// Play recordings as if they were live, and name their surfaces
///
/// Without DATA, plays the embedded synthetic scene. Without --library, the trials of DATA are
/// compared with each other: users with the expert if DATA has users, and otherwise each trial with
/// the same person's other trials.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced replay\n  \
                        surfaced replay LMT_108_SurfaceMaterials_Database --sources mi2 --speed max\n  \
                        surfaced replay new-scans --library my-library --json\n  \
                        surfaced replay new-scans --model model.surfaced --json\n  \
                        surfaced replay --speed 1.0 --serve\n  \
                        surfaced replay --continuous\n\nTime: about 10 s for the embedded scene, 6 s for LMT108's 200 dragging sounds, on two cores; with --speed 1.0 as long as the recordings")]
pub(super) struct Args {
    /// Recordings to play: a library, or the LMT108 database
    data: Option<PathBuf>,
    /// Labelled trials to compare with
    #[arg(long, value_name = "LIB", requires = "data")]
    library: Option<PathBuf>,
    /// Name by this model, a file written by `surfaced train`, instead of a library
    #[arg(long, value_name = "FILE", requires = "data", conflicts_with_all = not_with_model())]
    model: Option<PathBuf>,
    /// How fast to play: a multiple of real time, or `max`
    #[arg(long, default_value = "max", value_name = "SPEED")]
    speed: Speed,
    /// How queries and library are split, if no library is given
    #[arg(long, value_parser = one_of(protocols()), requires = "data",
        conflicts_with_all = ["library", "model"])]
    protocol: Option<Protocol>,
    #[command(flatten)]
    comparing: ComparingArgs,
    #[command(flatten)]
    only: WhereArgs,
    #[command(flatten)]
    answers: AnswerArgs,
    #[command(flatten)]
    accuracy: AccuracyArgs,
    /// Use only the first seconds of each drag
    #[arg(long, value_name = "X", value_parser = super::seconds, conflicts_with = "plan")]
    query_seconds: Option<f64>,
    /// Join the drags without a pause, name the surface by a sliding window, and say when it changes
    #[arg(long, conflicts_with = "query_seconds")]
    continuous: bool,
    /// Print one line of JSON for each scan on stdout
    #[arg(long)]
    json: bool,
    /// A station's configuration; the replay uses its `[scan]`, `[outputs]` and `[history]`
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    #[command(flatten)]
    serve: ServeArgs,
}

/// The recordings to play, and the recordings to compare them with.
pub(super) struct ReplayStage {
    pub name: String,
    pub scene: Scene,
    /// All trials: the recordings to play, and the library.
    pub entries: Vec<Entry>,
    pub folds: Vec<Fold>,
    pub synthetic: bool,
    /// The folder with the cache of prepared trials; `None` without a cache.
    pub cache: Option<PathBuf>,
    /// The recogniser, if it comes from a model file.
    pub ready: Option<Ready>,
}

pub(super) fn run(args: &Args) -> Done {
    say::results_aside(args.json);
    let mut how = args.comparing.resolve(args.query_seconds)?;
    // Trials are read while they are played, so the locks keep other programs from editing them.
    let _data = args.data.as_deref().map(LibraryLock::for_reading);
    let library = args.library.as_deref().map(LibraryLock::for_reading);
    let stage = match (&args.data, &args.library, &args.model) {
        (None, ..) if !args.only.is_empty() => {
            let why = "--where chooses among recordings: surfaced replay DATA --where KEY=X";
            return Err(Failure::usage(why));
        }
        (None, ..) => demonstration(&how)?,
        (Some(data), _, Some(model)) => by_model(args, &mut how, data, model)?,
        (Some(data), Some(library), _) => against(args, &how, data, library)?,
        (Some(data), None, None) => by_protocol(args, &how, data)?,
    };
    play(args, &how, stage, library)?;
    if !args.json {
        advise(args);
    }
    Ok(())
}

fn advise(args: &Args) {
    if let Some(model) = &args.model {
        return show::next(&format!("surfaced run --model {} names live scans", quoted(model)));
    }
    let next = match (&args.data, &args.library) {
        (None, _) if args.serve.is_wanted() => "surfaced eval my-library measures your own \
                                                recordings; see README.md for their form"
            .to_string(),
        (None, _) => "surfaced replay --speed 1.0 --serve plays it in real time, on a page".into(),
        (Some(data), None) => format!("surfaced eval {} sums up confusions", quoted(data)),
        (Some(_), Some(lib)) => {
            format!("surfaced run --library {} names live scans", quoted(lib))
        }
    };
    show::next(&next);
}

/// Uses the embedded scene. The expert's trials are the library, and the users' trials are the
/// queries; one surface of the queries is missing from the library.
fn demonstration(how: &Comparing) -> Done<ReplayStage> {
    let library = synth::embedded();
    show::library(&library);
    let scene = how.narrow(library.scene.clone())?;
    let entries = within(&library, &scene)?;
    let (of_expert, mut queries): (Vec<usize>, Vec<usize>) =
        (0..entries.len()).partition(|&i| entries[i].key.user == EXPERT);
    queries.sort_by_key(|&i| (&entries[i].key.user, &entries[i].key.surface));
    let folds = vec![Fold { name: "expert".into(), library: of_expert, queries }];
    let name = library.name;
    Ok(ReplayStage { name, scene, entries, folds, synthetic: true, cache: None, ready: None })
}

/// The recordings to play. Those that cannot be read are left out here, since all are played.
fn played(args: &Args, data: &Path) -> Done<Library> {
    let (mut library, _) = bad_files::readable(data, super::open_held(data)?)?;
    args.only.keep(data, &mut library)?;
    Ok(library)
}

fn by_protocol(args: &Args, how: &Comparing, folder: &Path) -> Done<ReplayStage> {
    let data = played(args, folder)?;
    let scene = how.narrow(data.scene.clone())?;
    let how_split = SplitArgs { protocol: args.protocol, ..SplitArgs::default() };
    let Choice { scene, entries, split } = how_split.choose(folder, &data, scene)?;
    if args.protocol.is_some() {
        say!("protocol: {}", split.name);
    }
    let (name, synthetic, cache) = (data.name, data.synthetic, how.cache_in(folder));
    Ok(ReplayStage { name, scene, entries, folds: split.folds, synthetic, cache, ready: None })
}

/// Uses the model file that is named. Its scene says which sources of the data are compared.
fn by_model(args: &Args, how: &mut Comparing, data: &Path, model: &Path) -> Done<ReplayStage> {
    let answering = (&args.answers, &args.accuracy);
    let (mut ready, file) = naming::open_model(model, answering, None)?;
    ready.say();
    how.query_seconds = how.query_seconds.or(file.query_s);
    let data = played(args, data)?;
    let synthetic = data.synthetic || file.is_synthetic;
    ready.by.library.synthetic = synthetic;
    let (name, scene) = (file.library, file.scene);
    let entries = within(&data, &scene)?;
    let queries = (0..entries.len()).collect();
    let folds = vec![Fold { name: "model".into(), library: Vec::new(), queries }];
    Ok(ReplayStage { name, scene, entries, folds, synthetic, cache: None, ready: Some(ready) })
}

fn against(args: &Args, how: &Comparing, data: &Path, library: &Path) -> Done<ReplayStage> {
    let same = |path: &Path| path.canonicalize().ok();
    if same(data).is_some() && same(data) == same(library) {
        let problem = "data and library are one folder, so each trial would meet itself; leave \
                       --library off, and each is named against the others";
        return Err(Failure::usage_at(data, problem));
    }
    let cache = how.cache_in(library);
    // Of the library, unreadable data may stay, since the cache may be enough.
    let data = played(args, data)?;
    let library = super::open_held(library)?;
    let synthetic = data.synthetic || library.synthetic;
    let (scene, of_data) = (how.narrow(library.scene.clone())?, how.narrow(data.scene.clone())?);
    let mut entries = within(&library, &scene)?;
    let queries = within(&data, &of_data)?;
    let of_library = entries.len();
    entries.extend(queries);
    let folds = vec![Fold {
        name: "library".into(),
        library: (0..of_library).collect(),
        queries: (of_library..entries.len()).collect(),
    }];
    let (name, scene) = (library.name, of_data.with(scene));
    Ok(ReplayStage { name, scene, entries, folds, synthetic, cache, ready: None })
}

/// Seconds between two scans on a page at real speed, so that people can read an answer.
const REST_S: f64 = 2.5;

/// Plays and names the queries of the stage. The lock keeps edits out until the library is read.
fn play(args: &Args, how: &Comparing, mut stage: ReplayStage, lock: Option<LibraryLock>) -> Done {
    let queries: Vec<Entry> = (stage.queries())
        .map(|(_, entry)| first_seconds(entry, &stage.scene, how.query_seconds))
        .collect();
    let mut config = super::config(args.config.as_deref())?;
    config.is_continuous |= args.continuous;
    if config.is_continuous && stage.folds.iter().any(|fold| fold.library != stage.folds[0].library)
    {
        let problem = "joined recordings are named by one library, and each of these has another; name it \
                       by --library, or use --protocol expert-vs-users";
        return Err(Failure::usage(problem));
    }
    let mut tally = Tally::new(!args.json, queries.len());
    let is_shown = args.serve.is_wanted() && args.speed == Speed::RealTime(1.0);
    let rest_s = if is_shown { REST_S } else { 0.0 };
    let (speed, is_joined, synthetic) = (args.speed, config.is_continuous, stage.synthetic);
    let replay = Replay::new(&stage.scene, queries);
    let device = Replay { speed, rest_s, is_joined, synthetic, ..replay };
    let options = args.serve.options(Options::default());
    let mut station = Station::new(vec![Box::new(device)], options).listener(&mut tally);
    station.continuous = config.continuous();
    if args.json {
        // While a page is served, a slow reader must not keep a signal from ending the program.
        let lines = JsonLines::start(station.commands(), !args.serve.is_wanted())?;
        station = station.listener(lines);
    }
    let library = args.library.as_ref().filter(|_| args.serve.is_wanted());
    let (enrolls, reloads) = (library.is_some(), library.is_some());
    let mut settings = Settings { enrolls, reloads, ..Settings::default() };
    if let Some(folder) = library {
        let (folder, scene) = (folder.clone(), stage.scene.clone());
        let answering = (&args.answers, &args.accuracy);
        let is_continuous = station.continuous.is_some();
        station.load = Some(naming::load(&folder, &scene, how, answering, None, is_continuous));
        station.store = Some(ScanStore::new(folder.clone(), scene.clone()));
        settings.check = Some(naming::check(&folder, how));
        settings.library = Some(LibraryFolder { folder, scene });
    }
    // Without a library, past scans and unsent answers are kept here only until the program ends.
    let until_end = tempfile::tempdir()?;
    if !args.serve.is_wanted() {
        config.keep_mb = 0;
    }
    let (page, folder) = (Page::default(), args.library.as_deref().unwrap_or(until_end.path()));
    let sources = (&stage.scene, BTreeMap::new(), None);
    station = live::keep_and_send(station, &config, folder, sources, (&mut settings, &page))?;
    let (mut station, server) = args.serve.start(station, settings, &page)?;
    // The page can be seen while the models are made; a signal then ends the program at once.
    station.emit(&StationEvent::Reading);
    let ready = stage.ready.take().map_or_else(|| made(args, how, &mut stage), Ok)?;
    drop(lock);
    if station.continuous.is_some() {
        naming::has_scan_time(&ready.by).map_err(Failure::Failed)?;
    }
    station.recogniser = Some(Arc::new(ready.by));
    if ready.follows {
        station.options.progress_every_s = Some(LOOK_S);
    }
    let signals = server.as_ref().map(|_| watch_signals(station.commands())).transpose()?;
    let totals = station.run()?;
    tally.sum_up(stage.synthetic);
    if let (Some(server), Some(signals)) = (server, signals) {
        // The page is served until a signal arrives.
        let _ = signals.recv();
        drop(server);
    }
    if let Some((name, error)) = totals.failed.first() {
        return Err(Failure::Failed(format!("{name}: {error}")));
    }
    tally.verdict(totals.lost())
}

/// Makes the recogniser, without recordings that cannot be read.
fn made(args: &Args, how: &Comparing, stage: &mut ReplayStage) -> Done<Ready> {
    match (recogniser(args, how, stage), &args.library) {
        (Err(error), Some(folder)) => {
            if bad_files::leave_out(folder, &mut stage.entries)? {
                return Err(error);
            }
            let ReplayStage { entries, folds, .. } = &mut *stage;
            let is_readable = |i: &usize| !entries[*i].sources.is_empty();
            folds.iter_mut().for_each(|fold| fold.library.retain(is_readable));
            recogniser(args, how, stage)
        }
        (made, _) => made,
    }
}

/// Makes the recogniser, which names each query by the library of its fold, and prints what its
/// answers are based on.
fn recogniser(args: &Args, how: &Comparing, stage: &ReplayStage) -> Done<Ready> {
    let method = how.method.build(&stage.scene);
    let models = models(&*method, stage)?;
    // The scan time is that of all trials together, although a query is named by only some of them.
    let lasting = match &models[..] {
        [_, _, ..] if how.method.name() == MethodName::Embedding => {
            let all = (0..stage.entries.len()).collect();
            let cache = stage.cache.as_deref();
            let whole = ready_model(&*method, &stage.entries, &all, cache, &|_, _| {})?;
            how.lasting(&args.accuracy, &whole.model)?
        }
        // A stage has at least one fold, and each fold has a model, so this index exists.
        _ => how.lasting(&args.accuracy, &models[0])?,
    };
    let fold_of = stage.queries().map(|(fold, entry)| (entry.key.clone(), fold)).collect();
    let compared = stage.compared();
    let mut library = LibraryState::of(&stage.name, &compared, stage.synthetic);
    if let Some(path) = &args.library {
        library.reference = references(path)?;
    }
    let by = Recogniser::with_folds(models, fold_of, stage.scene.clone(), library)
        .with_trials(&compared);
    let ready = Ready::new(by, &args.answers, lasting)?;
    ready.say();
    Ok(ready)
}

impl ReplayStage {
    /// The queries, each with the index of its fold.
    fn queries(&self) -> impl Iterator<Item = (usize, &Entry)> {
        let of_fold = |(index, fold): (usize, &'_ Fold)| {
            fold.queries.clone().into_iter().map(move |query| (index, query))
        };
        let all = self.folds.iter().enumerate().flat_map(of_fold);
        all.map(|(fold, query)| (fold, &self.entries[query]))
    }

    /// The trials that are in the library of at least one fold.
    fn compared(&self) -> Vec<Entry> {
        in_libraries(&self.folds).into_iter().map(|index| self.entries[index].clone()).collect()
    }
}

fn models(method: &dyn Method, stage: &ReplayStage) -> Result<Vec<Arc<dyn Model>>, RecogniseError> {
    let cache = stage.cache.as_deref();
    if let [fold] = &stage.folds[..] {
        let step = |done, of| say::progress("preparing the library", done, of);
        let library = fold.library.iter().copied().collect();
        let ReadyModel { model, remarks, .. } =
            ready_model(method, &stage.entries, &library, cache, &step)?;
        remarks.iter().for_each(|remark| say!("{remark}"));
        return Ok(vec![model]);
    }
    let evaluation = Evaluation::new(&stage.scene, &stage.entries, &stage.folds);
    let run = Evaluation { cache, progress: &say::progress, ..evaluation }.prepare(method)?;
    run.library.remarks.iter().for_each(|remark| say!("{remark}"));
    stage.folds.iter().map(|fold| run.fit(&fold.library)).collect()
}
