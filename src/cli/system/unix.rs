//! Linux, macOS and other Unix systems.

pub(crate) use std::os::fd::AsFd as AsOutput;

pub(crate) use sd_notify::watchdog_enabled as watchdog;

use std::fs;
use std::io::{self, IsTerminal, Read};
use std::path::Path;
use std::sync::OnceLock;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::termios::{self, LocalModes, OptionalActions, Termios};
use sd_notify::NotifyState;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

use surfaced_method::system::open_at_once;

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

/// Tells the supervisor of this service its state, in the format of sd_notify(3).
pub(crate) fn notify_supervisor(state: &str) {
    // This fails only without systemd, so the error is ignored.
    let _ = sd_notify::notify(&[NotifyState::Custom(state)]);
}
