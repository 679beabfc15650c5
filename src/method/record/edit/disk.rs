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

pub(super) fn remove_file(path: &Path) {
    let _ = point().and_then(|()| fs::remove_file(path));
}

pub(super) fn remove_empty_folder(path: &Path) {
    let _ = point().and_then(|()| fs::remove_dir(path));
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
    use std::cell::{Cell, RefCell};
    use std::io;
    use std::ops::Range;

    thread_local! {
        static CHANGES: Cell<u32> = const { Cell::new(0) };
        static REFUSED: RefCell<Range<u32>> = const { RefCell::new(0..0) };
    }

    pub fn point() -> io::Result<()> {
        let change = CHANGES.replace(CHANGES.get() + 1);
        match REFUSED.with_borrow(|refused| refused.contains(&change)) {
            true => Err(io::Error::other("stopped by the test")),
            false => Ok(()),
        }
    }

    /// Runs `work` while the file system refuses the `refused` changes, counted from 0. Returns the
    /// result of `work`, and whether it came to the first of these changes.
    pub fn refusing<T>(refused: Range<u32>, work: impl FnOnce() -> T) -> (T, bool) {
        let first = refused.start;
        CHANGES.set(0);
        REFUSED.set(refused);
        let done = work();
        REFUSED.set(0..0);
        (done, CHANGES.get() > first)
    }
}
