//! Linux, macOS and other Unix systems.

pub(crate) use std::os::fd::AsFd as AsOutput;
pub(crate) use std::os::unix::fs::symlink as link_folder;

pub(crate) use sd_notify::watchdog_enabled as watchdog;

use std::fs::{self, File, OpenOptions, Permissions};
use std::io::{self, IsTerminal, Read};
use std::os::unix::fs::{FileExt, FileTypeExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::Path;
use std::sync::OnceLock;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Access, OFlags, access, major, minor};
use rustix::termios::{self, LocalModes, OptionalActions, Termios};
use rustix::time::{ClockId, clock_gettime};
use sd_notify::NotifyState;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

/// Opens the file that is locked in place of a folder, which is the folder itself on Unix.
pub(crate) fn open_lock(folder: &Path) -> io::Result<File> {
    File::open(folder)
}

/// The command and number of the process that holds the lock of a file; `None` if it is not known.
pub(crate) fn lock_holder(file: &File) -> Option<String> {
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
pub(crate) fn usual_permissions(builder: &mut tempfile::Builder<'_, '_>) {
    builder.permissions(Permissions::from_mode(0o777));
}

/// The inode of a file, folder or link, a number that stays the same when it is renamed.
pub(crate) fn identity(path: &Path) -> Option<u64> {
    fs::symlink_metadata(path).ok().map(|about| about.ino())
}

/// Bytes that change whenever a file changes, made of its device, inode, size and times of change.
pub(crate) fn file_stamp(path: &Path) -> Option<Vec<u8>> {
    let about = fs::metadata(path).ok()?;
    let times = [about.mtime(), about.mtime_nsec(), about.ctime(), about.ctime_nsec()];
    let mut all = [about.dev(), about.ino(), about.size()].map(u64::to_le_bytes).concat();
    all.extend(times.map(i64::to_le_bytes).concat());
    Some(all)
}

/// Opens a file for reading; does not wait for the writer of a pipe.
pub(crate) fn open_at_once(path: &Path) -> io::Result<File> {
    OpenOptions::new().read(true).custom_flags(OFlags::NONBLOCK.bits() as i32).open(path)
}

pub(crate) fn read_exact_at(file: &File, bytes: &mut [u8], offset: u64) -> io::Result<()> {
    file.read_exact_at(bytes, offset)
}

/// Processor time of all threads of this process so far, in seconds; `None` if it is not known.
pub(crate) fn processor_s() -> Option<f64> {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    Some(time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9)
}

pub(crate) fn may_use(node: &Path) -> io::Result<()> {
    Ok(access(node, Access::READ_OK | Access::WRITE_OK)?)
}

/// Number and name of another process that has a device open, as far as this user may see it.
pub(crate) fn device_holder(node: &Path) -> Option<String> {
    let device = fs::metadata(node).ok().filter(|node| node.file_type().is_char_device())?.rdev();
    let has = |process: &Path| {
        let Ok(open) = fs::read_dir(process.join("fd")) else { return false };
        open.flatten().any(|entry| {
            // Looks at the link's text first, since following a link to a dead network may take long.
            let link = fs::read_link(entry.path()).unwrap_or_default();
            link.starts_with("/dev")
                && fs::metadata(entry.path())
                    .is_ok_and(|m| m.file_type().is_char_device() && m.rdev() == device)
        })
    };
    let own = std::process::id();
    fs::read_dir("/proc").ok()?.flatten().find_map(|entry| {
        let number: u32 = entry.file_name().to_str()?.parse().ok()?;
        let name = || fs::read_to_string(entry.path().join("comm")).unwrap_or_default();
        (number != own && has(&entry.path())).then(|| format!("{number} ({})", name().trim()))
    })
}

/// Whether `out` takes data without blocking; true if `out` cannot be polled. Waits at most `wait`,
/// which must be less than a second.
pub(crate) fn takes_more(out: &impl AsOutput, wait: Duration) -> bool {
    let wait = Timespec { tv_sec: 0, tv_nsec: wait.subsec_nanos().into() };
    !matches!(poll(&mut [PollFd::new(out, PollFlags::OUT)], Some(&wait)), Ok(0))
}

/// Whether stderr is a terminal that can clear its line.
pub(crate) fn has_status_line() -> bool {
    io::stderr().is_terminal()
}

/// The settings of the terminal before [`single_keys`] changed them.
static BEFORE: OnceLock<Termios> = OnceLock::new();

/// Makes [`next_key`] return each key at once, until [`restore_terminal`]. Returns false if there
/// is no terminal, or if this program is not in its foreground.
pub(crate) fn single_keys() -> bool {
    let stdin = io::stdin();
    let in_front =
        termios::tcgetpgrp(&stdin).is_ok_and(|group| group == rustix::process::getpgrp());
    let Some(before) = termios::tcgetattr(&stdin).ok().filter(|_| in_front) else { return false };
    let mut single = before.clone();
    // Signals stay on, so Ctrl-C still ends the program.
    single.local_modes.remove(LocalModes::ICANON | LocalModes::ECHO);
    let set = termios::tcsetattr(&stdin, OptionalActions::Now, &single).is_ok();
    if set {
        let _ = BEFORE.set(before);
    }
    set
}

/// Waits for a key; `None` if there will be no more keys.
pub(crate) fn next_key() -> Option<char> {
    // Holds the lock of stdin while it waits, which may be for ever.
    io::stdin().lock().bytes().next()?.ok().map(char::from)
}

/// Undoes [`single_keys`].
pub(crate) fn restore_terminal() {
    if let Some(before) = BEFORE.get() {
        // If this fails, the terminal is gone, so the error is ignored.
        let _ = termios::tcsetattr(io::stdin(), OptionalActions::Now, before);
    }
}

/// The number of the signal that a lost terminal sends.
pub(crate) const HANGUP: Option<i32> = Some(SIGHUP);

/// Whether a terminal controls this process, so that it hears when the terminal is closed.
pub(crate) fn has_terminal() -> bool {
    open_at_once(Path::new("/dev/tty")).is_ok()
}

/// Waits for the signals that ask a program to end, and gives their numbers. A hang-up stays
/// ignored if it was ignored when the process began, as under `nohup`.
pub(crate) fn signals() -> io::Result<impl Iterator<Item = i32> + Send> {
    let hangup = (!hangup_is_ignored()).then_some(SIGHUP);
    // SIGTERM comes last, so that once it is caught, the other signals are caught, too.
    let mut signals = Signals::new([SIGINT].into_iter().chain(hangup).chain([SIGTERM]))?;
    Ok(std::iter::from_fn(move || signals.forever().next()))
}

fn hangup_is_ignored() -> bool {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = ignored.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask & 1 << (SIGHUP - 1) != 0)
}

/// Whether standard input is a file, which waits until it is read; a pipe may come from a live sensor.
pub(crate) fn stdin_is_a_file() -> bool {
    let file = io::stdin().as_fd().try_clone_to_owned().map(File::from);
    file.and_then(|file| file.metadata()).is_ok_and(|about| about.is_file())
}

/// Tells the supervisor of this service its state, in the format of sd_notify(3).
pub(crate) fn notify_supervisor(state: &str) {
    // This fails only without systemd, so the error is ignored.
    let _ = sd_notify::notify(&[NotifyState::Custom(state)]);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_process_that_has_a_node_is_named() {
        let mut child = std::process::Command::new("sleep")
            .arg("60")
            .stdin(fs::File::open("/dev/full").unwrap())
            .spawn()
            .unwrap();
        let mut found = None;
        for _ in 0..100 {
            found = device_holder(Path::new("/dev/full"));
            if found.as_deref().is_some_and(|text| text.contains("(sleep)")) {
                break;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        child.kill().unwrap();
        child.wait().unwrap();
        assert_eq!(found, Some(format!("{} (sleep)", child.id())));
    }
}
