//! The texts that outputs send: answers, the state of the station, and its description for Home
//! Assistant.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::{Value, json};

use crate::device::DeviceState;
use crate::printable::json_text;
use crate::recognise::{RankedSurface, stated_probabilities};
use crate::station::{Answer, AnswerState, StationEvent, SurfaceProbability};

/// The largest answer, in bytes (about 1000 surfaces), since many brokers refuse larger messages.
pub(super) const LARGEST: usize = 128 << 10;
/// How many surfaces remain in an answer that would be too large.
const BEST: usize = 10;
/// How many devices are listed, at most. Hardware chooses their names, so there could be many.
pub(crate) const DEVICES: usize = 64;

#[derive(Serialize)]
struct Message<'a, T> {
    station: &'a str,
    /// Number of the message, counted from 1 for each outbox.
    #[serde(skip_serializing_if = "Option::is_none")]
    sequence: Option<u64>,
    #[serde(flatten)]
    event: &'a T,
}

#[derive(Serialize)]
struct AnswerText {
    #[serde(flatten)]
    answer: Answer,
    /// The surfaces, the most probable first, if it is one of them; they sum to 1. Empty for an unknown
    /// surface, and for some methods.
    probabilities: Vec<SurfaceProbability>,
    /// A scale of the p-value: one half at the threshold for unknown surfaces, 1 far below it. Null if
    /// unknown surfaces are not detected.
    unknown: Option<f64>,
}

/// An answer as JSON. If it would be too large, it holds only the best surfaces.
pub(super) fn answer(station: &str, sequence: u64, answer: &Answer) -> String {
    let text = of_surfaces(station, sequence, answer, usize::MAX);
    match text.len() {
        0..=LARGEST => text,
        _ => of_surfaces(station, sequence, answer, BEST),
    }
}

/// A change of the surface, or an alert, as JSON; only messages of an outbox are numbered.
pub(super) fn event<T: Serialize>(station: &str, sequence: Option<u64>, event: &T) -> String {
    json_text(&Message { station, sequence, event })
}

fn of_surfaces(station: &str, sequence: u64, answer: &Answer, most: usize) -> String {
    // An infinite or maximal score says only that its surface comes last, so it is left out.
    let means_something = |one: &&RankedSurface| one.score < f64::MAX;
    let ranked = answer.ranked.iter().filter(means_something).take(most).cloned().collect();
    let mut probabilities = probabilities(answer);
    probabilities.truncate(most);
    let answer = Answer { ranked, ..answer.clone() };
    event(station, Some(sequence), &AnswerText { probabilities, unknown: answer.unknown, answer })
}

/// The probabilities of all surfaces; empty if the answer has none.
fn probabilities(answer: &Answer) -> Vec<SurfaceProbability> {
    let scores: Vec<f64> = answer.ranked.iter().map(|one| one.score).collect();
    let of = |(one, probability): (&RankedSurface, f64)| SurfaceProbability {
        surface: one.surface.clone(),
        probability,
    };
    answer.ranked.iter().zip(stated_probabilities(&scores, answer.confidence)).map(of).collect()
}

/// The state of a station, as published in a retained message.
#[derive(Clone, Debug, Default)]
pub(super) struct StationCard {
    devices: BTreeMap<String, (DeviceState, String)>,
    counts: BTreeMap<AnswerState, u64>,
}

impl StationCard {
    pub(super) fn take(&mut self, event: &StationEvent) {
        match event {
            StationEvent::Device { device, state, detail }
                if self.devices.len() < DEVICES || self.devices.contains_key(device) =>
            {
                self.devices.insert(device.clone(), (*state, detail.clone()));
            }
            StationEvent::Answer(answer) | StationEvent::Unnamed(answer) => {
                *self.counts.entry(answer.state).or_default() += 1;
            }
            _ => {}
        }
    }

    /// The state as JSON, without the fields that the output itself adds.
    pub(super) fn json(&self) -> Value {
        let devices = self.devices.iter().map(|(device, (state, detail))| {
            json!({ "device": device, "state": state, "detail": detail })
        });
        let is_down = |(state, _): &&(DeviceState, String)| {
            matches!(state, DeviceState::Absent | DeviceState::Stalled | DeviceState::Lost)
        };
        json!({
            "version": env!("CARGO_PKG_VERSION"),
            "devices": devices.collect::<Vec<_>>(),
            "devices_down": self.devices.values().filter(is_down).count(),
            "counts": self.counts,
        })
    }
}

/// The word that Home Assistant gets instead of `unknown`.
const UNKNOWN_SURFACE: &str = "unknown_surface";

/// The entities of a station in Home Assistant: the discovery topic and description of each
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
        if let (Some(about), Value::Object(more)) = (about.as_object_mut(), more) {
            about.extend(more);
        }
        (format!("homeassistant/{kind}/{id}/{entity}/config"), about.to_string())
    };
    let certainty = "{{ (100 * value_json.confidence) | round(1) if value_json.confidence is \
                     number else None }}";
    let down = "{{ 'ON' if value_json.devices_down | default(0) > 0 else 'OFF' }}";
    let percent = json!({ "unit_of_measurement": "%", "state_class": "measurement" });
    // Home Assistant takes the state `unknown` for a sensor that has said nothing.
    let surface = format!("{{{{ value_json.surface or '{UNKNOWN_SURFACE}' }}}}");
    let said =
        format!("'{UNKNOWN_SURFACE}' if value_json.state == 'unknown' else value_json.state");
    let states = format!("{{{{ {said} }}}}");
    // Home Assistant fires no event for a retained message, so there is one for each answer.
    let event = format!(
        "{{{{ {{'event_type': {said}, 'surface': value_json.surface, 'confidence': \
         value_json.confidence, 'scan': value_json.scan, 'id': value_json.id}} | to_json }}}}"
    );
    let problem = json!({ "device_class": "problem" });
    let types = json!({ "event_types": ["named", "nearest", "unsure", UNKNOWN_SURFACE] });
    vec![
        entity("sensor", "surface", "Surface", answer, &surface, json!({})),
        entity("sensor", "certainty", "Certainty", answer, certainty, percent),
        entity("sensor", "state", "Answer", answer, &states, json!({})),
        entity("event", "event", "Scan", answer, &event, types),
        entity("binary_sensor", "devices", "Devices", state, down, problem),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(given: &Answer) -> Value {
        let text = answer("press-3", 7, given);
        assert!(text.len() <= LARGEST);
        serde_json::from_str(&text).unwrap()
    }

    fn with_scores(scores: &[f64]) -> Answer {
        let ranked =
            |(at, &score): (usize, &f64)| RankedSurface { surface: format!("s{at:06}"), score };
        let ranked = scores.iter().enumerate().map(ranked).collect();
        Answer { ranked, ..Answer::default() }
    }

    #[test]
    fn an_answer_that_is_too_large_keeps_its_ten_best_surfaces() {
        for (surfaces, kept) in [(170, 170), (6000, BEST)] {
            let scores: Vec<f64> = (0..surfaces).map(|at| 1.0 + at as f64).collect();
            assert_eq!(said(&with_scores(&scores))["ranked"].as_array().unwrap().len(), kept);
        }
    }

    #[test]
    fn the_first_probability_is_the_confidence_and_scores_without_a_meaning_are_left_out() {
        // The scores stand for probabilities of 0.6, 0.4 and 0; the first is then lowered to 0.59.
        let scored = with_scores(&[1.0 / 0.6, 1.0 / 0.4, f64::MAX]);
        let given = Answer { confidence: Some(0.59), unknown: Some(0.25), ..scored };
        let said = said(&given);
        assert_eq!((&said["station"], &said["sequence"]), (&"press-3".into(), &7.into()));
        assert_eq!(said["ranked"].as_array().unwrap().len(), 2);
        let shares = said["probabilities"].as_array().unwrap();
        let share = |at: usize| shares[at]["probability"].as_f64().unwrap();
        assert!((share(0) - 0.59).abs() < 1e-9 && said["confidence"] == 0.59, "{said}");
        let sum: f64 = (0..3).map(share).sum();
        assert!((sum - 1.0).abs() < 1e-9 && share(2) > 0.0, "{said}");
        let plain = self::said(&with_scores(&[2.0, f64::INFINITY]));
        assert_eq!(plain["probabilities"], json!([]));
        assert_eq!(plain["unknown"], Value::Null);
        assert_eq!(plain["ranked"].as_array().unwrap().len(), 1);
    }

    #[test]
    fn home_assistant_gets_plain_topics_and_descriptions_and_never_its_own_word_unknown() {
        let entities = discovery("press-3", "surfaced/press-3/answer", "surfaced/press-3/state");
        let ids = entities.iter().map(|(topic, _)| topic.split('/').nth(3).unwrap());
        assert!(ids.eq(["surface", "certainty", "state", "event", "devices"]));
        let about = |entity: usize| serde_json::from_str::<Value>(&entities[entity].1).unwrap();
        for (entity, (topic, _)) in entities.iter().enumerate() {
            let plain = |c: char| c.is_ascii_alphanumeric() || "-_/".contains(c);
            assert!(topic.chars().all(plain), "{topic}");
            let about = about(entity);
            assert_eq!(about["availability_topic"], "surfaced/press-3/state");
            assert_eq!(about["availability_template"], "{{ value_json.state }}");
            assert_eq!(about["device"]["name"], "press-3");
        }
        let said = "'unknown_surface' if value_json.state == 'unknown' else value_json.state";
        let surface = "{{ value_json.surface or 'unknown_surface' }}";
        assert_eq!(about(0)["value_template"], surface);
        assert_eq!(about(2)["value_template"], format!("{{{{ {said} }}}}"));
        let event = about(3);
        assert_eq!(event["state_topic"], "surfaced/press-3/answer");
        assert_eq!(event["event_types"], json!(["named", "nearest", "unsure", "unknown_surface"]));
        let template = event["value_template"].as_str().unwrap();
        assert!(template.starts_with(&format!("{{{{ {{'event_type': {said}, ")), "{template}");
        let answer = Answer { state: AnswerState::Unknown, ..with_scores(&[1.0]) };
        assert_eq!(self::said(&answer)["state"], "unknown", "the answer itself says so");
    }
}
