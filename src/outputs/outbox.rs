//! The answers that wait for one output. A file keeps them in order, and over a restart.
//!
//! ```text
//! {"head": {"next": 12, "dropped": 0}}        first line of a rewritten file
//! {"answer": {"sequence": 12, …}}             an answer, as it is sent
//! {"done": 12}                                answer 12 and all answers before it have arrived
//! ```

use std::collections::VecDeque;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::history::HistoryError;
use crate::history::log::{Log, Text};
use crate::printable::json_text;

/// The largest size of waiting answers, in bytes. To stay below, the oldest answers are dropped.
const MOST: u64 = 64 << 20;
/// The file is rewritten only if delivered answers take at least this many bytes of it.
const SPENT: u64 = 1 << 20;

#[derive(Debug)]
pub(super) struct Outbox {
    log: Log,
    waiting: VecDeque<(u64, Text)>,
    next: u64,
    /// Number of answers dropped to make room for newer ones.
    pub dropped: u64,
    waiting_bytes: u64,
    most: u64,
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Line {
    Head { next: u64, dropped: u64 },
    Answer { sequence: u64 },
    Done(u64),
}

impl Outbox {
    pub(super) fn open(folder: &Path, output: &str) -> Result<Self, HistoryError> {
        Self::of_at_most(folder, output, MOST)
    }

    fn of_at_most(folder: &Path, output: &str, most: u64) -> Result<Self, HistoryError> {
        let log = Log::hold(folder, &format!("{output}.jsonl"), &format!("{output}.lock"))?;
        let (waiting, next) = (VecDeque::new(), 1);
        let mut outbox = Self { log, waiting, next, dropped: 0, waiting_bytes: 0, most };
        for (line, span) in outbox.log.read(u64::MAX)? {
            match line {
                Line::Head { next, dropped } => (outbox.next, outbox.dropped) = (next, dropped),
                Line::Answer { sequence } => outbox.add(sequence, Text::InLog(span)),
                Line::Done(sequence) => outbox.forget(sequence),
            }
        }
        outbox.tidy()?;
        Ok(outbox)
    }

    /// Adds the answer that `text` returns for its number; it stays in memory if writing fails.
    pub(super) fn push(&mut self, text: impl FnOnce(u64) -> String) -> Result<(), HistoryError> {
        let sequence = self.next;
        let (text, written) = self.log.append_answer(text(sequence));
        self.add(sequence, text);
        written.and_then(|()| self.tidy())
    }

    fn add(&mut self, sequence: u64, text: Text) {
        self.waiting_bytes += text.bytes();
        self.waiting.push_back((sequence, text));
        self.next = sequence + 1;
        while self.waiting_bytes > self.most && self.waiting.len() > 1 {
            self.dropped += 1;
            self.pop();
        }
    }

    fn pop(&mut self) {
        let gone = self.waiting.pop_front();
        self.waiting_bytes -= gone.map_or(0, |(_, text)| text.bytes());
    }

    fn forget(&mut self, sequence: u64) {
        while self.waiting.front().is_some_and(|(first, _)| *first <= sequence) {
            self.pop();
        }
    }

    pub(super) fn first(&self) -> Result<Option<(u64, String)>, HistoryError> {
        let Some((sequence, text)) = self.waiting.front() else { return Ok(None) };
        Ok(Some((*sequence, text.read(Some(&self.log))?)))
    }

    /// Records that an answer has arrived, or was refused for good. If this cannot be written, the
    /// answer is sent again after a restart.
    pub(super) fn done(&mut self, sequence: u64) -> Result<(), HistoryError> {
        self.forget(sequence);
        self.log.append(&json_text(&Line::Done(sequence)))?;
        self.tidy()
    }

    /// Rewrites the file if most of its answers have arrived.
    fn tidy(&mut self) -> Result<(), HistoryError> {
        if self.log.bytes < 2 * self.waiting_bytes + SPENT {
            return Ok(());
        }
        let mut fresh = self.log.begin_anew()?;
        let next = self.waiting.front().map_or(self.next, |(first, _)| *first);
        fresh.append(&json_text(&Line::Head { next, dropped: self.dropped }))?;
        let mut places = Vec::new();
        for (_, text) in &self.waiting {
            let (place, written) = fresh.append_answer(text.read(Some(&self.log))?);
            written?;
            places.push(place);
        }
        self.log.replace(fresh)?;
        self.waiting.iter_mut().zip(places).for_each(|((_, text), place)| *text = place);
        self.waiting_bytes = self.waiting.iter().map(|(_, text)| text.bytes()).sum();
        Ok(())
    }

    pub(super) fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// The number of the newest answer; 0 before the first answer.
    pub(super) fn newest(&self) -> u64 {
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
        // Simulates a crash that cut off the last line.
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
        let (waiting, dropped) = (outbox.waiting() as u64, outbox.dropped);
        assert!((90..=100).contains(&waiting) && waiting + dropped == 5000, "{waiting} {dropped}");
        let file = fs::metadata(dir.path().join("mqtt.jsonl")).unwrap().len();
        assert!(file < 200_000 + SPENT + 2000, "{file}");
        drop(outbox);
        let mut outbox = Outbox::of_at_most(dir.path(), "mqtt", 100_000).unwrap();
        assert_eq!((outbox.waiting() as u64, outbox.dropped), (waiting, dropped));
        assert_eq!(all(&mut outbox), (dropped + 1..=5000).collect::<Vec<_>>());
        (0..2000).for_each(|_| {
            outbox.push(|n| text(n, 1000)).unwrap();
            let newest = outbox.newest();
            outbox.done(newest).unwrap();
        });
        assert!(fs::metadata(dir.path().join("mqtt.jsonl")).unwrap().len() < SPENT + 4000);
        assert_eq!(outbox.dropped, dropped);
    }
}
