//! The differences between operating systems: locks, renames, file identity, memory. Errors are the system's
//! own.

#[cfg(unix)]
mod unix;
#[cfg(windows)]
mod windows;

use std::fs::{self, File};
use std::io;
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};

use tempfile::NamedTempFile;

#[cfg(unix)]
#[doc(hidden)]
pub use unix::*;
#[cfg(windows)]
#[doc(hidden)]
pub use windows::*;

/// Locks a value that each change leaves valid, so that it can be used even after a panic of a thread.
pub fn lock<T>(shared: &Mutex<T>) -> MutexGuard<'_, T> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Renames a file or folder, but never replaces anything; [`io::ErrorKind::AlreadyExists`] if `to`
/// exists. Linux guarantees this. On other systems, `to` is checked just before the rename.
pub fn rename_new(from: &Path, to: &Path) -> io::Result<()> {
    #[cfg(target_os = "linux")]
    {
        use rustix::fs::{CWD, RenameFlags, renameat_with};
        match renameat_with(CWD, from, CWD, to, RenameFlags::NOREPLACE) {
            // This file system has no rename that never replaces, so `to` is checked first.
            Err(rustix::io::Errno::INVAL | rustix::io::Errno::NOSYS) => {}
            moved => return Ok(moved?),
        }
    }
    if fs::symlink_metadata(to).is_ok() {
        return Err(io::ErrorKind::AlreadyExists.into());
    }
    fs::rename(from, to)
}

/// Gives a temporary file its final name, and replaces a file of that name, even an open one. This
/// uses `fs::rename`, since on Windows `NamedTempFile::persist` cannot replace an open file. If the
/// rename fails, the temporary file is removed.
pub fn persist(file: NamedTempFile, to: &Path) -> io::Result<()> {
    let path = file.into_temp_path().keep()?;
    fs::rename(&path, to).inspect_err(|_| drop(fs::remove_file(&path)))
}

/// Makes new names in a folder survive a power cut; NTFS does this by itself.
pub fn names_written(folder: &Path) -> io::Result<()> {
    if cfg!(unix) { File::open(folder)?.sync_all() } else { Ok(()) }
}

/// On Linux, waits until the disk holds all changes to the file system of a folder. Elsewhere it
/// does nothing, and [`file_written`] waits for each file.
pub fn file_system_written(folder: &Path) -> io::Result<()> {
    #[cfg(target_os = "linux")]
    rustix::fs::syncfs(File::open(folder)?)?;
    let _ = folder;
    Ok(())
}

/// Waits until the disk holds a file; does nothing on Linux, where [`file_system_written`] waits.
pub fn file_written(file: &File) -> io::Result<()> {
    if cfg!(target_os = "linux") { Ok(()) } else { file.sync_all() }
}

/// A locked file. Dropping it ends the lock at once. Closing the file alone would not, since a
/// process that is just being started may hold a copy of the open file.
#[derive(Debug)]
pub struct Locked(pub File);

impl Locked {
    /// Locks a file at once; `None` if somebody else holds its lock, or there are no locks here.
    pub fn now(file: File) -> Option<Self> {
        file.try_lock().ok().map(|()| Self(file))
    }
}

impl Drop for Locked {
    fn drop(&mut self) {
        // If this fails, closing the file ends the lock, so the error is ignored.
        let _ = self.0.unlock();
    }
}

/// Has glibc's allocator keep freed memory for the next use, up to the limits that it would choose by itself
/// once a large buffer was freed. Fresh memory for each recording takes some 3 % of a library's processor
/// time. [`give_back_memory`] returns it.
pub fn keep_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: `mallopt` takes no pointer, and any thread may call it at any time.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, 32 << 20);
        libc::mallopt(libc::M_TRIM_THRESHOLD, 64 << 20);
    }
}

/// Returns freed memory to the system, which the allocator of glibc would keep.
pub fn give_back_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: `malloc_trim` takes no pointer, and any thread may call it at any time.
    unsafe {
        libc::malloc_trim(0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lock_ends_though_another_process_has_a_copy_of_the_open_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("lock");
        let file = File::create(&path).unwrap();
        let _copy = file.try_clone().unwrap();
        let locked = Locked::now(file).unwrap();
        let other = File::open(&path).unwrap();
        assert!(other.try_lock().is_err());
        drop(locked);
        other.try_lock().unwrap();
    }
}
