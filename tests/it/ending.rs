//! An end takes less than five seconds, whatever happens; nothing recorded is lost, and every scan
//! without an answer is reported.

use std::collections::BTreeMap;
use std::io::Write;
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use crate::common::id;
use crate::common::oak::Oak;
use surfaced::dataset;
use surfaced::device::{
    Begin, Device, DeviceError, DeviceLink, Mark, Open, StreamKind, StreamSpec,
};
use surfaced::history::{History, Keeper};
use surfaced::outputs::Output;
use surfaced::record::edit::LibraryLock;
use surfaced::ring::Sink;
use surfaced::scan::{CutFrom, Options};
use surfaced::scene::{Phase, Scene};
use surfaced::serve::{LibraryFolder, Server, Settings};
use surfaced::station::config::OutputsConfig;
use surfaced::station::{
    Command, Enrolled, EnrolledOutcome, Keep, LibraryState, Listener, Recogniser, ScanStore,
    Station, StationEvent,
};

/// An end may take this long.
const LIMIT: Duration = Duration::from_secs(5);
/// Scans that the stylus makes.
const SCANS: u32 = 3;
/// A time that never ends, as far as a test can see.
const FOR_EVER: Duration = Duration::from_secs(600);

/// Makes some scans, and rests until the end.
struct Stylus;

impl Device for Stylus {
    fn name(&self) -> &str {
        "stylus"
    }

    fn streams(&self) -> Vec<StreamSpec> {
        let kind = StreamKind::Series { channels: 1, rate_hz: 10_000.0 };
        vec![StreamSpec { id: id("ir"), kind }]
    }

    fn run(&mut self, sinks: &mut [Sink], control: &DeviceLink) -> Result<(), DeviceError> {
        for _ in 0..SCANS {
            control.mark(Mark::Begin(Begin::default()));
            let (source, start) = (id("ir"), sinks[0].position());
            let stream = source.clone();
            let cut = CutFrom { source: source.clone(), stream, phase: Phase::Drag, channels: 1 };
            control.mark(Mark::Open(Open { cut, start, rate_hz: 10_000.0 }));
            sinks[0].series().unwrap().push(&[0.25; 2000]);
            control.mark(Mark::Close { source, end: sinks[0].position() });
            control.mark(Mark::End { at: Instant::now() });
        }
        while !control.stopped() {
            std::thread::sleep(Duration::from_millis(5));
        }
        Ok(())
    }
}

/// Orders the end after the last scan, and notes what is reported.
struct Ends {
    commands: crossbeam_channel::Sender<Command>,
    ordered: Arc<Mutex<Option<Instant>>>,
    events: Arc<Mutex<Vec<StationEvent>>>,
}

impl Listener for Ends {
    fn on_event(&mut self, event: &StationEvent) {
        if let StationEvent::Phase { scan: SCANS, phase: None } = event {
            *self.ordered.lock().unwrap() = Some(Instant::now());
            self.commands.send(Command::Quit).unwrap();
        }
        self.events.lock().unwrap().push(event.clone());
    }
}

/// Runs a station, checks that it ends in time, and gives the numbers of scans that were said not
/// to be named.
fn unnamed(station: impl FnOnce(Station<'static>) -> Station<'static>) -> Vec<u32> {
    let options = Options { progress_every_s: Some(0.1), ..Options::default() };
    let station = station(Station::new(vec![Box::new(Stylus)], options));
    let (ordered, events) = (Arc::default(), Arc::<Mutex<Vec<StationEvent>>>::default());
    let commands = station.commands();
    let ends = Ends { commands, ordered: Arc::clone(&ordered), events: events.clone() };
    station.listener(ends).run().unwrap();
    let took = ordered.lock().unwrap().unwrap().elapsed();
    assert!(took < LIMIT, "the end took {took:?}");
    let events = events.lock().unwrap();
    assert!(matches!(events.last(), Some(StationEvent::Finished(_))));
    let number = |event: &StationEvent| match event {
        StationEvent::Warning(warning) if warning.text.contains("was not named") => {
            warning.text.split(' ').nth(1)?.parse().ok()
        }
        _ => None,
    };
    events.iter().filter_map(number).collect()
}

#[test]
fn of_a_station_whose_library_is_still_being_read() {
    let folder = tempfile::tempdir().unwrap();
    let keep = Keep {
        surface: "oak".into(),
        user: "anna".into(),
        trials: Some(1),
        good_only: false,
        ordered_by: None,
    };
    let load = || {
        std::thread::sleep(FOR_EVER);
        Err("no library".to_string())
    };
    let store = ScanStore::new(folder.path().to_path_buf(), Scene::lmt108());
    let left = unnamed(|mut station| {
        station.load = Some(Arc::new(load));
        (station.store, station.keep) = (Some(store), Some(keep));
        station
    });
    assert_eq!(left, [2, 3]);
    let kept = dataset::open(folder.path(), &Scene::lmt108()).unwrap();
    assert_eq!(kept.entries.len(), 1);
    assert_eq!(kept.entries[0].load().unwrap().signals.len(), 1);
}

/// An order to keep every scan.
fn every_scan() -> Keep {
    let (surface, user) = ("oak".into(), "anna".into());
    Keep { surface, user, trials: None, good_only: false, ordered_by: None }
}

#[test]
fn of_a_station_whose_disk_takes_no_scan() {
    let dir = tempfile::tempdir().unwrap();
    // A file lies in the place of the library's folder.
    let folder = dir.path().join("library");
    std::fs::write(&folder, "").unwrap();
    let keep = every_scan();
    let (lost, listener) = Became::new(EnrolledOutcome::Lost);
    let store = ScanStore::new(folder, Scene::lmt108());
    let station = |mut station: Station<'static>| {
        (station.store, station.keep) = (Some(store), Some(keep));
        station.listener(listener)
    };
    assert_eq!(unnamed(station), Vec::<u32>::new());
    assert_eq!(*lost.lock().unwrap(), [1, 2, 3]);
}

/// Notes the scans of which this became.
struct Became(EnrolledOutcome, Arc<Mutex<Vec<u32>>>);

impl Became {
    fn new(outcome: EnrolledOutcome) -> (Arc<Mutex<Vec<u32>>>, Self) {
        let scans = Arc::<Mutex<Vec<u32>>>::default();
        (scans.clone(), Self(outcome, scans))
    }
}

impl Listener for Became {
    fn on_event(&mut self, event: &StationEvent) {
        if let StationEvent::Enrolled(Enrolled { scan, outcome, .. }) = event
            && *outcome == self.0
        {
            self.1.lock().unwrap().push(*scan);
        }
        if let (StationEvent::Finished(totals), EnrolledOutcome::Lost) = (event, self.0) {
            assert_eq!(totals.lost_trials as usize, self.1.lock().unwrap().len());
        }
    }
}

#[test]
fn of_a_station_that_classifies_or_calibrates() {
    for part in ["prepare", "rank", "follow"] {
        assert_eq!(unnamed(|station| named_by(station, part)), [1, 2, 3], "{part}");
    }
}

fn named_by<'a>(mut station: Station<'a>, slow_part: &'static str) -> Station<'a> {
    let reach = move |part: &str| {
        if part == slow_part {
            std::thread::sleep(FOR_EVER);
        }
    };
    let by = Recogniser::new(Arc::new(Oak(reach)), Scene::lmt108(), LibraryState::default());
    station.recogniser = Some(Arc::new(by));
    station
}

#[test]
fn of_a_station_that_keeps_scans_and_cannot_say_what_they_are_like() {
    let folder = tempfile::tempdir().unwrap();
    let keep = every_scan();
    let (kept, listener) = Became::new(EnrolledOutcome::Kept);
    let store = ScanStore::new(folder.path().to_path_buf(), Scene::lmt108());
    let station = |mut station: Station<'static>| {
        (station.store, station.keep) = (Some(store), Some(keep));
        named_by(station, "rank").listener(listener)
    };
    assert_eq!(unnamed(station), Vec::<u32>::new());
    assert_eq!(*kept.lock().unwrap(), [1, 2, 3]);
    let library = dataset::open(folder.path(), &Scene::lmt108()).unwrap();
    assert_eq!(library.entries.len(), 3);
}

#[test]
fn of_a_station_whose_history_cannot_say_why() {
    let folder = tempfile::tempdir().unwrap();
    let history = Arc::new(History::open(folder.path(), 1 << 30).unwrap());
    let keeper = Keeper::start(history, Scene::lmt108(), BTreeMap::new(), None).unwrap();
    let station = |station: Station<'static>| named_by(station, "explain").listener(keeper);
    assert_eq!(unnamed(station), Vec::<u32>::new());
    // As it is on disk, with the signals of every scan.
    let extent = History::read(folder.path()).unwrap().extent();
    assert_eq!((extent.scans, extent.with_signals), (3, 3));
    let kept = dataset::open(folder.path(), &Scene::lmt108()).unwrap();
    assert_eq!(kept.entries.len(), 3);
}

/// Never ends.
struct Stuck;

impl Device for Stuck {
    fn name(&self) -> &str {
        "stuck"
    }

    fn streams(&self) -> Vec<StreamSpec> {
        Vec::new()
    }

    fn run(&mut self, _: &mut [Sink], _: &DeviceLink) -> Result<(), DeviceError> {
        std::thread::sleep(FOR_EVER);
        Ok(())
    }
}

#[test]
fn of_a_station_in_which_everything_hangs_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let history = Arc::new(History::open(&folder.path().join(".history"), 1 << 30).unwrap());
    // They take connections, and never answer.
    let mute = [(); 2].map(|()| TcpListener::bind("127.0.0.1:0").unwrap());
    let [http, mqtt] = [0, 1].map(|at| mute[at].local_addr().unwrap());
    let outputs = OutputsConfig {
        station: "press-3".into(),
        http: Some(format!("http://{http}/answers").parse().unwrap()),
        mqtt: Some(format!("mqtt://{mqtt}/answers").parse().unwrap()),
        alerts: Vec::new(),
    };
    let shown = (&history, &Arc::default());
    let outputs = Output::start(&outputs, &folder.path().join(".outbox"), shown).unwrap();
    let keeper = Keeper::start(history.clone(), Scene::lmt108(), BTreeMap::new(), None).unwrap();
    let library = LibraryFolder { folder: folder.path().to_path_buf(), scene: Scene::lmt108() };
    let settings = Settings {
        address: "127.0.0.1:0".parse().unwrap(),
        library: Some(library),
        ..Settings::default()
    };
    let devices: Vec<Box<dyn Device>> = vec![Box::new(Stylus), Box::new(Stuck)];
    let station = Station::new(devices, Options::default());
    let (server, reporter) = Server::start(&settings, station.commands()).unwrap();
    // Its edit waits for another program, which reads the library all the time.
    let _read = LibraryLock::for_reading(folder.path());
    let mut client = TcpStream::connect(server.address()).unwrap();
    let body = "{\"surface\":\"oak\",\"to\":\"ash\"}";
    write!(
        client,
        "POST /api/v1/library/rename HTTP/1.1\r\nHost: localhost\r\n\
         Content-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}",
        body.len()
    )
    .unwrap();
    let (ordered, events) = (Arc::default(), Arc::default());
    let ends = Ends { commands: station.commands(), ordered: Arc::clone(&ordered), events };
    let station = named_by(station, "explain").listener(reporter).listener(keeper);
    let station = outputs.into_iter().fold(station, Station::listener);
    station.listener(ends).run().unwrap();
    drop(server);
    let took = ordered.lock().unwrap().unwrap().elapsed();
    assert!(took < LIMIT, "the end took {took:?}");
    assert!(took > Duration::from_secs(2), "the device had its two seconds: {took:?}");
    assert_eq!(history.extent().with_signals, 3);
}
