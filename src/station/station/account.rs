//! The account of a scan, which is its doubts: which of them decide its state, which of them are
//! shown as lines, and how they are written as JSON.

use serde::Serializer;
use serde::ser::SerializeMap;
use serde_json::{Value, json};

use crate::trial::{Doubt, lines};

/// The share of the needed drag that a scan must reach to raise no doubt. Between this share and the
/// whole, the test has fewer samples than needed, so it is weaker but not wrong.
const LONG_ENOUGH: f64 = 0.5;

/// The damage of a scan: everything that spoils it, and the worst fault of each sensor.
pub fn damage(doubts: &[Doubt]) -> Vec<&Doubt> {
    let mut damage: Vec<&Doubt> = doubts.iter().filter(|doubt| doubt.spoils()).collect();
    let spoiled = damage.len();
    for doubt in doubts.iter().filter(|doubt| doubt.is_sensor_fault()) {
        match damage[spoiled..].iter_mut().find(|other| other.source() == doubt.source()) {
            Some(worst) if doubt.severity() > worst.severity() => *worst = doubt,
            Some(_) => {}
            None => damage.push(doubt),
        }
    }
    damage
}

pub(super) fn reasons(doubts: &[Doubt]) -> Vec<&Doubt> {
    let answers = |doubt: &&Doubt| {
        matches!(doubt, Doubt::FitsNone { .. } | Doubt::NotNamed { .. } | Doubt::TooLittle)
    };
    if let Some(answer) = doubts.iter().find(answers) {
        return vec![answer];
    }
    let mut reasons: Vec<&Doubt> = doubts.iter().filter(|doubt| decides(doubt, doubts)).collect();
    if reasons.is_empty() {
        reasons.extend(doubts.iter().find(|doubt| **doubt == Doubt::UnknownNotDetected));
    }
    reasons
}

/// Whether a doubt, one of `all`, makes an answer unsure.
pub(super) fn decides(doubt: &Doubt, all: &[Doubt]) -> bool {
    match doubt {
        Doubt::NotCompared { .. } | Doubt::Untested { .. } | Doubt::Improbable { .. } => true,
        // A settled answer does not need a longer scan.
        Doubt::TooShort { scan_s, needed_s, settled } => {
            !settled && *scan_s < LONG_ENOUGH * needed_s
        }
        // A fault of a sensor counts if its source was left out for it.
        fault if fault.is_sensor_fault() => fault.source().is_some_and(|source| {
            all.iter().any(|other| matches!(other, Doubt::NotCompared { source: s } if s == source))
        }),
        other => other.spoils(),
    }
}

/// All doubts except the lesser faults of each sensor.
pub fn told(doubts: &[Doubt]) -> impl Iterator<Item = &Doubt> {
    let worst = damage(doubts);
    let is_worst = move |doubt: &Doubt| worst.iter().any(|other| std::ptr::eq(*other, doubt));
    doubts.iter().filter(move |doubt| !doubt.is_sensor_fault() || is_worst(doubt))
}

/// The damage of a scan as JSON: a fault of one sensor, or of the whole scan without a `source`.
fn damage_entries(doubts: &[Doubt]) -> Value {
    let entry = |doubt: &Doubt| match doubt.is_sensor_fault() {
        true => json!({ "source": doubt.source(), "text": doubt.text() }),
        false => json!({ "source": null, "text": doubt.to_string() }),
    };
    damage(doubts).into_iter().map(entry).collect()
}

pub(super) fn of_answer<S: Serializer>(doubts: &[Doubt], to: S) -> Result<S::Ok, S::Error> {
    let listed = |is: fn(&Doubt) -> bool| json!(lines(doubts.iter().filter(|doubt| is(doubt))));
    let lists = [
        ("reasons", json!(lines(reasons(doubts)))),
        ("spoiled", listed(Doubt::spoils)),
        ("damage", damage_entries(doubts)),
        ("remarks", listed(Doubt::is_remark)),
    ];
    with_lists(lists, doubts, to)
}

pub(super) fn of_guess<S: Serializer>(doubts: &[Doubt], to: S) -> Result<S::Ok, S::Error> {
    with_lists([("damage", damage_entries(doubts))], doubts, to)
}

/// Writes the doubts about a scan that was to be kept. The field `nearest` says what it is near to.
pub(super) fn of_enrolled<S: Serializer>(doubts: &[Doubt], to: S) -> Result<S::Ok, S::Error> {
    let others = told(doubts).filter(|doubt| !matches!(doubt, Doubt::NearSurface { .. }));
    with_lists([("remarks", json!(lines(others)))], doubts, to)
}

pub(super) fn of_refused<S: Serializer>(doubts: &[Doubt], to: S) -> Result<S::Ok, S::Error> {
    with_lists([("reasons", json!(lines(told(doubts))))], doubts, to)
}

pub(super) fn of_left_out<S: Serializer>(doubts: &[Doubt], to: S) -> Result<S::Ok, S::Error> {
    with_lists([("left_out", json!(lines(doubts)))], doubts, to)
}

/// Writes these lists, each under its name, and then all doubts.
fn with_lists<S: Serializer, const N: usize>(
    lists: [(&str, Value); N],
    doubts: &[Doubt],
    to: S,
) -> Result<S::Ok, S::Error> {
    let mut map = to.serialize_map(None)?;
    for (name, list) in &lists {
        map.serialize_entry(name, list)?;
    }
    map.serialize_entry("doubts", doubts)?;
    map.end()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::SourceId;

    #[test]
    fn damage_is_what_spoils_a_scan_and_the_worst_fault_of_each_sensor() {
        let source = |id: &str| SourceId::new(id).unwrap();
        let clipped =
            |channel, share| Doubt::Clipped { source: source("ac"), channel, value: 1.0, share };
        let stuck =
            |id: &str, share| Doubt::Stuck { source: source(id), channel: 3, value: 0.0, share };
        let doubts = [
            Doubt::EndedEarly,
            clipped(1, 0.9),
            stuck("ac", 0.6),
            clipped(2, 0.2),
            stuck("ir", 1.0),
            Doubt::UnknownNotDetected,
        ];
        assert_eq!(damage(&doubts), [&doubts[0], &doubts[2], &doubts[4]]);
        assert_eq!(damage(&[clipped(1, 0.1), clipped(2, 0.4)]), [&clipped(2, 0.4)]);
    }
}
