//! Linux, macOS and other Unix systems.

#[doc(hidden)]
pub use std::os::unix::fs::symlink as link_folder;

use std::fs::{self, File, OpenOptions, Permissions};
use std::io;
use std::os::unix::fs::{FileExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::Path;

use rustix::fs::{OFlags, major, minor};
use rustix::time::{ClockId, clock_gettime};

/// Opens the file that is locked in place of a folder, which is the folder itself on Unix.
pub fn open_lock(folder: &Path) -> io::Result<File> {
    File::open(folder)
}

/// The command and number of the process that holds the lock of a file; `None` if it is not known.
pub fn lock_holder(file: &File) -> Option<String> {
    let about = file.metadata().ok()?;
    let device = about.dev() as rustix::fs::Dev;
    let place = format!("{:02x}:{:02x}:{}", major(device), minor(device), about.ino());
    let locks = fs::read_to_string("/proc/locks").ok()?;
    let pid = locks.lines().find_map(|line| {
        let words: Vec<&str> = line.split_whitespace().collect();
        // Form: "1: FLOCK ADVISORY WRITE 4711 08:01:1234 0 EOF"; waiting processes have an arrow.
        let [_, "FLOCK", _, _, pid, at, ..] = words[..] else { return None };
        (at == place).then(|| pid.to_string())
    })?;
    let command = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
    let words = command.split(|&byte| byte == 0).take(3).map(String::from_utf8_lossy);
    let words: Vec<_> = words.filter(|word| !word.is_empty()).collect();
    let program = words.first()?.rsplit('/').next()?.to_string();
    let rest =
        words.iter().skip(1).filter(|word| !word.contains('/')).map(|word| format!(" {word}"));
    Some(format!("`{program}{}` (process {pid})", rest.collect::<String>()))
}

/// Gives temporary folders the same permissions as other new folders, which the umask limits.
pub fn usual_permissions(builder: &mut tempfile::Builder<'_, '_>) {
    builder.permissions(Permissions::from_mode(0o777));
}

/// The inode of a file, folder or link, a number that stays the same when it is renamed.
pub fn identity(path: &Path) -> Option<u64> {
    fs::symlink_metadata(path).ok().map(|about| about.ino())
}

/// Bytes that change whenever a file changes, made of its device, inode, size and times of change.
pub fn file_stamp(path: &Path) -> Option<Vec<u8>> {
    let about = fs::metadata(path).ok()?;
    let times = [about.mtime(), about.mtime_nsec(), about.ctime(), about.ctime_nsec()];
    let mut all = [about.dev(), about.ino(), about.size()].map(u64::to_le_bytes).concat();
    all.extend(times.map(i64::to_le_bytes).concat());
    Some(all)
}

/// Opens a file for reading; does not wait for the writer of a pipe.
pub fn open_at_once(path: &Path) -> io::Result<File> {
    OpenOptions::new().read(true).custom_flags(OFlags::NONBLOCK.bits() as i32).open(path)
}

pub fn read_exact_at(file: &File, bytes: &mut [u8], offset: u64) -> io::Result<()> {
    file.read_exact_at(bytes, offset)
}

/// Processor time of all threads of this process so far, in seconds; `None` if it is not known.
pub fn processor_s() -> Option<f64> {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    Some(time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9)
}
