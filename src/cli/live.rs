//! `surfaced run`: the station at work, and what it shares with `enroll` and `record`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use crossbeam_channel::Sender;

use super::answers::{AccuracyArgs, AnswerArgs};
use super::choose::within;
use super::devices::SURVEY_PATIENCE;
use super::json_lines::JsonLines;
use super::keys::{Keys, watch_signals};
use super::method::{Comparing, ComparingArgs};
use super::outputs::{Page, is_at, send_answers};
use super::serve::ServeArgs;
use super::show::{counted, quoted};
use super::terminal::Terminal;
use super::{Done, Failure, bad_files, shown};
use crate::dataset;
use crate::device::lines::{LinesAddress, SURVEY_S, survey_of};
use crate::device::serial::Selector;
use crate::history::{self, History, Keeper};
use crate::recognise::{LOOK_S, ReadyModel, ready_model};
use crate::record::edit::LibraryLock;
use crate::scan::{Options, Totals};
use crate::scene::{Scene, SourceId};
use crate::serve::{Audit, LibraryFolder, Settings};
use crate::station::config::{StationConfig, StylusConfig, fitting};
use crate::station::{
    Assembled, Command, Keep, LibraryState, Listener, Load, Recogniser, ScanStore, Station,
    StationEvent, assemble,
};
use crate::system;

/// Options that describe the station.
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
    /// A sensor that prints lines of numbers: a serial port (PORT@BAUD), tcp://HOST:PORT,
    /// udp://HOST:PORT, or - for standard input. Alone, or with the [[lines]] of --config
    #[arg(long, value_name = "PORT", allow_hyphen_values = true)]
    lines: Option<LinesAddress>,
    /// Print lines of JSON on stdout
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub serve: ServeArgs,
}

impl StationArgs {
    /// The options that name the station, as they are typed, for commands to be typed next.
    pub fn typed(&self) -> String {
        let config = self.config.as_ref().map(|path| format!(" --config {}", quoted(path)));
        let lines = self.lines.as_ref().map(|address| format!(" --lines {address}"));
        config.unwrap_or_default() + &lines.unwrap_or_default()
    }

    /// The configuration that the file and the flags give.
    pub fn config(&self) -> Result<StationConfig, Failure> {
        let mut config = match (&self.config, &self.lines) {
            (None, Some(address)) => surveyed(address)?,
            (file, _) => config(file.as_deref())?,
        };
        if let (Some(address), Some(path)) = (&self.lines, &self.config) {
            let [lines] = &mut config.lines[..] else {
                return Err(Failure::Usage(format!(
                    "{}: it has {} [[lines]], and --lines names the port of one; leave --config \
                     out to learn a sensor from what it prints",
                    shown(path),
                    config.lines.len()
                )));
            };
            lines.address = address.clone();
        }
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

/// A station of one sensor that nobody has described, by what it prints.
fn surveyed(address: &LinesAddress) -> Result<StationConfig, Failure> {
    say!("learning what comes from {address}, for {SURVEY_S} s; leave the sensor at rest");
    let survey = survey_of(address, SURVEY_PATIENCE).map_err(Failure::Failed)?;
    let text = fitting(address, &survey).map_err(Failure::Failed)?;
    let parsed = StationConfig::parse(&text, Path::new("what was learnt"));
    let config = parsed.map_err(|error| Failure::Failed(error.to_string()))?;
    for lines in &config.lines {
        let columns = lines.streams.iter().map(|stream| stream.columns.len()).sum::<usize>();
        let rate_hz = lines.rate_hz.unwrap_or(0.0);
        say!(
            "{address}: {} at {rate_hz} Hz; `surfaced devices --watch {address} --write FILE` keeps \
             this as a configuration",
            counted(columns, "channel")
        );
    }
    Ok(config)
}

/// A station's configuration, or the defaults.
pub fn config(file: Option<&Path>) -> Result<StationConfig, Failure> {
    let read = |path| StationConfig::read(path).map_err(|error| Failure::Usage(error.to_string()));
    file.map_or_else(|| Ok(StationConfig::embedded()), read)
}

/// The folder of a station's library.
pub fn library_of(config: &StationConfig) -> Result<PathBuf, Failure> {
    config.library.clone().ok_or_else(|| {
        let text = "no library is named; give --library FOLDER, or `library` in the configuration";
        Failure::Usage(text.into())
    })
}

/// Returns a function that reads the library anew at each call, and makes it ready to name scans.
/// `given` are the sources that scans can have, where that is known.
pub fn load(
    path: &Path,
    scene: &Scene,
    how: &Comparing,
    (answers, accuracy): (&AnswerArgs, &AccuracyArgs),
    given: Option<BTreeSet<SourceId>>,
) -> Load {
    let (path, scene) = (path.to_path_buf(), scene.clone());
    let (how, answers, accuracy) = (how.clone(), answers.clone(), accuracy.clone());
    Arc::new(move || {
        let _lock = LibraryLock::for_reading(&path);
        let library = bad_files::open(&path, &scene).map_err(Failure::text)?;
        let ready = bad_files::work(&path, library, |library| {
            let scene = how.narrow(library.scene.clone())?;
            let entries = within(library, &scene)?;
            let state = LibraryState::of(&library.name, &entries, library.synthetic);
            if let Some(given) = &given
                && !state.sources.iter().any(|source| given.contains(source))
            {
                return Err(Failure::Failed(nothing_in_common(&path, &state.sources, given)));
            }
            let all = (0..entries.len()).collect();
            let (method, cache) = (how.method.build(&scene), how.cache_in(&path));
            let ready = ready_model(&*method, &entries, &all, cache.as_deref(), &|_, _| {})?;
            Ok((scene, entries, state, ready))
        });
        let (scene, entries, state, ReadyModel { model, remarks, .. }) =
            ready.map_err(Failure::text)?;
        remarks.iter().for_each(|remark| say!("{remark}"));
        let lasting = how.lasting(&accuracy, &model).map_err(Failure::text)?;
        let mut by = Recogniser::new(model, scene, state).with_trials(&entries).lasting(lasting.0);
        answers.apply(&mut by).map_err(|error| error.to_string())?;
        by.add_remarks(lasting.1.as_slice());
        by.add_remarks(&bad_files::skipped());
        Ok(Arc::new(by))
    })
}

/// Returns a function that audits the library anew at each call.
pub fn check(path: &Path, how: &Comparing) -> Audit {
    let (path, how) = (path.to_path_buf(), how.clone());
    Audit(Arc::new(move || super::check::audit(&path, &how, false).map_err(Failure::text)))
}

/// The message that no scan of a station can be compared with its library.
fn nothing_in_common(path: &Path, library: &[SourceId], given: &BTreeSet<SourceId>) -> String {
    let list =
        |ids: Vec<&SourceId>| ids.iter().map(|id| id.as_str()).collect::<Vec<_>>().join(", ");
    let live = match cfg!(all(feature = "microphone", feature = "camera")) {
        true => "",
        false => " (for sound and pictures, build with `--features live`)",
    };
    format!(
        "{}: it has {}, but the devices of this station give {}, so no scan can be named; record \
         a library with these devices (`surfaced enroll LABEL`), or configure the devices that it \
         was recorded with{live}",
        path.display(),
        list(library.iter().collect()),
        list(given.iter().collect()),
    )
}

/// Makes a listener that may send commands.
pub type Listen<'a> = Box<dyn FnOnce(Sender<Command>) -> Box<dyn Listener + 'a> + 'a>;

/// What a command wants a station to do.
pub struct StationWork<'a> {
    /// The function that reads the library, if scans are to be named.
    pub load: Option<Load>,
    /// The library for enrolled scans.
    pub store: PathBuf,
    /// The station's own order to keep scans, which holds unless the page gives another one.
    pub keep: Option<Keep>,
    /// Further listeners, which may send commands.
    pub listeners: Vec<Listen<'a>>,
    /// Instructions for the operator, shown while there is nothing else to show.
    pub hint: String,
    /// The function that audits the library, if the page may ask for it.
    pub check: Option<Audit>,
    /// Whether to print lines of JSON.
    pub json: bool,
    /// Whether and where the station's page is served.
    pub serve: ServeArgs,
}

/// The sources that scans of these devices can have.
pub fn given(assembled: &Assembled) -> BTreeSet<SourceId> {
    assembled.device_of.keys().filter_map(|id| SourceId::new(id).ok()).collect()
}

/// Runs a station of these devices until a key, a signal or a listener makes it quit.
pub fn work(
    config: &StationConfig,
    assembled: Assembled,
    work: StationWork<'_>,
) -> Result<Totals, Failure> {
    if assembled.devices.is_empty() {
        for what in &assembled.left_out {
            say!("{what}");
        }
        return Err(Failure::Usage("no device is configured that this build can use".into()));
    }
    let options = Options {
        detection: Some(config.detection.clone()),
        progress_every_s: Some(LOOK_S),
        ..Options::default()
    };
    let options = work.serve.options(options);
    let store = ScanStore {
        folder: work.store,
        scene: config.scene.clone(),
        devices: assembled.device_of,
        by_t_star: config.by_t_star.clone(),
    };
    let library = LibraryFolder { folder: store.folder.clone(), scene: store.scene.clone() };
    let devices = store.devices.clone();
    let mut station = Station::new(assembled.devices, options).store(store);
    let mut history = Arc::default();
    let (mut outputs, page) = (Vec::new(), Page::default());
    if work.load.is_some() {
        let folder = library.folder.join(history::FOLDER);
        (station, history) =
            keep_scans(station, &folder, config.keep_mb, (&library.scene, devices))?;
        (station, outputs) =
            send_answers(station, &config.outputs, &library.folder, (&history, &page))?;
    }
    let commands = station.commands();
    if let Some(load) = work.load {
        station = station.load(load);
    }
    if let Some(keep) = work.keep {
        station = station.keep(keep);
    }
    if let Some(flasher) = assembled.flasher {
        station = station.listener(flasher);
    }
    if work.json {
        station = station.listener(JsonLines::start(commands.clone(), false)?);
    }
    for listen in work.listeners {
        station = station.listener(listen(commands.clone()));
    }
    let supervisor = Supervisor::new(commands.clone())?;
    // In a library of another layout, added trials would not be read.
    let enrolls = !dataset::is_foreign(&library.folder);
    let (address, library) = (config.serve, enrolls.then_some(library));
    let (check, viewfinder) = (work.check, assembled.viewfinder);
    let settings = Settings {
        address,
        enrolls,
        library,
        check,
        history,
        viewfinder,
        outputs,
        ..Settings::default()
    };
    let (station, server) = work.serve.start(station.listener(supervisor), settings)?;
    is_at(&page, server.as_ref());
    let terminal = Terminal::new(work.json, work.hint);
    let _keys = Keys::listen(commands.clone(), terminal.scanning());
    let _signals = watch_signals(commands.clone())?;
    let mut station = station.listener(terminal);
    for what in assembled.left_out {
        station.emit(&StationEvent::Warning(what));
    }
    Ok(station.run()?)
}

/// Keeps the scans of a station in a folder of at most `keep_mb` million bytes. Where that fails, a
/// warning says why, and answers are kept in memory until the program ends. `sources` holds the
/// scene, and the device of each source.
pub fn keep_scans<'a>(
    station: Station<'a>,
    folder: &Path,
    keep_mb: u32,
    sources: (&Scene, BTreeMap<String, String>),
) -> Result<(Station<'a>, Arc<History>), Failure> {
    if keep_mb == 0 {
        return Ok((station, Arc::default()));
    }
    match History::open(folder, u64::from(keep_mb) * 1_000_000) {
        Ok(history) => {
            let history = Arc::new(history);
            // Recordings at any rate are kept.
            let scene = sources.0.clone().changed(|spec| spec.rate_hz = None);
            let keeper = Keeper::start(history.clone(), scene, sources.1)?;
            Ok((station.listener(keeper), history))
        }
        Err(error) => {
            say!("warning: scans are not kept: {error}");
            Ok((station, Arc::default()))
        }
    }
}

/// The result of a command with live devices.
pub fn verdict(totals: &Totals) -> Done {
    if let Some((name, error)) = totals.failed.first() {
        return Err(Failure::Damaged(format!("{name}: {error}")));
    }
    match totals.lost() {
        0 => Ok(()),
        lost => Err(Failure::Damaged(format!(
            "samples were lost, within scans or between them: {lost}"
        ))),
    }
}

/// Reports to systemd, where it is there.
pub struct Supervisor(());

impl Supervisor {
    /// Pings the station that takes `commands` as often as the watchdog of the unit demands.
    ///
    /// # Errors
    /// If no thread can be started.
    pub fn new(commands: Sender<Command>) -> std::io::Result<Self> {
        if let Some(limit) = system::watchdog() {
            // Three times as often as necessary: two may come late.
            let every = (limit / 3).max(Duration::from_millis(10));
            let ping = move || {
                while commands.send(Command::Ping).is_ok() {
                    std::thread::sleep(every);
                }
            };
            std::thread::Builder::new().name("watchdog".into()).spawn(ping)?;
        }
        Ok(Self(()))
    }
}

impl Listener for Supervisor {
    fn on_event(&mut self, event: &StationEvent) {
        let state = match event {
            StationEvent::Streams(_) => "READY=1",
            StationEvent::Alive => "WATCHDOG=1",
            StationEvent::Finished(_) => "STOPPING=1",
            _ => return,
        };
        system::notify_supervisor(state);
    }
}

/// Name surfaces as they are dragged over: live devices, until `q` or Ctrl-C
///
/// Starts with the devices that are there, and names those that are missing. Scans are detected by
/// their tap and drag; on a terminal, the space bar also begins and ends one by hand.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced run --library my-library\n  \
                        surfaced run --config station.toml --json --serve\n  \
                        surfaced run --library my-library --stylus /dev/ttyUSB0\n  \
                        surfaced run --library my-library --lines /dev/ttyACM0\n\nTime: until you quit; an answer comes about 10 ms after its scan")]
pub struct Args {
    #[command(flatten)]
    station: StationArgs,
    #[command(flatten)]
    comparing: ComparingArgs,
    #[command(flatten)]
    answers: AnswerArgs,
    #[command(flatten)]
    accuracy: AccuracyArgs,
}

pub fn run(args: &Args) -> Done {
    let how = args.comparing.resolve(None)?;
    let mut config = args.station.config()?;
    if let Some(plan) = &how.plan {
        config = config.only(&plan.sources);
    }
    let library = library_of(&config)?;
    if !library.is_dir() {
        return Err(Failure::Failed(format!(
            "{}: no such folder; record a library first, with `surfaced enroll LABEL --library {0}` \
             for each surface, or name another one",
            shown(&library)
        )));
    }
    let check = Some(check(&library, &how));
    let assembled = assemble(&config);
    let given = Some(given(&assembled));
    let load = load(&library, &config.scene, &how, (&args.answers, &args.accuracy), given);
    let long = how.query_seconds.map(|s| format!(" for {s} s or more")).unwrap_or_default();
    let totals = work(
        &config,
        assembled,
        StationWork {
            load: Some(load),
            store: library,
            keep: None,
            listeners: Vec::new(),
            hint: format!(
                "tap a surface, then drag over it{long}; space begins and ends a scan, q quits"
            ),
            check,
            json: args.station.json,
            serve: args.station.serve.clone(),
        },
    )?;
    verdict(&totals)
}
