//! An end takes less than five seconds, whatever happens; nothing recorded is lost, and every scan
//! without an answer is reported.

mod common;

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use common::id;
use surfaced::device::{Begin, Control, Device, DeviceError, Mark, Open, StreamKind, StreamSpec};
use surfaced::library::{Entry, recording};
use surfaced::recognise::features::FeatureVector;
use surfaced::recognise::{Follow, FollowOptions, Model, Prepared, Ranking, RecogniseError};
use surfaced::ring::Sink;
use surfaced::scan::Options;
use surfaced::scene::{Phase, Scene};
use surfaced::station::{
    Command, Enrolled, Keep, LibraryState, Listener, Recogniser, ScanStore, Station, StationEvent,
};
use surfaced::trial::{Trial, TrialKey};

/// An end may take this long.
const LIMIT: Duration = Duration::from_secs(5);
/// Scans that the stylus makes.
const SCANS: u32 = 3;
/// What never ends, as far as a test can see.
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

    fn run(&mut self, sinks: &mut [Sink], control: &Control) -> Result<(), DeviceError> {
        for _ in 0..SCANS {
            control.mark(Mark::Begin(Begin::default()));
            let (source, start) = (id("ir"), sinks[0].position());
            control.mark(Mark::Open(Open {
                source: source.clone(),
                stream: source.clone(),
                start,
                phase: Phase::Drag,
                rate_hz: 10_000.0,
                channels: 1,
            }));
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
        StationEvent::Warning(text) if text.contains("was not named") => {
            text.split(' ').nth(1)?.parse().ok()
        }
        _ => None,
    };
    events.iter().filter_map(number).collect()
}

#[test]
fn of_a_station_whose_library_is_still_being_read() {
    let folder = tempfile::tempdir().unwrap();
    let keep =
        Keep { surface: "oak".into(), user: "anna".into(), trials: Some(1), good_only: false };
    let load = || {
        std::thread::sleep(FOR_EVER);
        Err("no library".to_string())
    };
    let store = ScanStore::new(folder.path().to_path_buf(), Scene::lmt108());
    let left = unnamed(|station| station.load(Arc::new(load)).store(store).keep(keep));
    assert_eq!(left, [2, 3]);
    let kept = recording::open(folder.path(), &Scene::lmt108()).unwrap();
    assert_eq!(kept.entries.len(), 1);
    assert_eq!(kept.entries[0].load().unwrap().signals.len(), 1);
}

#[test]
fn of_a_station_whose_disk_takes_no_scan() {
    let dir = tempfile::tempdir().unwrap();
    // Where the library's folder should be lies a file.
    let folder = dir.path().join("library");
    std::fs::write(&folder, "").unwrap();
    let keep = Keep { surface: "oak".into(), user: "anna".into(), trials: None, good_only: false };
    let lost = Arc::<Mutex<Vec<u32>>>::default();
    struct Lost(Arc<Mutex<Vec<u32>>>);
    impl Listener for Lost {
        fn on_event(&mut self, event: &StationEvent) {
            use surfaced::station::EnrolledOutcome::Lost;
            if let StationEvent::Enrolled(Enrolled { scan, outcome: Lost, .. }) = event {
                self.0.lock().unwrap().push(*scan);
            }
        }
    }
    let listener = Lost(lost.clone());
    let store = ScanStore::new(folder, Scene::lmt108());
    assert_eq!(unnamed(|s| s.store(store).keep(keep).listener(listener)), Vec::<u32>::new());
    assert_eq!(*lost.lock().unwrap(), [1, 2, 3]);
}

/// Takes for ever in one of its parts.
#[derive(Clone, Copy)]
struct Slow(&'static str);

impl Slow {
    fn reach(self, part: &str) {
        if self.0 == part {
            std::thread::sleep(FOR_EVER);
        }
    }
}

impl Model for Slow {
    fn prepare(&self, entry: &Entry, _: &Trial) -> Result<Prepared, RecogniseError> {
        self.reach("prepare");
        let (key, sources) = (entry.key.clone(), BTreeMap::new());
        Ok(Prepared::Features(Arc::new(FeatureVector { key, sources })))
    }

    fn rank(&self, _: &Prepared) -> Result<Ranking, RecogniseError> {
        self.reach("rank");
        Ok(Ranking {
            ranked: Vec::new(),
            margin: 0.0,
            sources: Vec::new(),
            nearest: TrialKey::new("oak", "", 1),
            confidence: None,
            p_value: None,
        })
    }

    // It calibrates itself when the first scan is followed.
    fn follow(self: Arc<Self>, _: &FollowOptions) -> Option<Box<dyn Follow>> {
        self.reach("follow");
        None
    }
}

#[test]
fn of_a_station_that_classifies_or_calibrates() {
    for part in ["prepare", "rank", "follow"] {
        let by = Recogniser::new(Arc::new(Slow(part)), Scene::lmt108(), LibraryState::default());
        assert_eq!(unnamed(|station| station.recogniser(Arc::new(by))), [1, 2, 3], "{part}");
    }
}
