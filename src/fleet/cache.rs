//! The answers of all stations, with a line each on disk, and an index of the lines in memory.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::history::HistoryError;
use crate::history::log::{Log, Span};
use crate::outputs::Sent;
use crate::record::folder_name::is_plain;
use crate::station::AnswerState;

const LOG: &str = "answers.jsonl";
const LONGEST_ID: usize = 64;

/// The fields of an answer that are read into memory.
#[derive(Clone, Debug, Deserialize, Serialize)]
pub(super) struct Head {
    #[serde(skip_serializing)]
    pub station: String,
    pub id: String,
    pub unix_ms: u64,
    pub state: AnswerState,
    /// The number given by the station's output; `None` for an answer from the station's history.
    #[serde(default, skip_serializing)]
    pub sequence: Option<u64>,
    pub surface: Option<String>,
    pub confidence: Option<f64>,
    /// The time that the station gave, where its clock was ahead.
    #[serde(default, skip_serializing)]
    pub said_unix_ms: Option<u64>,
}

#[derive(Deserialize)]
struct Line {
    answer: Head,
}

/// The sort order of the history: time of the answer in milliseconds, id, and station.
type Key = (u64, String, String);

/// The answers, without duplicates, in the order in which they were given.
#[derive(Debug)]
pub(super) struct Cache {
    log: Log,
    entries: BTreeMap<Key, Entry>,
    most: u64,
    /// Answers before this time may be missing, since they were dropped to make room for newer ones.
    floor_ms: u64,
}

#[derive(Clone, Copy, Debug)]
struct Entry {
    span: Span,
    state: AnswerState,
}

/// The answers of one moment, so that a slow reader does not block the cache.
pub(super) type Texts = Box<dyn Iterator<Item = Result<String, HistoryError>> + Send>;

impl Cache {
    pub(super) fn open(folder: &Path, most: u64) -> Result<Self, HistoryError> {
        let log = Log::hold(folder, LOG, "lock")?;
        let entry = |(Line { answer }, span)| (key(&answer), Entry { span, state: answer.state });
        let entries = log.read(u64::MAX)?.into_iter().map(entry).collect();
        let mut cache = Self { log, entries, most, floor_ms: 0 };
        cache.make_room()?;
        Ok(cache)
    }

    pub(super) fn has(&self, station: &str, id: &str) -> bool {
        self.entries.keys().any(|(_, of, at)| of == id && at == station)
    }

    /// Adds an answer of a station, and returns its head; `None` if the answer was known already.
    /// Refuses an answer that names another station.
    pub(super) fn add(&mut self, station: &str, answer: &Value) -> Sent<Option<Head>> {
        let head = Head::deserialize(answer)?;
        if head.station != station || !is_plain(&head.id) || head.id.len() > LONGEST_ID {
            Err(format!("it is of station {:?}, with the id {:?}", head.station, head.id))?;
        }
        if head.unix_ms < self.floor_ms || self.entries.contains_key(&key(&head)) {
            return Ok(None);
        }
        let span = self.log.append(&format!("{{\"answer\":{answer}}}"))?;
        self.entries.insert(key(&head), Entry { span, state: head.state });
        self.make_room()?;
        Ok(Some(head))
    }

    /// If the log is too long, writes it again with only the newest three quarters.
    fn make_room(&mut self) -> Result<(), HistoryError> {
        if self.log.bytes <= self.most {
            return Ok(());
        }
        let (mut bytes, most) = (0, self.most / 4 * 3);
        let fits = |entry: &&Entry| {
            bytes += u64::from(entry.span.length) + 1;
            bytes <= most
        };
        let kept = self.entries.values().rev().take_while(fits).count();
        for _ in kept..self.entries.len() {
            self.entries.pop_first();
        }
        self.floor_ms = self.entries.first_key_value().map_or(0, |((unix_ms, ..), _)| *unix_ms);
        let mut fresh = self.log.begin_anew()?;
        for entry in self.entries.values_mut() {
            entry.span = fresh.append(&self.log.line(entry.span)?)?;
        }
        self.log.replace(fresh)
    }

    pub(super) fn len(&self) -> usize {
        self.entries.len()
    }

    /// The station of each answer given since a moment, and whether the surface was unknown.
    pub(super) fn since(&self, unix_ms: u64) -> impl Iterator<Item = (&str, bool)> {
        let entries = self.entries.range((unix_ms, String::new(), String::new())..);
        entries.map(|(key, entry)| (key.2.as_str(), entry.state == AnswerState::Unknown))
    }

    /// The head of every answer, the oldest first. Unreadable answers are skipped.
    pub(super) fn heads(&self) -> impl Iterator<Item = Head> + '_ {
        let head = |entry: &Entry| {
            let line = self.log.line(entry.span).ok()?;
            serde_json::from_str(&line).ok().map(|Line { answer }| answer)
        };
        self.entries.values().filter_map(head)
    }

    /// The newest answers first, of one station or of all, from before `before_ms`: `most` and those of
    /// the last one's millisecond, so that the next page begins where this one ends.
    pub(super) fn newest(
        &self,
        most: usize,
        station: Option<&str>,
        before_ms: u64,
    ) -> Result<Vec<String>, HistoryError> {
        let mut all = self.spans(station, before_ms).rev();
        let mut wanted: Vec<_> = all.by_ref().take(most).collect();
        let last_ms = wanted.last().map(|(ms, _)| *ms);
        wanted.extend(all.take_while(|(ms, _)| Some(*ms) == last_ms));
        wanted.into_iter().map(|(_, span)| self.log.answer_text(span)).collect()
    }

    pub(super) fn texts(&self, station: Option<&str>) -> Result<Texts, HistoryError> {
        let spans: Vec<Span> = self.spans(station, u64::MAX).map(|(_, span)| span).collect();
        let log = self.log.share()?;
        Ok(Box::new(spans.into_iter().map(move |span| log.answer_text(span))))
    }

    /// Times and places of the answers of one station or of all, from before `before_ms`.
    fn spans(
        &self,
        station: Option<&str>,
        before_ms: u64,
    ) -> impl DoubleEndedIterator<Item = (u64, Span)> {
        let entries = self.entries.range(..(before_ms, String::new(), String::new()));
        let wanted = entries.filter(move |(key, _)| station.is_none_or(|name| key.2 == name));
        wanted.map(|(key, entry)| (key.0, entry.span))
    }
}

fn key(head: &Head) -> Key {
    (head.unix_ms, head.id.clone(), head.station.clone())
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn row(station: &str, scan: u64) -> Value {
        let id = format!("20260921-143000.{scan:03}-{scan:02}");
        json!({
            "station": station, "id": id, "sequence": scan, "unix_ms": 1_790_000_000_000 + scan,
            "state": "named", "surface": "oak", "confidence": 0.9, "scan": scan,
        })
    }

    fn scans(cache: &Cache) -> Vec<(String, u64)> {
        let of = |text: Result<String, HistoryError>| {
            let row: Value = serde_json::from_str(&text.unwrap()).unwrap();
            (row["station"].as_str().unwrap().to_string(), row["scan"].as_u64().unwrap())
        };
        cache.texts(None).unwrap().map(of).collect()
    }

    #[test]
    fn answers_are_kept_once_and_in_the_order_of_their_time_whenever_they_come() {
        let dir = tempfile::tempdir().unwrap();
        let mut cache = Cache::open(dir.path(), 1 << 20).unwrap();
        for (station, scan, is_new) in [
            ("a", 1, true),
            ("a", 4, true),
            ("b", 2, true),
            ("a", 4, false),
            ("a", 3, true),
            ("b", 4, true),
        ] {
            assert_eq!(cache.add(station, &row(station, scan)).unwrap().is_some(), is_new);
        }
        let of = |name: &str, scan| (name.to_string(), scan);
        let expected = [of("a", 1), of("b", 2), of("a", 3), of("a", 4), of("b", 4)];
        assert_eq!(scans(&cache), expected);
        assert!(cache.add("b", &row("a", 9)).unwrap_err().to_string().contains("\"a\""));
        assert!(cache.add("a", &json!({ "id": "x" })).is_err());
        assert!(matches!(Cache::open(dir.path(), 1), Err(HistoryError::InUse(_))));
        drop(cache);
        let mut cache = Cache::open(dir.path(), 1 << 20).unwrap();
        assert_eq!(scans(&cache), expected);
        assert!(cache.add("a", &row("a", 3)).unwrap().is_none(), "known after a restart");
        let newest = cache.newest(2, Some("a"), 1_790_000_000_004).unwrap();
        assert!(newest[0].contains("\"scan\":3") && newest[1].contains("\"scan\":1"), "{newest:?}");
        assert_eq!(cache.since(1_790_000_000_004).count(), 2);
        for (before_ms, count) in [(u64::MAX, 2), (1_790_000_000_004, 1), (1_790_000_000_003, 1)] {
            let page = cache.newest(1, None, before_ms).unwrap();
            assert_eq!(page.len(), count, "both of a millisecond: {page:?}");
        }
    }

    #[test]
    fn the_oldest_make_room_and_are_not_taken_in_again() {
        let dir = tempfile::tempdir().unwrap();
        let most = 20_000;
        let mut cache = Cache::open(dir.path(), most).unwrap();
        for scan in 1..=900 {
            cache.add("a", &row("a", scan)).unwrap();
            assert!(cache.log.bytes <= most);
        }
        let kept = scans(&cache);
        assert_eq!(kept.last().unwrap().1, 900);
        assert!((50..200).contains(&kept.len()) && kept.len() == cache.len(), "{}", kept.len());
        assert!(cache.add("a", &row("a", 1)).unwrap().is_none());
        assert_eq!(scans(&cache), kept);
    }
}
