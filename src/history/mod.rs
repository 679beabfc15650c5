//! Past scans: every answer, and the signals of as many scans as fit a bounded space on disk
//! (`[history] keep_mb` in `configs/stylus.toml`).
//!
//! ```text
//! HISTORY/
//!   answers.jsonl                every answer, and what people said of it; see `log`
//!   scans/ID/                    one scan in the recording format, the newest ones
//!     trial.toml  ac.wav  ca1.png  …
//!     .why.json                  why it was named as it was, and its outline beside the nearest trial's
//!     .nearest-ca1.jpg           pictures of the nearest trial
//!   aside/ID/                    scans that the log does not know, for it may be damaged
//! ```
//! [`Keeper`] listens to a station and writes; [`History`] is read by what shows it. Nothing here
//! knows of the network.

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

/// Answers that are remembered where none is written to disk.
const IN_MEMORY: usize = 1000;
/// Name of the history's folder, in that of the library that names its scans.
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
    /// Held while a scan is made a trial, or such a trial is corrected.
    review: Mutex<()>,
}

/// The size of a history.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Extent {
    /// Answers.
    pub scans: usize,
    /// Those whose signals are kept.
    pub with_signals: usize,
    /// Bytes on disk.
    pub bytes: u64,
    /// At most this many bytes; `None` where nothing is written to disk.
    pub most_bytes: Option<u64>,
    /// The reason why scans are not kept, if so.
    pub problem: Option<String>,
}

impl Default for History {
    fn default() -> Self {
        Self::in_memory()
    }
}

impl History {
    /// A history of the last thousand answers, without their signals, that ends with the program.
    pub fn in_memory() -> Self {
        Self { inner: Mutex::default(), review: Mutex::default() }
    }

    /// The history in a folder, which is made if need be, of at most `most_bytes`, and less where its
    /// disk has little room: a tenth of it stays free, of a large one a gigabyte.
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
            // A crash may have come between the signals and their line.
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

    /// The history in a folder, to be read alone.
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
        // Each change leaves it whole.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Keeps others from making scans trials, and from correcting them, until it is dropped: each
    /// scan becomes one trial, however many ask for it at a time.
    pub(crate) fn reviewing(&self) -> MutexGuard<'_, ()> {
        // It guards nothing that a panic could leave half done.
        self.review.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether answers are written to disk, by a [`Keeper`].
    pub(crate) fn is_on_disk(&self) -> bool {
        self.lock().disk.is_some()
    }

    /// Adds an answer.
    ///
    /// # Errors
    /// If it cannot be written; it is remembered all the same.
    pub(crate) fn answered(&self, answer: &Answer) -> Result<(), HistoryError> {
        let inner = &mut *self.lock();
        // First, for on a full disk nothing could be written.
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

    /// Notes that the signals of a scan are on disk, in its `History::folder_for`; older ones make
    /// room for them.
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

    /// Says what a scan truly was, or takes that back.
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

    /// Notes which trial of the library a scan became.
    ///
    /// # Errors
    /// If there is no such scan, or it cannot be written.
    pub(crate) fn became(&self, id: &str, trial: Option<String>) -> Result<(), HistoryError> {
        let inner = &mut *self.lock();
        inner.find(id)?;
        inner.change(LogLine::Trial { id: id.into(), trial })
    }

    /// Notes where trials went that scans had become.
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

    /// The newest answers first, at most `most`, those before the scan of a name or number alone.
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

    /// Every answer, the oldest first, handed over one by one.
    ///
    /// # Errors
    /// If one cannot be read, or what `each` gives.
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

    /// The answer of a name, or the newest one of a number.
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

    /// The folder that scans are to be written into, as trials of a library there.
    pub(crate) fn root(&self) -> Option<PathBuf> {
        self.lock().disk.as_ref().map(|disk| disk.root().to_path_buf())
    }

    /// How right the answers are that somebody corrected, surface by surface.
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

    /// Notes why scans are not kept now; true if they were kept before.
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
