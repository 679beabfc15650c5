//! Keys and signals that end or steer a station.

use std::io::IsTerminal;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::Duration;

use crossbeam_channel::Sender;

use super::{DAMAGED, Failure};
use crate::station::Command;
use crate::system::{next_key, restore_terminal, signals, single_keys};

/// Time from the first signal until the process ends in any case: later than a station ends by
/// itself, and within the five seconds allowed for it.
const LIMIT: Duration = Duration::from_millis(4700);

/// Keys that are read one by one, until it is dropped.
pub struct Keys;

impl Keys {
    /// Reads keys if the program is in the foreground of a terminal: `space` begins or ends a scan,
    /// `q` quits.
    pub fn listen(commands: Sender<Command>, scanning: Arc<AtomicBool>) -> Option<Self> {
        if !std::io::stderr().is_terminal() || !single_keys() {
            return None;
        }
        let keys = Self;
        let read = move || {
            while let Some(key) = next_key() {
                let (command, does) = match key {
                    ' ' if scanning.load(Ordering::Acquire) => (Command::Stop, "ends the scan"),
                    ' ' => (Command::Start, "begins a scan"),
                    'q' | 'Q' => (Command::Quit, "quits"),
                    _ => continue,
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
        restore_terminal();
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

/// Makes the first signal a command to quit. The second one ends the process at once, as does the
/// first when there is neither a station nor anybody who waits for it. However the station takes
/// it, the process ends within [`LIMIT`].
pub fn watch_signals(commands: Sender<Command>) -> Result<Signalled, Failure> {
    let signals = signals()?;
    let (send, signalled) = mpsc::channel();
    let watch = move || {
        for (count, signal) in signals.enumerate() {
            let taken = [commands.send(Command::Quit).is_ok(), send.send(()).is_ok()];
            if count > 0 || taken == [false; 2] {
                restore_terminal();
                std::process::exit(128 + signal);
            }
            // If the system gives no thread, the second signal ends it.
            let _ = std::thread::Builder::new().name("end".into()).spawn(end_late);
        }
    };
    std::thread::Builder::new().name("signals".into()).spawn(watch)?;
    Ok(Signalled(signalled))
}

/// Ends a process that has not ended by itself in time, such as one whose output nobody reads.
fn end_late() {
    std::thread::sleep(LIMIT);
    // On a thread of its own: the process may be stuck on stderr.
    let warn = || say!("warning: the program did not end in time; some data may be lost");
    let _ = std::thread::Builder::new().spawn(warn);
    std::thread::sleep(Duration::from_millis(50));
    restore_terminal();
    std::process::exit(DAMAGED.into());
}
