//! The texts that outputs send: answers, the state of the station, and its description for Home
//! Assistant.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::json;

use crate::device::DeviceState;
use crate::recognise::RankedSurface;
use crate::station::{Answer, AnswerState, StationEvent, SurfaceProbability};

/// Largest answer in bytes, some 1000 surfaces: brokers refuse large ones, often from here on.
pub(super) const LARGEST: usize = 128 << 10;
/// Surfaces that stay in an answer that is larger.
const BEST: usize = 10;
/// Devices that are listed; names come from the hardware, and could be many.
const DEVICES: usize = 64;

/// An answer for other programs.
#[derive(Serialize)]
struct Message<'a> {
    station: &'a str,
    /// Counts the answers of this output, from 1.
    sequence: u64,
    #[serde(flatten)]
    answer: &'a Answer,
    /// The surfaces, the most probable first; with `unknown` they sum to 1. Empty by a method that
    /// gives no probabilities.
    probabilities: Vec<SurfaceProbability>,
    /// The probability that it is none of them; null where that cannot be told.
    unknown: Option<f64>,
}

/// An answer as JSON, with the best surfaces alone where it would be too large.
pub(super) fn answer(station: &str, sequence: u64, answer: &Answer) -> String {
    let text = of_surfaces(station, sequence, answer, usize::MAX);
    match text.len() {
        0..=LARGEST => text,
        _ => of_surfaces(station, sequence, answer, BEST),
    }
}

fn of_surfaces(station: &str, sequence: u64, answer: &Answer, most: usize) -> String {
    // A score that no number can hold says no more than the order does.
    let means_something = |one: &&RankedSurface| one.score < f64::MAX;
    let ranked = answer.ranked.iter().filter(means_something).take(most).cloned().collect();
    let mut probabilities = probabilities(answer);
    probabilities.truncate(most);
    let answer = &Answer { ranked, ..answer.clone() };
    let message = Message { station, sequence, answer, probabilities, unknown: answer.unknown };
    // Plain structs, numbers and text: nothing here that JSON cannot express.
    serde_json::to_string(&message).unwrap_or_default()
}

/// The probabilities of all surfaces, by a method that gives that of the first.
///
/// Scores of such a method are inverse probabilities p. That of the first may be held back to what
/// the library's trials can show; the others then gain alike, as (1 − s) p + s / n for n surfaces.
fn probabilities(answer: &Answer) -> Vec<SurfaceProbability> {
    let (Some(first), Some(best)) = (answer.confidence, answer.ranked.first()) else {
        return Vec::new();
    };
    let (alike, best) = (1.0 / answer.ranked.len() as f64, best.score.recip());
    let shared = if best > alike { ((best - first) / (best - alike)).clamp(0.0, 1.0) } else { 0.0 };
    let known = 1.0 - answer.unknown.unwrap_or(0.0);
    let of = |one: &RankedSurface| SurfaceProbability {
        surface: one.surface.clone(),
        probability: known * ((1.0 - shared) * one.score.recip() + shared * alike),
    };
    answer.ranked.iter().map(of).collect()
}

/// A station as its retained state shows it.
#[derive(Clone, Debug, Default)]
pub(super) struct StationCard {
    devices: BTreeMap<String, (DeviceState, String)>,
    counts: BTreeMap<&'static str, u64>,
}

#[derive(Serialize)]
struct CardDevice<'a> {
    device: &'a str,
    state: DeviceState,
    detail: &'a str,
}

/// The rest of a station's state, which its output knows.
pub(super) struct CardRest<'a> {
    pub station: &'a str,
    pub is_online: bool,
    /// The address of its page, if it has one.
    pub page: Option<&'a str>,
    /// Answers that nobody has looked at and that are unknown or unsure.
    pub review: usize,
    /// Number of the newest answer.
    pub sequence: u64,
    /// Answers that were dropped because the broker was away for too long.
    pub dropped: u64,
}

impl StationCard {
    /// Takes in an event of the station.
    pub fn take(&mut self, event: &StationEvent) {
        match event {
            StationEvent::Device { device, state, detail }
                if self.devices.len() < DEVICES || self.devices.contains_key(device) =>
            {
                self.devices.insert(device.clone(), (*state, detail.clone()));
            }
            StationEvent::Answer(answer) => {
                *self.counts.entry(answer.state.as_str()).or_default() += 1
            }
            StationEvent::Unnamed(_) => {
                *self.counts.entry(AnswerState::Unnamed.as_str()).or_default() += 1;
            }
            _ => {}
        }
    }

    /// The state as JSON.
    pub fn text(&self, rest: &CardRest<'_>) -> String {
        let devices = self.devices.iter().map(|(device, (state, detail))| CardDevice {
            device,
            state: *state,
            detail,
        });
        let is_down = |(state, _): &&(DeviceState, String)| {
            matches!(state, DeviceState::Absent | DeviceState::Stalled | DeviceState::Lost)
        };
        json!({
            "station": rest.station,
            "state": if rest.is_online { "online" } else { "offline" },
            "version": env!("CARGO_PKG_VERSION"),
            "page": rest.page,
            "devices": devices.collect::<Vec<_>>(),
            "devices_down": self.devices.values().filter(is_down).count(),
            "counts": self.counts,
            "review": rest.review,
            "sequence": rest.sequence,
            "dropped": rest.dropped,
        })
        .to_string()
    }
}

/// What the broker says of a station that is gone without a word.
pub(super) fn last_will(station: &str) -> String {
    json!({ "station": station, "state": "offline" }).to_string()
}

/// The entities of a station in Home Assistant: the topic of each, and its description
/// (<https://www.home-assistant.io/integrations/mqtt/#mqtt-discovery>).
pub(super) fn discovery(station: &str, answer: &str, state: &str) -> Vec<(String, String)> {
    let entity = |kind: &str, entity: &str, name: &str, topic: &str, template: &str, more| {
        let id = format!("surfaced_{station}");
        let mut about = json!({
            "name": name,
            "unique_id": format!("{id}_{entity}"),
            "state_topic": topic,
            "value_template": template,
            "availability_topic": state,
            "availability_template": "{{ value_json.state }}",
            "device": {
                "identifiers": [&id], "name": station, "manufacturer": "surfaced",
                "model": "surface recognition", "sw_version": env!("CARGO_PKG_VERSION"),
            },
        });
        if let (Some(about), serde_json::Value::Object(more)) = (about.as_object_mut(), more) {
            about.extend(more);
        }
        (format!("homeassistant/{kind}/{id}/{entity}/config"), about.to_string())
    };
    let certainty = "{{ (100 * value_json.confidence) | round(1) if value_json.confidence is \
                     number else None }}";
    let down = "{{ 'ON' if value_json.devices_down | default(0) > 0 else 'OFF' }}";
    let percent = json!({ "unit_of_measurement": "%", "state_class": "measurement" });
    vec![
        entity(
            "sensor",
            "surface",
            "Surface",
            answer,
            "{{ value_json.surface or 'unknown' }}",
            json!({}),
        ),
        entity("sensor", "certainty", "Certainty", answer, certainty, percent),
        entity("sensor", "state", "Answer", answer, "{{ value_json.state }}", json!({})),
        entity(
            "binary_sensor",
            "devices",
            "Devices",
            state,
            down,
            json!({ "device_class": "problem" }),
        ),
    ]
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::*;
    use crate::scan::Scan;

    fn said(given: &Answer) -> Value {
        let text = answer("press-3", 7, given);
        assert!(text.len() <= LARGEST);
        serde_json::from_str(&text).unwrap()
    }

    fn with_scores(scores: &[f64]) -> Answer {
        let ranked =
            |(at, &score): (usize, &f64)| RankedSurface { surface: format!("s{at:06}"), score };
        let ranked = scores.iter().enumerate().map(ranked).collect();
        Answer { ranked, ..Answer::of(&Scan::of_signals(1, Default::default()), 0.0) }
    }

    #[test]
    fn an_answer_that_is_too_large_keeps_its_ten_best_surfaces() {
        for (surfaces, kept) in [(170, 170), (6000, BEST)] {
            let scores: Vec<f64> = (0..surfaces).map(|at| 1.0 + at as f64).collect();
            assert_eq!(said(&with_scores(&scores))["ranked"].as_array().unwrap().len(), kept);
        }
    }

    #[test]
    fn probabilities_sum_to_one_with_the_unknown_and_scores_without_a_meaning_are_left_out() {
        // 0.6, 0.4 and nothing, of which the first is held back to 0.59.
        let scored = with_scores(&[1.0 / 0.6, 1.0 / 0.4, f64::MAX]);
        let given = Answer { confidence: Some(0.59), unknown: Some(0.25), ..scored };
        let said = said(&given);
        assert_eq!((&said["station"], &said["sequence"]), (&"press-3".into(), &7.into()));
        assert_eq!(said["ranked"].as_array().unwrap().len(), 2);
        let shares = said["probabilities"].as_array().unwrap();
        let share = |at: usize| shares[at]["probability"].as_f64().unwrap();
        assert!((share(0) - 0.75 * 0.59).abs() < 1e-9, "{said}");
        let sum: f64 = (0..3).map(share).sum::<f64>() + said["unknown"].as_f64().unwrap();
        assert!((sum - 1.0).abs() < 1e-9 && share(2) > 0.0, "{said}");
        let plain = self::said(&with_scores(&[2.0, f64::INFINITY]));
        assert_eq!(
            (&plain["probabilities"], &plain["unknown"]),
            (&Value::Array(vec![]), &Value::Null)
        );
        assert_eq!(plain["ranked"].as_array().unwrap().len(), 1);
    }

    #[test]
    fn topics_and_descriptions_for_home_assistant_are_plain() {
        let entities = discovery("press-3", "surfaced/press-3/answer", "surfaced/press-3/state");
        assert_eq!(entities.len(), 4);
        for (topic, about) in entities {
            let plain = |c: char| c.is_ascii_alphanumeric() || "-_/".contains(c);
            assert!(topic.chars().all(plain), "{topic}");
            let about: Value = serde_json::from_str(&about).unwrap();
            assert_eq!(about["availability_topic"], "surfaced/press-3/state");
            assert_eq!(about["device"]["name"], "press-3");
        }
    }
}
