//! The answers that wait for one output, in a file: they survive a restart, in their order.
//!
//! ```text
//! {"head": {"next": 12, "dropped": 0}}        where a file begins that took the place of a longer one
//! {"answer": {"sequence": 12, …}}             an answer as it is sent
//! {"done": 12}                                it arrived, and so did those before
//! ```

use std::collections::VecDeque;
use std::fs::File;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::history::HistoryError;
use crate::history::log::{Log, Span, hold};

/// Most bytes of answers that wait; the oldest make room.
const MOST: u64 = 64 << 20;
/// A file of answers that arrived is begun anew from this size on.
const SPENT: u64 = 1 << 20;

/// The answers that wait, the oldest first.
#[derive(Debug)]
pub(super) struct Outbox {
    log: Log,
    waiting: VecDeque<(u64, Text)>,
    /// The number of the next answer.
    next: u64,
    /// Answers that made room for newer ones.
    dropped: u64,
    /// Bytes of those that wait.
    bytes: u64,
    most: u64,
    /// Held for as long as the file is in use.
    _lock: File,
}

#[derive(Debug)]
enum Text {
    InLog(Span),
    /// The disk did not take it.
    Here(String),
}

impl Text {
    fn bytes(&self) -> u64 {
        match self {
            Self::InLog(span) => u64::from(span.length),
            Self::Here(text) => text.len() as u64,
        }
    }
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Line {
    Head(Head),
    Answer(Numbered),
    Done(u64),
}

#[derive(Clone, Copy, Serialize, Deserialize)]
struct Head {
    next: u64,
    dropped: u64,
}

#[derive(Serialize, Deserialize)]
struct Numbered {
    sequence: u64,
}

impl Outbox {
    /// The answers that wait for the output of a name, in a folder that is made if need be.
    ///
    /// # Errors
    /// If the folder cannot be read or written, or another program sends from it.
    pub fn open(folder: &Path, output: &str) -> Result<Self, HistoryError> {
        Self::of_at_most(folder, output, MOST)
    }

    fn of_at_most(folder: &Path, output: &str, most: u64) -> Result<Self, HistoryError> {
        let lock = hold(folder, &format!("{output}.lock"))?;
        let log = Log::open(&folder.join(format!("{output}.jsonl")), false)?;
        let (waiting, next) = (VecDeque::new(), 1);
        let mut outbox = Self { log, waiting, next, dropped: 0, bytes: 0, most, _lock: lock };
        for (line, span) in outbox.log.read(u64::MAX)? {
            match line {
                Line::Head(Head { next, dropped }) => {
                    (outbox.next, outbox.dropped) = (next, dropped)
                }
                Line::Answer(Numbered { sequence }) => outbox.add(sequence, Text::InLog(span)),
                Line::Done(sequence) => outbox.forget(sequence),
            }
        }
        outbox.tidy()?;
        Ok(outbox)
    }

    /// Adds the answer that `text` gives for its number.
    ///
    /// # Errors
    /// If it cannot be written; it waits in memory then.
    pub fn push(&mut self, text: impl FnOnce(u64) -> String) -> Result<(), HistoryError> {
        let sequence = self.next;
        let text = text(sequence);
        let written = self.log.append(&format!("{{\"answer\":{text}}}"));
        let (text, written) = match written {
            Ok(span) => (Text::InLog(span), Ok(())),
            Err(error) => (Text::Here(text), Err(error)),
        };
        self.add(sequence, text);
        written.and_then(|()| self.tidy())
    }

    fn add(&mut self, sequence: u64, text: Text) {
        self.bytes += text.bytes();
        self.waiting.push_back((sequence, text));
        self.next = sequence + 1;
        while self.bytes > self.most && self.waiting.len() > 1 {
            self.dropped += 1;
            self.pop();
        }
    }

    fn pop(&mut self) {
        let gone = self.waiting.pop_front();
        self.bytes -= gone.map_or(0, |(_, text)| text.bytes());
    }

    fn forget(&mut self, sequence: u64) {
        while self.waiting.front().is_some_and(|(first, _)| *first <= sequence) {
            self.pop();
        }
    }

    /// The oldest answer, with its number.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn first(&self) -> Result<Option<(u64, String)>, HistoryError> {
        let Some((sequence, text)) = self.waiting.front() else { return Ok(None) };
        let text = match text {
            Text::InLog(span) => self.log.answer_text(*span)?,
            Text::Here(text) => text.clone(),
        };
        Ok(Some((*sequence, text)))
    }

    /// Notes that the answer of a number arrived, or never will.
    ///
    /// # Errors
    /// If that cannot be written: after a restart it would be sent again.
    pub fn done(&mut self, sequence: u64) -> Result<(), HistoryError> {
        self.forget(sequence);
        // Plain numbers: nothing here that JSON cannot express.
        self.log.append(&serde_json::to_string(&Line::Done(sequence)).unwrap_or_default())?;
        self.tidy()
    }

    /// Begins the file anew where most of it has arrived.
    fn tidy(&mut self) -> Result<(), HistoryError> {
        if self.log.bytes() < 2 * self.bytes + SPENT {
            return Ok(());
        }
        let mut fresh = self.log.begin_anew()?;
        let (next, dropped) =
            (self.waiting.front().map_or(self.next, |(first, _)| *first), self.dropped);
        fresh.append(
            &serde_json::to_string(&Line::Head(Head { next, dropped })).unwrap_or_default(),
        )?;
        let mut places = Vec::new();
        for (_, text) in &self.waiting {
            let line = match text {
                Text::InLog(span) => self.log.line(*span)?,
                Text::Here(text) => format!("{{\"answer\":{text}}}"),
            };
            places.push(Text::InLog(fresh.append(&line)?));
        }
        self.log.replace(fresh)?;
        self.waiting.iter_mut().zip(places).for_each(|((_, text), place)| *text = place);
        self.bytes = self.waiting.iter().map(|(_, text)| text.bytes()).sum();
        Ok(())
    }

    /// How many answers wait.
    pub fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// How many made room for newer ones.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    /// The number of the newest answer; 0 before the first.
    pub fn newest(&self) -> u64 {
        self.next - 1
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn text(sequence: u64, length: usize) -> String {
        format!("{{\"sequence\":{sequence},\"text\":\"{}\"}}", "x".repeat(length))
    }

    fn all(outbox: &mut Outbox) -> Vec<u64> {
        let mut all = Vec::new();
        while let Some((sequence, text)) = outbox.first().unwrap() {
            let said: serde_json::Value = serde_json::from_str(&text).unwrap();
            assert_eq!(said["sequence"], sequence);
            all.push(sequence);
            outbox.done(sequence).unwrap();
        }
        all
    }

    #[test]
    fn answers_that_did_not_arrive_wait_through_restarts_in_their_order_and_numbers_go_on() {
        let dir = tempfile::tempdir().unwrap();
        let mut outbox = Outbox::open(dir.path(), "mqtt").unwrap();
        (0..5).for_each(|_| outbox.push(|n| text(n, 10)).unwrap());
        outbox.done(2).unwrap();
        assert!(matches!(Outbox::open(dir.path(), "mqtt"), Err(HistoryError::InUse(_))));
        drop(outbox);
        // A crash cut the last line short.
        let file = dir.path().join("mqtt.jsonl");
        fs::write(&file, fs::read_to_string(&file).unwrap() + "{\"answer\":{\"sequence\":6,")
            .unwrap();
        let mut outbox = Outbox::open(dir.path(), "mqtt").unwrap();
        outbox.push(|n| text(n, 10)).unwrap();
        assert_eq!(all(&mut outbox), [3, 4, 5, 6]);
        drop(outbox);
        let mut outbox = Outbox::open(dir.path(), "mqtt").unwrap();
        assert_eq!((outbox.waiting(), outbox.newest()), (0, 6));
        outbox.push(|n| text(n, 10)).unwrap();
        assert_eq!(all(&mut outbox), [7]);
    }

    #[test]
    fn the_oldest_make_room_and_are_counted_and_the_file_stays_small() {
        let dir = tempfile::tempdir().unwrap();
        let mut outbox = Outbox::of_at_most(dir.path(), "mqtt", 100_000).unwrap();
        (0..5000).for_each(|_| outbox.push(|n| text(n, 1000)).unwrap());
        let (waiting, dropped) = (outbox.waiting() as u64, outbox.dropped());
        assert!((90..=100).contains(&waiting) && waiting + dropped == 5000, "{waiting} {dropped}");
        let file = fs::metadata(dir.path().join("mqtt.jsonl")).unwrap().len();
        assert!(file < 200_000 + SPENT + 2000, "{file}");
        drop(outbox);
        let mut outbox = Outbox::of_at_most(dir.path(), "mqtt", 100_000).unwrap();
        assert_eq!((outbox.waiting() as u64, outbox.dropped()), (waiting, dropped));
        assert_eq!(all(&mut outbox), (dropped + 1..=5000).collect::<Vec<_>>());
        (0..2000).for_each(|_| {
            outbox.push(|n| text(n, 1000)).unwrap();
            let newest = outbox.newest();
            outbox.done(newest).unwrap();
        });
        assert!(fs::metadata(dir.path().join("mqtt.jsonl")).unwrap().len() < SPENT + 4000);
        assert_eq!(outbox.dropped(), dropped);
    }
}
