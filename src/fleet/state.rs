//! The stations of a fleet, with their states, their last answers, and times of missing answers.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use serde_json::{Map, Value, json};

use super::cache::{Cache, Head};
use crate::serve::unix_ms;

/// How many stations are kept, at most. Their names come from the network, so there could be many.
const MOST: usize = 1000;
/// How many recent answers are shown for each station.
const RECENT: usize = 5;
/// The answers of each station are counted over this time.
const COUNTED: Duration = Duration::from_secs(600);
/// How long an answer may be on its way before it counts as missing.
const ON_THEIR_WAY: Duration = Duration::from_secs(10);
/// The pause before a station whose history could not be read is tried again.
const AGAIN: Duration = Duration::from_secs(60);

/// The fields of a station's published state that the page shows.
const FIELDS: &str = "state version page devices devices_down counts review sequence dropped";

#[derive(Debug, Default)]
pub(super) struct Stations(BTreeMap<String, Station>);

#[derive(Debug, Default)]
struct Station {
    card: Map<String, Value>,
    /// When the station's `state` last changed, in milliseconds since 1970.
    since_unix_ms: u64,
    recent: VecDeque<Head>,
    /// The number of the newest answer, and the time when it was given, in milliseconds since 1970.
    newest: (u64, u64),
    /// Since when the published state has counted more answers than have arrived.
    behind: Option<Instant>,
    /// Answers since this time must be read from the station's history; `None` if none is missing.
    missing_from_ms: Option<u64>,
    /// The history must not be read before this moment.
    not_before: Option<Instant>,
    /// The reason why the history could not be read; `None` after a success.
    page_problem: Option<String>,
}

impl Stations {
    pub(super) fn of(cache: &Cache) -> Self {
        let mut stations = Self::default();
        cache.heads().for_each(|head| stations.answered(&head));
        // A gap before the oldest answer (0) comes from dropped answers, which are not read again.
        for station in stations.0.values_mut() {
            station.missing_from_ms = station.missing_from_ms.filter(|from_ms| *from_ms > 0);
        }
        stations
    }

    fn named(&mut self, name: &str) -> Option<&mut Station> {
        if self.0.len() >= MOST && !self.0.contains_key(name) {
            return None;
        }
        Some(self.0.entry(name.into()).or_default())
    }

    pub(super) fn answered(&mut self, head: &Head) {
        let Some(station) = self.named(&head.station) else { return };
        let unix_ms = head.unix_ms;
        let at = station.recent.iter().position(|other| other.unix_ms <= unix_ms);
        station.recent.insert(at.unwrap_or(station.recent.len()), head.clone());
        station.recent.truncate(RECENT);
        let Some(sequence) = head.sequence else { return };
        let (newest, newest_ms) = station.newest;
        // A station with a new outbox counts from 1 again, so number 1 shows no gap.
        if sequence > newest + 1 || (sequence <= newest && sequence > 1) {
            station.misses(newest_ms);
        }
        station.newest = (sequence, unix_ms);
    }

    /// Updates the state of a station. A last will has fewer fields, so the others keep their values.
    pub(super) fn stated(&mut self, name: &str, state: &Map<String, Value>) {
        let Some(station) = self.named(name) else { return };
        let is_new = station.card.get("state") != state.get("state");
        for field in FIELDS.split(' ') {
            if let Some(value) = state.get(field) {
                station.card.insert(field.into(), value.clone());
            }
        }
        if is_new {
            station.since_unix_ms = unix_ms();
            station.not_before = None;
        }
        let tells = station.card.get("sequence").and_then(Value::as_u64).unwrap_or(0);
        if tells <= station.newest.0 {
            station.behind = None;
        } else if station.behind.is_none() {
            station.behind = Some(Instant::now());
        }
    }

    /// Finds a station whose history must be read. Returns its name, its page, and where to begin.
    /// The station need not be online, since the page of a replay remains after the last answer.
    pub(super) fn next_to_read(&mut self) -> Option<(String, String, u64)> {
        let now = Instant::now();
        for (name, station) in &mut self.0 {
            if station.behind.is_some_and(|since| now.duration_since(since) > ON_THEIR_WAY) {
                station.behind = None;
                let from = station.newest.1;
                station.misses(from);
            }
            let is_due = station.not_before.is_none_or(|moment| moment <= now);
            let page = station.card.get("page").and_then(Value::as_str);
            if let (Some(from), Some(page), true) = (station.missing_from_ms, page, is_due) {
                return Some((name.clone(), page.into(), from));
            }
        }
        None
    }

    /// Notes that the history of a station was read since `from_ms`, or why it could not be read.
    pub(super) fn was_read(&mut self, name: &str, from_ms: u64, done: Result<(), String>) {
        let Some(station) = self.0.get_mut(name) else { return };
        station.page_problem = done.err();
        if station.page_problem.is_some() {
            station.not_before = Some(Instant::now() + AGAIN);
        } else if station.missing_from_ms == Some(from_ms) {
            station.missing_from_ms = None;
            let tells = station.card.get("sequence").and_then(Value::as_u64).unwrap_or(0);
            station.newest.0 = station.newest.0.max(tells);
        }
    }

    pub(super) fn view(&self, cache: &Cache) -> Value {
        let mut counts: BTreeMap<&str, (u64, u64)> = BTreeMap::new();
        for (name, is_unknown) in cache.since(unix_ms().saturating_sub(COUNTED.as_millis() as u64))
        {
            let (scans, unknown) = counts.entry(name).or_default();
            (*scans, *unknown) = (*scans + 1, *unknown + u64::from(is_unknown));
        }
        let view = |(name, station): (&String, &Station)| {
            let (scans, unknown) = counts.get(name.as_str()).copied().unwrap_or_default();
            let mut view = json!({
                "station": name,
                "since_unix_ms": station.since_unix_ms,
                "page_problem": station.page_problem,
                "scans_10_min": scans,
                "unknown_10_min": unknown,
                "answers": station.recent,
            });
            if let Some(fields) = view.as_object_mut() {
                fields.extend(station.card.clone());
            }
            view
        };
        self.0.iter().map(view).collect()
    }
}

impl Station {
    fn misses(&mut self, from_ms: u64) {
        let from = self.missing_from_ms.map_or(from_ms, |before| before.min(from_ms));
        self.missing_from_ms = Some(from);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn answered(stations: &mut Stations, sequence: Option<u64>, unix_ms: u64) {
        let (station, id) = ("a", format!("x-{unix_ms}"));
        let head = json!({
            "station": station, "id": id, "unix_ms": unix_ms, "state": "named", "sequence": sequence,
        });
        stations.answered(&serde_json::from_value(head).unwrap());
    }

    fn online(sequence: u64) -> Map<String, Value> {
        let page = "http://127.0.0.1:1";
        let state = json!({ "state": "online", "page": page, "sequence": sequence });
        state.as_object().unwrap().clone()
    }

    #[test]
    fn answers_that_are_missing_are_read_from_the_last_one_before_them() {
        let mut stations = Stations::default();
        (1..=3).for_each(|n| answered(&mut stations, Some(n), 10 * n));
        stations.stated("a", &online(3));
        assert_eq!(stations.next_to_read(), None);
        answered(&mut stations, Some(6), 60);
        let due = Some(("a".into(), "http://127.0.0.1:1".into(), 30));
        assert_eq!(stations.next_to_read(), due);
        stations.was_read("a", 30, Err("a token is needed".into()));
        assert_eq!(stations.next_to_read(), None, "not at once again");
        stations.stated("a", json!({ "state": "offline" }).as_object().unwrap());
        stations.stated("a", &online(6));
        assert_eq!(stations.next_to_read(), due, "it is back");
        stations.was_read("a", 30, Ok(()));
        answered(&mut stations, None, 40);
        answered(&mut stations, Some(7), 70);
        assert_eq!(stations.next_to_read(), None);
        // The outbox is new, so number 1 shows no gap.
        answered(&mut stations, Some(1), 80);
        assert_eq!(stations.next_to_read(), None);
        answered(&mut stations, Some(3), 100);
        assert_eq!(stations.next_to_read().unwrap().2, 80);
    }

    #[test]
    fn a_last_will_leaves_the_rest_of_a_state_and_the_last_answers_are_in_order() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::open(dir.path(), 1 << 20).unwrap();
        let mut stations = Stations::of(&cache);
        stations.stated("a", &online(0));
        stations.stated("a", json!({ "state": "offline", "other": 1 }).as_object().unwrap());
        for unix_ms in [10, 30, 20, 60, 50, 40] {
            answered(&mut stations, None, unix_ms);
        }
        let view = stations.view(&cache);
        assert_eq!(
            (&view[0]["state"], &view[0]["page"]),
            (&json!("offline"), &json!("http://127.0.0.1:1"))
        );
        assert_eq!(view[0]["other"], Value::Null);
        let order: Vec<_> =
            view[0]["answers"].as_array().unwrap().iter().map(|a| &a["unix_ms"]).collect();
        assert_eq!(order, [60, 50, 40, 30, 20]);
    }
}
