//! The thread that writes enrolled scans into a library, whole or not at all.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::thread::JoinHandle;
use std::time::SystemTime;

use crossbeam_channel::{Receiver, Sender};

use super::enroll::{Enrolment, faults};
use super::event::Enrolled;
use crate::library::{About, LibraryError, recording};
use crate::record::{TrialOptions, trial_folder, utc, write_trial};
use crate::scan::Scan;
use crate::scene::{Scene, SourceId};
use crate::trial::{Trial, TrialKey};

/// Where scans are kept, and what is noted with them.
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
    /// Keeps scans in a library, with nothing noted beside them.
    pub fn new(folder: PathBuf, scene: Scene) -> Self {
        Self { folder, scene, devices: BTreeMap::new(), by_t_star: Vec::new() }
    }
}

/// The thread, and its two ends.
pub(super) struct RecordingThread {
    scans: Sender<(Box<Scan>, Enrolment)>,
    pub kept: Receiver<Enrolled>,
    thread: JoinHandle<()>,
}

impl RecordingThread {
    /// Starts the thread.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn start(keep: ScanStore) -> std::io::Result<Self> {
        // A scan of 10 s is 3 MB, and a disk takes less than a second for it.
        let (scans, to_do) = crossbeam_channel::unbounded::<(Box<Scan>, Enrolment)>();
        let (tell, kept) = crossbeam_channel::unbounded();
        let run = move || {
            let mut numbers = BTreeMap::new();
            for (scan, wish) in to_do {
                if tell.send(keep.scan(*scan, wish, &mut numbers)).is_err() {
                    return;
                }
            }
        };
        let thread = std::thread::Builder::new().name("record".into()).spawn(run)?;
        Ok(Self { scans, kept, thread })
    }

    pub fn keep(&self, scan: Box<Scan>, wish: Enrolment) {
        // Fails only if the thread has panicked, and then nothing is told as kept either.
        let _ = self.scans.send((scan, wish));
    }

    /// Gives what is still to come, once all is on the disk.
    pub fn finish(self) -> impl Iterator<Item = Enrolled> {
        drop(self.scans);
        let _ = self.thread.join();
        self.kept.into_iter()
    }
}

/// The next number of each surface and user.
type Numbers = BTreeMap<(String, String), u32>;

impl ScanStore {
    /// Writes a scan, unless it is refused.
    fn scan(&self, scan: Scan, wish: Enrolment, numbers: &mut Numbers) -> Enrolled {
        let mut remarks = faults(&scan, &self.scene, &self.by_t_star);
        let mut enrolled = Enrolled {
            scan: scan.number,
            surface: wish.surface.clone(),
            trial: None,
            folder: None,
            remarks: Vec::new(),
            wanted: 0,
        };
        if !wish.good_only || remarks.is_empty() {
            match self.write(scan, &wish, numbers) {
                Ok((number, folder)) => {
                    enrolled.trial = Some(number);
                    enrolled.folder = Some(folder);
                }
                Err(error) => remarks.push(error.to_string()),
            }
        }
        enrolled.remarks = remarks;
        enrolled
    }

    fn write(
        &self,
        scan: Scan,
        wish: &Enrolment,
        numbers: &mut Numbers,
    ) -> Result<(u32, PathBuf), LibraryError> {
        let of = (wish.surface.clone(), wish.user.clone());
        if !numbers.contains_key(&of) {
            *numbers = self.numbers()?;
        }
        let mut key =
            TrialKey::new(&wish.surface, &wish.user, numbers.get(&of).copied().unwrap_or(1));
        // One that is incomplete is no entry of the library, but has its folder.
        while trial_folder(&self.folder, &key).exists() {
            key.number += 1;
        }
        let number = key.number;
        let took = scan.ended_at.elapsed().as_secs_f64() + scan.scan_s;
        let began = SystemTime::now() - std::time::Duration::from_secs_f64(took.max(0.0));
        let about = About {
            started_at: Some(utc(began)),
            notes: (!scan.spoiled.is_empty()).then(|| scan.spoiled.join("\n")),
            synthetic: scan.synthetic,
            // Nothing is to be compared with a scan that has holes.
            incomplete: !scan.spoiled.is_empty(),
            devices: self.devices.clone(),
            ..About::default()
        };
        let trial = Trial { key, signals: scan.trial.signals };
        let options = TrialOptions { about, durable: true };
        let folder = write_trial(&self.folder, &trial, &self.scene, &options)?;
        numbers.insert(of, number + 1);
        Ok((number, folder))
    }

    /// The numbers after those that the library holds.
    fn numbers(&self) -> Result<Numbers, LibraryError> {
        let mut numbers = Numbers::new();
        let library = match recording::open(&self.folder, &self.scene) {
            Ok(library) => library,
            Err(LibraryError::NothingFound { .. }) => return Ok(numbers),
            Err(_) if !self.folder.exists() => return Ok(numbers),
            Err(error) => return Err(error),
        };
        for entry in library.entries {
            let next = numbers.entry((entry.key.surface, entry.key.user)).or_insert(1);
            *next = (*next).max(entry.key.number + 1);
        }
        Ok(numbers)
    }
}
