//! All changes that an edit makes on disk, as functions in which a test can stop the edit.

use std::fs::{self, File};
use std::io::{self, Seek, Write};
use std::path::Path;

use crate::system;

pub(super) fn rename(from: &Path, to: &Path) -> io::Result<()> {
    point()?;
    fs::rename(from, to)
}

/// Renames a file or folder; fails if the new name is taken.
pub(super) fn move_to(from: &Path, to: &Path) -> io::Result<()> {
    point()?;
    system::rename_new(from, to)
}

/// Writes `bytes` at the end of a file, and waits until the disk holds them.
pub(super) fn append(file: &mut File, bytes: &[u8]) -> io::Result<()> {
    let (first, second) = bytes.split_at(bytes.len() / 2);
    file.seek(io::SeekFrom::End(0))?;
    file.write_all(first)?;
    point()?;
    file.write_all(second)?;
    point()?;
    if cfg!(test) { Ok(()) } else { file.sync_all() }
}

/// Shortens a file to `length`. If a crash restores the rest, the next edit cuts it off again.
pub(super) fn cut(file: &File, length: u64) -> io::Result<()> {
    point()?;
    file.set_len(length)?;
    let _ = point().and_then(|()| if cfg!(test) { Ok(()) } else { file.sync_all() });
    Ok(())
}

/// Writes a file. The data are sure to be on disk only after [`sync_all`].
pub(super) fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = File::create(path)?;
    point()?;
    file.write_all(&bytes[..bytes.len() / 2])?;
    point()?;
    file.write_all(&bytes[bytes.len() / 2..])?;
    if cfg!(test) { Ok(()) } else { system::file_written(&file) }
}

pub(super) fn create_folder(path: &Path) -> io::Result<()> {
    point()?;
    fs::create_dir_all(path)
}

pub(super) fn link(target: &Path, path: &Path) -> io::Result<()> {
    point()?;
    system::link_folder(target, path)
}

/// Waits until the disk holds all changes below a folder, with one wait for any number of files.
pub(super) fn sync_all(folder: &Path) -> io::Result<()> {
    point()?;
    if cfg!(test) { Ok(()) } else { system::file_system_written(folder) }
}

#[cfg(not(test))]
fn point() -> io::Result<()> {
    Ok(())
}

#[cfg(test)]
use stops::point;

#[cfg(test)]
pub(super) mod stops {
    use std::cell::Cell;
    use std::io;
    use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};

    /// How a test disturbs a change on disk.
    #[derive(Clone, Copy, Debug, PartialEq)]
    pub enum Stop {
        /// The process is killed at this change.
        Kill,
        /// The file system refuses this one change.
        Fail,
        /// The file system refuses this change and all later ones.
        FailOn,
    }

    thread_local! {
        static AT: Cell<Option<(u32, Stop)>> = const { Cell::new(None) };
    }

    pub fn point() -> io::Result<()> {
        let Some((left, stop)) = AT.get() else { return Ok(()) };
        if left > 0 {
            AT.set(Some((left - 1, stop)));
            return Ok(());
        }
        if stop == Stop::Kill {
            resume_unwind(Box::new(stop));
        }
        AT.set(Some((0, stop)).filter(|_| stop == Stop::FailOn));
        Err(io::Error::other("stopped by the test"))
    }

    /// Runs `work`, and interrupts its change number `change` (from 0) by `stop`. Returns the
    /// result of `work` (`None` if it was killed), and whether `work` made that many changes.
    pub fn until<T>(change: u32, stop: Stop, work: impl FnOnce() -> T) -> (Option<T>, bool) {
        AT.set(Some((change, stop)));
        let done = catch_unwind(AssertUnwindSafe(work));
        let reached = !matches!(AT.replace(None), Some((left, _)) if left > 0 || stop == Stop::Kill)
            || done.is_err();
        match done {
            Ok(done) => (Some(done), reached),
            Err(panic) if panic.is::<Stop>() => (None, true),
            Err(panic) => resume_unwind(panic),
        }
    }
}
