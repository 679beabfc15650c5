//! Texts for people on stderr: summaries, progress, advice.

use std::io::Write;
use std::path::Path;
use std::sync::Mutex;

use indicatif::{ProgressBar, ProgressStyle};

use crate::evaluate::{LeftOutSources, Share};
use crate::library::Library;
use crate::printable;
use crate::station::{Answer, AnswerState};

/// Says what a library holds, and what was skipped.
pub fn library(library: &Library) {
    let trials = counted(library.entries.len(), "trial");
    let surfaces = counted(library.surfaces().len(), "surface");
    let mark = if library.synthetic { " (synthetic)" } else { "" };
    say!("{}{mark}: {trials} of {surfaces}", library.name);
    for remark in &library.remarks {
        say!("  {remark}");
    }
}

/// Prints one JSON document on stdout.
///
/// A reader that has gone away (`| head`) wants no more: the program ends there.
pub fn json(value: &impl serde::Serialize) {
    if writeln!(std::io::stdout(), "{}", json_text(value)).is_err() {
        std::process::exit(1);
    }
}

/// The JSON text of one document, or of one line in a stream.
pub fn json_text(value: &impl serde::Serialize) -> String {
    // Plain structs, numbers and text: nothing here that JSON cannot express.
    serde_json::to_string(value).expect("plain data")
}

/// Warns which sources were left out of queries, and why; returns the same lines.
pub fn left_out(left_out: &LeftOutSources) -> Vec<String> {
    let lines = left_out.iter().filter_map(|(remark, trials)| {
        let more = match trials.len() {
            0 | 1 => String::new(),
            several => format!(" and {} more", several - 1),
        };
        trials.first().map(|first| format!("{remark} ({first}{more})"))
    });
    let lines: Vec<String> = lines.collect();
    lines.iter().for_each(|line| say!("warning: {line}"));
    lines
}

/// Says which files were written.
pub fn wrote<P: AsRef<Path>>(files: &[P]) {
    let names: Vec<String> = files.iter().map(|file| shown(file.as_ref())).collect();
    say!("wrote {}", names.join(", "));
}

/// Says what to do next.
pub fn next(what: &str) {
    say!("next: {what}");
}

/// A path, quoted for a shell where necessary.
pub fn quoted(path: &Path) -> String {
    printable::quoted(&shown(path))
}

/// A number of things: `1 trial`, `2 trials`.
pub fn counted(number: usize, thing: &str) -> String {
    format!("{number} {thing}{}", if number == 1 { "" } else { "s" })
}

/// A fraction as a percentage.
pub fn percent(fraction: f64) -> String {
    format!("{:.1} %", fraction * 100.0)
}

/// The 95 % interval of a share: `93.6 % to 98.6 %`.
pub fn interval(share: Share) -> String {
    let (low, high) = share.interval();
    format!("{} to {}", percent(low), percent(high))
}

/// An answer in a word or two: the surface, and whether the name stands.
pub fn named(answer: &Answer) -> String {
    let surface = answer.surface.as_deref().unwrap_or("unknown");
    match answer.state {
        AnswerState::Named | AnswerState::Unknown => surface.into(),
        AnswerState::Unnamed => "not named".into(),
        AnswerState::Nearest => format!("nearest: {surface}"),
        AnswerState::Unsure => format!("unsure: {surface}"),
    }
}

/// The certainty of an answer: `fits none` for an unknown surface, its probability where the method
/// states one, else the margin to the next surface.
pub fn certainty(answer: &Answer) -> String {
    match answer.confidence {
        _ if answer.surface.is_none() => "fits none".into(),
        Some(probability) if probability > 0.999 => "over 99.9 %".into(),
        Some(probability) => percent(probability),
        None => format!("margin {:.2}", answer.margin),
    }
}

/// A progress bar on stderr, one for each step of some work; it appears only on a terminal.
pub struct Steps(Mutex<Option<(&'static str, ProgressBar)>>);

impl Steps {
    /// A progress bar without a step yet.
    pub fn new() -> Self {
        Self(Mutex::new(None))
    }

    /// Shows how much of a step is done.
    pub fn show(&self, step: &'static str, done: usize, of: usize) {
        // A thread that panicked while it held the lock left a bar that can still be drawn.
        let mut bar = self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if bar.as_ref().is_none_or(|(name, _)| *name != step) {
            if let Some((_, old)) = bar.take() {
                old.finish_and_clear();
            }
            let style = ProgressStyle::with_template("{msg} {bar:40} {pos}/{len} · {eta} left");
            let style = style.unwrap_or_else(|_| ProgressStyle::default_bar());
            let new = ProgressBar::new(of as u64).with_style(style).with_message(step);
            *bar = Some((step, new));
        }
        if let Some((_, bar)) = bar.as_ref() {
            bar.set_position(done as u64);
        }
    }
}

impl Drop for Steps {
    fn drop(&mut self) {
        if let Ok(Some((_, bar))) = self.0.get_mut() {
            bar.finish_and_clear();
        }
    }
}

/// A file that a person named, for messages.
pub(super) fn shown(path: &Path) -> String {
    path.display().to_string()
}
