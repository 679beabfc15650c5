//! Windows.

/// Fails for most users, since Windows allows links only to administrators and in developer mode.
pub(crate) use std::os::windows::fs::symlink_dir as link_folder;
pub(crate) use std::os::windows::io::AsHandle as AsOutput;

use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::windows::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::time::Duration;

use console::Term;
use winapi_util::{Handle, file};

use crate::seed;

/// Number of the signal that Ctrl-C sends on Unix.
const SIGINT: i32 = 2;

/// Opens the file that is locked in place of a folder, since Windows cannot lock a folder. A hash of
/// the folder's path names this file; all users of this machine share it, other machines do not.
pub(crate) fn open_lock(folder: &Path) -> io::Result<File> {
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
pub(crate) fn lock_holder(_: &File) -> Option<String> {
    None
}

/// Does nothing, since temporary folders already have the permissions of the folder around them.
pub(crate) fn usual_permissions(_: &mut tempfile::Builder<'_, '_>) {}

/// The index of a file or folder on its volume, a number that stays the same when it is renamed.
pub(crate) fn identity(path: &Path) -> Option<u64> {
    Some(about(path)?.file_index())
}

/// Bytes that change whenever a file changes, made of its volume, index, size and times.
pub(crate) fn file_stamp(path: &Path) -> Option<Vec<u8>> {
    let about = about(path)?;
    let times = [about.creation_time()?, about.last_write_time()?];
    let place = [about.volume_serial_number(), about.file_index(), about.file_size()];
    Some(place.into_iter().chain(times).flat_map(u64::to_le_bytes).collect())
}

fn about(path: &Path) -> Option<file::Information> {
    file::information(Handle::from_path_any(path).ok()?).ok()
}

pub(crate) fn open_at_once(path: &Path) -> io::Result<File> {
    File::open(path)
}

/// Fills `bytes` from position `at` of a file, and moves the file's own position.
pub(crate) fn read_exact_at(file: &File, mut bytes: &mut [u8], mut at: u64) -> io::Result<()> {
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
pub(crate) fn processor_s() -> Option<f64> {
    None
}

/// Always succeeds, since opening a device shows whether it can be used.
pub(crate) fn may_use(_: &Path) -> io::Result<()> {
    Ok(())
}

/// Always `None`, since Windows does not tell which process has a device open.
pub(crate) fn device_holder(_: &Path) -> Option<String> {
    None
}

/// Always true, since Windows does not tell whether a write would block.
pub(crate) fn takes_more(_: &impl AsOutput, _: Duration) -> bool {
    true
}

/// Whether stderr is a terminal that can clear its line. The check also switches this ability on.
pub(crate) fn has_status_line() -> bool {
    Term::stderr().features().colors_supported()
}

/// Whether [`next_key`] can give keys, which needs only a terminal.
pub(crate) fn single_keys() -> bool {
    Term::stderr().is_term()
}

/// Waits for a key; `None` if there will be no more keys.
pub(crate) fn next_key() -> Option<char> {
    Term::stderr().read_char().ok()
}

/// Does nothing, since keys are read as events and the terminal was not changed.
pub(crate) fn restore_terminal() {}

/// Always `None`, since a closed window is an order to end.
pub(crate) const HANGUP: Option<i32> = None;

/// Always true, since only a missing terminal would matter, and only on Unix.
pub(crate) fn has_terminal() -> bool {
    true
}

/// Waits for orders to end (Ctrl-C, a closed window), and gives SIGINT's number for each order.
pub(crate) fn signals() -> io::Result<impl Iterator<Item = i32> + Send> {
    let (send, orders) = mpsc::channel();
    let order = move || {
        // If nobody receives the order, the program is ending already.
        let _ = send.send(SIGINT);
    };
    ctrlc::set_handler(order).map_err(io::Error::other)?;
    Ok(orders.into_iter())
}

/// Always `None`, since Windows has no supervisor that expects signs of life.
pub(crate) fn watchdog() -> Option<Duration> {
    None
}

/// Whether standard input is a file, which waits until it is read; a pipe may come from a live sensor.
pub(crate) fn stdin_is_a_file() -> bool {
    let file = io::stdin().as_handle().try_clone_to_owned().map(File::from);
    file.and_then(|file| file.metadata()).is_ok_and(|about| about.is_file())
}

/// Does nothing, since Windows has no supervisor that takes states.
pub(crate) fn notify_supervisor(_: &str) {}
