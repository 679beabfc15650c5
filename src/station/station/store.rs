//! The thread that writes enrolled scans into a library. A scan becomes a complete trial or none.
//!
//! A scan that cannot be written (the disk is full, a permission is missing) stays in memory and is
//! tried again until it is written or the station ends.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::convert::Infallible;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use crossbeam_channel::{
    Receiver, RecvTimeoutError, Sender, TryRecvError, bounded, select, unbounded,
};

use super::event::{Enrolled, EnrolledOutcome};
use super::orders::{Enrolment, Keep};
use super::recogniser::Recogniser;
use super::trial_need::faults;
use crate::library::{About, LibraryError};
use crate::record::{TrialOptions, append_trial, edit, number_by_names};
use crate::scan::Scan;
use crate::scene::{Scene, SourceId};
use crate::trial::{Doubt, Trial, TrialKey, lines, utc};

const RETRY: Duration = Duration::from_secs(2);
/// How many scans may wait to be written. Scans of 10 s then take 200 MB.
const MAX_WAITING: usize = 64;

#[derive(Clone, Debug)]
pub struct ScanStore {
    /// The folder of the library; it need not exist yet.
    pub folder: PathBuf,
    pub scene: Scene,
    pub devices: BTreeMap<String, String>,
    /// The session of the trials: the sitting in which they are recorded.
    pub session: Option<String>,
    /// A good trial must hold enough independent samples of each of these sources, judged by T*.
    pub by_t_star: Vec<SourceId>,
}

impl ScanStore {
    pub fn new(folder: PathBuf, scene: Scene) -> Self {
        let (devices, session, by_t_star) = (BTreeMap::new(), None, Vec::new());
        Self { folder, scene, devices, session, by_t_star }
    }
}

pub(super) struct StoredScan {
    pub enrolment: Enrolment,
    pub enrolled: Enrolled,
    /// A kept scan, and the recogniser that finds its nearest surface; `None` unless there are both.
    pub kept: Option<(Box<Scan>, Arc<Recogniser>)>,
}

impl StoredScan {
    fn lost(scan: u32, enrolment: Enrolment, why: &str) -> Self {
        let doubts = vec![Doubt::NotWritten { why: why.into() }];
        let enrolled = enrolled(scan, &enrolment, EnrolledOutcome::Lost, doubts);
        Self { enrolment, enrolled, kept: None }
    }
}

enum Task {
    Store(WaitingScan),
    /// Stores the scan of this number, which must be the one that was refused last.
    KeepRefused(u32, Enrolment),
}

pub(super) struct RecordingThread {
    scans: Sender<Task>,
    pub stored: Receiver<StoredScan>,
    /// Dropped when the station ends, so that the thread stops reading the library.
    working: Sender<Infallible>,
    /// The enrolments of scans that may still become trials, by the scan's number.
    under_way: BTreeMap<u32, Enrolment>,
}

impl RecordingThread {
    pub(super) fn start(store: ScanStore) -> std::io::Result<Self> {
        // The channel is unbounded, but the thread moves its scans at once to a bounded queue.
        let (scans, to_store) = unbounded();
        let (send, stored) = unbounded();
        let (working, ending) = bounded(0);
        let mut writer = StoreWriter::new(store, send, ending);
        let run = move || writer.run(&to_store);
        std::thread::Builder::new().name("record".into()).spawn(run)?;
        Ok(Self { scans, stored, working, under_way: BTreeMap::new() })
    }

    /// Stores a scan; once the scan is kept, `by` finds its nearest surface.
    pub(super) fn store(
        &mut self,
        scan: Box<Scan>,
        enrolment: Enrolment,
        by: Option<Arc<Recogniser>>,
    ) {
        self.under_way.insert(scan.number, enrolment.clone());
        // Sending fails only if the thread has panicked; `finish` then reports the scan as lost.
        let doubts = Vec::new();
        let _ = self.scans.send(Task::Store(WaitingScan { scan, enrolment, by, doubts }));
    }

    pub(super) fn keep_refused(&mut self, scan: u32, enrolment: Enrolment) {
        self.under_way.insert(scan, enrolment.clone());
        // Sending fails only if the thread has panicked, as in `store`.
        let _ = self.scans.send(Task::KeepRefused(scan, enrolment));
    }

    pub(super) fn settle(&mut self, enrolled: &Enrolled) {
        settle(&mut self.under_way, enrolled);
    }

    /// Tries a last time to write the waiting scans. Data not written by `until` is lost.
    pub(super) fn finish(self, until: Option<Instant>) -> Vec<StoredScan> {
        let Self { scans, stored, working, mut under_way } = self;
        drop((scans, working));
        let next = || match until {
            Some(until) => stored.recv_deadline(until).ok(),
            None => stored.recv().ok(),
        };
        let mut last: Vec<StoredScan> = std::iter::from_fn(next).collect();
        last.iter().for_each(|stored| settle(&mut under_way, &stored.enrolled));
        let why = "it was not on disk when the station ended";
        last.extend(under_way.into_iter().map(|(scan, of)| StoredScan::lost(scan, of, why)));
        last
    }
}

fn settle(under_way: &mut BTreeMap<u32, Enrolment>, enrolled: &Enrolled) {
    if enrolled.outcome != EnrolledOutcome::Waiting {
        under_way.remove(&enrolled.scan);
    }
}

struct WaitingScan {
    scan: Box<Scan>,
    enrolment: Enrolment,
    by: Option<Arc<Recogniser>>,
    doubts: Vec<Doubt>,
}

struct StoreWriter {
    store: ScanStore,
    waiting: VecDeque<WaitingScan>,
    refused: Option<WaitingScan>,
    /// The sources that any scan of this session has had.
    seen: BTreeSet<SourceId>,
    /// The next free trial numbers, read from the library and raised by the trials written since.
    next: BTreeMap<(String, String), u32>,
    /// Whether `next` was read from the library for the current scan.
    current: bool,
    send: Sender<StoredScan>,
    /// Closed when the station ends, so that the library is no longer read.
    ending: Receiver<Infallible>,
}

impl StoreWriter {
    fn new(store: ScanStore, send: Sender<StoredScan>, ending: Receiver<Infallible>) -> Self {
        let (waiting, refused, next) = (VecDeque::new(), None, BTreeMap::new());
        let seen = BTreeSet::new();
        Self { store, waiting, refused, seen, next, current: false, send, ending }
    }

    /// Stores scans until the channel closes, then tries a last time to write the waiting scans.
    fn run(&mut self, scans: &Receiver<Task>) {
        loop {
            let next = match self.waiting.is_empty() {
                true => scans.recv().map_err(|_| RecvTimeoutError::Disconnected),
                false => scans.recv_timeout(RETRY),
            };
            match next {
                Ok(Task::Store(scan)) => self.accept(scan),
                Ok(Task::KeepRefused(scan, enrolment)) => {
                    let why = "another scan was refused meanwhile";
                    match self.refused.take_if(|refused| refused.scan.number == scan) {
                        Some(refused) => self.keep(refused),
                        None => self.tell(StoredScan::lost(scan, enrolment, why)),
                    }
                }
                Err(RecvTimeoutError::Timeout) => self.retry(),
                Err(RecvTimeoutError::Disconnected) => break,
            }
        }
        self.current = false;
        while let Some(last) = self.waiting.pop_front() {
            self.try_write(last, false);
        }
    }

    fn accept(&mut self, mut new: WaitingScan) {
        let ScanStore { scene, by_t_star, devices, .. } = &self.store;
        new.doubts = faults(&new.scan, scene, by_t_star, new.by.as_deref());
        let has = &new.scan.trial.signals;
        self.seen.extend(has.keys().cloned());
        let expected = devices.keys().filter_map(|id| SourceId::new(id).ok());
        let lacks = |id: &SourceId| scene.is_dragged(id) && !has.contains_key(id);
        // A sensor that was never there may be left out on purpose.
        let (lost, absent): (Vec<_>, Vec<_>) =
            expected.filter(lacks).partition(|id| self.seen.contains(id));
        let missing = |source| Doubt::SourceMissing { source };
        new.doubts.extend(lost.into_iter().map(missing));
        if new.enrolment.keep.good_only && !new.doubts.is_empty() {
            self.report(&new, EnrolledOutcome::Refused);
            self.refused = Some(new);
        } else {
            new.doubts.extend(absent.into_iter().map(missing));
            self.keep(new);
        }
    }

    fn keep(&mut self, new: WaitingScan) {
        // The numbers are read for each scan, since other programs may write into the same library.
        self.read_numbers();
        self.try_write(new, self.waiting.len() < MAX_WAITING);
    }

    /// Writes a scan. If that fails, the scan waits if it `may_wait`, and is lost otherwise.
    fn try_write(&mut self, mut new: WaitingScan, may_wait: bool) {
        match self.write(&new) {
            Ok(stored) => self.kept(new, stored),
            Err(error) => {
                let outcome =
                    if may_wait { EnrolledOutcome::Waiting } else { EnrolledOutcome::Lost };
                new.doubts.push(Doubt::NotWritten { why: error.to_string() });
                self.report(&new, outcome);
                new.doubts.pop();
                self.waiting.extend(may_wait.then_some(new));
            }
        }
    }

    /// Writes waiting scans until writing one fails; that scan goes to the end of the queue.
    fn retry(&mut self) {
        self.read_numbers();
        while let Some(first) = self.waiting.pop_front() {
            match self.write(&first) {
                Ok(stored) => self.kept(first, stored),
                Err(_) => return self.waiting.push_back(first),
            }
        }
    }

    /// Writes a scan, and returns the number and the folder of its trial.
    fn write(&mut self, waiting: &WaitingScan) -> Result<(u32, PathBuf), LibraryError> {
        let WaitingScan { scan, enrolment, .. } = waiting;
        let of = (enrolment.keep.surface.clone(), enrolment.keep.user.clone());
        let known = self.next.get(&of).copied().unwrap_or(1);
        let number = match self.current {
            true => known,
            false => known.max(number_by_names(&self.store.folder, &of.0)),
        };
        let took = scan.ended_at.elapsed().as_secs_f64() + scan.scan_s;
        let began = SystemTime::now() - Duration::from_secs_f64(took.max(0.0));
        let about = About {
            started_at: Some(utc(began)),
            notes: (!scan.spoiled.is_empty()).then(|| lines(&scan.spoiled).join("\n")),
            synthetic: scan.synthetic,
            // A spoiled scan is marked as incomplete, so that no scan is compared with it.
            incomplete: !scan.spoiled.is_empty(),
            devices: self.store.devices.clone(),
            ..About::default()
        };
        let key = TrialKey::new(&of.0, &of.1, number).with_session(self.store.session.clone());
        let trial = Trial { key, signals: scan.trial.signals.clone() };
        let options = TrialOptions { about, durable: true };
        let stored = append_trial(&self.store.folder, &trial, &self.store.scene, &options)?;
        self.next.insert(of, stored.0.saturating_add(1));
        Ok(stored)
    }

    fn report(&self, of: &WaitingScan, outcome: EnrolledOutcome) {
        let WaitingScan { scan, enrolment, doubts, .. } = of;
        let enrolled = enrolled(scan.number, enrolment, outcome, doubts.clone());
        self.tell(StoredScan { enrolment: enrolment.clone(), enrolled, kept: None });
    }

    fn kept(&self, of: WaitingScan, (trial, folder): (u32, PathBuf)) {
        let WaitingScan { scan, enrolment, by, doubts } = of;
        let enrolled = enrolled(scan.number, &enrolment, EnrolledOutcome::Kept, doubts);
        let session = self.store.session.clone();
        let enrolled = Enrolled { session, trial: Some(trial), folder: Some(folder), ..enrolled };
        self.tell(StoredScan { enrolment, enrolled, kept: by.map(|by| (scan, by)) });
    }

    fn tell(&self, stored: StoredScan) {
        // Sending fails only if the station has panicked or has stopped waiting for outcomes.
        let _ = self.send.send(stored);
    }

    /// Reads the next free trial numbers, unless the station is ending; sets `current` on success.
    fn read_numbers(&mut self) {
        self.current = false;
        if self.ending.try_recv() == Err(TryRecvError::Disconnected) {
            return;
        }
        let (send, read) = bounded(1);
        let ScanStore { folder, scene, .. } = self.store.clone();
        // A separate thread reads, since the end of the station must not wait for the library.
        let work = move || drop(send.send(edit::numbers_after(&folder, &scene)));
        if std::thread::Builder::new().name("numbers".into()).spawn(work).is_err() {
            return;
        }
        select! {
            recv(read) -> numbers => if let Ok(Ok(numbers)) = numbers {
                (self.next, self.current) = (numbers, true);
            },
            recv(self.ending) -> _ => {}
        }
    }
}

/// Makes the outcome of a scan. Session, number and folder of its trial are added later.
pub(super) fn enrolled(
    scan: u32,
    of: &Enrolment,
    outcome: EnrolledOutcome,
    doubts: Vec<Doubt>,
) -> Enrolled {
    let Keep { surface, user, .. } = of.keep.clone();
    Enrolled { scan, surface, user, outcome, doubts, wanted: Some(0), ..Enrolled::default() }
}

#[cfg(test)]
mod tests;
