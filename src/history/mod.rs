//! Past scans: every answer, and the signals of as many scans as fit a bounded space on disk
//! (`[history] keep_mb` in `configs/stylus.toml`).
//!
//! ```text
//! HISTORY/
//!   answers.jsonl                every answer, and what people said of it; see `log`
//!   scans/ID/                    one scan in the recording format, the newest ones
//!     trial.toml  ac.wav  ca1.png  …
//!     .why.json                  reasons for its name, and outlines of it and of the nearest trial
//!     .nearest-ca1.jpg           pictures of the nearest trial
//!   aside/ID/                    scans that are missing from the log, which may be damaged
//! ```
//! [`Keeper`] listens to a station and writes its scans; the page and the commands read
//! [`History`]. Nothing here uses the network.

mod csv;
mod entries;
mod file;
mod keeper;
pub(crate) mod log;
mod review;
mod view;

pub(crate) use self::csv::CsvWriter;
pub use keeper::Keeper;
pub(crate) use review::precision;
pub use review::{Correction, Precision};
pub(crate) use view::{Bands, bands, four_digits, jpeg};

use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use serde_json::Value;

use self::entries::{HistoryEntry, HistoryState, Text};
use self::file::{Disk, SCANS};
use self::log::{Head, LogLine};
use crate::record::edit::Move;
use crate::scene::SourceId;
use crate::station::{Answer, AnswerState};

/// Most answers that a history in memory remembers.
const IN_MEMORY: usize = 1000;
/// Name of the history's folder, inside the folder of the library that names its scans.
pub(crate) const FOLDER: &str = ".history";
/// Name of the file that says why a scan was named as it was, in the scan's folder.
pub(crate) const NOTES: &str = ".why.json";

/// Name of the nearest trial's picture of a source, in the scan's folder.
pub(crate) fn nearest_picture(source: &SourceId) -> String {
    format!(".nearest-{source}.jpg")
}

/// All answers and scans that are kept.
#[derive(Debug)]
pub struct History {
    inner: Mutex<HistoryState>,
    /// Locked while a scan becomes a trial, or such a trial is corrected.
    review: Mutex<()>,
}

/// The size of a history.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Extent {
    /// Number of answers.
    pub scans: usize,
    /// Number of answers whose signals are kept.
    pub with_signals: usize,
    /// Bytes on disk.
    pub bytes: u64,
    /// Limit of the bytes on disk; `None` for a history in memory.
    pub most_bytes: Option<u64>,
    /// Why scans cannot be kept now; `None` if they can.
    pub problem: Option<String>,
}

impl Default for History {
    fn default() -> Self {
        Self::in_memory()
    }
}

impl History {
    /// A history in memory: the last thousand answers, without signals, until the program ends.
    pub fn in_memory() -> Self {
        Self { inner: Mutex::default(), review: Mutex::default() }
    }

    /// Opens the history in a folder, which is created if absent. It takes at most `most_bytes`,
    /// and less on a full disk: a tenth of the disk stays free, or a gigabyte if that is less.
    ///
    /// # Errors
    /// If the folder cannot be read or written, or another program uses it.
    pub fn open(folder: &Path, most_bytes: u64) -> Result<Self, HistoryError> {
        let disk = Disk::open(folder, most_bytes)?;
        let mut inner = HistoryState::default();
        inner.take_log(&disk.log, disk.for_answers())?;
        let known: HashSet<&str> = inner.entries.iter().map(|e| e.head.id.as_str()).collect();
        disk.tidy(|id| known.contains(id))?;
        let there = disk.scans()?;
        for entry in &mut inner.entries {
            // After a crash, signals may be on disk without their line in the log.
            entry.signals = match there.contains(&entry.head.id) {
                true => entry.signals.or_else(|| disk.size(&entry.head.id).ok()),
                false => None,
            };
        }
        inner.signals = inner.entries.iter().filter_map(|entry| entry.signals).sum();
        inner.disk = Some(disk);
        inner.make_room()?;
        Ok(Self { inner: Mutex::new(inner), review: Mutex::default() })
    }

    /// Opens the history in a folder for reading only.
    ///
    /// # Errors
    /// If the folder cannot be read.
    pub fn read(folder: &Path) -> Result<Self, HistoryError> {
        let disk = Disk::read_only(folder)?;
        let mut inner = HistoryState::default();
        inner.take_log(&disk.log, u64::MAX)?;
        inner.disk = Some(disk);
        Ok(Self { inner: Mutex::new(inner), review: Mutex::default() })
    }

    fn lock(&self) -> MutexGuard<'_, HistoryState> {
        // Each change is complete in itself, so a panic leaves a usable state.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Locks out others that make scans into trials, or correct these, until the guard is dropped:
    /// so a scan becomes one trial only, even if several clients ask for it at once.
    pub(crate) fn reviewing(&self) -> MutexGuard<'_, ()> {
        // The lock holds no data that a panic could leave half changed.
        self.review.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether answers are written to disk, by a [`Keeper`].
    pub(crate) fn is_on_disk(&self) -> bool {
        self.lock().disk.is_some()
    }

    /// Adds an answer.
    ///
    /// # Errors
    /// If it cannot be written; it is kept in memory all the same.
    pub(crate) fn answered(&self, answer: &Answer) -> Result<(), HistoryError> {
        let inner = &mut *self.lock();
        // Before writing, which a full disk would refuse.
        let room = inner.make_room();
        let head = Head::of(answer);
        // Plain structs, numbers and text: nothing here that JSON cannot express.
        let text = serde_json::to_string(answer).unwrap_or_default();
        let written = inner.write(&format!("{{\"answer\":{text}}}"));
        let text = match &written {
            Ok(Some(span)) => Text::InLog(*span),
            Ok(None) | Err(_) => Text::Here(text.into()),
        };
        inner.entries.push_back(HistoryEntry {
            head,
            text,
            correction: None,
            trial: None,
            signals: None,
        });
        if inner.disk.is_none() && inner.entries.len() > IN_MEMORY {
            inner.entries.pop_front();
        }
        written?;
        room
    }

    /// Notes that the signals of a scan are in its folder on disk, and removes the oldest signals
    /// where room is short.
    ///
    /// # Errors
    /// If it cannot be written.
    pub(crate) fn kept(&self, id: &str) -> Result<(), HistoryError> {
        let inner = &mut *self.lock();
        let Some(bytes) = inner.disk.as_ref().map(|disk| disk.size(id)).transpose()? else {
            return Ok(());
        };
        inner.change(LogLine::Signals { id: id.into(), bytes: Some(bytes) })?;
        inner.make_room()
    }

    /// Sets the correction of a scan (what it truly was), or removes it.
    ///
    /// # Errors
    /// If there is no such scan, or it cannot be written.
    pub fn correct(&self, id: &str, correction: Option<Correction>) -> Result<(), HistoryError> {
        let inner = &mut *self.lock();
        inner.find(id)?;
        if let Some(disk) = &inner.disk {
            let label = correction.as_ref().and_then(Correction::surface);
            disk.label(id, label.unwrap_or(SCANS))?;
        }
        inner.change(LogLine::Correction { id: id.into(), correction })
    }

    /// Notes which trial of the library a scan became; `None` if it is no longer one.
    ///
    /// # Errors
    /// If there is no such scan, or it cannot be written.
    pub(crate) fn became(&self, id: &str, trial: Option<String>) -> Result<(), HistoryError> {
        let inner = &mut *self.lock();
        inner.find(id)?;
        inner.change(LogLine::Trial { id: id.into(), trial })
    }

    /// Updates the scans that became trials, after such trials were moved or removed.
    ///
    /// # Errors
    /// If it cannot be written.
    pub(crate) fn relocated(&self, moves: &[Move]) -> Result<(), HistoryError> {
        let inner = &mut *self.lock();
        let went: BTreeMap<&str, &str> =
            moves.iter().map(|one| (one.from.as_str(), one.to.as_str())).collect();
        let of = |entry: &HistoryEntry| {
            let to = *went.get(entry.trial.as_deref()?)?;
            let trial = (!to.starts_with('.')).then(|| to.to_string());
            Some(LogLine::Trial { id: entry.head.id.clone(), trial })
        };
        let lines: Vec<LogLine> = inner.entries.iter().filter_map(of).collect();
        lines.into_iter().try_for_each(|line| inner.change(line))
    }

    /// At most `most` answers, the newest first; with `before`, a name or number, only older ones.
    ///
    /// # Errors
    /// If they cannot be read.
    pub fn newest(&self, before: Option<&str>, most: usize) -> Result<Vec<Value>, HistoryError> {
        let inner = &*self.lock();
        let end = match before {
            Some(name) => inner.position(name).unwrap_or(0),
            None => inner.entries.len(),
        };
        let of = |entry| inner.json(entry);
        inner.entries.range(..end).rev().take(most).map(of).collect()
    }

    /// Passes every answer to `each`, the oldest first.
    ///
    /// # Errors
    /// If one cannot be read, or `each` fails.
    pub fn each<E: From<HistoryError>>(
        &self,
        mut each: impl FnMut(Value) -> Result<(), E>,
    ) -> Result<(), E> {
        let count = self.lock().entries.len();
        (0..count).try_for_each(|at| {
            let inner = self.lock();
            let json = inner.entries.get(at).map(|entry| inner.json(entry)).transpose()?;
            drop(inner);
            json.map_or(Ok(()), &mut each)
        })
    }

    /// The answer with this name (its id), or the newest one with this scan number.
    ///
    /// # Errors
    /// If there is no such scan, or it cannot be read.
    pub fn answer(&self, name: &str) -> Result<Value, HistoryError> {
        let inner = &*self.lock();
        let at = inner.position(name).ok_or_else(|| HistoryError::NoScan(name.into()))?;
        inner.json(&inner.entries[at])
    }

    /// The folder of a scan's signals.
    ///
    /// # Errors
    /// If there is no such scan, or its signals are not kept.
    pub fn folder(&self, name: &str) -> Result<PathBuf, HistoryError> {
        let inner = &*self.lock();
        let at = inner.position(name).ok_or_else(|| HistoryError::NoScan(name.into()))?;
        let HistoryEntry { head: Head { id, .. }, signals, .. } = &inner.entries[at];
        let folder = inner.disk.as_ref().filter(|_| signals.is_some()).map(|disk| disk.folder(id));
        folder.ok_or_else(|| HistoryError::NoSignals(id.clone()))
    }

    /// The history's folder, a library into which scans are written as trials; `None` in memory.
    pub(crate) fn root(&self) -> Option<PathBuf> {
        self.lock().disk.as_ref().map(|disk| disk.root().to_path_buf())
    }

    /// The precision of the answers that somebody corrected, for each surface that was answered.
    pub fn precision(&self) -> Vec<Precision> {
        let inner = &*self.lock();
        let answered = inner.entries.iter().filter(|e| e.head.state != AnswerState::Unnamed);
        let corrected = answered
            .filter_map(|entry| Some((entry.head.surface.as_deref(), entry.correction.as_ref()?)));
        precision(corrected)
    }

    /// Answers that are unknown or unsure, and that nobody has corrected.
    pub fn to_review(&self) -> usize {
        let doubtful = |entry: &&HistoryEntry| {
            matches!(entry.head.state, AnswerState::Unknown | AnswerState::Unsure)
                && entry.correction.is_none()
        };
        self.lock().entries.iter().filter(doubtful).count()
    }

    /// Its size.
    pub fn extent(&self) -> Extent {
        let inner = &*self.lock();
        let log = inner.disk.as_ref().map_or(0, |disk| disk.log.bytes());
        Extent {
            scans: inner.entries.len(),
            with_signals: inner.entries.iter().filter(|entry| entry.signals.is_some()).count(),
            bytes: inner.signals + log,
            most_bytes: inner.disk.as_ref().map(|disk| disk.most_bytes),
            problem: inner.problem.clone(),
        }
    }

    /// Notes why scans cannot be kept now, or `None` if they can; true if a problem is new.
    fn set_problem(&self, problem: Option<String>) -> bool {
        let inner = &mut *self.lock();
        let news = inner.problem.is_none() && problem.is_some();
        inner.problem = problem;
        news
    }
}

/// Why scans cannot be kept, read or corrected.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The messages say it.
pub enum HistoryError {
    #[error("{}: {error}", path.display())]
    Io { path: PathBuf, error: std::io::Error },
    #[error("{}: another surfaced uses this folder", .0.display())]
    InUse(PathBuf),
    #[error("there is no scan {0}")]
    NoScan(String),
    #[error("the signals of scan {0} are no longer kept")]
    NoSignals(String),
    #[error(transparent)]
    Library(#[from] crate::library::LibraryError),
}

impl HistoryError {
    pub(crate) fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_path_buf();
        |error| Self::Io { path, error }
    }
}

#[cfg(test)]
mod tests;
