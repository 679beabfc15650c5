//! The answers of a history, held in memory. Each change is also written to the log on disk.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use super::HistoryError;
use super::drift::{Drift, Reading, surface_of};
use super::folder::Disk;
use super::log::{HistoryEntry, HistoryRow, Log, LogLine, Span, Text};
use crate::printable::json_text;
use crate::record::folder_name::is_plain;

#[derive(Debug, Default)]
pub(super) struct HistoryState {
    /// The oldest first.
    pub entries: VecDeque<HistoryEntry>,
    pub disk: Option<Disk>,
    pub signals: u64,
    /// Why the last write failed; `None` once a write succeeds again.
    pub problem: Option<String>,
    /// The reference surfaces, each with the moment from which its scans count.
    pub references: BTreeMap<String, u64>,
    /// The values of reference scans that were read already, by surface and id; `None` for a scan that
    /// lacks data.
    pub readings: BTreeMap<(String, String), Option<Reading>>,
    /// The drift by all reference scans; `None` if one came or changed since it was computed.
    pub drift: Option<Arc<Drift>>,
}

impl HistoryState {
    pub(super) fn change(&mut self, line: LogLine) -> Result<(), HistoryError> {
        let span = self.disk.as_mut().map(|disk| disk.log.append(&json_text(&line))).transpose()?;
        self.take(line, span.unwrap_or_default());
        Ok(())
    }

    /// Applies the lines in the last `most` bytes of a log.
    pub(super) fn take_log(&mut self, log: &Log, most: u64) -> Result<(), HistoryError> {
        for (line, span) in log.read::<LogLine>(most)? {
            if is_plain(line.id()) {
                self.take(line, span);
            }
        }
        Ok(())
    }

    pub(super) fn take(&mut self, line: LogLine, span: Span) {
        if let LogLine::Answer(head) = line {
            return self.entries.push_back(HistoryEntry::new(head, Text::InLog(span)));
        }
        // The search begins at the newest answer, since most changes are to a new answer.
        let changed = self.entries.iter_mut().rev().find(|entry| entry.head.id == line.id());
        let Some(entry) = changed else { return };
        match line {
            LogLine::Answer(_) => {}
            LogLine::Signals { bytes, .. } => {
                self.signals = self.signals + bytes.unwrap_or(0) - entry.signals.unwrap_or(0);
                entry.signals = bytes;
            }
            LogLine::Correction { correction, .. } => {
                entry.correction = correction;
                self.drift = None;
            }
            LogLine::Trial { trial, person, .. } => {
                (entry.became, entry.became_by) = (trial, person);
            }
        }
    }

    /// The index of the scan with the id `name` or, if `name` is a number, of the newest so numbered.
    pub(super) fn position(&self, name: &str) -> Option<usize> {
        let number: Option<u32> = name.parse().ok();
        let is = |entry: &HistoryEntry| match number {
            Some(number) => entry.head.scan == number,
            None => entry.head.id == name,
        };
        self.entries.iter().rposition(is)
    }

    pub(super) fn find(&self, name: &str) -> Result<&HistoryEntry, HistoryError> {
        let at = self.position(name).ok_or_else(|| HistoryError::NoScan(name.into()))?;
        Ok(&self.entries[at])
    }

    pub(super) fn row(&self, entry: &HistoryEntry) -> Result<HistoryRow, HistoryError> {
        let text = entry.text.read(self.disk.as_ref().map(|disk| &disk.log))?;
        let damaged = || HistoryRow { head: entry.head.clone(), ..HistoryRow::default() };
        Ok(HistoryRow {
            correction: entry.correction.clone(),
            became: entry.became.clone(),
            became_by: entry.became_by.clone(),
            kept: entry.signals.is_some(),
            ..serde_json::from_str(&text).unwrap_or_else(|_| damaged())
        })
    }

    /// The reference surface that a scan was, if it counts.
    fn reference_of(&self, entry: &HistoryEntry) -> Option<&str> {
        let (surface, since) = self.references.get_key_value(surface_of(entry)?)?;
        (entry.head.unix_ms >= *since).then_some(surface)
    }

    pub(super) fn drift(&mut self) -> Arc<Drift> {
        if let Some(drift) = &self.drift {
            return drift.clone();
        }
        // The readings of answers that are no longer held are dropped.
        let (mut known, mut readings) = (std::mem::take(&mut self.readings), BTreeMap::new());
        let mut all: BTreeMap<&str, Vec<Reading>> = BTreeMap::new();
        for entry in &self.entries {
            let Some(surface) = self.reference_of(entry) else { continue };
            let key = (surface.to_string(), entry.head.id.clone());
            // A scan that cannot be read counts as one that lacks data.
            let read = || self.row(entry).ok().and_then(|row| Reading::of(row, surface));
            let reading = known.remove(&key).unwrap_or_else(read);
            all.entry(surface).or_default().extend(reading.clone());
            readings.insert(key, reading);
        }
        let of = |(surface, since): (&String, &u64)| {
            (surface.clone(), *since, all.remove(surface.as_str()).unwrap_or_default())
        };
        let drift = Arc::new(Drift::of(&self.references.iter().map(of).collect::<Vec<_>>()));
        (self.readings, self.drift) = (readings, Some(drift.clone()));
        drift
    }

    /// Removes the oldest signals until the history and the disk have room.
    pub(super) fn make_room(&mut self) -> Result<(), HistoryError> {
        let lacking = self.disk.as_ref().map_or(0, Disk::lacks);
        self.let_go(lacking)
    }

    /// Like [`Self::make_room`], but removes signals of at least `lacking` bytes, the oldest first.
    pub(super) fn let_go(&mut self, lacking: u64) -> Result<(), HistoryError> {
        let Some(disk) = &mut self.disk else { return Ok(()) };
        let for_answers = disk.for_answers();
        let most = (disk.most_bytes - for_answers).min(self.signals.saturating_sub(lacking));
        while self.signals > most {
            let Some(entry) = self.entries.iter_mut().find(|entry| entry.signals.is_some()) else {
                break;
            };
            disk.remove_signals(&entry.head.id)?;
            let id = entry.head.id.clone();
            disk.log.append(&json_text(&LogLine::Signals { id, bytes: None }))?;
            self.signals -= entry.signals.take().unwrap_or(0);
        }
        Ok(())
    }

    /// Removes the oldest answers from a log that has grown too long. Not called before the reference
    /// surfaces are known, since their first scans stay.
    pub(super) fn bound_log(&mut self) -> Result<(), HistoryError> {
        let Some(disk) = &self.disk else { return Ok(()) };
        match disk.for_answers() {
            most_bytes if disk.log.bytes > most_bytes => self.shorten(most_bytes / 2),
            _ => Ok(()),
        }
    }

    /// Rewrites the log with as many of the newest answers as fit into `most_bytes`.
    fn shorten(&mut self, most_bytes: u64) -> Result<(), HistoryError> {
        let mut bytes = 0;
        let fits = |entry: &&HistoryEntry| {
            bytes += entry.text.bytes();
            bytes <= most_bytes
        };
        let old = self.entries.len() - self.entries.iter().rev().take_while(fits).count();
        // The first reference scans stay, since later ones are compared with them.
        let mut room = most_bytes / 2;
        let mut is_first = |entry: &HistoryEntry| {
            let fits = self.reference_of(entry).is_some() && entry.text.bytes() <= room;
            room -= if fits { entry.text.bytes() } else { 0 };
            fits
        };
        let firsts: Vec<bool> = self.entries.iter().take(old).map(&mut is_first).collect();
        let Some(disk) = &mut self.disk else { return Ok(()) };
        for entry in self.entries.iter_mut().take(old) {
            if let Some(bytes) = entry.signals {
                disk.remove_signals(&entry.head.id)?;
                self.signals -= bytes;
                entry.signals = None;
            }
        }
        let mut firsts = firsts.into_iter();
        self.entries.retain(|_| firsts.next().unwrap_or(true));
        let (mut fresh, mut texts) = (disk.log.begin_anew()?, Vec::new());
        for entry in &self.entries {
            let (text, written) = fresh.append_answer(entry.text.read(Some(&disk.log))?);
            written?;
            texts.push(text);
            let id = || entry.head.id.clone();
            let (bytes, correction) = (entry.signals, entry.correction.clone());
            let (trial, person) = (entry.became.clone(), entry.became_by.clone());
            let is_or_was_trial = trial.is_some() || person.is_some();
            let changes = [
                bytes.is_some().then(|| LogLine::Signals { id: id(), bytes }),
                correction.is_some().then(|| LogLine::Correction { id: id(), correction }),
                is_or_was_trial.then(|| LogLine::Trial { id: id(), trial, person }),
            ];
            for line in changes.into_iter().flatten() {
                fresh.append(&json_text(&line))?;
            }
        }
        disk.log.replace(fresh)?;
        // Until now, the texts are in the old log, which stays in use if the new one cannot be written.
        self.entries.iter_mut().zip(texts).for_each(|(entry, text)| entry.text = text);
        Ok(())
    }
}
