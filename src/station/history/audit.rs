//! The audit log: who changed what, with one line of JSON for each change. It lies beside the log of
//! answers as `audit.jsonl`. Lines are only ever added, and none is removed to make room for scans.
//!
//! ```text
//! {"unix_ms": 1790000012000, "person": "anna", "role": "operator", "action": "correct",
//!  "subject": "20260921-143000.001-01", "before": null, "after": "ash"}
//! ```

use std::collections::VecDeque;
use std::io::{self, Write};
use std::path::Path;
use std::time::SystemTime;

use serde::Serialize;
use serde_json::{Map, Value};

use super::log::Log;
use super::{History, HistoryError, MOST_IN_MEMORY};
use crate::printable::json_text;
use crate::system::lock;
use crate::trial::unix_ms;

const FILE: &str = "audit.jsonl";
/// Longest text of a record, in characters, so that a record takes at most some 10 kB.
const LONGEST_TEXT: usize = 400;
/// Usual length of a line, in bytes. More is read where lines are longer.
const USUAL_LINE: u64 = 256;

/// The rights of a client.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Sees everything, begins and ends scans, and corrects them.
    Operator,
    Administrator,
}

/// Who asks for a change.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Actor {
    pub role: Role,
    /// The name that the client gave; `None` if it gave none.
    pub person: Option<String>,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AuditRecord {
    unix_ms: u64,
    person: Option<String>,
    role: Role,
    action: &'static str,
    /// The id of the scan, or the surface or trial, that was changed.
    subject: Option<String>,
    before: Option<String>,
    after: Option<String>,
}

impl AuditRecord {
    /// A change that was made just now. Texts of more than 400 characters are cut short.
    pub fn now(
        actor: &Actor,
        action: &'static str,
        subject: Option<&str>,
        (before, after): (Option<&str>, Option<&str>),
    ) -> Self {
        let Actor { role, person } = actor.clone();
        let [subject, before, after] = [subject, before, after].map(|text| text.map(short));
        let unix_ms = unix_ms(SystemTime::now());
        Self { unix_ms, person, role, action, subject, before, after }
    }
}

fn short(text: &str) -> String {
    match text.char_indices().nth(LONGEST_TEXT) {
        Some((at, _)) => format!("{}…", &text[..at]),
        None => text.into(),
    }
}

/// A record as it was written, perhaps by another version, with its `id`.
type Row = Map<String, Value>;

/// The records, on disk or, by default, the last 1000 in memory.
#[derive(Debug, Default)]
pub(super) struct AuditLog {
    log: Option<Log>,
    /// Lines that are not on disk: those that could not be written yet, or all without a disk.
    unwritten: VecDeque<String>,
    /// Without a disk, the bytes of the lines that were dropped, which stand before the others.
    dropped: u64,
}

impl AuditLog {
    pub(super) fn open(folder: &Path) -> Result<Self, HistoryError> {
        Ok(Self { log: Some(Log::open(&folder.join(FILE), false)?), ..Self::default() })
    }

    fn add(&mut self, record: &AuditRecord) -> Result<(), HistoryError> {
        self.unwritten.push_back(json_text(record));
        if self.unwritten.len() > MOST_IN_MEMORY {
            let line = self.unwritten.pop_front().unwrap_or_default();
            self.dropped += line.len() as u64 + 1;
        }
        self.write()
    }

    /// Writes the lines that are not on disk yet.
    fn write(&mut self) -> Result<(), HistoryError> {
        let Some(log) = &mut self.log else { return Ok(()) };
        while let Some(line) = self.unwritten.front() {
            log.append(line)?;
            self.unwritten.pop_front();
        }
        Ok(())
    }

    /// The records that are not on disk, the oldest first. Each has the id that it would have there.
    fn waiting(&self) -> Vec<Row> {
        let mut at = self.log.as_ref().map_or(self.dropped, |log| log.bytes);
        let mut rows = Vec::new();
        for line in &self.unwritten {
            rows.extend(row(line.as_bytes(), at));
            at += line.len() as u64 + 1;
        }
        rows
    }

    fn newest(&self, before: u64, most: usize) -> Result<Vec<Row>, HistoryError> {
        let mut waiting = self.waiting();
        waiting.retain(|row| row["id"].as_u64() < Some(before));
        let Some(log) = &self.log else {
            return Ok(waiting.into_iter().rev().take(most).collect());
        };
        let end = before.min(log.bytes);
        let mut span = USUAL_LINE.saturating_mul(most as u64);
        loop {
            let begin = end.saturating_sub(span);
            let mut rows = Vec::new();
            log.each(begin..end, |line, at| {
                rows.extend(row(line, at.offset));
                Ok(())
            })?;
            if rows.len() >= most || begin == 0 {
                rows.append(&mut waiting);
                return Ok(rows.into_iter().rev().take(most).collect());
            }
            span = span.saturating_mul(4);
        }
    }
}

/// The record of a line. Its id is its place in the file, so that later records have greater ids.
fn row(line: &[u8], id: u64) -> Option<Row> {
    let mut row: Row = serde_json::from_slice(line).ok()?;
    row.insert("id".into(), id.into());
    Some(row)
}

impl History {
    /// Adds records of changes that were made. A record that cannot be written to disk is tried again
    /// with the next one, and every few seconds.
    pub fn note_changes(&self, records: impl IntoIterator<Item = AuditRecord>) {
        let mut log = lock(&self.audit);
        for record in records {
            if let Err(error) = log.add(&record) {
                tracing::warn!("a change is not yet in the audit log: {error}");
            }
        }
    }

    pub(super) fn write_waiting_changes(&self) {
        // That they wait was said when they were made.
        let _ = lock(&self.audit).write();
    }

    /// At most `most` records of changes, the newest first. With `before`, all are older than the
    /// record with that id.
    pub fn changes(&self, before: Option<u64>, most: usize) -> Result<Vec<Row>, HistoryError> {
        lock(&self.audit).newest(before.unwrap_or(u64::MAX), most)
    }

    /// Writes all records of changes, the oldest first, with a line of JSON for each.
    pub fn write_changes(&self, mut out: impl Write) -> io::Result<()> {
        let (log, others) = {
            let audit = lock(&self.audit);
            (audit.log.as_ref().map(Log::share).transpose()?, audit.waiting())
        };
        if let Some(log) = log {
            log.each(0..log.bytes, |line, at| match row(line, at.offset) {
                Some(row) => writeln!(out, "{}", json_text(&row)),
                None => Ok(()),
            })?;
        }
        for row in others {
            writeln!(out, "{}", json_text(&row))?;
        }
        out.flush()
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn note(history: &History, subject: &str) {
        let anna = Actor { role: Role::Operator, person: Some("anna".into()) };
        let change = (None, Some("ash"));
        history.note_changes([AuditRecord::now(&anna, "correct", Some(subject), change)]);
    }

    fn subjects(rows: &[Row]) -> Vec<&str> {
        rows.iter().map(|row| row["subject"].as_str().unwrap()).collect()
    }

    #[test]
    fn changes_are_there_after_a_restart_and_a_line_that_was_cut_short_spoils_no_other() {
        let dir = tempfile::tempdir().unwrap();
        {
            let history = History::open(dir.path(), 1 << 20).unwrap();
            ["a", "b"].iter().for_each(|subject| note(&history, subject));
        }
        let path = dir.path().join(FILE);
        fs::write(&path, fs::read_to_string(&path).unwrap() + "{\"unix_ms\": 1, \"per").unwrap();
        let history = History::open(dir.path(), 1 << 20).unwrap();
        note(&history, "c");
        let rows = history.changes(None, 10).unwrap();
        assert_eq!(subjects(&rows), ["c", "b", "a"]);
        let first = &rows[2];
        assert_eq!((&first["role"], &first["person"]), (&"operator".into(), &"anna".into()));
        assert_eq!((&first["before"], &first["after"]), (&Value::Null, &"ash".into()));
        let mut text = Vec::new();
        history.write_changes(&mut text).unwrap();
        let text = String::from_utf8(text).unwrap();
        let all: Vec<Row> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        assert_eq!(subjects(&all), ["a", "b", "c"]);
    }

    #[test]
    fn a_change_that_a_full_disk_refused_is_listed_and_written_once_there_is_room() {
        let dir = tempfile::tempdir().unwrap();
        let history = History::open(dir.path(), 1 << 20).unwrap();
        note(&history, "a");
        let refused = |subject: &str| format!("{{\"subject\": \"{subject}\"}}");
        lock(&history.audit).unwritten = ["b", "c"].map(refused).into();
        let waiting = history.changes(None, 2).unwrap();
        assert_eq!(subjects(&waiting), ["c", "b"]);
        let older = history.changes(waiting[1]["id"].as_u64(), 2).unwrap();
        assert_eq!(subjects(&older), ["a"]);
        history.write_waiting_changes();
        assert!(lock(&history.audit).unwritten.is_empty());
        assert_eq!(history.changes(None, 2).unwrap(), waiting);
    }

    #[test]
    fn changes_are_listed_by_page_without_a_gap_on_disk_and_in_memory() {
        let dir = tempfile::tempdir().unwrap();
        for history in [History::open(dir.path(), 1 << 20).unwrap(), History::default()] {
            let names: Vec<String> = (0..40).map(|n| format!("{n}").repeat(1 + n)).collect();
            names.iter().for_each(|name| note(&history, name));
            let (mut before, mut found) = (None, Vec::<String>::new());
            loop {
                let rows = history.changes(before, 7).unwrap();
                let Some(last) = rows.last() else { break };
                before = last["id"].as_u64();
                found.extend(rows.into_iter().map(|row| row["subject"].as_str().unwrap().into()));
            }
            found.reverse();
            assert_eq!(names, found);
        }
    }

    #[test]
    fn a_record_is_bounded_and_memory_holds_the_newest() {
        let history = History::default();
        note(&history, &"é".repeat(LONGEST_TEXT + 1));
        let rows = history.changes(None, 1).unwrap();
        assert_eq!(rows[0]["subject"], format!("{}…", "é".repeat(LONGEST_TEXT)));
        (0..MOST_IN_MEMORY + 5).for_each(|n| note(&history, &n.to_string()));
        assert_eq!(history.changes(None, usize::MAX).unwrap().len(), MOST_IN_MEMORY);
    }
}
