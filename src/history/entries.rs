//! The answers of a history, held in memory. Each change is also written to the log on disk, in a folder
//! with a folder for each scan, which may take a limited space.

use std::collections::{HashSet, VecDeque};
use std::fs;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::log::{Head, Log, LogLine, Span, Text};
use super::{Correction, HistoryError};
use crate::library::recording::UNFINISHED;
use crate::library::{ABOUT_FILE, About};
use crate::printable::json_text;
use crate::record::edit::is_plain;
use crate::system::{Locked, open_lock};

/// An answer, its correction, and what became of its scan. Only the fields that the program reads have
/// types; `others` holds the rest as it was written.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub(crate) struct HistoryRow {
    #[serde(flatten)]
    pub head: Head,
    pub scan_s: f64,
    pub reasons: Vec<String>,
    pub spoiled: Vec<String>,
    #[serde(flatten)]
    pub others: Map<String, Value>,
    pub correction: Option<Correction>,
    /// The trial of the library that the scan became, as `SURFACE/TRIAL`.
    pub became: Option<String>,
    /// Whether the signals of the scan are on disk.
    pub kept: bool,
}

#[derive(Debug)]
pub(super) struct HistoryEntry {
    pub head: Head,
    pub text: Text,
    pub correction: Option<Correction>,
    pub became: Option<String>,
    /// Bytes of the scan's signals on disk; `None` if they are not kept.
    pub signals: Option<u64>,
}

impl HistoryEntry {
    pub fn new(head: Head, text: Text) -> Self {
        Self { head, text, correction: None, became: None, signals: None }
    }
}

#[derive(Debug, Default)]
pub(super) struct HistoryState {
    /// The oldest first.
    pub entries: VecDeque<HistoryEntry>,
    pub disk: Option<Disk>,
    /// Bytes of all signals on disk.
    pub signals: u64,
    /// Why the last write failed; `None` once a write succeeds again.
    pub problem: Option<String>,
}

impl HistoryState {
    /// Writes a change to the log, then applies it.
    pub fn change(&mut self, line: LogLine) -> Result<(), HistoryError> {
        let span = self.disk.as_mut().map(|disk| disk.log.append(&json_text(&line))).transpose()?;
        self.take(line, span.unwrap_or_default());
        Ok(())
    }

    /// Applies the lines in the last `most` bytes of a log.
    pub fn take_log(&mut self, log: &Log, most: u64) -> Result<(), HistoryError> {
        for (line, span) in log.read::<LogLine>(most)? {
            if is_plain(line.id()) {
                self.take(line, span);
            }
        }
        Ok(())
    }

    pub fn take(&mut self, line: LogLine, span: Span) {
        if let LogLine::Answer(head) = line {
            return self.entries.push_back(HistoryEntry::new(head, Text::InLog(span)));
        }
        // The search begins at the newest answer, since most changes are to a new answer.
        let changed = self.entries.iter_mut().rev().find(|entry| entry.head.id == line.id());
        let Some(entry) = changed else { return };
        match line {
            LogLine::Answer(_) => {}
            LogLine::Signals { bytes, .. } => {
                self.signals = self.signals + bytes.unwrap_or(0) - entry.signals.unwrap_or(0);
                entry.signals = bytes;
            }
            LogLine::Correction { correction, .. } => entry.correction = correction,
            LogLine::Trial { trial, .. } => entry.became = trial,
        }
    }

    /// The index of the scan with the id `name` or, if `name` is a number, of the newest so numbered.
    pub fn position(&self, name: &str) -> Option<usize> {
        let number: Option<u32> = name.parse().ok();
        let is = |entry: &HistoryEntry| match number {
            Some(number) => entry.head.scan == number,
            None => entry.head.id == name,
        };
        self.entries.iter().rposition(is)
    }

    pub fn find(&self, name: &str) -> Result<&HistoryEntry, HistoryError> {
        let at = self.position(name).ok_or_else(|| HistoryError::NoScan(name.into()))?;
        Ok(&self.entries[at])
    }

    pub fn row(&self, entry: &HistoryEntry) -> Result<HistoryRow, HistoryError> {
        let text = entry.text.read(self.disk.as_ref().map(|disk| &disk.log))?;
        let damaged = || HistoryRow { head: entry.head.clone(), ..HistoryRow::default() };
        Ok(HistoryRow {
            correction: entry.correction.clone(),
            became: entry.became.clone(),
            kept: entry.signals.is_some(),
            ..serde_json::from_str(&text).unwrap_or_else(|_| damaged())
        })
    }

    /// Removes the oldest signals, then the oldest answers, until the history and the disk have room.
    pub fn make_room(&mut self) -> Result<(), HistoryError> {
        let lacking = self.disk.as_ref().map_or(0, Disk::lacks);
        self.let_go(lacking)
    }

    /// Like [`Self::make_room`], but removes signals of at least `lacking` bytes, the oldest first.
    pub fn let_go(&mut self, lacking: u64) -> Result<(), HistoryError> {
        let Some(disk) = &mut self.disk else { return Ok(()) };
        let for_answers = disk.for_answers();
        let most = (disk.most_bytes - for_answers).min(self.signals.saturating_sub(lacking));
        while self.signals > most {
            let Some(entry) = self.entries.iter_mut().find(|entry| entry.signals.is_some()) else {
                break;
            };
            disk.remove_signals(&entry.head.id)?;
            let id = entry.head.id.clone();
            disk.log.append(&json_text(&LogLine::Signals { id, bytes: None }))?;
            self.signals -= entry.signals.take().unwrap_or(0);
        }
        if disk.log.bytes > for_answers {
            self.shorten(for_answers / 2)?;
        }
        Ok(())
    }

    /// Rewrites the log with as many of the newest answers as fit into `most_bytes`.
    fn shorten(&mut self, most_bytes: u64) -> Result<(), HistoryError> {
        let Some(disk) = &mut self.disk else { return Ok(()) };
        let mut bytes = 0;
        let fits = |entry: &&HistoryEntry| {
            bytes += entry.text.bytes();
            bytes <= most_bytes
        };
        let kept = self.entries.iter().rev().take_while(fits).count();
        for entry in self.entries.drain(..self.entries.len() - kept) {
            if let Some(bytes) = entry.signals {
                disk.remove_signals(&entry.head.id)?;
                self.signals -= bytes;
            }
        }
        let mut fresh = disk.log.begin_anew()?;
        for entry in &mut self.entries {
            let (text, written) = fresh.append_answer(entry.text.read(Some(&disk.log))?);
            written?;
            entry.text = text;
            let id = || entry.head.id.clone();
            let (bytes, correction, trial) =
                (entry.signals, entry.correction.clone(), entry.became.clone());
            let changes = [
                bytes.is_some().then(|| LogLine::Signals { id: id(), bytes }),
                correction.is_some().then(|| LogLine::Correction { id: id(), correction }),
                trial.is_some().then(|| LogLine::Trial { id: id(), trial }),
            ];
            for line in changes.into_iter().flatten() {
                fresh.append(&json_text(&line))?;
            }
        }
        disk.log.replace(fresh)
    }
}

/// The log of answers may take 1/8 of the history's space; signals take the rest.
const FOR_ANSWERS: u64 = 8;
pub(super) const SCANS: &str = "scans";
/// The folder for scans that are missing from the log.
const ASIDE: &str = "aside";
const LOG: &str = "answers.jsonl";
/// Past scans leave 1/10 of the disk free for trials, since trials matter more.
const FREE: u64 = 10;
/// Upper limit of that free space, in bytes.
const MOST_FREE: u64 = 1_000_000_000;

/// The folder of a history: its lock, its log, and a folder for each scan.
#[derive(Debug)]
pub(super) struct Disk {
    pub root: PathBuf,
    pub log: Log,
    pub most_bytes: u64,
    /// The lock on the folder; `None` for a folder that is only read.
    _lock: Option<Locked>,
}

impl Disk {
    /// Opens a folder for this program alone.
    pub fn open(root: &Path, most_bytes: u64) -> Result<Self, HistoryError> {
        let scans = root.join(SCANS);
        fs::create_dir_all(&scans).map_err(HistoryError::io(&scans))?;
        let lock = open_lock(root).map_err(HistoryError::io(root))?;
        let lock = Locked::now(lock).ok_or_else(|| HistoryError::InUse(root.to_path_buf()))?;
        let log = Log::open(&root.join(LOG), false)?;
        Ok(Self { root: root.to_path_buf(), log, most_bytes, _lock: Some(lock) })
    }

    /// Opens a folder to be read, while another process may write there.
    pub fn read_only(root: &Path) -> Result<Self, HistoryError> {
        let log = Log::open(&root.join(LOG), true)?;
        Ok(Self { root: root.to_path_buf(), log, most_bytes: u64::MAX, _lock: None })
    }

    pub fn for_answers(&self) -> u64 {
        self.most_bytes / FOR_ANSWERS
    }

    pub fn folder(&self, id: &str) -> PathBuf {
        self.root.join(SCANS).join(id)
    }

    /// Ids of the scans that have a folder. Plain files are ignored, since they are not the history's.
    pub fn scans(&self) -> Result<HashSet<String>, HistoryError> {
        let folder = self.root.join(SCANS);
        let listed = fs::read_dir(&folder).map_err(HistoryError::io(&folder))?;
        let folders = listed.flatten().filter(|item| item.file_type().is_ok_and(|is| is.is_dir()));
        Ok(folders.filter_map(|item| item.file_name().into_string().ok()).collect())
    }

    /// Removes scans that a crash left unfinished, and moves complete scans that are missing from
    /// the log aside, since the log may be damaged.
    pub fn tidy(&self, is_known: impl Fn(&str) -> bool) -> Result<(), HistoryError> {
        let aside = self.root.join(ASIDE);
        let (mut moved, fail) = (0, HistoryError::io(&aside));
        let set_aside = |id: &str| {
            fs::create_dir_all(&aside)?;
            fs::rename(self.folder(id), aside.join(id))
        };
        let mut done = Ok(());
        for id in self.scans()?.iter().filter(|id| !is_known(id)) {
            if id.ends_with(UNFINISHED) {
                self.remove_signals(id)?;
            } else {
                moved += 1;
                done = done.and(set_aside(id));
            }
        }
        if moved > 0 {
            tracing::warn!(
                "{}: {moved} scans that the list of answers does not know are set aside here; look \
                 at them with `surfaced export`, or remove the folder",
                aside.display()
            );
        }
        done.map_err(fail)
    }

    pub fn remove_signals(&self, id: &str) -> Result<(), HistoryError> {
        let folder = self.folder(id);
        match fs::remove_dir_all(&folder) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                Err(HistoryError::Io { path: folder, error })
            }
            _ => Ok(()),
        }
    }

    /// Bytes to remove until the disk has enough free space; 0 if its free space is unknown.
    pub fn lacks(&self) -> u64 {
        fs4::statvfs(&self.root).map_or(0, |disk| lacks(disk.total_space(), disk.available_space()))
    }

    pub fn signal_bytes(&self, id: &str) -> Result<u64, HistoryError> {
        let folder = self.folder(id);
        let size =
            || fs::read_dir(&folder)?.try_fold(0, |sum, item| Ok(sum + item?.metadata()?.len()));
        size().map_err(HistoryError::io(&folder))
    }

    /// Writes a label into the `trial.toml` of a scan, if its signals are kept.
    pub fn label(&self, id: &str, surface: &str) -> Result<(), HistoryError> {
        let folder = self.folder(id);
        if !folder.is_dir() {
            return Ok(());
        }
        let about = About { surface: Some(surface.into()), ..About::read(&folder)? };
        let path = folder.join(ABOUT_FILE);
        let unfinished = folder.join(format!(".{ABOUT_FILE}.unfinished"));
        fs::write(&unfinished, about.to_toml())
            .and_then(|()| fs::rename(&unfinished, &path))
            .map_err(HistoryError::io(&path))
    }
}

/// Bytes to remove from a disk of `size` bytes with `free` free bytes.
fn lacks(size: u64, free: u64) -> u64 {
    (size / FREE).min(MOST_FREE).saturating_sub(free)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tenth_of_a_small_disk_stays_free_and_a_gigabyte_of_a_large_one() {
        assert_eq!([lacks(100, 30), lacks(100, 10), lacks(100, 4)], [0, 0, 6]);
        let large = 1000 * MOST_FREE;
        assert_eq!([lacks(large, MOST_FREE), lacks(large, MOST_FREE - 1)], [0, 1]);
    }
}
