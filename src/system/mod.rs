//! Everything that operating systems do differently: locks, renames, the identity of files, terminals,
//! signals, services. Elsewhere, only drivers of devices ask for the system. Errors are those of the system.

#[cfg(unix)]
mod unix;
#[cfg(windows)]
mod windows;

use std::fs::{self, File};
use std::io;
use std::path::Path;

use tempfile::NamedTempFile;

#[cfg(unix)]
pub(crate) use unix::*;
#[cfg(windows)]
pub(crate) use windows::*;

/// Renames a file or folder, and replaces nothing: [`io::ErrorKind::AlreadyExists`] if something has that
/// name. Linux promises that; elsewhere it is looked at first.
pub(crate) fn rename_new(from: &Path, to: &Path) -> io::Result<()> {
    #[cfg(target_os = "linux")]
    {
        use rustix::fs::{CWD, RenameFlags, renameat_with};
        match renameat_with(CWD, from, CWD, to, RenameFlags::NOREPLACE) {
            // A file system that cannot promise it.
            Err(rustix::io::Errno::INVAL | rustix::io::Errno::NOSYS) => {}
            moved => return Ok(moved?),
        }
    }
    if fs::symlink_metadata(to).is_ok() {
        return Err(io::ErrorKind::AlreadyExists.into());
    }
    fs::rename(from, to)
}

/// Gives a temporary file its name. A file of that name is replaced, even while it is open: the
/// standard library asks Windows for that, `NamedTempFile::persist` does not. If it fails, the temporary
/// file is removed.
pub(crate) fn persist(file: NamedTempFile, to: &Path) -> io::Result<()> {
    let path = file.into_temp_path().keep()?;
    fs::rename(&path, to).inspect_err(|_| drop(fs::remove_file(&path)))
}

/// Makes new names in a folder last, which NTFS does by itself.
pub(crate) fn names_written(folder: &Path) -> io::Result<()> {
    if cfg!(unix) { File::open(folder)?.sync_all() } else { Ok(()) }
}

/// Waits until the disk holds all that was done on the file system of a folder; nothing outside Linux,
/// where each file is synchronised by itself, see [`file_written`].
pub(crate) fn file_system_written(folder: &Path) -> io::Result<()> {
    #[cfg(target_os = "linux")]
    rustix::fs::syncfs(File::open(folder)?)?;
    let _ = folder;
    Ok(())
}

/// Waits until the disk holds a file, where [`file_system_written`] does nothing.
pub(crate) fn file_written(file: &File) -> io::Result<()> {
    if cfg!(target_os = "linux") { Ok(()) } else { file.sync_all() }
}
