//! Writes text: results on stdout, everything else on stderr. It never fails.
//!
//! A daemon must survive the loss of its log, so a line that cannot be written (closed pipe, full
//! disk) is dropped. While devices are running, a line is also dropped if its reader has stalled.

use std::fmt;
use std::io::{self, Write};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};
use tracing::field::Field;
use tracing::level_filters::LevelFilter;
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::layer::{Context, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;

use super::system::{AsOutput, takes_more};
use crate::outputs::lock;
use crate::printable::Printable;

/// How long a line may wait for a stalled reader. Later lines do not wait until the reader is ready.
const PATIENCE: Duration = Duration::from_millis(100);
/// A pipe that is ready accepts this many bytes without blocking (`PIPE_BUF` on Linux).
const ATOMIC: usize = 4096;

/// Whether devices are running. If so, no line may wait for its reader.
static LIVE: AtomicBool = AtomicBool::new(false);
/// Whether the readers of stdout and of stderr, in this order, had stalled at the last line.
static STALLED: [AtomicBool; 2] = [const { AtomicBool::new(false) }; 2];
/// Whether stdout is reserved for JSON.
static RESULTS_ASIDE: AtomicBool = AtomicBool::new(false);
/// The text of the status line, the last line of the terminal. `None` if no status line is kept. It is
/// locked while a line is written, so that the two do not mix.
static STATUS: Mutex<Option<String>> = Mutex::new(None);

/// Moves the cursor to the start of the line, and clears the line.
const CLEAR: &str = "\r\x1b[2K";

/// Writes a line for people on stderr; the arguments are those of `format!`. It never panics.
macro_rules! say {
    () => { $crate::cli::say::line("") };
    ($($text:tt)*) => { $crate::cli::say::line(&format!($($text)*)) };
}

/// Writes a line of a result on stdout; the arguments are those of `format!`. It never panics.
macro_rules! result {
    () => { $crate::cli::say::result_line("") };
    ($($text:tt)*) => { $crate::cli::say::result_line(&format!($($text)*)) };
}

static VERBOSE: AtomicBool = AtomicBool::new(false);

pub(super) fn be_verbose(verbose: bool) {
    VERBOSE.store(verbose, Ordering::Release);
}

pub(super) fn is_verbose() -> bool {
    VERBOSE.load(Ordering::Acquire)
}

/// From now on, no line waits for a stalled reader.
pub(super) fn never_wait() {
    LIVE.store(true, Ordering::Release);
}

/// Starts (`on`) or ends the status line at the bottom of the terminal; [`status`] sets its text.
pub(super) fn keep_status_line(on: bool) {
    let mut kept = lock(&STATUS);
    if kept.is_some() && !on {
        write_stderr(CLEAR);
    }
    *kept = on.then(String::new);
}

/// The name and the progress bar of the current step.
static PROGRESS: Mutex<Option<(&'static str, ProgressBar)>> = Mutex::new(None);

/// Draws the progress of a step as a bar on a terminal; the next line of text removes the bar.
pub(super) fn progress(step: &'static str, done: usize, of: usize) {
    let mut shown = lock(&PROGRESS);
    if shown.as_ref().is_none_or(|(name, _)| *name != step) {
        shown.take().inspect(|(_, old)| old.finish_and_clear());
        let style = ProgressStyle::with_template("{msg} {bar:40} {pos}/{len} · {eta} left");
        let style = style.unwrap_or_else(|_| ProgressStyle::default_bar());
        let new = ProgressBar::new(of as u64).with_style(style).with_message(step);
        *shown = Some((step, new));
    }
    shown.iter().for_each(|(_, bar)| bar.set_position(done as u64));
}

pub(super) fn end_progress() {
    let shown = lock(&PROGRESS).take();
    shown.inspect(|(_, bar)| bar.finish_and_clear());
}

pub(super) fn line(text: &str) {
    end_progress();
    write_stderr(&above(&lock(&STATUS), &format!("{}\n", lines(text))));
}

/// The text that prints a line above the status line, if there is one.
fn above(status: &Option<String>, line: &str) -> String {
    status.as_ref().map_or(line.into(), |status| format!("{CLEAR}{line}{status}"))
}

/// With `aside`, results for people go to stderr from now on, since stdout is for JSON.
pub(super) fn results_aside(aside: bool) {
    RESULTS_ASIDE.store(aside, Ordering::Release);
}

/// Writes a line of a result on stdout, unless [`results_aside`] sent results to stderr.
pub(super) fn result_line(text: &str) {
    end_progress();
    if RESULTS_ASIDE.load(Ordering::Acquire) {
        return line(text);
    }
    let print = || write(&mut io::stdout().lock(), &STALLED[0], &format!("{}\n", Printable(text)));
    let kept = lock(&STATUS);
    let Some(status) = &*kept else {
        // A stalled reader of stdout must not delay lines on stderr.
        drop(kept);
        return print();
    };
    write_stderr(CLEAR);
    print();
    write_stderr(status);
}

/// Replaces the text of the status line, if one is kept.
pub(super) fn status(text: &str) {
    if let Some(kept) = &mut *lock(&STATUS) {
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
        // An error is ignored, since there is nowhere to report it.
        if out.write_all(part).and_then(|()| out.flush()).is_err() {
            return;
        }
    }
}

/// Whether text can be written without blocking. Waits up to `PATIENCE` for a reader not yet stalled.
fn ready(out: &impl AsOutput, stalled: &AtomicBool) -> bool {
    let wait = if stalled.load(Ordering::Acquire) { Duration::ZERO } else { PATIENCE };
    let ready = takes_more(out, wait);
    stalled.store(!ready, Ordering::Release);
    ready
}

/// A text made safe for the terminal or the log. All lines after the first are indented, so that
/// none can be mistaken for a separate message.
fn lines(text: &str) -> String {
    let shown = Printable(text).to_string();
    let indented = shown.split('\n').enumerate().map(|(at, line)| match at {
        0 => line.to_string(),
        _ if line.is_empty() || line.starts_with(' ') => format!("\n{line}"),
        _ => format!("\n  {line}"),
    });
    indented.collect()
}

/// Sends the program's log events to stderr through [`line`].
pub(super) fn start_log() {
    // Starting fails only if a log was started before, for example by a test.
    let _ = tracing_subscriber::registry().with(LevelFilter::INFO).with(Log).try_init();
}

/// Prints each log event as a line that holds its priority for the journal, its level and its text.
struct Log;

impl<S: Subscriber> Layer<S> for Log {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let level = *event.metadata().level();
        let mut text = format!("{}{}", priority(level), word(level));
        event.record(&mut |_: &Field, value: &dyn fmt::Debug| text += &format!("{value:?}"));
        line(&text);
    }
}

/// The word with which messages of this level begin.
pub(super) fn word(level: Level) -> &'static str {
    match level {
        Level::ERROR => "error: ",
        Level::WARN => "warning: ",
        _ => "",
    }
}

/// The prefix of a line that tells the systemd journal its priority (see sd-daemon(3)).
pub(super) fn priority(level: Level) -> &'static str {
    if std::env::var_os("JOURNAL_STREAM").is_none() {
        return "";
    }
    match level {
        Level::ERROR => "<3>",
        Level::WARN => "<4>",
        _ => "<6>",
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
