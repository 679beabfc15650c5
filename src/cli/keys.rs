//! Keys and signals that end or steer a station.

use std::io::{IsTerminal, Read};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock, mpsc};
use std::time::Duration;

use crossbeam_channel::Sender;
use rustix::termios::{self, LocalModes, OptionalActions, Termios};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

use super::{DAMAGED, Failure};
use crate::station::Command;

/// Time from the first signal until the process ends in any case: later than a station ends by
/// itself, and within the five seconds allowed for it.
const LIMIT: Duration = Duration::from_millis(4700);

/// The settings of the terminal before keys were read one by one.
static BEFORE: OnceLock<Termios> = OnceLock::new();

/// Reads keys one by one, without waiting for Enter, until it is dropped.
pub struct Keys;

impl Keys {
    /// Reads keys if the program is in the foreground of a terminal: `space` begins or ends a scan,
    /// `q` quits.
    pub fn listen(commands: Sender<Command>, scanning: Arc<AtomicBool>) -> Option<Self> {
        let stdin = std::io::stdin();
        let in_front =
            termios::tcgetpgrp(&stdin).is_ok_and(|group| group == rustix::process::getpgrp());
        if !in_front || !std::io::stderr().is_terminal() {
            return None;
        }
        let before = termios::tcgetattr(&stdin).ok()?;
        let mut single = before.clone();
        // Signals stay: Ctrl-C still ends the program.
        single.local_modes.remove(LocalModes::ICANON | LocalModes::ECHO);
        termios::tcsetattr(&stdin, OptionalActions::Now, &single).ok()?;
        let keys = Self;
        let _ = BEFORE.set(before);
        let read = move || {
            // This thread may hold the lock of stdin for ever.
            for key in std::io::stdin().lock().bytes() {
                let (command, does) = match key {
                    Ok(b' ') if scanning.load(Ordering::Acquire) => {
                        (Command::Stop, "ends the scan")
                    }
                    Ok(b' ') => (Command::Start, "begins a scan"),
                    Ok(b'q' | b'Q') => (Command::Quit, "quits"),
                    Ok(_) => continue,
                    Err(_) => return,
                };
                // Said at once, even if the station is busy.
                say!("the key {does}");
                if commands.send(command).is_err() {
                    return;
                }
            }
        };
        // The thread waits for keys until the process ends.
        std::thread::Builder::new().name("keys".into()).spawn(read).ok()?;
        Some(keys)
    }
}

impl Drop for Keys {
    fn drop(&mut self) {
        restore();
    }
}

fn restore() {
    if let Some(before) = BEFORE.get() {
        // If this fails, the terminal is gone.
        let _ = termios::tcsetattr(std::io::stdin(), OptionalActions::Now, before);
    }
}

/// Waits for a signal.
pub struct Signalled(mpsc::Receiver<()>);

impl Signalled {
    /// Waits for the first signal, if it has not come yet.
    pub fn wait(self) {
        let _ = self.0.recv();
    }
}

/// Turns the first signal into [`Command::Quit`]. The second one ends the process at once, as does
/// the first if no station and no [`Signalled`] receives it. In any case the process ends within
/// [`LIMIT`]. A hang-up that was ignored when the process began, as under `nohup`, stays ignored.
pub fn watch_signals(commands: Sender<Command>) -> Result<Signalled, Failure> {
    let hangup = (!hangup_is_ignored()).then_some(SIGHUP);
    // SIGTERM is caught last: once it is, so are the others.
    let mut signals = Signals::new([SIGINT].into_iter().chain(hangup).chain([SIGTERM]))?;
    let (send, signalled) = mpsc::channel();
    let watch = move || {
        for (count, signal) in signals.forever().enumerate() {
            let taken = [commands.send(Command::Quit).is_ok(), send.send(()).is_ok()];
            if count > 0 || taken == [false; 2] {
                restore();
                std::process::exit(128 + signal);
            }
            // If the system gives no thread, the second signal ends it.
            let _ = std::thread::Builder::new().name("end".into()).spawn(end_late);
        }
    };
    std::thread::Builder::new().name("signals".into()).spawn(watch)?;
    Ok(Signalled(signalled))
}

fn hangup_is_ignored() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = ignored.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask & 1 << (SIGHUP - 1) != 0)
}

/// Ends a process that has not ended by itself in time, such as one whose output nobody reads.
fn end_late() {
    std::thread::sleep(LIMIT);
    // On a thread of its own: the process may be stuck on stderr.
    let warn = || say!("warning: the program did not end in time; some data may be lost");
    let _ = std::thread::Builder::new().spawn(warn);
    std::thread::sleep(Duration::from_millis(50));
    restore();
    std::process::exit(DAMAGED.into());
}
