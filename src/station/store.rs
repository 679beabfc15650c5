//! The thread that writes enrolled scans into a library, each as a complete trial or not at all.
//!
//! A scan that cannot be written, for a full disk or a lost permission, stays in memory and is
//! tried again until it is written or the station ends.

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, SystemTime};

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender};

use super::enroll::faults;
use super::event::{Enrolled, EnrolledOutcome};
use super::orders::Enrolment;
use super::recogniser::Recogniser;
use crate::library::{About, LibraryError, recording};
use crate::record::{TrialOptions, append_trial, utc};
use crate::scan::Scan;
use crate::scene::{Scene, SourceId};
use crate::trial::{Trial, TrialKey};

/// Time between two attempts to write a scan.
const RETRY: Duration = Duration::from_secs(2);
/// Scans that wait to be written: of 10 s each, 200 MB.
const MAX_WAITING: usize = 64;

/// Where scans are stored, and what is noted with them.
#[derive(Clone, Debug)]
pub struct ScanStore {
    /// The library; it need not exist.
    pub folder: PathBuf,
    /// What its sources are.
    pub scene: Scene,
    /// Which device each source comes from.
    pub devices: BTreeMap<String, String>,
    /// Sources of which a good trial holds enough independent samples.
    pub by_t_star: Vec<SourceId>,
}

impl ScanStore {
    /// Stores scans in a library, with nothing noted beside them.
    pub fn new(folder: PathBuf, scene: Scene) -> Self {
        Self { folder, scene, devices: BTreeMap::new(), by_t_star: Vec::new() }
    }
}

/// What became of a scan, and the enrolment that it belongs to.
pub(super) type Stored = (Enrolment, Enrolled);

/// A scan, the enrolment that it belongs to, and what it is compared with.
type ToStore = (Box<Scan>, Enrolment, Option<Arc<Recogniser>>);

/// The thread, and its two ends.
pub(super) struct RecordingThread {
    scans: Sender<ToStore>,
    pub stored: Receiver<Stored>,
    ending: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

impl RecordingThread {
    /// Starts the thread.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn start(store: ScanStore) -> std::io::Result<Self> {
        // Unbounded, but emptied at once: what cannot be written waits within limits of its own.
        let (scans, to_store) = crossbeam_channel::unbounded();
        let (send, stored) = crossbeam_channel::unbounded();
        let ending = Arc::<AtomicBool>::default();
        let (waiting, next) = (VecDeque::new(), Numbers::new());
        let mut writer = Writer { store, waiting, next, send, ending: ending.clone() };
        let run = move || writer.run(&to_store);
        let thread = std::thread::Builder::new().name("record".into()).spawn(run)?;
        Ok(Self { scans, stored, ending, thread })
    }

    /// Stores a scan, and says what `by` would have named it, unless the end cannot wait for that.
    pub fn store(&self, scan: Box<Scan>, enrolment: Enrolment, by: Option<Arc<Recogniser>>) {
        // Fails only if the thread has panicked, and then nothing is reported as stored either.
        let _ = self.scans.send((scan, enrolment, by));
    }

    /// Gives what is still to come, after a last attempt to write what waits.
    pub fn finish(self) -> impl Iterator<Item = Stored> {
        self.ending.store(true, Ordering::Release);
        drop(self.scans);
        let _ = self.thread.join();
        self.stored.into_iter()
    }
}

/// The next number of each surface and user.
type Numbers = BTreeMap<(String, String), u32>;

/// A scan that could not be written so far.
struct Waiting {
    scan: Box<Scan>,
    enrolment: Enrolment,
    remarks: Vec<String>,
    /// As [`Enrolled::nearest`].
    nearest: Option<String>,
}

struct Writer {
    store: ScanStore,
    waiting: VecDeque<Waiting>,
    /// The next numbers when the library was last readable.
    next: Numbers,
    send: Sender<Stored>,
    /// Whether there is no time left for names.
    ending: Arc<AtomicBool>,
}

impl Writer {
    /// Stores scans until there will be no more.
    fn run(&mut self, scans: &Receiver<ToStore>) {
        loop {
            let next = match self.waiting.is_empty() {
                true => scans.recv().map_err(|_| RecvTimeoutError::Disconnected),
                false => scans.recv_timeout(RETRY),
            };
            match next {
                Ok(scan) => self.accept(scan),
                Err(RecvTimeoutError::Timeout) => self.retry(),
                Err(RecvTimeoutError::Disconnected) => break,
            }
        }
        if !self.waiting.is_empty() {
            self.read_numbers();
        }
        while let Some(mut last) = self.waiting.pop_front() {
            match self.write(&last) {
                Ok(stored) => self.report(&last, EnrolledOutcome::Kept, Some(stored)),
                Err(error) => {
                    last.remarks.push(error.to_string());
                    self.report(&last, EnrolledOutcome::Lost, None);
                }
            }
        }
    }

    /// Stores a new scan, unless it is refused.
    fn accept(&mut self, (scan, enrolment, by): ToStore) {
        let remarks = faults(&scan, &self.store.scene, &self.store.by_t_star);
        let refused = enrolment.good_only && !remarks.is_empty();
        let mut new = Waiting { scan, enrolment, remarks, nearest: None };
        if refused {
            return self.report(&new, EnrolledOutcome::Refused, None);
        }
        // Each time, since others may write into the same library.
        self.read_numbers();
        let stored = self.write(&new);
        // After that, since it may take long.
        let by = by.filter(|_| !self.ending.load(Ordering::Acquire));
        new.nearest = by.and_then(|by| nearest(&by, &new.scan));
        match stored {
            Ok(stored) => self.report(&new, EnrolledOutcome::Kept, Some(stored)),
            Err(error) => {
                let full = self.waiting.len() >= MAX_WAITING;
                let outcome = if full { EnrolledOutcome::Lost } else { EnrolledOutcome::Waiting };
                new.remarks.push(error.to_string());
                self.report(&new, outcome, None);
                new.remarks.pop();
                if !full {
                    self.waiting.push_back(new);
                }
            }
        }
    }

    /// Tries to write what waits, until the first that fails; another one is first next time.
    fn retry(&mut self) {
        self.read_numbers();
        while let Some(first) = self.waiting.pop_front() {
            match self.write(&first) {
                Ok(stored) => self.report(&first, EnrolledOutcome::Kept, Some(stored)),
                Err(_) => return self.waiting.push_back(first),
            }
        }
    }

    /// Writes a scan; gives its number and its folder.
    fn write(&mut self, waiting: &Waiting) -> Result<(u32, PathBuf), LibraryError> {
        let Waiting { scan, enrolment, .. } = waiting;
        let of = (enrolment.surface.clone(), enrolment.user.clone());
        let number = self.next.get(&of).copied().unwrap_or(1);
        let took = scan.ended_at.elapsed().as_secs_f64() + scan.scan_s;
        let began = SystemTime::now() - Duration::from_secs_f64(took.max(0.0));
        let about = About {
            started_at: Some(utc(began)),
            notes: (!scan.spoiled.is_empty()).then(|| scan.spoiled.join("\n")),
            synthetic: scan.synthetic,
            // Nothing is to be compared with a scan that has holes.
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

    fn report(&self, of: &Waiting, outcome: EnrolledOutcome, stored: Option<(u32, PathBuf)>) {
        let (trial, folder) = stored.unzip();
        let enrolled = Enrolled {
            scan: of.scan.number,
            surface: of.enrolment.surface.clone(),
            user: of.enrolment.user.clone(),
            outcome,
            trial,
            folder,
            remarks: of.remarks.clone(),
            nearest: of.nearest.clone(),
            wanted: 0,
        };
        // Fails only if the station has panicked.
        let _ = self.send.send((of.enrolment.clone(), enrolled));
    }

    /// Learns the numbers that are taken, if the library can be read now.
    fn read_numbers(&mut self) {
        if let Ok(numbers) = self.numbers() {
            self.next = numbers;
        }
    }

    /// The numbers after those that the library holds.
    fn numbers(&self) -> Result<Numbers, LibraryError> {
        let mut numbers = Numbers::new();
        let library = match recording::open(&self.store.folder, &self.store.scene) {
            Ok(library) => library,
            Err(LibraryError::NothingFound { .. }) => return Ok(numbers),
            Err(_) if !self.store.folder.exists() => return Ok(numbers),
            Err(error) => return Err(error),
        };
        for entry in library.entries {
            let next = numbers.entry((entry.key.surface, entry.key.user)).or_insert(1);
            *next = (*next).max(entry.key.number.saturating_add(1));
        }
        Ok(numbers)
    }
}

/// The surface that a library would name a scan.
fn nearest(by: &Recogniser, scan: &Scan) -> Option<String> {
    // A method that panics must not take the recording with it.
    let named = std::panic::AssertUnwindSafe(|| Some(by.verdict(scan, by.rank(scan).ok()?)));
    let verdict = std::panic::catch_unwind(named).ok()??;
    (!verdict.is_unknown()).then(|| verdict.ranking.surface().to_string())
}

#[cfg(test)]
mod tests;
