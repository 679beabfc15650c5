//! Writes text for people: results on stdout, everything else on stderr. It never fails.
//!
//! A daemon outlives its log. A line that cannot be written, because its reader is gone or its disk
//! is full, is dropped; while devices are at work, so is one whose reader has stalled.

use std::fmt;
use std::io::{self, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tracing::{Event, Level, Subscriber};
use tracing_subscriber::fmt::format::Writer;
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields};
use tracing_subscriber::registry::LookupSpan;

use crate::printable::Printable;
use crate::system::{AsOutput, takes_more};

/// The time for which a stalled reader may hold up live devices, once.
const PATIENCE: Duration = Duration::from_millis(100);
/// A pipe that is ready takes this much without blocking (`PIPE_BUF` on Linux).
const ATOMIC: usize = 4096;

/// Whether devices are at work, which must not wait for a reader.
static LIVE: AtomicBool = AtomicBool::new(false);
/// Whether the reader of stdout, and that of stderr, did not take the last line.
static STALLED: [AtomicBool; 2] = [const { AtomicBool::new(false) }; 2];
/// Whether stdout is for JSON alone.
static RESULTS_ASIDE: AtomicBool = AtomicBool::new(false);
/// The status line, if one is kept: the last line of the terminal, below all others.
static STATUS: Mutex<Option<String>> = Mutex::new(None);

/// Goes to the start of the terminal's line, and clears it.
const CLEAR: &str = "\r\x1b[2K";

/// Writes a line for people on stderr; takes what `format!` takes. It never panics.
macro_rules! say {
    () => { $crate::cli::say::line("") };
    ($($text:tt)*) => { $crate::cli::say::line(&format!($($text)*)) };
}

/// Writes a line of a result on stdout; takes what `format!` takes. It never panics.
macro_rules! result {
    () => { $crate::cli::say::result_line("") };
    ($($text:tt)*) => { $crate::cli::say::result_line(&format!($($text)*)) };
}

/// Whether to print details, too.
static VERBOSE: AtomicBool = AtomicBool::new(false);

/// Sets whether to print details, too; see [`is_verbose`].
pub fn be_verbose(verbose: bool) {
    VERBOSE.store(verbose, Ordering::Release);
}

/// Whether `--verbose` asks for details.
pub fn is_verbose() -> bool {
    VERBOSE.load(Ordering::Acquire)
}

/// From now on, no line waits for its reader.
pub fn never_wait() {
    LIVE.store(true, Ordering::Release);
}

/// Locks the status line while a line is written, so that no other line comes in between.
fn status_line() -> MutexGuard<'static, Option<String>> {
    // Each change is one assignment, so a panic leaves a usable line.
    STATUS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Keeps a status line from now on, see [`status`], or ends it.
pub fn keep_status_line(on: bool) {
    let mut kept = status_line();
    if kept.is_some() && !on {
        write_stderr(CLEAR);
    }
    *kept = on.then(String::new);
}

/// Writes a line; see [`say!`].
pub fn line(text: &str) {
    write_stderr(&above(&status_line(), &format!("{}\n", lines(text))));
}

/// A line with its end, above the status line, if there is one.
fn above(status: &Option<String>, line: &str) -> String {
    match status {
        Some(status) => format!("{CLEAR}{line}{status}"),
        None => line.into(),
    }
}

/// From now on, results for people go to stderr: stdout is for JSON.
pub fn results_aside(aside: bool) {
    RESULTS_ASIDE.store(aside, Ordering::Release);
}

/// Writes a line of a result; see [`result!`].
pub fn result_line(text: &str) {
    if RESULTS_ASIDE.load(Ordering::Acquire) {
        return line(text);
    }
    let print = || write(&mut io::stdout().lock(), &STALLED[0], &format!("{}\n", Printable(text)));
    let kept = status_line();
    let Some(status) = &*kept else {
        // A reader of results who stalls must not hold up what is said on stderr.
        drop(kept);
        return print();
    };
    write_stderr(CLEAR);
    print();
    write_stderr(status);
}

/// Replaces the status line, where one is kept.
pub fn status(text: &str) {
    if let Some(kept) = &mut *status_line() {
        *kept = Printable(text).to_string();
        write_stderr(&format!("{CLEAR}{kept}"));
    }
}

fn write_stderr(text: &str) {
    write(&mut io::stderr().lock(), &STALLED[1], text);
}

fn write(out: &mut (impl Write + AsOutput), stalled: &AtomicBool, text: &str) {
    for part in text.as_bytes().chunks(ATOMIC) {
        if LIVE.load(Ordering::Acquire) && !ready(out, stalled) {
            return;
        }
        // Nobody is left to read about an error.
        if out.write_all(part).and_then(|()| out.flush()).is_err() {
            return;
        }
    }
}

/// Whether a part can be written without blocking; waits a moment, but only once in a row.
fn ready(out: &impl AsOutput, stalled: &AtomicBool) -> bool {
    let wait = if stalled.load(Ordering::Acquire) { Duration::ZERO } else { PATIENCE };
    let ready = takes_more(out, wait);
    stalled.store(!ready, Ordering::Release);
    ready
}

/// A text as it stands on the terminal or in the log: further lines are indented, so that none
/// passes for a message of its own.
fn lines(text: &str) -> String {
    let shown = Printable(text).to_string();
    let indented = shown.split('\n').enumerate().map(|(at, line)| match at {
        0 => line.to_string(),
        _ if line.is_empty() || line.starts_with(' ') => format!("\n{line}"),
        _ => format!("\n  {line}"),
    });
    indented.collect()
}

/// Sends what the program logs to stderr, through [`line`].
pub fn start_log() {
    let lines = tracing_subscriber::fmt()
        .with_max_level(Level::INFO)
        .with_ansi(false)
        .event_format(Lines)
        .with_writer(|| Stderr);
    // Fails only where a log was started before, as by a test.
    let _ = lines.try_init();
}

/// A line for each event: its priority for the journal, `error` or `warning`, its text.
struct Lines;

impl<S, N> FormatEvent<S, N> for Lines
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
{
    fn format_event(
        &self,
        context: &FmtContext<'_, S, N>,
        mut writer: Writer<'_>,
        event: &Event<'_>,
    ) -> fmt::Result {
        let level = *event.metadata().level();
        write!(writer, "{}{}", priority(level), word(level))?;
        context.format_fields(writer, event)
    }
}

/// The first word of a message of this level.
pub fn word(level: Level) -> &'static str {
    match level {
        Level::ERROR => "error: ",
        Level::WARN => "warning: ",
        _ => "",
    }
}

/// The priority of a line, in the form that the journal reads at its start (see sd-daemon(3)).
pub fn priority(level: Level) -> &'static str {
    if std::env::var_os("JOURNAL_STREAM").is_none() {
        return "";
    }
    match level {
        Level::ERROR => "<3>",
        Level::WARN => "<4>",
        _ => "<6>",
    }
}

/// Takes one event at each write, and never fails.
struct Stderr;

impl io::Write for Stderr {
    fn write(&mut self, text: &[u8]) -> io::Result<usize> {
        line(String::from_utf8_lossy(text).trim_end_matches('\n'));
        Ok(text.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_stands_above_the_status_line_and_neither_overwrites_the_other() {
        let status = Some("last: oak │ stylus streaming".to_string());
        let shown = above(&status, "warning: disk\n");
        assert_eq!(shown, "\r\x1b[2Kwarning: disk\nlast: oak │ stylus streaming");
        assert_eq!(above(&None, "warning: disk\n"), "warning: disk\n");
    }

    #[test]
    fn no_label_passes_for_a_message_or_moves_the_cursor() {
        assert_eq!(lines("oak\n<3>error: disk\x1b[2J"), "oak\n  <3>error: disk\\u{1b}[2J");
        assert_eq!(lines("2 files:\n  a.wav\n"), "2 files:\n  a.wav\n");
    }
}
