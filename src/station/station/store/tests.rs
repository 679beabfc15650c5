use std::path::Path;
use std::time::Instant;

use super::*;
use crate::dataset;
use crate::trial::{Series, Signal};

fn scan(number: u32) -> Box<Scan> {
    scan_at(number, 0.0)
}

/// The outcome of a scan that the thread stores.
fn stored(thread: &mut RecordingThread, scan: Box<Scan>, enrolment: Enrolment) -> Enrolled {
    thread.store(scan, enrolment, None);
    thread.stored.recv().unwrap().enrolled
}

/// A scan in which every source starts at `level`.
fn scan_at(number: u32, level: f32) -> Box<Scan> {
    let signal = |channels: usize| {
        let samples = (0..100 * channels).map(|x| level + x as f32 / 1024.0).collect();
        Signal::Series(Series::new(10_000.0, channels, samples).unwrap())
    };
    let signals = [("ir", 1), ("fr", 2), ("ac", 3)]
        .map(|(id, channels)| (SourceId::new(id).unwrap(), signal(channels)));
    Box::new(Scan { scan_s: 0.01, ..Scan::of_signals(number, signals.into()) })
}

/// The session of trials that are recorded.
const SESSION: &str = "2026-11-25T10:42";

fn start(folder: &Path) -> RecordingThread {
    let store = ScanStore::new(folder.to_path_buf(), Scene::lmt108());
    RecordingThread::start(ScanStore { session: Some(SESSION.into()), ..store }).unwrap()
}

fn enrolment() -> Enrolment {
    let (surface, user) = ("oak".into(), "anna".into());
    let keep = Keep { surface, user, trials: None, good_only: false, ordered_by: None };
    Enrolment { order: 0, keep }
}

/// Like [`enrolment`], but refuses a scan that would be a bad trial.
fn strict() -> Enrolment {
    Enrolment { order: 0, keep: Keep { good_only: true, ..enrolment().keep } }
}

#[test]
fn a_trial_belongs_to_the_session_of_its_station() {
    let dir = tempfile::tempdir().unwrap();
    let mut thread = start(dir.path());
    let enrolled = stored(&mut thread, scan(1), enrolment());
    let said = (enrolled.outcome, enrolled.session.as_deref());
    assert_eq!(said, (EnrolledOutcome::Kept, Some(SESSION)));
    let library = dataset::open(dir.path(), &Scene::lmt108()).unwrap();
    assert_eq!(library.entries[0].key.session.as_deref(), Some(SESSION));
}

#[test]
fn a_scan_that_cannot_be_written_waits_and_is_written_once_it_can_be() {
    let dir = tempfile::tempdir().unwrap();
    // A file lies where the library's folder should be.
    let folder = dir.path().join("library");
    std::fs::write(&folder, "").unwrap();
    let mut thread = start(&folder);
    let stored = thread.stored.clone();
    let outcomes = |n: usize| -> Vec<_> {
        let next = || stored.recv().unwrap().enrolled;
        (0..n).map(|_| next()).map(|e| (e.scan, e.outcome)).collect()
    };
    (1..=2).for_each(|number| thread.store(scan(number), enrolment(), None));
    use EnrolledOutcome::{Kept, Waiting};
    assert_eq!(outcomes(2), [(1, Waiting), (2, Waiting)]);
    std::fs::remove_file(&folder).unwrap();
    assert_eq!(outcomes(2), [(1, Kept), (2, Kept)]);
    assert_eq!(dataset::open(&folder, &Scene::lmt108()).unwrap().entries.len(), 2);
}

#[test]
fn two_that_record_under_one_label_both_keep_every_scan_and_mix_none() {
    let dir = tempfile::tempdir().unwrap();
    let mut both = [start(dir.path()), start(dir.path())];
    // Both have the same process number, as programs in two containers may.
    for number in 1..=8 {
        for (thread, level) in both.iter_mut().zip([0.0, 0.5]) {
            thread.store(scan_at(number, level), enrolment(), None);
        }
    }
    for thread in both {
        let last = thread.finish(None);
        assert!(last.iter().all(|stored| stored.enrolled.outcome == EnrolledOutcome::Kept));
    }
    let library = dataset::open(dir.path(), &Scene::lmt108()).unwrap();
    assert_eq!(library.entries.len(), 16);
    let level = |signal: &Signal| match signal {
        Signal::Series(series) => series.samples()[0],
        Signal::Image(_) => f32::NAN,
    };
    let mut of_each = [0, 0];
    for entry in library.entries {
        let levels: Vec<f32> = entry.load().unwrap().signals.values().map(level).collect();
        assert!(levels.len() == 3 && levels.iter().all(|x| *x == levels[0]), "{levels:?}");
        of_each[usize::from(levels[0] > 0.25)] += 1;
    }
    assert_eq!(of_each, [8, 8]);
}

#[test]
fn a_trial_that_a_script_adds_meanwhile_keeps_its_number() {
    let dir = tempfile::tempdir().unwrap();
    let mut thread = start(dir.path());
    assert_eq!(stored(&mut thread, scan(1), enrolment()).trial, Some(1));
    let script = dir.path().join("oak/trial2");
    std::fs::create_dir(&script).unwrap();
    std::fs::copy(dir.path().join("oak/anna-01/ir.wav"), script.join("ir.wav")).unwrap();
    std::fs::write(script.join("trial.toml"), "user = \"anna\"\n").unwrap();
    assert_eq!(stored(&mut thread, scan(2), enrolment()).trial, Some(3));
}

#[test]
fn at_the_end_a_scan_takes_the_number_after_those_in_the_names_of_folders() {
    let dir = tempfile::tempdir().unwrap();
    for name in ["trial7", "anna-02", "notes"] {
        std::fs::create_dir_all(dir.path().join("oak").join(name)).unwrap();
    }
    let (send, stored) = unbounded();
    let (working, ending) = bounded(0);
    let store = ScanStore::new(dir.path().to_path_buf(), Scene::lmt108());
    let mut writer = StoreWriter::new(store, send, ending);
    drop(working);
    let (scan, enrolment, doubts) = (scan(1), enrolment(), Vec::new());
    writer.accept(WaitingScan { scan, enrolment, by: None, doubts });
    // The library holds no trial and would give number 1, but it is not read at the end.
    let Enrolled { trial, outcome, .. } = stored.recv().unwrap().enrolled;
    assert_eq!((trial, outcome), (Some(8), EnrolledOutcome::Kept));
}

#[test]
fn a_scan_that_was_refused_is_kept_once_somebody_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let mut thread = start(dir.path());
    let refused = stored(&mut thread, scan(1), strict());
    assert_eq!(refused.outcome, EnrolledOutcome::Refused);
    let short = Doubt::TooShort { scan_s: 0.01, needed_s: 1.0, settled: false };
    assert_eq!(refused.doubts, [short]);
    thread.keep_refused(2, strict());
    let lost = thread.stored.recv().unwrap().enrolled;
    assert_eq!((lost.scan, lost.outcome), (2, EnrolledOutcome::Lost), "another was refused last");
    thread.keep_refused(1, strict());
    let kept = thread.stored.recv().unwrap().enrolled;
    assert_eq!((kept.scan, kept.outcome, kept.trial), (1, EnrolledOutcome::Kept, Some(1)));
    assert_eq!(dataset::open(dir.path(), &Scene::lmt108()).unwrap().entries.len(), 1);
}

#[test]
fn what_the_disk_has_not_taken_by_the_end_is_reported_as_lost() {
    let (scans, _hung) = unbounded();
    let (_send, stored) = unbounded();
    let (working, _ending) = bounded(0);
    let mut thread = RecordingThread { scans, stored, working, under_way: BTreeMap::new() };
    thread.store(scan(1), enrolment(), None);
    let last = thread.finish(Some(Instant::now()));
    assert_eq!(last.len(), 1);
    assert_eq!((last[0].enrolled.scan, last[0].enrolled.outcome), (1, EnrolledOutcome::Lost));
}

#[test]
fn a_trial_without_a_sensor_is_refused_once_the_sensor_was_there_and_says_so_before() {
    let dir = tempfile::tempdir().unwrap();
    let devices = ["ir", "fr", "ac"].map(|id| (id.to_string(), "stylus".to_string())).into();
    let store = ScanStore::new(dir.path().to_path_buf(), Scene::lmt108());
    let mut thread = RecordingThread::start(ScanStore { devices, ..store }).unwrap();
    let long = |without: Option<&str>, number| {
        let mut scan = scan(number);
        scan.scan_s = 2.0;
        without.map(|id| scan.trial.signals.remove(id));
        scan
    };
    let mut outcome = |scan| {
        let enrolled = stored(&mut thread, scan, strict());
        (enrolled.outcome, enrolled.doubts)
    };
    let lacks = vec![Doubt::SourceMissing { source: SourceId::new("fr").unwrap() }];
    assert_eq!(outcome(long(Some("fr"), 1)), (EnrolledOutcome::Kept, lacks.clone()));
    assert_eq!(outcome(long(None, 2)), (EnrolledOutcome::Kept, vec![]));
    assert_eq!(outcome(long(Some("fr"), 3)), (EnrolledOutcome::Refused, lacks));
}
