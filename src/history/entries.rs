//! The answers of a history in memory, in step with its disk.

use std::collections::VecDeque;

use serde_json::{Map, Value};

use super::file::Disk;
use super::log::{Head, Log, LogLine, Span};
use super::{Correction, HistoryError};
use crate::record::edit::is_plain;

#[derive(Debug)]
pub(super) struct HistoryEntry {
    pub head: Head,
    pub text: Text,
    pub correction: Option<Correction>,
    /// The trial of the library that the scan became, as `SURFACE/TRIAL`.
    pub trial: Option<String>,
    /// Bytes of its signals on disk; `None` if they are not kept.
    pub signals: Option<u64>,
}

#[derive(Debug)]
pub(super) enum Text {
    Here(Box<str>),
    InLog(Span),
}

#[derive(Debug, Default)]
pub(super) struct HistoryState {
    /// The oldest first.
    pub entries: VecDeque<HistoryEntry>,
    pub disk: Option<Disk>,
    /// Bytes of all signals.
    pub signals: u64,
    /// The last failure to write, until it works again.
    pub problem: Option<String>,
}

/// How a line of the log changes an entry.
type Change = Box<dyn FnOnce(&mut HistoryEntry)>;

impl HistoryState {
    pub fn write(&mut self, line: &str) -> Result<Option<Span>, HistoryError> {
        self.disk.as_mut().map(|disk| disk.log.append(line)).transpose()
    }

    /// Writes a change to the log, then applies it.
    pub fn change(&mut self, line: LogLine) -> Result<(), HistoryError> {
        let span = self.write(&line.to_json())?;
        self.take(line, span.unwrap_or_default());
        Ok(())
    }

    /// Takes in the last `most` bytes of a log.
    pub fn take_log(&mut self, log: &Log, most: u64) -> Result<(), HistoryError> {
        for (line, span) in log.read::<LogLine>(most)? {
            if is_plain(line.id()) {
                self.take(line, span);
            }
        }
        Ok(())
    }

    /// Takes in what a line says.
    pub fn take(&mut self, line: LogLine, span: Span) {
        let (id, change): (String, Change) = match line {
            LogLine::Answer(head) => {
                let text = Text::InLog(span);
                let (correction, trial, signals) = (None, None, None);
                self.entries.push_back(HistoryEntry { head, text, correction, trial, signals });
                return;
            }
            LogLine::Signals { id, bytes } => (id, Box::new(move |entry| entry.signals = bytes)),
            LogLine::Correction { id, correction } => {
                (id, Box::new(move |entry| entry.correction = correction))
            }
            LogLine::Trial { id, trial } => (id, Box::new(move |entry| entry.trial = trial)),
        };
        // Most changes are to one of the newest.
        if let Some(entry) = self.entries.iter_mut().rev().find(|entry| entry.head.id == id) {
            let before = entry.signals.unwrap_or(0);
            change(entry);
            self.signals = self.signals + entry.signals.unwrap_or(0) - before;
        }
    }

    /// The index of the scan with this name, or of the newest one with this number.
    pub fn position(&self, name: &str) -> Option<usize> {
        let number: Option<u32> = name.parse().ok();
        let is = |entry: &HistoryEntry| match number {
            Some(number) => entry.head.scan == number,
            None => entry.head.id == name,
        };
        self.entries.iter().rposition(is)
    }

    pub fn find(&self, id: &str) -> Result<&HistoryEntry, HistoryError> {
        let at = self.position(id).ok_or_else(|| HistoryError::NoScan(id.into()))?;
        Ok(&self.entries[at])
    }

    /// An answer with its correction, its trial, and whether its signals are kept.
    pub fn json(&self, entry: &HistoryEntry) -> Result<Value, HistoryError> {
        let mut answer: Map<String, Value> = match (&entry.text, &self.disk) {
            (Text::Here(text), _) => serde_json::from_str(text).unwrap_or_default(),
            (Text::InLog(span), Some(disk)) => disk.log.answer(*span)?,
            (Text::InLog(_), None) => Map::new(),
        };
        let correction = serde_json::to_value(&entry.correction).unwrap_or_default();
        answer.insert("correction".into(), correction);
        answer.insert("became".into(), entry.trial.clone().into());
        answer.insert("kept".into(), entry.signals.is_some().into());
        Ok(Value::Object(answer))
    }

    /// Removes the oldest signals, and then the oldest answers, until the history fits its space
    /// and the disk has enough free space.
    pub fn make_room(&mut self) -> Result<(), HistoryError> {
        let lacking = self.disk.as_ref().map_or(0, Disk::lacks);
        self.let_go(lacking)
    }

    /// Makes room likewise, and removes at least `lacking` bytes of signals.
    pub fn let_go(&mut self, lacking: u64) -> Result<(), HistoryError> {
        let Some(disk) = &mut self.disk else { return Ok(()) };
        let for_answers = disk.for_answers();
        let most = (disk.most_bytes - for_answers).min(self.signals.saturating_sub(lacking));
        while self.signals > most {
            let Some(entry) = self.entries.iter_mut().find(|entry| entry.signals.is_some()) else {
                break;
            };
            disk.remove(&entry.head.id)?;
            let id = entry.head.id.clone();
            disk.log.append(&LogLine::Signals { id, bytes: None }.to_json())?;
            self.signals -= entry.signals.take().unwrap_or(0);
        }
        if disk.log.bytes() > for_answers {
            self.shorten(for_answers / 2)?;
        }
        Ok(())
    }

    /// Rewrites the log with as many of the newest answers as fit into `most_bytes`.
    fn shorten(&mut self, most_bytes: u64) -> Result<(), HistoryError> {
        let Some(disk) = &mut self.disk else { return Ok(()) };
        let length = |entry: &HistoryEntry| match &entry.text {
            Text::InLog(span) => u64::from(span.length),
            Text::Here(text) => text.len() as u64,
        };
        let mut left = self.entries.len();
        let mut bytes = 0;
        for entry in self.entries.iter().rev() {
            bytes += length(entry);
            if bytes > most_bytes {
                break;
            }
            left -= 1;
        }
        for entry in self.entries.drain(..left) {
            if let Some(bytes) = entry.signals {
                disk.remove(&entry.head.id)?;
                self.signals -= bytes;
            }
        }
        let mut fresh = disk.log.begin_anew()?;
        for entry in &mut self.entries {
            let answer = match &entry.text {
                Text::InLog(span) => disk.log.line(*span)?,
                Text::Here(text) => format!("{{\"answer\":{text}}}"),
            };
            let span = fresh.append(&answer)?;
            let id = || entry.head.id.clone();
            if entry.signals.is_some() {
                fresh.append(&LogLine::Signals { id: id(), bytes: entry.signals }.to_json())?;
            }
            if let Some(correction) = entry.correction.clone() {
                let correction = Some(correction);
                fresh.append(&LogLine::Correction { id: id(), correction }.to_json())?;
            }
            if let Some(trial) = entry.trial.clone() {
                fresh.append(&LogLine::Trial { id: id(), trial: Some(trial) }.to_json())?;
            }
            entry.text = Text::InLog(span);
        }
        disk.log.replace(fresh)
    }
}
