//! Windows.

/// Fails for most users, since Windows allows links only to administrators and in developer mode.
#[doc(hidden)]
pub use std::os::windows::fs::symlink_dir as link_folder;

use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::windows::fs::FileExt;
use std::path::{Path, PathBuf};

use winapi_util::{Handle, file};

use crate::seed;

/// Opens the file that is locked in place of a folder, since Windows cannot lock a folder. A hash of
/// the folder's path names this file; all users of this machine share it, other machines do not.
pub fn open_lock(folder: &Path) -> io::Result<File> {
    let path = folder.canonicalize()?;
    let id = seed::stable_hash(&[path.as_os_str().as_encoded_bytes()]);
    let data = std::env::var_os("ProgramData").map_or_else(std::env::temp_dir, PathBuf::from);
    let locks = data.join("surfaced").join("locks");
    fs::create_dir_all(&locks)?;
    let path = locks.join(format!("{id:016x}"));
    let made = OpenOptions::new().read(true).append(true).create(true).open(&path);
    // A file that another user made can only be read, which is enough for a lock.
    made.or_else(|_| File::open(&path))
}

/// Always `None`, since Windows does not tell which process holds a lock.
pub fn lock_holder(_: &File) -> Option<String> {
    None
}

/// Does nothing, since temporary folders already have the permissions of the folder around them.
pub fn usual_permissions(_: &mut tempfile::Builder<'_, '_>) {}

/// The index of a file or folder on its volume, a number that stays the same when it is renamed.
pub fn identity(path: &Path) -> Option<u64> {
    Some(about(path)?.file_index())
}

/// Bytes that change whenever a file changes, made of its volume, index, size and times.
pub fn file_stamp(path: &Path) -> Option<Vec<u8>> {
    let about = about(path)?;
    let times = [about.creation_time()?, about.last_write_time()?];
    let place = [about.volume_serial_number(), about.file_index(), about.file_size()];
    Some(place.into_iter().chain(times).flat_map(u64::to_le_bytes).collect())
}

fn about(path: &Path) -> Option<file::Information> {
    file::information(Handle::from_path_any(path).ok()?).ok()
}

pub fn open_at_once(path: &Path) -> io::Result<File> {
    File::open(path)
}

/// Fills `bytes` from position `at` of a file, and moves the file's own position.
pub fn read_exact_at(file: &File, mut bytes: &mut [u8], mut at: u64) -> io::Result<()> {
    while !bytes.is_empty() {
        match file.seek_read(bytes, at) {
            Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(read) => (bytes, at) = (&mut bytes[read..], at + read as u64),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

/// Always `None`, since the standard library does not tell the processor time.
pub fn processor_s() -> Option<f64> {
    None
}
