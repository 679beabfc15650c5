//! What the commands share that work with live devices: `run`, `enroll` and `record`.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crossbeam_channel::Sender;

use super::answers::AnswerArgs;
use super::lines::JsonLines;
use super::method::{MethodArgs, WithMethod};
use super::plan::PlanArgs;
use super::serve::ServeArgs;
use super::terminal::{Keys, Terminal, watch_signals};
use super::{Done, Failure, SourceArgs};
use crate::dataset;
use crate::device::serial::Selector;
use crate::library::Entry;
use crate::recognise::{LOOK_S, Method, prepare_library};
use crate::scan::{Options, Totals};
use crate::scene::Scene;
use crate::station::config::{StationConfig, StylusConfig};
use crate::station::{
    ByMethod, Keep, LibraryState, Listener, Load, Needs, Order, Recogniser, Station, assemble,
};

/// Which station.
#[derive(Clone, Debug, clap::Args)]
pub struct StationArgs {
    /// The station's configuration (default: that of configs/stylus.toml)
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// The library: a folder of labelled trials
    #[arg(long, value_name = "LIB")]
    library: Option<PathBuf>,
    /// The stylus's port, instead of the configured one: `auto`, `usb:VENDOR:PRODUCT` or a path
    #[arg(long, value_name = "PORT")]
    stylus: Option<Selector>,
    /// Print lines of JSON on stdout
    #[arg(long)]
    pub json: bool,
}

impl StationArgs {
    /// What the file and the flags say.
    pub fn config(&self) -> Result<StationConfig, Failure> {
        let mut config = match &self.config {
            Some(path) => {
                StationConfig::read(path).map_err(|error| Failure::Usage(error.to_string()))?
            }
            None => StationConfig::embedded(),
        };
        if let Some(library) = &self.library {
            config.library = Some(library.clone());
        }
        if let Some(port) = &self.stylus {
            let stylus = config.stylus.take().or(StationConfig::embedded().stylus);
            config.stylus = stylus.map(|stylus| StylusConfig { port: port.clone(), ..stylus });
        }
        Ok(config)
    }
}

/// The folder of a station's library.
pub fn library_of(config: &StationConfig) -> Result<PathBuf, Failure> {
    config.library.clone().ok_or_else(|| {
        let text = "no library is named; say --library FOLDER, or `library` in the configuration";
        Failure::Usage(text.into())
    })
}

/// How scans are compared with a library.
#[derive(Clone, Debug, clap::Args)]
pub struct CompareArgs {
    #[command(flatten)]
    sources: SourceArgs,
    #[command(flatten)]
    method: MethodArgs,
    #[command(flatten)]
    plan: PlanArgs,
    #[command(flatten)]
    answers: AnswerArgs,
}

impl CompareArgs {
    /// Reads a library and makes it ready to name scans, whenever it is asked to; the plan too.
    pub fn load(&self, path: &Path, scene: &Scene) -> Load {
        let (path, scene, args) = (path.to_path_buf(), scene.clone(), self.clone());
        Arc::new(move || args.read(&path, &scene).map_err(Failure::text))
    }

    fn read(&self, path: &Path, scene: &Scene) -> Result<Arc<dyn Recogniser>, Failure> {
        let plan = self.plan.read()?;
        let library = dataset::open(path, scene)?;
        let (scene, method) = match &plan {
            None => (self.sources.narrow(library.scene)?, self.method.clone()),
            Some(plan) => (plan.narrow(library.scene)?, self.method.planned(plan.setting)),
        };
        let entries: Vec<Entry> = (library.entries.into_iter())
            .map(|entry| entry.within(&scene))
            .filter(|entry| !entry.sources.is_empty())
            .collect();
        let state = LibraryState::of(&library.name, &entries, library.synthetic);
        let beside = method.cache_beside(path);
        let answers = &self.answers;
        method.apply(&scene, Fit { scene: &scene, entries, state, beside, answers })
    }
}

struct Fit<'a> {
    scene: &'a Scene,
    entries: Vec<Entry>,
    state: LibraryState,
    beside: Option<&'a Path>,
    answers: &'a AnswerArgs,
}

impl WithMethod for Fit<'_> {
    type Output = Result<Arc<dyn Recogniser>, Failure>;

    fn with(self, method: impl Method + 'static) -> Self::Output {
        let Self { scene, entries, state, beside, answers } = self;
        let all = (0..entries.len()).collect();
        let prepared = prepare_library(&method, &entries, &all, beside, &|_, _| {})?;
        let model = method.fit(prepared.trials.into_iter().flatten().collect())?;
        let needs = Needs::of(scene, entries, state.synthetic);
        let mut by = ByMethod::new(method, model, needs, state);
        answers.apply(&mut by)?;
        Ok(Arc::new(by))
    }
}

/// Makes a listener that may give orders.
pub type Listen<'a> = Box<dyn FnOnce(Sender<Order>) -> Box<dyn Listener + 'a> + 'a>;

/// A station at work, as a command wants it.
pub struct Work<'a> {
    /// Reads the library, if scans are to be named.
    pub load: Option<Load>,
    /// Where enrolled scans go.
    pub keep: PathBuf,
    /// What it is told first.
    pub orders: Vec<Order>,
    /// Whoever else listens, and may give orders.
    pub listeners: Vec<Listen<'a>>,
    /// The page, if it is to be served.
    pub serve: Option<&'a ServeArgs>,
    /// What a person is to do, while nothing else is to be said.
    pub hint: String,
    /// Prints lines of JSON.
    pub json: bool,
}

/// Runs a station until it is told to quit, by a key, a signal or a listener.
pub fn work(config: &StationConfig, work: Work<'_>) -> Result<Totals, Failure> {
    let assembled = assemble(config);
    for what in &assembled.left_out {
        eprintln!("{what}");
    }
    if assembled.devices.is_empty() {
        return Err(Failure::Usage("no device is configured that this build can use".into()));
    }
    let options = Options {
        detection: Some(config.detection.clone()),
        progress_every_s: Some(LOOK_S),
        ..Options::default()
    };
    let options = match work.serve {
        Some(serve) => serve.options(options),
        None => options,
    };
    let keep = Keep {
        folder: work.keep,
        scene: config.scene.clone(),
        devices: assembled.device_of,
        by_t_star: config.by_t_star.clone(),
    };
    let mut station = Station::new(assembled.devices, options).keep(keep);
    let orders = station.orders();
    if let Some(load) = work.load {
        station = station.load(load);
    }
    if let Some(flasher) = assembled.flasher {
        station = station.listener(flasher);
    }
    if work.json {
        station = station.listener(JsonLines);
    }
    for listen in work.listeners {
        station = station.listener(listen(orders.clone()));
    }
    let serving = match work.serve {
        Some(serve) => serve.start(orders.clone(), true, Some(config.serve))?,
        None => None,
    };
    let (serving, reporter) = serving.unzip();
    if let Some(reporter) = reporter {
        station = station.listener(reporter);
    }
    let terminal = Terminal::new(work.json, work.hint);
    let _keys = Keys::listen(orders.clone(), terminal.scanning());
    watch_signals(orders.clone())?;
    for order in work.orders {
        // The station holds the other end.
        let _ = orders.send(order);
    }
    let totals = station.listener(terminal).run();
    if let Some(serving) = serving {
        serving.stop();
    }
    Ok(totals?)
}

/// How a command with live devices ends.
pub fn verdict(totals: &Totals) -> Done {
    if let Some((name, error)) = totals.failed.first() {
        return Err(Failure::Damaged(format!("{name}: {error}")));
    }
    match totals.lost() {
        0 => Ok(()),
        lost => Err(Failure::Damaged(format!("{lost} sample(s) were lost, in scans or between"))),
    }
}
