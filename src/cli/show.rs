//! Formats results, summaries and advice.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;
use std::path::Path;

use super::say;
use crate::evaluate::{LeftOutSources, Over};
use crate::library::Library;
use crate::printable;
pub(super) use crate::printable::{counted, json_text};
use crate::scene::SourceId;
use crate::station::{Answer, AnswerState};
use crate::trial::{Doubt, TrialKey};

/// Prints what a library contains, and what was skipped.
pub(super) fn library(library: &Library) {
    let (trials, surfaces) = (library.entries.len(), library.surfaces().len());
    say!("{}", summary(&library.name, library.synthetic, trials, surfaces));
    library.remarks.iter().for_each(|remark| say!("  {remark}"));
}

pub(super) fn summary(name: &str, synthetic: bool, trials: usize, surfaces: usize) -> String {
    let mark = if synthetic { " (synthetic)" } else { "" };
    format!("{name}{mark}: {} of {}", counted(trials, "trial"), counted(surfaces, "surface"))
}

/// Prints one JSON document on stdout.
///
/// If the reader has closed stdout (as `| head` does), the program ends here.
pub(super) fn json(value: &impl serde::Serialize) {
    say::end_progress();
    if writeln!(std::io::stdout(), "{}", json_text(value)).is_err() {
        std::process::exit(1);
    }
}

/// Shows the result of a command on stdout: as one JSON document, or as `print` shows it to people.
pub(super) fn result<T: serde::Serialize>(as_json: bool, value: &T, print: impl FnOnce(&T)) {
    if as_json { json(value) } else { print(value) }
}

/// A report, and what it was made by.
#[derive(serde::Serialize, serde::Deserialize)]
pub(super) struct Made<T> {
    #[serde(flatten)]
    pub(super) of: T,
    #[serde(default)]
    made_by: MadeBy,
}

#[derive(Default, serde::Serialize, serde::Deserialize)]
struct MadeBy {
    version: String,
    command: String,
    seed: u64,
    /// The digest of the trials that were used; see [`Library::digest`].
    library: String,
}

impl<T> Made<T> {
    /// A report that this program made by its command line, from the library with this digest.
    pub(super) fn new(of: T, seed: u64, library: String) -> Self {
        let words = std::env::args_os().skip(1);
        let words = words.map(|word| printable::quoted(&word.to_string_lossy()));
        let command = joined(std::iter::once("surfaced".to_string()).chain(words), " ");
        let version = env!("CARGO_PKG_VERSION").into();
        Self { of, made_by: MadeBy { version, command, seed, library } }
    }
}

/// The sources that were left out of queries, and the reasons. There is one line for each source and
/// channel, even if the channel was stuck at many values.
pub(super) fn left_out(left_out: &LeftOutSources) -> Vec<String> {
    type Found<'a> = (BTreeSet<&'a TrialKey>, BTreeSet<String>);
    let mut kinds: BTreeMap<(Option<&SourceId>, usize), Found<'_>> = BTreeMap::new();
    for (trial, doubt) in left_out {
        let channel = if let Doubt::Stuck { channel, .. } = doubt { *channel } else { 0 };
        let (trials, texts) = kinds.entry((doubt.source(), channel)).or_default();
        trials.insert(trial);
        texts.insert(doubt.text());
    }
    let line = |((source, channel), (trials, texts)): ((Option<&SourceId>, usize), Found<'_>)| {
        let first = trials.first().map(ToString::to_string).unwrap_or_default();
        let more = match trials.len() {
            0 | 1 => String::new(),
            several => format!(" and {} more", several - 1),
        };
        let text = match texts.len() {
            2.. if channel > 0 => format!("channel {channel} is stuck; check its cable"),
            _ => texts.first().cloned().unwrap_or_default(),
        };
        match source {
            Some(source) => format!("{source} is left out: {text} ({first}{more})"),
            None => format!("not named: {text} ({first}{more})"),
        }
    };
    kinds.into_iter().map(line).collect()
}

pub(super) fn table(head: &[&str], rows: impl IntoIterator<Item = Vec<String>>) {
    result!("{}", printable::table(head, &rows.into_iter().collect::<Vec<_>>()).trim_end());
}

pub(super) fn wrote<P: AsRef<Path>>(files: &[P]) {
    say!("wrote {}", listed(files.iter().map(|file| file.as_ref().display())));
}

pub(super) fn listed<T: ToString>(things: impl IntoIterator<Item = T>) -> String {
    joined(things, ", ")
}

pub(super) fn joined<T: ToString>(things: impl IntoIterator<Item = T>, by: &str) -> String {
    things.into_iter().map(|thing| thing.to_string()).collect::<Vec<_>>().join(by)
}

pub(super) fn next(what: &str) {
    say!("next: {what}");
}

/// A path, quoted for a shell if necessary.
pub(super) fn quoted(path: &Path) -> String {
    printable::quoted(&path.display().to_string())
}

pub(super) fn percent(fraction: f64) -> String {
    format!("{:.1} %", fraction * 100.0)
}

/// An interval of shares, such as `93.6 % to 98.6 %`.
pub(super) fn ends((low, high): (f64, f64)) -> String {
    format!("{} to {}", percent(low), percent(high))
}

/// The scans that an interval is for.
pub(super) fn over(over: Over) -> String {
    match over {
        Over::Queries => "for more scans like these".into(),
        over => format!("for other {}", over.plural()),
    }
}

/// An answer in one or two words, for the surface and a mark of doubt.
pub(super) fn named(answer: &Answer) -> String {
    let surface = answer.surface.as_deref().unwrap_or("unknown");
    match answer.state {
        AnswerState::Named | AnswerState::Unknown => surface.into(),
        AnswerState::Unnamed => "not named".into(),
        AnswerState::Nearest => format!("nearest: {surface}"),
        AnswerState::Unsure => format!("unsure: {surface}"),
    }
}

/// Advice to drag longer, by the time that was missing; empty if the drag was long enough.
pub(super) fn longer(answer: &Answer) -> String {
    answer.more_s().map(|s| format!("  (drag {s:.1} s longer)")).unwrap_or_default()
}

/// The certainty of an answer. It is `fits none` for an unknown surface; for others the probability, or
/// the margin to the next surface if the method gives no probabilities.
pub(super) fn certainty(answer: &Answer) -> String {
    match answer.confidence {
        _ if answer.surface.is_none() => "fits none".into(),
        Some(probability) if probability > 0.999 => "over 99.9 %".into(),
        Some(probability) => percent(probability),
        None => format!("margin {:.2}", answer.margin),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_channel_that_is_stuck_at_many_values_is_warned_of_once() {
        let key = |number| TrialKey::new("oak", "anna", number);
        let source = SourceId::new("vel").unwrap();
        let stuck = |number, channel, value, share| {
            (key(number), Doubt::Stuck { source: source.clone(), channel, value, share })
        };
        let all = vec![stuck(3, 1, 0.5, 1.0), stuck(2, 1, -0.2, 0.5), stuck(4, 2, 0.0, 1.0)];
        let lines = [
            format!("vel is left out: channel 1 is stuck; check its cable ({} and 1 more)", key(2)),
            format!("vel is left out: channel 2 is stuck at 0; check its cable ({})", key(4)),
        ];
        assert_eq!(left_out(&all), lines);
    }
}
