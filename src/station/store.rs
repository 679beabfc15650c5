//! The thread that writes enrolled scans into a library, each as a complete trial or not at all.
//!
//! A scan that cannot be written, because of a full disk or a lost permission, stays in memory and
//! is tried again until it is written or the station ends.

use std::collections::{BTreeMap, VecDeque};
use std::convert::Infallible;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use crossbeam_channel::{
    Receiver, RecvTimeoutError, Sender, TryRecvError, at, bounded, never, select, unbounded,
};

use super::event::{Enrolled, EnrolledOutcome};
use super::orders::Enrolment;
use super::recogniser::Recogniser;
use super::trial_need::faults;
use crate::library::{About, LibraryError};
use crate::record::{TrialOptions, append_trial, edit, number_by_names, utc};
use crate::scan::Scan;
use crate::scene::{Scene, SourceId};
use crate::trial::{Trial, TrialKey, normal};

/// Time between two attempts to write a scan.
const RETRY: Duration = Duration::from_secs(2);
/// Most scans that wait to be written: 200 MB for scans of 10 s.
const MAX_WAITING: usize = 64;

/// The library in which scans are stored, and the notes that go with them.
#[derive(Clone, Debug)]
pub struct ScanStore {
    /// The library; it need not exist.
    pub folder: PathBuf,
    /// The sources of the library.
    pub scene: Scene,
    /// The device of each source.
    pub devices: BTreeMap<String, String>,
    /// Sources of which a good trial must hold enough independent samples, by T*.
    pub by_t_star: Vec<SourceId>,
}

impl ScanStore {
    /// Stores scans in a library, without further notes.
    pub fn new(folder: PathBuf, scene: Scene) -> Self {
        Self { folder, scene, devices: BTreeMap::new(), by_t_star: Vec::new() }
    }
}

/// The outcome of a scan, and the enrolment that it belongs to.
pub(super) struct StoredScan {
    pub enrolment: Enrolment,
    pub enrolled: Enrolled,
    /// If it was kept: the scan, and the recogniser that finds its nearest surface.
    pub kept: Option<(Box<Scan>, Arc<Recogniser>)>,
}

/// A scan, the enrolment that it belongs to, and the recogniser for it.
type ToStore = (Box<Scan>, Enrolment, Option<Arc<Recogniser>>);

/// Work of the thread.
enum Task {
    Store(ToStore),
    /// Store the scan of this number, which was refused last.
    KeepRefused(u32),
}

/// The thread that writes scans: the channels to and from it.
pub(super) struct RecordingThread {
    scans: Sender<Task>,
    pub stored: Receiver<StoredScan>,
    /// Dropped at the end, when there is no time left for reading the library.
    working: Sender<Infallible>,
    /// Scans that may still become trials.
    under_way: BTreeMap<u32, Enrolment>,
}

impl RecordingThread {
    /// Starts the thread.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn start(store: ScanStore) -> std::io::Result<Self> {
        // Unbounded, but emptied at once: scans that cannot be written wait in a bounded queue.
        let (scans, to_store) = unbounded();
        let (send, stored) = unbounded();
        let (working, ending) = bounded(0);
        let mut writer = StoreWriter::new(store, send, ending);
        let run = move || writer.run(&to_store);
        std::thread::Builder::new().name("record".into()).spawn(run)?;
        Ok(Self { scans, stored, working, under_way: BTreeMap::new() })
    }

    /// Stores a scan; once it is kept, `by` finds its nearest surface.
    pub fn store(&mut self, scan: Box<Scan>, enrolment: Enrolment, by: Option<Arc<Recogniser>>) {
        self.under_way.insert(scan.number, enrolment.clone());
        // Fails only if the thread has panicked; then the end reports the scan as lost.
        let _ = self.scans.send(Task::Store((scan, enrolment, by)));
    }

    /// Stores the scan that was refused last, if it is this one.
    pub fn keep_refused(&mut self, scan: u32, enrolment: Enrolment) {
        self.under_way.insert(scan, enrolment);
        // As in `store`.
        let _ = self.scans.send(Task::KeepRefused(scan));
    }

    /// Notes the outcome of a scan.
    pub fn settle(&mut self, enrolled: &Enrolled) {
        settle(&mut self.under_way, enrolled);
    }

    /// Gives the last outcomes, after a last attempt to write the waiting scans. Data not written
    /// by `until` is lost.
    pub fn finish(self, until: Option<Instant>) -> Vec<StoredScan> {
        let Self { scans, stored, working, mut under_way } = self;
        drop((scans, working));
        let deadline = until.map_or_else(never, at);
        let mut last: Vec<StoredScan> = Vec::new();
        loop {
            select! {
                recv(stored) -> stored => match stored {
                    Ok(stored) => last.push(stored),
                    Err(_) => break,
                },
                recv(deadline) -> _ => break,
            }
        }
        last.iter().for_each(|stored| settle(&mut under_way, &stored.enrolled));
        let lost = under_way.into_iter().map(|(scan, enrolment)| {
            let why = "it was not on disk when the station ended";
            let enrolled = enrolled(scan, &enrolment, EnrolledOutcome::Lost, vec![why.into()]);
            StoredScan { enrolment, enrolled, kept: None }
        });
        last.extend(lost);
        last
    }
}

fn settle(under_way: &mut BTreeMap<u32, Enrolment>, enrolled: &Enrolled) {
    if enrolled.outcome != EnrolledOutcome::Waiting {
        under_way.remove(&enrolled.scan);
    }
}

/// The next number of each surface and user.
type Numbers = BTreeMap<(String, String), u32>;

/// A scan that is not written yet.
struct WaitingScan {
    scan: Box<Scan>,
    enrolment: Enrolment,
    by: Option<Arc<Recogniser>>,
    remarks: Vec<String>,
}

struct StoreWriter {
    store: ScanStore,
    waiting: VecDeque<WaitingScan>,
    /// The scan that was refused last.
    refused: Option<WaitingScan>,
    /// The next numbers, as last read from the library and counted on.
    next: Numbers,
    /// Whether `next` was read from the library for the scan that is now stored.
    current: bool,
    send: Sender<StoredScan>,
    /// Closed when there is no time left for reading the library.
    ending: Receiver<Infallible>,
}

impl StoreWriter {
    fn new(store: ScanStore, send: Sender<StoredScan>, ending: Receiver<Infallible>) -> Self {
        let (waiting, refused, next) = (VecDeque::new(), None, Numbers::new());
        Self { store, waiting, refused, next, current: false, send, ending }
    }

    /// Stores scans until the channel closes, then tries a last time to write those that wait.
    fn run(&mut self, scans: &Receiver<Task>) {
        loop {
            let next = match self.waiting.is_empty() {
                true => scans.recv().map_err(|_| RecvTimeoutError::Disconnected),
                false => scans.recv_timeout(RETRY),
            };
            match next {
                Ok(Task::Store(scan)) => self.accept(scan),
                Ok(Task::KeepRefused(scan)) => {
                    let refused = self.refused.take_if(|refused| refused.scan.number == scan);
                    refused.into_iter().for_each(|refused| self.keep(refused));
                }
                Err(RecvTimeoutError::Timeout) => self.retry(),
                Err(RecvTimeoutError::Disconnected) => break,
            }
        }
        self.current = false;
        while let Some(mut last) = self.waiting.pop_front() {
            match self.write(&last) {
                Ok(stored) => self.kept(last, stored),
                Err(error) => {
                    last.remarks.push(error.to_string());
                    self.report(&last, EnrolledOutcome::Lost);
                }
            }
        }
    }

    /// Stores a new scan, unless it is refused.
    fn accept(&mut self, (scan, enrolment, by): ToStore) {
        let remarks = faults(&scan, &self.store.scene, &self.store.by_t_star, by.as_deref());
        let refused = enrolment.good_only && !remarks.is_empty();
        let new = WaitingScan { scan, enrolment, by, remarks };
        if refused {
            self.report(&new, EnrolledOutcome::Refused);
            self.refused = Some(new);
        } else {
            self.keep(new);
        }
    }

    /// Writes a scan, or lets it wait.
    fn keep(&mut self, mut new: WaitingScan) {
        // Read each time, since other programs may write into the same library.
        self.read_numbers();
        match self.write(&new) {
            Ok(stored) => self.kept(new, stored),
            Err(error) => {
                let full = self.waiting.len() >= MAX_WAITING;
                let outcome = if full { EnrolledOutcome::Lost } else { EnrolledOutcome::Waiting };
                new.remarks.push(error.to_string());
                self.report(&new, outcome);
                new.remarks.pop();
                if !full {
                    self.waiting.push_back(new);
                }
            }
        }
    }

    /// Tries to write the waiting scans until one fails, which then goes to the end of the queue.
    fn retry(&mut self) {
        self.read_numbers();
        while let Some(first) = self.waiting.pop_front() {
            match self.write(&first) {
                Ok(stored) => self.kept(first, stored),
                Err(_) => return self.waiting.push_back(first),
            }
        }
    }

    /// Writes a scan; gives its number and its folder.
    fn write(&mut self, waiting: &WaitingScan) -> Result<(u32, PathBuf), LibraryError> {
        let WaitingScan { scan, enrolment, .. } = waiting;
        let of = (normal(&enrolment.surface), normal(&enrolment.user));
        let known = self.next.get(&of).copied().unwrap_or(1);
        let number = match self.current {
            true => known,
            false => known.max(number_by_names(&self.store.folder, &of.0)),
        };
        let took = scan.ended_at.elapsed().as_secs_f64() + scan.scan_s;
        let began = SystemTime::now() - Duration::from_secs_f64(took.max(0.0));
        let about = About {
            started_at: Some(utc(began)),
            notes: (!scan.spoiled.is_empty()).then(|| scan.spoiled.join("\n")),
            synthetic: scan.synthetic,
            // So that no scan is compared with one that has gaps.
            incomplete: !scan.spoiled.is_empty(),
            devices: self.store.devices.clone(),
            ..About::default()
        };
        let key = TrialKey::new(&of.0, &of.1, number);
        let trial = Trial { key, signals: scan.trial.signals.clone() };
        let options = TrialOptions { about, durable: true };
        let stored = append_trial(&self.store.folder, &trial, &self.store.scene, &options)?;
        self.next.insert(of, stored.0.saturating_add(1));
        Ok(stored)
    }

    fn report(&self, of: &WaitingScan, outcome: EnrolledOutcome) {
        let WaitingScan { scan, enrolment, remarks, .. } = of;
        let enrolled = enrolled(scan.number, enrolment, outcome, remarks.clone());
        // Fails only if the station has panicked, or waits no longer.
        let _ = self.send.send(StoredScan { enrolment: enrolment.clone(), enrolled, kept: None });
    }

    fn kept(&self, of: WaitingScan, (trial, folder): (u32, PathBuf)) {
        let WaitingScan { scan, enrolment, by, remarks } = of;
        let enrolled = enrolled(scan.number, &enrolment, EnrolledOutcome::Kept, remarks);
        let enrolled = Enrolled { trial: Some(trial), folder: Some(folder), ..enrolled };
        // As in `report`.
        let _ = self.send.send(StoredScan { enrolment, enrolled, kept: by.map(|by| (scan, by)) });
    }

    /// Reads the next free trial numbers, if the library can be read now and there is time for it.
    fn read_numbers(&mut self) {
        self.current = false;
        if self.ending.try_recv() == Err(TryRecvError::Disconnected) {
            return;
        }
        let (send, read) = bounded(1);
        let ScanStore { folder, scene, .. } = self.store.clone();
        // On a separate thread, since the end of the station must not wait for a library.
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

/// The outcome of a scan, without the number and folder of its trial.
fn enrolled(scan: u32, of: &Enrolment, outcome: EnrolledOutcome, remarks: Vec<String>) -> Enrolled {
    Enrolled {
        scan,
        surface: of.surface.clone(),
        user: of.user.clone(),
        outcome,
        trial: None,
        folder: None,
        remarks,
        nearest: None,
        wanted: 0,
    }
}

#[cfg(test)]
mod tests;
