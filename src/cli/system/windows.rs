//! Windows.

pub(crate) use std::os::windows::io::AsHandle as AsOutput;

use std::io;
use std::sync::mpsc;
use std::time::Duration;

use console::Term;

/// Number of the signal that Ctrl-C sends on Unix.
const SIGINT: i32 = 2;

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

/// Does nothing, since Windows has no supervisor that takes states.
pub(crate) fn notify_supervisor(_: &str) {}
