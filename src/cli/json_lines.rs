//! Prints the events of a station as lines of JSON on stdout.
//!
//! A separate thread writes the lines, so that a slow reader delays neither live devices nor the
//! end of the program.

use std::convert::Infallible;
use std::io::Write;
use std::time::Duration;

use crossbeam_channel::{Sender, TrySendError, bounded};
use serde::Serialize;

use super::show;
use crate::station::{Command, End, Listener, StationEvent};

/// How many lines may wait for a slow reader; there are only a few scans a minute.
const WAITING: usize = 1024;
/// How many warnings one line may hold; all warnings also go to stderr and to the HTTP API.
const WARNINGS: usize = 50;
/// How long the program waits for a slow reader before it ends.
const PATIENCE: Duration = Duration::from_secs(1);

/// Prints a line for each scan that was named or was to be kept, together with the warnings since
/// the previous line. Warnings after the last scan get a line of their own.
pub(super) struct JsonLines {
    /// The channel to the thread that prints; `None` after the last line.
    lines: Option<Sender<String>>,
    end: End,
    /// Whether to wait for a slow reader, which is allowed only if no device loses data meanwhile.
    waits: bool,
    /// Number of lines dropped because the reader was too slow.
    dropped: u64,
    /// Warnings since the previous line.
    warnings: Vec<String>,
}

#[derive(Serialize)]
struct JsonLine<'a, T> {
    #[serde(flatten)]
    of: Option<&'a T>,
    warnings: Vec<String>,
}

impl JsonLines {
    /// Starts to print. Sends [`Command::Quit`] to `commands` if the reader has closed stdout.
    pub(super) fn start(commands: Sender<Command>, waits: bool) -> std::io::Result<Self> {
        let (lines, to_print) = bounded::<String>(WAITING);
        let (end, ended) = bounded::<Infallible>(0);
        let print = move || {
            let _end = end;
            for line in to_print {
                if writeln!(std::io::stdout(), "{line}").is_err() {
                    // Sending fails only if the station has already ended.
                    let _ = commands.send(Command::Quit);
                    return;
                }
            }
        };
        std::thread::Builder::new().name("lines".into()).spawn(print)?;
        Ok(Self { lines: Some(lines), end: End::of(ended), waits, dropped: 0, warnings: vec![] })
    }

    fn print(&mut self, of: Option<&impl Serialize>) {
        let Some(lines) = &self.lines else { return };
        let line = show::json_text(&JsonLine { of, warnings: std::mem::take(&mut self.warnings) });
        if self.waits {
            // Sending fails only if the reader has closed stdout.
            let _ = lines.send(line);
        } else if let Err(TrySendError::Full(_)) = lines.try_send(line) {
            if self.dropped == 0 {
                tracing::warn!("nobody reads the lines of JSON; they are dropped");
            }
            self.dropped += 1;
        }
    }

    fn warn(&mut self, text: String) {
        if self.warnings.len() < WARNINGS {
            self.warnings.push(text);
        }
    }
}

impl Listener for JsonLines {
    fn on_event(&mut self, event: &StationEvent) {
        let last = self.end.is_here(event);
        match event {
            StationEvent::Answer(answer) => self.print(Some(&**answer)),
            StationEvent::Change(change) => self.print(Some(&**change)),
            StationEvent::Enrolled(enrolled) => self.print(Some(enrolled)),
            StationEvent::Finished(_) if !self.warnings.is_empty() => self.print(None::<&()>),
            StationEvent::Warning(warning) => self.warn(warning.text.clone()),
            StationEvent::Unnamed(answer) => self.warn(answer.not_named()),
            _ => {}
        }
        if last {
            self.lines = None;
        }
    }
}

impl Drop for JsonLines {
    fn drop(&mut self) {
        self.lines = None;
        self.end.wait(if self.waits { Duration::MAX } else { PATIENCE });
        if self.dropped > 0 {
            tracing::warn!("lines of JSON that nobody read: {}", self.dropped);
        }
    }
}
