//! Windows.

/// Windows permits links to administrators and to developers.
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

/// Number of the signal that Ctrl-C is elsewhere.
const SIGINT: i32 = 2;

/// The file whose lock stands for a folder, which itself cannot be locked: in a folder of this machine
/// that all its users share, by a number for the folder's path. Other machines do not see it.
pub(crate) fn open_lock(folder: &Path) -> io::Result<File> {
    let path = folder.canonicalize()?;
    let id = seed::stable_hash(&[path.as_os_str().as_encoded_bytes()]);
    let data = std::env::var_os("ProgramData").map_or_else(std::env::temp_dir, PathBuf::from);
    let locks = data.join("surfaced").join("locks");
    fs::create_dir_all(&locks)?;
    let path = locks.join(format!("{id:016x}"));
    let made = OpenOptions::new().read(true).append(true).create(true).open(&path);
    // One that another user made can only be read, which is enough for a lock.
    made.or_else(|_| File::open(&path))
}

/// The process that holds a lock of a file, which Windows does not tell.
pub(crate) fn lock_holder(_: &File) -> Option<String> {
    None
}

/// Temporary folders have the permissions of the folder around them already.
pub(crate) fn usual_permissions(_: &mut tempfile::Builder<'_, '_>) {}

/// A number that a file or folder keeps when it is renamed: its index on its volume.
pub(crate) fn identity(path: &Path) -> Option<u64> {
    Some(about(path)?.file_index())
}

/// Bytes that change whenever a file does: its volume, index, size and times.
pub(crate) fn file_stamp(path: &Path) -> Option<Vec<u8>> {
    let about = about(path)?;
    let times = [about.creation_time()?, about.last_write_time()?];
    let place = [about.volume_serial_number(), about.file_index(), about.file_size()];
    Some(place.into_iter().chain(times).flat_map(u64::to_le_bytes).collect())
}

fn about(path: &Path) -> Option<file::Information> {
    file::information(Handle::from_path_any(path).ok()?).ok()
}

/// Opens a file to be read.
pub(crate) fn open_at_once(path: &Path) -> io::Result<File> {
    File::open(path)
}

/// Reads at a place of a file, and goes there.
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

/// Processor time of this process, which the standard library does not tell.
pub(crate) fn processor_s() -> Option<f64> {
    None
}

/// Whether a device can be used shows when it is opened.
pub(crate) fn may_use(_: &Path) -> io::Result<()> {
    Ok(())
}

/// The process that has a device open, which Windows does not tell.
pub(crate) fn device_holder(_: &Path) -> Option<String> {
    None
}

/// Whether a part can be written without blocking, which Windows does not tell.
pub(crate) fn takes_more(_: &impl AsOutput, _: Duration) -> bool {
    true
}

/// Whether stderr is a terminal that can clear its line; tells it to understand how that is done.
pub(crate) fn has_status_line() -> bool {
    Term::stderr().features().colors_supported()
}

/// Whether [`next_key`] gives keys: whether there is a terminal.
pub(crate) fn single_keys() -> bool {
    Term::stderr().is_term()
}

/// Waits for a key; `None` if there will be no more.
pub(crate) fn next_key() -> Option<char> {
    Term::stderr().read_char().ok()
}

/// The terminal is as it was: keys are read as events.
pub(crate) fn restore_terminal() {}

/// Orders to end (Ctrl-C, the window that is closed), as they come, by the number of an interrupt.
pub(crate) fn signals() -> io::Result<impl Iterator<Item = i32> + Send> {
    let (send, orders) = mpsc::channel();
    let order = move || {
        // If nobody receives it, the program ends already.
        let _ = send.send(SIGINT);
    };
    ctrlc::set_handler(order).map_err(io::Error::other)?;
    Ok(orders.into_iter())
}

/// Time within which a supervisor wants to hear of this service; there is none.
pub(crate) fn watchdog() -> Option<Duration> {
    None
}

/// Tells a supervisor the state of this service; there is none.
pub(crate) fn notify_supervisor(_: &str) {}
