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

/// A station whose history must be read: its name, its page, and the time where to begin.
pub(super) type Due = (String, String, u64);

#[derive(Debug, Default)]
pub(super) struct Stations {
    of: BTreeMap<String, Station>,
    /// Whether more stations have published than are kept.
    pub are_too_many: bool,
}

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
    /// When the history was last begun to be read, and whether that is still going on.
    tried: Option<Instant>,
    is_read: bool,
    /// How far the station's clock was ahead at its newest answer, if it was.
    ahead_ms: Option<u64>,
    /// The reason why the history could not be read; `None` after a success.
    page_problem: Option<String>,
}

impl Stations {
    pub(super) fn of(cache: &Cache) -> Self {
        let mut stations = Self::default();
        cache.heads().for_each(|head| stations.answered(&head));
        // A gap before the oldest answer (0) comes from dropped answers, which are not read again.
        for station in stations.of.values_mut() {
            station.missing_from_ms = station.missing_from_ms.filter(|from_ms| *from_ms > 0);
        }
        stations
    }

    fn named(&mut self, name: &str) -> Option<&mut Station> {
        if self.of.len() >= MOST && !self.of.contains_key(name) {
            self.are_too_many = true;
            return None;
        }
        Some(self.of.entry(name.into()).or_default())
    }

    pub(super) fn answered(&mut self, head: &Head) {
        let Some(station) = self.named(&head.station) else { return };
        let unix_ms = head.unix_ms;
        let newer = station.recent.iter().take_while(|other| other.unix_ms > unix_ms).count();
        if newer == 0 {
            station.ahead_ms = head.said_unix_ms.map(|said| said.saturating_sub(unix_ms));
        }
        station.recent.insert(newer, head.clone());
        station.recent.truncate(RECENT);
        let Some(sequence) = head.sequence else { return };
        let (newest, newest_ms) = station.newest;
        // A station with a new outbox counts from 1 again, so number 1 shows no gap.
        if sequence > newest + 1 || (sequence <= newest && sequence > 1) {
            station.misses(newest_ms);
        }
        station.newest = (sequence, unix_ms);
    }

    /// Updates the state of a station. A last will has fewer fields, so the others keep their values. Fails
    /// if a field that the page shows is of another type than a station publishes.
    pub(super) fn stated(&mut self, name: &str, state: &Map<String, Value>) -> Result<(), String> {
        let unsound = |field: &&str| state.get(*field).is_some_and(|value| !is_sound(field, value));
        if let Some(field) = FIELDS.split(' ').find(unsound) {
            return Err(format!("its `{field}` is none that a station publishes"));
        }
        let Some(station) = self.named(name) else { return Ok(()) };
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
        let is_behind = tells > station.newest.0;
        station.behind = is_behind.then(|| station.behind.unwrap_or_else(Instant::now));
        Ok(())
    }

    /// Finds a station whose history must be read, the one first that has waited longest. The station
    /// need not be online, since the page of a replay remains after the last answer.
    pub(super) fn next_to_read(&mut self) -> Option<Due> {
        let now = Instant::now();
        self.of.values_mut().for_each(|station| station.look_back(now));
        let due = self.of.iter_mut().filter(|(_, station)| station.is_due(now));
        let (name, station) = due.min_by_key(|(_, station)| station.tried)?;
        let page = station.card.get("page")?.as_str()?;
        (station.tried, station.is_read) = (Some(now), true);
        Some((name.clone(), page.into(), station.missing_from_ms?))
    }

    /// Notes that the history of a station was read since `from_ms`, or why it could not be read.
    pub(super) fn was_read(&mut self, name: &str, from_ms: u64, done: Result<(), String>) {
        let Some(station) = self.of.get_mut(name) else { return };
        station.is_read = false;
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
                "ahead_ms": station.ahead_ms,
                "scans_10_min": scans,
                "unknown_10_min": unknown,
                "answers": station.recent,
            });
            if let Some(fields) = view.as_object_mut() {
                fields.extend(station.card.clone());
            }
            view
        };
        self.of.iter().map(view).collect()
    }
}

/// Whether a published field has the type that the page expects.
fn is_sound(field: &str, value: &Value) -> bool {
    let is_device = |device: &Value| device["device"].is_string() && device["state"].is_string();
    match field {
        "state" | "version" => value.is_string(),
        "page" => value.is_string() || value.is_null(),
        "devices" => value.as_array().is_some_and(|all| all.iter().all(is_device)),
        "counts" => value.is_object(),
        _ => value.is_u64() || value.is_null(),
    }
}

impl Station {
    /// Notes answers that should have arrived by now.
    fn look_back(&mut self, now: Instant) {
        if self.behind.is_some_and(|since| now.duration_since(since) > ON_THEIR_WAY) {
            self.behind = None;
            self.misses(self.newest.1);
        }
    }

    fn is_due(&self, now: Instant) -> bool {
        let may = !self.is_read && self.not_before.is_none_or(|moment| moment <= now);
        let has_page = self.card.get("page").is_some_and(Value::is_string);
        may && has_page && self.missing_from_ms.is_some()
    }

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
        serde_json::from_value(state).unwrap()
    }

    #[test]
    fn answers_that_are_missing_are_read_from_the_last_one_before_them() {
        let mut stations = Stations::default();
        (1..=3).for_each(|n| answered(&mut stations, Some(n), 10 * n));
        stations.stated("a", &online(3)).unwrap();
        assert_eq!(stations.next_to_read(), None);
        answered(&mut stations, Some(6), 60);
        let due = Some(("a".into(), "http://127.0.0.1:1".into(), 30));
        assert_eq!(stations.next_to_read(), due);
        stations.was_read("a", 30, Err("a token is needed".into()));
        assert_eq!(stations.next_to_read(), None, "not at once again");
        stations.stated("a", json!({ "state": "offline" }).as_object().unwrap()).unwrap();
        stations.stated("a", &online(6)).unwrap();
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
        assert_eq!(stations.next_to_read(), None, "it is being read");
    }

    #[test]
    fn every_station_has_its_turn_though_one_is_slow() {
        let mut stations = Stations::default();
        for name in ["a", "b", "c"] {
            stations.stated(name, &online(1)).unwrap();
            stations.of.get_mut(name).unwrap().misses(0);
        }
        let order: Vec<String> = (0..6)
            .map(|_| {
                let (name, _, from) = stations.next_to_read().unwrap();
                stations.of.get_mut(&name).unwrap().tried = Some(Instant::now());
                stations.was_read(&name, from + 1, Ok(()));
                name
            })
            .collect();
        assert_eq!(order.concat(), "abcabc");
    }

    #[test]
    fn what_no_station_publishes_is_refused_and_changes_nothing() {
        let mut stations = Stations::default();
        stations.stated("a", &online(1)).unwrap();
        for (field, value) in [
            ("devices", json!(7)),
            ("devices", json!([{ "device": "stylus" }])),
            ("devices", json!([null])),
            ("state", json!({})),
            ("page", json!(["http://127.0.0.1"])),
            ("sequence", json!("many")),
            ("dropped", json!(-1)),
        ] {
            let said = json!({ "state": "offline", field: value });
            let refused = stations.stated("a", said.as_object().unwrap());
            assert!(refused.is_err_and(|why| why.contains(field)), "{said}");
        }
        assert_eq!(stations.of["a"].card["sequence"], json!(1));
        (0..MOST).for_each(|n| stations.stated(&format!("x-{n}"), &online(0)).unwrap());
        assert!(stations.are_too_many && stations.of.len() == MOST);
    }

    #[test]
    fn a_last_will_leaves_the_rest_of_a_state_and_the_last_answers_are_in_order() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::open(dir.path(), 1 << 20).unwrap();
        let mut stations = Stations::of(&cache);
        stations.stated("a", &online(0)).unwrap();
        let will = json!({ "state": "offline", "other": 1 });
        stations.stated("a", will.as_object().unwrap()).unwrap();
        for unix_ms in [10, 30, 20, 60, 50, 40] {
            answered(&mut stations, None, unix_ms);
        }
        let view = &stations.view(&cache)[0];
        assert_eq!([&view["state"], &view["page"]], ["offline", "http://127.0.0.1:1"]);
        assert_eq!(view["other"], Value::Null);
        let answers = view["answers"].as_array().unwrap().iter();
        assert!(answers.map(|one| &one["unix_ms"]).eq(&[60, 50, 40, 30, 20]), "{view}");
    }
}
