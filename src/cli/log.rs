//! Where the log goes: lines on stderr, with the journal's priorities where it is the journal's.

use std::fmt;
use std::io;

use tracing::{Event, Level, Subscriber};
use tracing_subscriber::fmt::format::Writer;
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields};
use tracing_subscriber::registry::LookupSpan;

/// Sends what the program logs to stderr, through [`super::say`].
pub fn start() {
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

/// How a message of a level begins.
pub fn word(level: Level) -> &'static str {
    match level {
        Level::ERROR => "error: ",
        Level::WARN => "warning: ",
        _ => "",
    }
}

/// What the journal reads at the start of a line as its priority (see sd-daemon(3)).
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

/// Takes an event a write, and never fails.
struct Stderr;

impl io::Write for Stderr {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        super::say::line(String::from_utf8_lossy(line).trim_end_matches('\n'));
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
