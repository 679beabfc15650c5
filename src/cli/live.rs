//! `surfaced run`: runs a station. `enroll` and `record` share parts of this file.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, IsTerminal};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use crossbeam_channel::Sender;

use super::devices::SURVEY_PATIENCE;
use super::json_lines::JsonLines;
use super::keys::{Keys, watch_service};
use super::method::{AccuracyArgs, AnswerArgs, ComparingArgs, not_with_model};
use super::naming;
use super::serve::{Page, ServeArgs};
use super::show::{counted, quoted};
use super::system;
use super::terminal::Terminal;
use super::{Done, Failure};
use crate::dataset;
use crate::device::lines::{LinesAddress, SURVEY_S, survey_of};
use crate::device::serial::Selector;
use crate::device::{Warning, WarningKind};
use crate::history::{self, History, Keeper};
use crate::outputs::Output;
use crate::recognise::LOOK_S;
use crate::record::write_library_toml;
use crate::scan::{Options, Totals};
use crate::scene::{Scene, SourceId};
use crate::serve::{Audit, LibraryFolder, Settings};
use crate::station::config::{StationConfig, StylusConfig, fitting};
use crate::station::{
    Assembled, Command, Enrolled, EnrolledOutcome, Keep, Listener, Load, Recogniser, ScanStore,
    Station, StationEvent, assemble,
};
use crate::trial::checked_session;

/// Name of the folder, inside the library, that holds answers not sent yet.
const OUTBOX: &str = ".outbox";

#[derive(Clone, Debug, clap::Args)]
pub(super) struct StationArgs {
    /// The station's configuration (default: that of configs/stylus.toml)
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// The library, a folder of labelled trials
    #[arg(long, value_name = "LIB")]
    library: Option<PathBuf>,
    /// The stylus's port, instead of the configured one: `auto`, `usb:VENDOR:PRODUCT` or a path
    #[arg(long, value_name = "PORT")]
    stylus: Option<Selector>,
    /// A sensor that prints lines of numbers: a serial port (PORT@BAUD), tcp://HOST:PORT,
    /// udp://HOST:PORT, or - for standard input. With --config, it replaces the port of its [[lines]]
    #[arg(long, value_name = "PORT", allow_hyphen_values = true)]
    lines: Option<LinesAddress>,
    /// The session that new trials belong to, a sitting of one person at one place (default: the time
    /// of this start, such as 2026-11-25T10:42)
    #[arg(long, value_name = "NAME", value_parser = session)]
    session: Option<String>,
    /// Print lines of JSON on stdout
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    serve: ServeArgs,
}

pub(super) fn session(name: &str) -> Result<String, String> {
    checked_session(name).map_err(|problem| format!("the name {problem}"))
}

impl StationArgs {
    /// The session that was named, or else one that is called by the local time.
    fn session(&self) -> String {
        let now = || jiff::Zoned::now().strftime("%Y-%m-%dT%H:%M").to_string();
        self.session.clone().unwrap_or_else(now)
    }

    /// The options that describe the station, as the user types them in a suggested command.
    pub(super) fn typed(&self) -> String {
        let config = self.config.as_ref().map(|path| format!(" --config {}", quoted(path)));
        let lines = self.lines.as_ref().map(|address| format!(" --lines {address}"));
        config.unwrap_or_default() + &lines.unwrap_or_default()
    }

    pub(super) fn config(&self) -> Done<StationConfig> {
        let mut config = match (&self.config, &self.lines) {
            (None, Some(address)) => surveyed(address)?,
            (file, _) => super::config(file.as_deref())?,
        };
        if let (Some(address), Some(path)) = (&self.lines, &self.config) {
            let [lines] = &mut config.lines[..] else {
                let problem = format!(
                    "it has {} [[lines]], and --lines names the port of one; leave --config out to \
                     learn a sensor from what it prints",
                    config.lines.len()
                );
                return Err(Failure::usage_at(path, problem));
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

/// A configuration for one sensor that no file describes, made from the lines that it sends.
fn surveyed(address: &LinesAddress) -> Done<StationConfig> {
    say!("learning what comes from {address}, for {SURVEY_S} s; leave the sensor at rest");
    let survey = survey_of(address, SURVEY_PATIENCE).map_err(Failure::Failed)?;
    let text = fitting(address, &survey).map_err(Failure::Failed)?;
    survey.remarks().iter().for_each(|remark| say!("{address}: {remark}"));
    let config = StationConfig::parse(&text, Path::new("what was learnt"))?;
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

pub(super) fn library_of(config: &StationConfig) -> Done<PathBuf> {
    config.library.clone().ok_or_else(|| {
        let text = "no library is named; give --library FOLDER, or `library` in the configuration";
        Failure::usage(text)
    })
}

pub(super) fn make_library(folder: &Path, scene: &Scene) -> Done {
    let name = folder.file_name().map(|name| name.to_string_lossy()).unwrap_or_default();
    Ok(write_library_toml(folder, scene, &name, false)?)
}

/// Asks on a terminal whether a missing library is to be made. Nobody is asked elsewhere.
fn is_agreed(library: &Path) -> bool {
    if library.exists() || !io::stdin().is_terminal() || !io::stderr().is_terminal() {
        return false;
    }
    say!("{}: no such folder; make it? [y/N]", library.display());
    let mut answer = String::new();
    let is_read = io::stdin().read_line(&mut answer).is_ok();
    is_read && matches!(answer.trim(), "y" | "Y" | "yes" | "Yes")
}

/// The purpose of a station's scans.
pub(super) enum Work<'a> {
    /// Keeps them. The order applies while the page has given no other one.
    Keep(Keep, &'a mut Kept),
    /// Names them by the library that the first function reads, and the second one audits.
    ByLibrary(Load, Audit),
    /// Names them by a model without trials.
    ByModel(Arc<Recogniser>),
}

/// Runs a station with these devices until a key, a signal or a listener ends it. `folder` is the library
/// for enrolled scans; of a model, it holds past scans and unsent answers. The operator sees `hint` while
/// there is no other text.
pub(super) fn work(
    config: &StationConfig,
    args: &StationArgs,
    assembled: Assembled,
    (work, folder, hint): (Work<'_>, PathBuf, String),
) -> Done<Totals> {
    if assembled.devices.is_empty() {
        assembled.left_out.iter().for_each(|what| say!("{what}"));
        return Err(Failure::usage("no device is configured that this build can use"));
    }
    let options = Options {
        detection: Some(config.detection.clone()),
        progress_every_s: Some(LOOK_S),
        ..Options::default()
    };
    let options = args.serve.options(options);
    let store = ScanStore {
        folder,
        scene: config.scene.clone(),
        devices: assembled.device_of,
        session: Some(args.session()),
        by_t_star: config.by_t_star.clone(),
    };
    let library = LibraryFolder { folder: store.folder.clone(), scene: store.scene.clone() };
    let (devices, session) = (store.devices.clone(), store.session.clone());
    let mut station = Station::new(assembled.devices, options);
    let is_named = !matches!(work, Work::Keep(..));
    let has_trials = !matches!(work, Work::ByModel(_));
    station.store = has_trials.then_some(store);
    station.continuous = config.continuous().filter(|_| is_named);
    let commands = station.commands();
    // A library of another layout would not find new trials, so no scans are enrolled there.
    let enrolls = has_trials && !dataset::is_foreign(&library.folder);
    let mut settings = Settings {
        address: config.serve,
        reloads: has_trials,
        enrolls,
        library: enrolls.then(|| library.clone()),
        viewfinder: assembled.viewfinder,
        ..Settings::default()
    };
    let page = Page::default();
    if is_named {
        let sources = (&library.scene, devices, session);
        station = keep_and_send(station, config, &library.folder, sources, (&mut settings, &page))?;
    }
    match work {
        Work::Keep(order, kept) => {
            let counter = KeptCounter { commands: commands.clone(), order: order.clone(), kept };
            station.keep = Some(order);
            station = station.listener(counter);
        }
        Work::ByLibrary(load, check) => (station.load, settings.check) = (Some(load), Some(check)),
        Work::ByModel(recogniser) => station.recogniser = Some(recogniser),
    }
    if let Some(flasher) = assembled.flasher {
        station = station.listener(flasher);
    }
    if args.json {
        station = station.listener(JsonLines::start(commands.clone(), false)?);
    }
    let supervisor = Supervisor::new(commands.clone())?;
    let (station, _server) = args.serve.start(station.listener(supervisor), settings, &page)?;
    let terminal = Terminal::new(args.json, hint);
    let _keys = Keys::listen(commands.clone(), terminal.scanning());
    let _signals = watch_service(commands.clone())?;
    let mut station = station.listener(terminal);
    for what in assembled.left_out {
        station.emit(&StationEvent::Warning(Warning::new(WarningKind::LeftOut, what)));
    }
    Ok(station.run()?)
}

/// Keeps the scans of a station, and sends its answers to the configured outputs. Scans and unsent
/// answers lie in `folder`. If scans cannot be kept, a warning gives the reason, and answers stay in
/// memory until the program ends. The third argument holds the scene, the device of each source, and the
/// session. Settings of the page come from `config`.
pub(super) fn keep_and_send<'a>(
    mut station: Station<'a>,
    config: &StationConfig,
    folder: &Path,
    (scene, devices, session): (&Scene, BTreeMap<String, String>, Option<String>),
    (settings, page): (&mut Settings, &Page),
) -> Done<Station<'a>> {
    settings.stale_after_s = config.stale_after_s;
    settings.public_address = config.public_address.clone();
    if config.keep_mb > 0 {
        let most_bytes = u64::from(config.keep_mb) * 1_000_000;
        match History::open(&folder.join(history::FOLDER), most_bytes) {
            Ok(history) => {
                settings.history = Arc::new(history);
                // The scene states no rate, so that scans are kept at whatever rate they have.
                let scene = scene.clone().changed(|spec| spec.rate_hz = None);
                let history = settings.history.clone();
                station = station.listener(Keeper::start(history, scene, devices, session)?);
            }
            Err(error) => say!("warning: scans are not kept: {error}"),
        }
    }
    let shown = (&settings.history, page);
    for output in Output::start(&config.outputs, &folder.join(OUTBOX), shown)? {
        settings.outputs.push(output.health());
        station = station.listener(output);
    }
    Ok(station)
}

pub(super) fn verdict(totals: &Totals) -> Done {
    if let Some((name, error)) = totals.failed.first() {
        return Err(Failure::Damaged(format!("{name}: {error}")));
    }
    if totals.lost_trials > 0 {
        let trials = counted(totals.lost_trials as usize, "trial");
        return Err(Failure::Damaged(format!("{trials} could not be written and are lost")));
    }
    match totals.lost() {
        0 => Ok(()),
        lost => Err(Failure::Damaged(format!(
            "samples were lost, within scans or between them: {lost}"
        ))),
    }
}

/// Reports the state of the station to systemd, if systemd runs it.
struct Supervisor;

impl Supervisor {
    /// Pings the station through `commands` as often as the watchdog of the systemd unit requires.
    fn new(commands: Sender<Command>) -> io::Result<Self> {
        if let Some(limit) = system::watchdog() {
            // Pings three times as often as required, so that two pings may be late.
            let every = (limit / 3).max(Duration::from_millis(10));
            let ping = move || {
                while commands.send(Command::Ping).is_ok() {
                    std::thread::sleep(every);
                }
            };
            std::thread::Builder::new().name("watchdog".into()).spawn(ping)?;
        }
        Ok(Self)
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
/// Starts with the available devices, and lists the missing ones. Scans are detected by their tap
/// and drag; on a terminal, the space bar also starts and stops a scan.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced run --library my-library\n  \
                        surfaced run --config station.toml --json --serve\n  \
                        surfaced run --library my-library --stylus /dev/ttyUSB0\n  \
                        surfaced run --model model.surfaced --continuous\n  \
                        surfaced run --library my-library --lines /dev/ttyACM0\n\nTime: until you quit; an answer comes about 10 ms after its scan")]
pub(super) struct Args {
    #[command(flatten)]
    station: StationArgs,
    /// Make the library if there is none yet; surfaces are then enrolled on the page
    #[arg(long)]
    create: bool,
    /// Name scans by this model, a file written by `surfaced train`, instead of a library
    ///
    /// A model holds no trials: surfaces are not enrolled, and nothing is reloaded. Past scans and unsent
    /// answers are kept beside it, in the folder FILE.kept.
    #[arg(long, value_name = "FILE", conflicts_with_all = not_with_model(), conflicts_with = "create")]
    model: Option<PathBuf>,
    /// Name the surface while something moves, without tap and end, and say when it changes
    #[arg(long)]
    continuous: bool,
    #[command(flatten)]
    comparing: ComparingArgs,
    #[command(flatten)]
    answers: AnswerArgs,
    #[command(flatten)]
    accuracy: AccuracyArgs,
}

/// The folder of a model's past scans and unsent answers, beside its file.
fn kept_beside(model: &Path) -> PathBuf {
    let mut name = model.as_os_str().to_owned();
    name.push(".kept");
    name.into()
}

/// Whether a library is yet to be made. Fails if it is not there, and the user does not want it made.
fn is_to_be_made(args: &Args, library: &Path) -> Done<bool> {
    if library.is_dir() {
        return Ok(false);
    }
    if !args.create && !is_agreed(library) {
        return Err(Failure::Failed(format!(
            "{}: no such folder; record a library first, with `surfaced enroll LABEL --library \
             {0}` for each surface, or make an empty one with --create, or name another one",
            library.display()
        )));
    }
    Ok(true)
}

pub(super) fn run(args: &Args) -> Done {
    let how = args.comparing.resolve(None)?;
    // Before a sensor is learnt, which takes seconds.
    let makes = match &args.station.library {
        Some(library) if args.model.is_none() => Some(is_to_be_made(args, library)?),
        _ => None,
    };
    let mut config = args.station.config()?;
    if let Some(plan) = &how.plan {
        config = config.only(&plan.sources);
    }
    config.is_continuous |= args.continuous;
    let assembled = assemble(&config);
    let given = assembled.device_of.keys().filter_map(|id| SourceId::new(id).ok());
    let is_used = |id: &SourceId| !config.is_continuous || config.scene.is_dragged(id);
    let given: BTreeSet<SourceId> = given.filter(is_used).collect();
    let answering = (&args.answers, &args.accuracy);
    let (by, folder, scan_s) = match &args.model {
        Some(path) => {
            let (ready, file) = naming::open_model(path, answering, Some(&given))?;
            if config.is_continuous {
                naming::has_scan_time(&ready.by).map_err(Failure::Failed)?;
            }
            (Work::ByModel(Arc::new(ready.by)), kept_beside(path), file.query_s)
        }
        None => {
            let library = library_of(&config)?;
            if makes.map_or_else(|| is_to_be_made(args, &library), Ok)? {
                make_library(&library, &config.scene)?;
                say!("{} is made; enroll surfaces on the page (--serve)", library.display());
            }
            let check = naming::check(&library, &how);
            let (scene, is_continuous) = (&config.scene, config.is_continuous);
            let load = naming::load(&library, scene, &how, answering, Some(given), is_continuous);
            (Work::ByLibrary(load, check), library, how.query_seconds)
        }
    };
    let long = scan_s.map(|s| format!(" for {s} s or more")).unwrap_or_default();
    let hint = match config.is_continuous {
        true => "names the surface while something moves; q quits".into(),
        false => {
            format!("tap a surface, then drag over it{long}; space begins and ends a scan, q quits")
        }
    };
    verdict(&work(&config, &args.station, assembled, (by, folder, hint))?)
}

/// How many scans of an order were kept, and how many could not be written.
#[derive(Default)]
pub(super) struct Kept {
    pub kept: u32,
    pub lost: u32,
}

/// Counts kept scans, and stops the station after the last one of the order.
///
/// If the order has no limit, scans kept under other labels are counted too.
struct KeptCounter<'a> {
    commands: Sender<Command>,
    order: Keep,
    kept: &'a mut Kept,
}

impl Listener for KeptCounter<'_> {
    fn on_event(&mut self, event: &StationEvent) {
        let StationEvent::Enrolled(Enrolled { outcome, surface, user, .. }) = event else { return };
        let ours = (surface, user) == (&self.order.surface, &self.order.user);
        if self.order.trials.is_some() && !ours {
            return;
        }
        match outcome {
            EnrolledOutcome::Kept => self.kept.kept += 1,
            EnrolledOutcome::Lost => self.kept.lost += 1,
            EnrolledOutcome::Refused | EnrolledOutcome::Waiting => return,
        }
        if self.order.trials.is_some_and(|wanted| self.kept.kept >= wanted) {
            // Sending fails only if the station has already ended, so an error is ignored.
            let _ = self.commands.send(Command::Quit);
        }
    }
}
