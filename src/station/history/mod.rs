//! Past scans. Keeps every answer, and the signals of as many scans as fit a bounded space on disk
//! (`[history] keep_mb` in `configs/stylus.toml`).
//!
//! ```text
//! HISTORY/
//!   answers.jsonl                every answer, and every correction by a person; see `log`
//!   audit.jsonl                  who changed what; see `audit`
//!   scans/ID/                    one scan in the recording format; old scans make room for new ones
//!     trial.toml  ac.wav  ca1.png  …
//!     .why.json                  why the scan got its name; small views of scan and nearest trial
//!     .nearest-ca1.jpg           pictures of the nearest trial
//!   aside/ID/                    scans that the log does not list, since the log may be damaged
//! ```
//! [`Keeper`] listens to a station and writes its scans; the page and the commands read
//! [`History`]. Nothing here uses the network.

mod audit;
mod csv;
mod drift;
mod entries;
mod folder;
mod keeper;
#[doc(hidden)]
pub mod log;
mod view;

#[doc(hidden)]
pub use self::{
    audit::{Actor, AuditRecord, Role},
    csv::{COLUMNS, STATION_COLUMNS, write_csv},
    drift::{ChartView, Drift, Quantity, ReferenceView, news},
    log::HistoryRow,
    view::{Bands, WINDOW, bands, four_digits},
};
pub use keeper::Keeper;

use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard};

use serde::{Deserialize, Serialize};
use serde_json::Value;

use self::audit::AuditLog;
use self::entries::HistoryState;
use self::folder::{Disk, SCANS};
use self::log::{Head, HistoryEntry, LogLine, Text};
use crate::printable::json_text;
use crate::recognise::wilson_interval;
use crate::record::edit::Move;
use crate::scene::SourceId;
use crate::station::{Answer, AnswerState};
use crate::system::lock;

const MOST_IN_MEMORY: usize = 1000;
/// Name of the folder of a history. It lies in the folder of the library that names the scans.
pub const FOLDER: &str = ".history";
/// Name of the file, in the scan's folder, that says why the scan got its name.
pub const NOTES: &str = ".why.json";

/// Name of the file, in the scan's folder, with the nearest trial's picture of a source.
pub fn nearest_picture(source: &SourceId) -> String {
    format!(".nearest-{source}.jpg")
}

/// The answers and scans that are kept, on disk or, by default, the last 1000 answers in memory.
#[derive(Debug, Default)]
pub struct History {
    inner: Mutex<HistoryState>,
    /// Locked while a scan becomes a trial, or while a trial that was a scan is corrected.
    review: Mutex<()>,
    audit: Mutex<AuditLog>,
}

/// The answers that are asked for. A field that is absent or empty lets all through.
#[derive(Clone, Debug, Default)]
pub struct Wanted {
    pub states: Vec<AnswerState>,
    /// The surface that was answered, or that the scan was by its correction.
    pub surface: Option<String>,
    pub user: Option<String>,
    /// Times in milliseconds since 1970; both are included.
    pub from_unix_ms: Option<u64>,
    pub to_unix_ms: Option<u64>,
    /// Part of anything that is kept of the scan, in capitals or not.
    pub text: Option<String>,
}

impl Wanted {
    fn lets(&self, entry: &HistoryEntry) -> bool {
        let Head { unix_ms, state, surface, user, .. } = &entry.head;
        let was = entry.correction.as_ref().and_then(Correction::surface);
        let is_of = |wanted: &String| surface.as_ref() == Some(wanted) || was == Some(wanted);
        (self.states.is_empty() || self.states.contains(state))
            && self.surface.as_ref().is_none_or(is_of)
            && (self.user.is_none() || self.user == *user)
            && self.from_unix_ms.is_none_or(|from| *unix_ms >= from)
            && self.to_unix_ms.is_none_or(|to| *unix_ms <= to)
    }

    fn lets_text(&self, row: &HistoryRow) -> bool {
        let holds = |text: &String| json_text(row).to_lowercase().contains(&text.to_lowercase());
        self.text.as_ref().is_none_or(holds)
    }
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Extent {
    pub scans: usize,
    pub with_signals: usize,
    pub bytes: u64,
    /// Limit of the bytes on disk; `None` for a history in memory.
    pub most_bytes: Option<u64>,
    /// Why scans cannot be kept now; `None` if they can be kept.
    pub problem: Option<String>,
}

impl History {
    /// Opens the history in a folder, which is created if absent. It takes at most `most_bytes`,
    /// and less on a nearly full disk, so that a tenth of the disk or a gigabyte stays free.
    ///
    /// # Errors
    /// If the folder cannot be read or written, or another program uses it.
    pub fn open(folder: &Path, most_bytes: u64) -> Result<Self, HistoryError> {
        let disk = Disk::open(folder, most_bytes)?;
        let mut inner = HistoryState::default();
        // The log may be longer by some lines, since it is shortened before a line is added.
        inner.take_log(&disk.log, disk.for_answers() / 8 * 9)?;
        let known: HashSet<&str> = inner.entries.iter().map(|e| e.head.id.as_str()).collect();
        disk.tidy(|id| known.contains(id))?;
        let there = disk.scans()?;
        for entry in &mut inner.entries {
            // After a crash, signals may be on disk that the log does not mention, so the disk is asked.
            entry.signals = match there.contains(&entry.head.id) {
                true => entry.signals.or_else(|| disk.signal_bytes(&entry.head.id).ok()),
                false => None,
            };
        }
        inner.signals = inner.entries.iter().filter_map(|entry| entry.signals).sum();
        inner.disk = Some(disk);
        inner.make_room()?;
        let audit = Mutex::new(AuditLog::open(folder)?);
        Ok(Self { inner: Mutex::new(inner), audit, ..Self::default() })
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
        Ok(Self { inner: Mutex::new(inner), ..Self::default() })
    }

    /// Until the guard is dropped, nobody else can turn a scan into a trial, or correct such a trial.
    /// So a scan becomes only one trial, even if several clients ask at once.
    pub fn reviewing(&self) -> MutexGuard<'_, ()> {
        lock(&self.review)
    }

    /// Adds an answer. If it cannot be written, it is kept in memory, and the error is returned.
    pub fn answered(&self, answer: &Answer) -> Result<(), HistoryError> {
        let inner = &mut *lock(&self.inner);
        // Room is made first, since a full disk would refuse the answer.
        let room = inner.make_room().and_then(|()| inner.bound_log());
        let head = Head::of(answer);
        let text = json_text(answer);
        let (text, written) = match &mut inner.disk {
            Some(disk) => disk.log.append_answer(text),
            None => (Text::Here(text), Ok(())),
        };
        inner.entries.push_back(HistoryEntry::new(head, text));
        inner.drift = None;
        if inner.disk.is_none() && inner.entries.len() > MOST_IN_MEMORY {
            inner.entries.pop_front();
        }
        written?;
        room
    }

    /// Notes that the signals of a scan are on disk, and removes the oldest if space is short.
    pub(crate) fn kept(&self, id: &str) -> Result<(), HistoryError> {
        let inner = &mut *lock(&self.inner);
        let Some(bytes) = inner.disk.as_ref().map(|disk| disk.signal_bytes(id)).transpose()? else {
            return Ok(());
        };
        inner.change(LogLine::Signals { id: id.into(), bytes: Some(bytes) })?;
        inner.make_room()?;
        let is_gone = inner.find(id).is_ok_and(|entry| entry.signals.is_none());
        if is_gone { Err(HistoryError::NoRoom) } else { Ok(()) }
    }

    /// Sets the reference surfaces, each with the moment from which its scans count, in milliseconds
    /// since 1970.
    pub fn refer(&self, surfaces: &BTreeMap<String, u64>) {
        let inner = &mut *lock(&self.inner);
        if inner.references != *surfaces {
            inner.references.clone_from(surfaces);
            (inner.readings, inner.drift) = (BTreeMap::new(), None);
        }
    }

    /// The drift of the station, by its reference scans so far. Reads those that it has not read yet.
    pub fn drift(&self) -> Arc<Drift> {
        lock(&self.inner).drift()
    }

    /// Sets the correction of a scan (what it truly was), or removes it. Returns the correction before.
    pub fn correct(
        &self,
        id: &str,
        correction: Option<Correction>,
    ) -> Result<Option<Correction>, HistoryError> {
        let inner = &mut *lock(&self.inner);
        let before = inner.find(id)?.correction.clone();
        if let Some(disk) = &inner.disk {
            let label = correction.as_ref().and_then(Correction::surface);
            disk.label(id, label.unwrap_or(SCANS))?;
        }
        inner.change(LogLine::Correction { id: id.into(), correction })?;
        Ok(before)
    }

    /// Notes which trial of the library a scan became, and who made it so; `None` if it is no longer one.
    pub fn became(
        &self,
        id: &str,
        trial: Option<String>,
        person: Option<String>,
    ) -> Result<(), HistoryError> {
        let inner = &mut *lock(&self.inner);
        inner.find(id)?;
        inner.change(LogLine::Trial { id: id.into(), trial, person })
    }

    /// Updates the scans that became trials, after a person moved, removed or restored trials of the
    /// library. `scan_of` gives the id of the scan that a trial was made of.
    pub fn relocated(
        &self,
        moves: &[Move],
        scan_of: impl Fn(&Move) -> Option<String>,
        person: Option<&str>,
    ) -> Result<(), HistoryError> {
        let inner = &mut *lock(&self.inner);
        let went: BTreeMap<String, &str> =
            moves.iter().filter_map(|one| Some((scan_of(one)?, one.to.as_str()))).collect();
        let of = |entry: &HistoryEntry| {
            let to = *went.get(&entry.head.id)?;
            let trial = (!to.starts_with('.')).then(|| to.to_string());
            let person = person.map(String::from);
            Some(LogLine::Trial { id: entry.head.id.clone(), trial, person })
        };
        let lines: Vec<LogLine> = inner.entries.iter().filter_map(of).collect();
        lines.into_iter().try_for_each(|line| inner.change(line))
    }

    /// At most `most` of the wanted answers, the newest first. With `before`, all are older than that
    /// scan.
    pub fn newest(
        &self,
        before: Option<&str>,
        most: usize,
        wanted: &Wanted,
    ) -> Result<Vec<HistoryRow>, HistoryError> {
        let end = {
            let inner = &*lock(&self.inner);
            before.map_or(inner.entries.len(), |name| inner.position(name).unwrap_or(0))
        };
        (0..end).rev().filter_map(|at| self.at(at, wanted)).take(most).collect()
    }

    /// The wanted answers, the oldest first. Each step locks anew, so the history may change in between.
    pub fn rows(
        &self,
        wanted: Wanted,
    ) -> impl Iterator<Item = Result<HistoryRow, HistoryError>> + '_ {
        (0..lock(&self.inner).entries.len()).filter_map(move |at| self.at(at, &wanted))
    }

    fn at(&self, at: usize, wanted: &Wanted) -> Option<Result<HistoryRow, HistoryError>> {
        let inner = lock(&self.inner);
        let row = inner.row(inner.entries.get(at).filter(|entry| wanted.lets(entry))?);
        drop(inner);
        Some(row).filter(|row| row.as_ref().map_or(true, |row| wanted.lets_text(row)))
    }

    pub fn values(&self, wanted: Wanted) -> impl Iterator<Item = std::io::Result<Value>> + '_ {
        self.rows(wanted).map(|row| Ok(serde_json::to_value(row?)?))
    }

    /// The answer with this name (its id), or the newest one with this scan number.
    pub fn answer(&self, name: &str) -> Result<HistoryRow, HistoryError> {
        let inner = &*lock(&self.inner);
        inner.row(inner.find(name)?)
    }

    pub fn folder(&self, name: &str) -> Result<PathBuf, HistoryError> {
        let inner = &*lock(&self.inner);
        let HistoryEntry { head: Head { id, .. }, signals, .. } = inner.find(name)?;
        let folder = inner.disk.as_ref().filter(|_| signals.is_some()).map(|disk| disk.folder(id));
        folder.ok_or_else(|| HistoryError::NoSignals(id.clone()))
    }

    /// The history's folder, a library into which scans are written as trials; `None` in memory.
    pub fn root(&self) -> Option<PathBuf> {
        lock(&self.inner).disk.as_ref().map(|disk| disk.root.clone())
    }

    pub fn precision(&self) -> Vec<Precision> {
        let inner = &*lock(&self.inner);
        let answered = inner.entries.iter().filter(|e| e.head.state != AnswerState::Unnamed);
        let corrected = answered
            .filter_map(|entry| Some((entry.head.surface.as_deref(), entry.correction.as_ref()?)));
        precision(corrected)
    }

    /// Number of answers that are unknown or unsure, and that nobody has corrected.
    pub fn to_review(&self) -> usize {
        let doubtful = |entry: &&HistoryEntry| {
            matches!(entry.head.state, AnswerState::Unknown | AnswerState::Unsure)
                && entry.correction.is_none()
        };
        lock(&self.inner).entries.iter().filter(doubtful).count()
    }

    pub fn extent(&self) -> Extent {
        let inner = &*lock(&self.inner);
        let log = inner.disk.as_ref().map_or(0, |disk| disk.log.bytes);
        Extent {
            scans: inner.entries.len(),
            with_signals: inner.entries.iter().filter(|entry| entry.signals.is_some()).count(),
            bytes: inner.signals + log,
            most_bytes: inner.disk.as_ref().map(|disk| disk.most_bytes),
            problem: inner.problem.clone(),
        }
    }

    /// Stores as `problem` why scans cannot be kept now. Warns only if there was no problem before.
    fn note(&self, done: Result<(), HistoryError>) {
        let problem = done.err().map(|error| error.to_string());
        let before = std::mem::replace(&mut lock(&self.inner).problem, problem.clone());
        if let (None, Some(problem)) = (before, problem) {
            tracing::warn!("scans are not kept in the history: {problem}");
        }
    }
}

/// The truth about a scan, and who gave it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Correction {
    #[serde(flatten)]
    pub truth: Truth,
    /// `None` if nobody gave a name.
    #[serde(default)]
    pub person: Option<String>,
}

/// The truth about a scan, as a person gave it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "was", rename_all = "lowercase")]
pub enum Truth {
    Surface {
        surface: String,
    },
    /// The scan was of a surface that the library lacks.
    Unknown,
    /// The scan was so bad that nobody could name it.
    Bad,
}

impl Correction {
    pub fn surface(&self) -> Option<&str> {
        match &self.truth {
            Truth::Surface { surface } => Some(surface),
            Truth::Unknown | Truth::Bad => None,
        }
    }

    /// The correction in a table: its surface, or a word in brackets.
    pub fn text(&self) -> &str {
        match &self.truth {
            Truth::Surface { surface } => surface,
            Truth::Unknown => "(unknown)",
            Truth::Bad => "(bad)",
        }
    }
}

/// How often one answer was right, among the scans that somebody corrected. Bad scans are left out.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Precision {
    /// The answer; `None` for unknown.
    pub surface: Option<String>,
    pub corrected: usize,
    /// How many of the corrected scans had this answer as their truth.
    pub right: usize,
    pub precision: f64,
    /// Ends of the 95 % Wilson interval.
    pub precision_low: f64,
    pub precision_high: f64,
}

/// The precision of each answer (a surface or unknown), from pairs of an answer and its correction.
fn precision<'a>(
    corrected: impl Iterator<Item = (Option<&'a str>, &'a Correction)>,
) -> Vec<Precision> {
    let mut counts: BTreeMap<Option<&str>, (usize, usize)> = BTreeMap::new();
    for (answered, correction) in corrected {
        let right = match &correction.truth {
            Truth::Bad => continue,
            Truth::Unknown => answered.is_none(),
            Truth::Surface { surface } => answered == Some(surface),
        };
        let (all, rights) = counts.entry(answered).or_default();
        *all += 1;
        *rights += usize::from(right);
    }
    let of = |(surface, (corrected, right)): (Option<&str>, (usize, usize))| {
        let (precision_low, precision_high) = wilson_interval(right, corrected);
        let precision = right as f64 / corrected as f64;
        let surface = surface.map(String::from);
        Precision { surface, corrected, right, precision, precision_low, precision_high }
    };
    counts.into_iter().map(of).collect()
}

/// Why scans cannot be kept, read or corrected.
#[derive(Debug, thiserror::Error)]
pub enum HistoryError {
    #[error("{}: {error}", path.display())]
    Io { path: PathBuf, error: std::io::Error },
    #[error("{}: another surfaced uses this folder", .0.display())]
    InUse(PathBuf),
    #[error("there is no scan {0}")]
    NoScan(String),
    #[error(
        "there is no room for their signals; make room on the disk, of which a tenth or 1 GB stays free \
         for trials, or raise keep_mb of [history]"
    )]
    NoRoom,
    #[error("the signals of scan {0} are no longer kept")]
    NoSignals(String),
    #[error(transparent)]
    Library(#[from] crate::library::LibraryError),
}

impl From<HistoryError> for std::io::Error {
    fn from(error: HistoryError) -> Self {
        Self::other(error)
    }
}

impl HistoryError {
    pub fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_path_buf();
        |error| Self::Io { path, error }
    }
}

#[cfg(test)]
mod tests;
