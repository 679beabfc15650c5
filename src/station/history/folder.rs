//! The folder of a history (its lock, its log, and a folder for each scan), and the space that it may take.

use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};

use super::HistoryError;
use super::log::Log;
use crate::library::recording::UNFINISHED;
use crate::library::{ABOUT_FILE, About};
use crate::system::{Locked, open_lock};

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
    pub(super) fn open(root: &Path, most_bytes: u64) -> Result<Self, HistoryError> {
        let scans = root.join(SCANS);
        fs::create_dir_all(&scans).map_err(HistoryError::io(&scans))?;
        let lock = open_lock(root).map_err(HistoryError::io(root))?;
        let lock = Locked::now(lock).ok_or_else(|| HistoryError::InUse(root.to_path_buf()))?;
        let log = Log::open(&root.join(LOG), false)?;
        Ok(Self { root: root.to_path_buf(), log, most_bytes, _lock: Some(lock) })
    }

    /// Opens a folder to be read, while another process may write there.
    pub(super) fn read_only(root: &Path) -> Result<Self, HistoryError> {
        let log = Log::open(&root.join(LOG), true)?;
        Ok(Self { root: root.to_path_buf(), log, most_bytes: u64::MAX, _lock: None })
    }

    pub(super) fn for_answers(&self) -> u64 {
        self.most_bytes / FOR_ANSWERS
    }

    pub(super) fn folder(&self, id: &str) -> PathBuf {
        self.root.join(SCANS).join(id)
    }

    /// Ids of the scans that have a folder. Plain files are ignored, since they are not the history's.
    pub(super) fn scans(&self) -> Result<HashSet<String>, HistoryError> {
        let folder = self.root.join(SCANS);
        let listed = fs::read_dir(&folder).map_err(HistoryError::io(&folder))?;
        let folders = listed.flatten().filter(|item| item.file_type().is_ok_and(|is| is.is_dir()));
        Ok(folders.filter_map(|item| item.file_name().into_string().ok()).collect())
    }

    /// Removes scans that a crash left unfinished, and moves complete scans that are missing from
    /// the log aside, since the log may be damaged.
    pub(super) fn tidy(&self, is_known: impl Fn(&str) -> bool) -> Result<(), HistoryError> {
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

    pub(super) fn remove_signals(&self, id: &str) -> Result<(), HistoryError> {
        let folder = self.folder(id);
        match fs::remove_dir_all(&folder) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                Err(HistoryError::Io { path: folder, error })
            }
            _ => Ok(()),
        }
    }

    /// Bytes to remove until the disk has enough free space; 0 if its free space is unknown.
    pub(super) fn lacks(&self) -> u64 {
        fs4::statvfs(&self.root).map_or(0, |disk| lacks(disk.total_space(), disk.available_space()))
    }

    pub(super) fn signal_bytes(&self, id: &str) -> Result<u64, HistoryError> {
        let folder = self.folder(id);
        let size =
            || fs::read_dir(&folder)?.try_fold(0, |sum, item| Ok(sum + item?.metadata()?.len()));
        size().map_err(HistoryError::io(&folder))
    }

    /// Writes a label into the `trial.toml` of a scan, if its signals are kept.
    pub(super) fn label(&self, id: &str, surface: &str) -> Result<(), HistoryError> {
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
