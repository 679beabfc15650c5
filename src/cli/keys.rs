//! Keys and signals that control or end a station.

use std::io::IsTerminal;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::Duration;

use crossbeam_channel::Sender;

use super::system::{HANGUP, has_terminal, next_key, restore_terminal, signals, single_keys};
use super::{DAMAGED, Done};
use crate::station::Command;

/// Time from the first signal until the process is ended by force. It is longer than a station needs
/// to end, and shorter than the five seconds allowed.
const LIMIT: Duration = Duration::from_millis(4700);

/// Puts the terminal into a mode that delivers single keys; dropping it restores the old mode.
pub(super) struct Keys;

impl Keys {
    /// Reads keys if the program is in the foreground of a terminal: `space` starts or stops a
    /// scan, `q` quits.
    pub(super) fn listen(commands: Sender<Command>, scanning: Arc<AtomicBool>) -> Option<Self> {
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
                // The line is printed here, at once, since the station may be busy.
                say!("the key {does}");
                if commands.send(command).is_err() {
                    return;
                }
            }
        };
        // The handle is dropped, since the thread waits for keys until the process ends.
        std::thread::Builder::new().name("keys".into()).spawn(read).ok()?;
        Some(keys)
    }
}

impl Drop for Keys {
    fn drop(&mut self) {
        restore_terminal();
    }
}

/// Turns the first signal into [`Command::Quit`], and notifies the receiver. A second signal ends
/// the process at once; the first signal also does if neither a station nor the receiver exists.
/// In any case, the process ends within [`LIMIT`].
pub(super) fn watch_signals(commands: Sender<Command>) -> Done<mpsc::Receiver<()>> {
    watch(signals()?, commands)
}

/// Like [`watch_signals`], for a station that lasts. Where no terminal could hang up, a hang-up asks a
/// service to read its configuration anew; this is refused, and the station goes on.
pub(super) fn watch_service(commands: Sender<Command>) -> Done<mpsc::Receiver<()>> {
    let is_service = !has_terminal();
    let ends = move |signal: &i32| {
        let is_reload = is_service && HANGUP == Some(*signal);
        if is_reload {
            tracing::warn!(
                "SIGHUP: the configuration is read at the start; restart to read it anew"
            );
        }
        !is_reload
    };
    watch(signals()?.filter(ends), commands)
}

fn watch(
    signals: impl Iterator<Item = i32> + Send + 'static,
    commands: Sender<Command>,
) -> Done<mpsc::Receiver<()>> {
    let (send, signalled) = mpsc::channel();
    let watch = move || {
        for (count, signal) in signals.enumerate() {
            let taken = [commands.send(Command::Quit).is_ok(), send.send(()).is_ok()];
            if count > 0 || taken == [false; 2] {
                restore_terminal();
                std::process::exit(128 + signal);
            }
            // If no thread can be started, a second signal ends the process.
            let _ = std::thread::Builder::new().name("end".into()).spawn(end_late);
        }
    };
    std::thread::Builder::new().name("signals".into()).spawn(watch)?;
    Ok(signalled)
}

/// Ends a process that has not ended in time, for example because nobody reads its output.
fn end_late() {
    std::thread::sleep(LIMIT);
    // A separate thread writes, since writing to stderr may block.
    let warn = || say!("warning: the program did not end in time; some data may be lost");
    let _ = std::thread::Builder::new().spawn(warn);
    std::thread::sleep(Duration::from_millis(50));
    restore_terminal();
    std::process::exit(DAMAGED.into());
}
