//! Drift of a station, found by the scans of its reference surfaces: parts that stay the same, and are
//! scanned again and again. What changes in these scans is the station.

use std::collections::BTreeMap;
use std::mem::{Discriminant, discriminant};

use serde::Serialize;
use serde_json::Value;

use super::log::{HistoryEntry, HistoryRow};
use super::{AnswerState, Correction};
use crate::evaluate::control_chart::{BASELINE, Chart, SOON, WITHIN, Worse};
use crate::scene::SourceId;
use crate::station::ChannelLevel;
use crate::trial::Doubt;

/// How many points of a chart are reported, the newest ones.
const MOST_POINTS: usize = 500;

/// The charts of all reference surfaces, and the doubts that follow from them.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Drift {
    /// Number of scans from which centre and spread are estimated; nothing is stated before.
    pub needed: usize,
    /// Number of reference scans in which at most one false alarm comes on average.
    pub one_false_alarm_in: usize,
    /// Number of scans within which nine of ten changes of the size `finds` are found.
    pub within: usize,
    pub references: Vec<ReferenceView>,
    pub doubts: Vec<Doubt>,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ReferenceView {
    pub surface: String,
    pub since_unix_ms: u64,
    /// Number of its scans since then; scans that lack data do not count.
    pub scans: usize,
    pub series: Vec<ChartView>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Quantity {
    /// The p-value of the scan.
    Fit,
    /// The natural logarithm of the surface's score, for methods without p-values.
    Distance,
    /// The level of a channel during the drag, in dB.
    Level,
    /// The level of a channel at rest, in dB.
    Noise,
}

impl std::fmt::Display for Quantity {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // Writes the quantity's name in JSON.
        self.serialize(f)
    }
}

impl Quantity {
    /// The least spread, and the direction in which the quantity gets worse.
    fn how(self) -> (f64, Worse) {
        match self {
            Self::Fit => (0.001, Worse::Lower),
            Self::Distance => (0.001, Worse::Higher),
            // Levels are rounded to 0.01 dB.
            Self::Level | Self::Noise => (0.01, Worse::Both),
        }
    }
}

/// A series with its chart. What follows from the chart is `None` while there are too few scans.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ChartView {
    pub quantity: Quantity,
    pub source: Option<SourceId>,
    /// Counted from 1.
    pub channel: Option<usize>,
    /// Number of values; the newest of them are in `points`.
    pub scans: usize,
    pub centre: Option<f64>,
    pub spread: Option<f64>,
    /// The largest distance of the average from the centre that is no drift.
    pub limit: Option<f64>,
    /// The smallest sudden change that is found soon.
    pub finds: Option<f64>,
    /// The moving average after the newest scan.
    pub average: Option<f64>,
    pub drifted: bool,
    pub points: Vec<PointView>,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PointView {
    pub id: String,
    pub unix_ms: u64,
    pub value: f64,
    /// The moving average after this scan; `None` for the scans from which the centre is estimated.
    pub average: Option<f64>,
}

/// The values of one reference scan.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Reading {
    pub id: String,
    pub unix_ms: u64,
    fit: Option<f64>,
    distance: Option<f64>,
    levels: Vec<ChannelLevel>,
}

/// The surface that a scan was, by its correction or else by its answer.
pub(super) fn surface_of(entry: &HistoryEntry) -> Option<&str> {
    match &entry.correction {
        Some(correction) => Correction::surface(correction),
        None if entry.head.state == AnswerState::Unnamed => None,
        None => entry.head.surface.as_deref(),
    }
}

impl Reading {
    /// The values of a scan of `surface`; `None` for a scan that lacks data.
    pub(super) fn of(row: HistoryRow, surface: &str) -> Option<Self> {
        if !row.spoiled.is_empty() {
            return None;
        }
        let finite = |value: &Value| value.as_f64().filter(|value| value.is_finite());
        let field = |name: &str| row.others.get(name);
        let ranked = field("ranked").and_then(Value::as_array).into_iter().flatten();
        let score =
            ranked.filter(|one| one["surface"] == surface).find_map(|one| finite(&one["score"]));
        let score = score.filter(|score| *score > 0.0 && *score < f64::MAX);
        let levels = field("levels").cloned().map(serde_json::from_value).transpose();
        Some(Self {
            fit: field("p_value").and_then(finite),
            distance: score.map(f64::ln),
            // Answers of older versions have no levels.
            levels: levels.ok().flatten().unwrap_or_default(),
            id: row.head.id,
            unix_ms: row.head.unix_ms,
        })
    }
}

type Key = (Quantity, Option<(SourceId, usize)>);
type Points<'a> = Vec<(&'a Reading, f64)>;

/// All series of the readings of one surface, the oldest value first.
fn series(readings: &[Reading]) -> BTreeMap<Key, Points<'_>> {
    let mut all: BTreeMap<Key, Points<'_>> = BTreeMap::new();
    let has_fit = readings.iter().any(|reading| reading.fit.is_some());
    for reading in readings {
        let mut add = |key: Key, value: Option<f64>| {
            all.entry(key).or_default().extend(value.map(|value| (reading, value)));
        };
        match has_fit {
            true => add((Quantity::Fit, None), reading.fit),
            false => add((Quantity::Distance, None), reading.distance),
        }
        for ChannelLevel { source, channel, level_db, noise_db } in &reading.levels {
            let of = || Some((source.clone(), *channel));
            add((Quantity::Level, of()), Some(*level_db));
            add((Quantity::Noise, of()), *noise_db);
        }
    }
    all.retain(|_, points| !points.is_empty());
    all
}

impl Drift {
    /// The charts of these readings, the oldest first, of each reference surface since its moment.
    pub(super) fn of(all: &[(String, u64, Vec<Reading>)]) -> Self {
        let of_each: Vec<_> = all.iter().map(|(_, _, readings)| series(readings)).collect();
        let charts = of_each.iter().map(BTreeMap::len).sum();
        let mut drift =
            Self { needed: BASELINE, one_false_alarm_in: WITHIN, within: SOON, ..Self::default() };
        for ((surface, since, readings), of) in all.iter().zip(of_each) {
            let mut views = Vec::new();
            for (key, points) in of {
                let values: Vec<f64> = points.iter().map(|(_, value)| *value).collect();
                let (resolution, worse) = key.0.how();
                let chart = Chart::of(&values, charts, resolution, worse);
                let drifted = chart.as_ref().filter(|chart| chart.has_drifted);
                drift.doubts.extend(drifted.map(|chart| doubt(&key, surface, chart)));
                views.push(view(key, &points, chart));
            }
            drift.references.push(ReferenceView {
                surface: surface.clone(),
                since_unix_ms: *since,
                scans: readings.len(),
                series: views,
            });
        }
        drift
    }
}

fn doubt((quantity, channel): &Key, surface: &str, chart: &Chart) -> Doubt {
    let moved = chart.averages.last().map_or(0.0, |average| average - chart.centre);
    let (surface, limit) = (surface.to_string(), chart.limit);
    match (quantity, channel.clone()) {
        (Quantity::Noise, Some((source, channel))) => {
            Doubt::NoiseDrift { source, channel, surface, moved_db: moved, limit_db: limit }
        }
        (_, Some((source, channel))) => {
            Doubt::LevelDrift { source, channel, surface, moved_db: moved, limit_db: limit }
        }
        (_, None) => Doubt::FitDrift { surface, moved, limit },
    }
}

/// The doubts about drift whose subject differs from those of all doubts `before`.
pub fn news<'a>(before: &[Doubt], doubts: &'a [Doubt]) -> impl Iterator<Item = &'a Doubt> {
    doubts.iter().filter(|doubt| !before.iter().any(|known| about(known) == about(doubt)))
}

/// The subject of a doubt about drift, without its numbers, which change with each scan.
fn about(doubt: &Doubt) -> (Discriminant<Doubt>, &str, Option<(&SourceId, usize)>) {
    let (surface, channel) = match doubt {
        Doubt::LevelDrift { source, channel, surface, .. }
        | Doubt::NoiseDrift { source, channel, surface, .. } => {
            (surface.as_str(), Some((source, *channel)))
        }
        Doubt::FitDrift { surface, .. } => (surface.as_str(), None),
        _ => ("", None),
    };
    (discriminant(doubt), surface, channel)
}

fn view((quantity, of): Key, points: &Points<'_>, chart: Option<Chart>) -> ChartView {
    let averages = chart.as_ref().map_or(&[][..], |chart| &chart.averages);
    let first = points.len() - averages.len();
    let point = |(at, (reading, value)): (usize, &(&Reading, f64))| PointView {
        id: reading.id.clone(),
        unix_ms: reading.unix_ms,
        value: *value,
        average: at.checked_sub(first).map(|at| averages[at]),
    };
    let older = points.len().saturating_sub(MOST_POINTS);
    let (source, channel) = of.unzip();
    ChartView {
        quantity,
        source,
        channel,
        scans: points.len(),
        centre: chart.as_ref().map(|chart| chart.centre),
        spread: chart.as_ref().map(|chart| chart.spread),
        limit: chart.as_ref().map(|chart| chart.limit),
        finds: chart.as_ref().map(|chart| chart.finds),
        average: averages.last().copied(),
        drifted: chart.as_ref().is_some_and(|chart| chart.has_drifted),
        points: points.iter().enumerate().skip(older).map(point).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::history::{History, Truth, tests};
    use crate::seed;
    use crate::station::Answer;

    fn id(name: &str) -> SourceId {
        SourceId::new(name).unwrap()
    }

    /// The answer to a scan with these levels of `ac`, in the drag and at rest.
    fn answer(scan: u32, surface: &str, level_db: f64, noise_db: Option<f64>) -> Answer {
        let level = ChannelLevel { source: id("ac"), channel: 1, level_db, noise_db };
        Answer {
            unix_ms: 1000 + u64::from(scan),
            p_value: Some(0.5),
            levels: vec![level],
            ..tests::answer(scan, Some(surface))
        }
    }

    fn oak_since(unix_ms: u64) -> BTreeMap<String, u64> {
        BTreeMap::from([("oak".into(), unix_ms)])
    }

    /// Levels of a gain that falls by 10 % after scan `falls`, and that spread by 0.2 dB.
    fn levels(count: u32, falls: u32) -> Vec<(u32, f64)> {
        let mut rng = seed::rng(5, &[]);
        let fallen = |scan: u32| if scan > falls { 20.0 * 0.9_f64.log10() } else { 0.0 };
        (1..=count).map(|scan| (scan, 0.2 * seed::normal(&mut rng) + fallen(scan) - 20.0)).collect()
    }

    #[test]
    fn a_gain_that_falls_by_a_tenth_is_found_within_15_reference_scans_and_nothing_is_said_before_26()
     {
        let history = History::default();
        history.refer(&oak_since(0));
        let falls = BASELINE as u32 + 20;
        for (scan, level_db) in levels(falls + SOON as u32, falls) {
            history.answered(&answer(scan, "oak", level_db, Some(-60.0))).unwrap();
            let drift = history.drift();
            let [reference] = &drift.references[..] else { panic!("{drift:?}") };
            assert_eq!(reference.scans, scan as usize);
            let is_known = scan > BASELINE as u32;
            assert!(
                reference.series.iter().all(|chart| chart.limit.is_some() == is_known),
                "{scan}"
            );
            assert!(drift.doubts.is_empty() || scan > falls, "{scan}: {:?}", drift.doubts);
        }
        let drift = history.drift();
        let [Doubt::LevelDrift { source, channel: 1, surface, moved_db, .. }] = &drift.doubts[..]
        else {
            panic!("{:?}", drift.doubts)
        };
        assert_eq!((source, &**surface), (&id("ac"), "oak"));
        assert!((-1.0..-0.4).contains(moved_db), "{moved_db}");
        let quantities: Vec<_> = drift.references[0].series.iter().map(|of| of.quantity).collect();
        assert_eq!(quantities, [Quantity::Fit, Quantity::Level, Quantity::Noise]);
        let json = serde_json::to_value(&*drift).unwrap();
        assert_eq!(json["doubts"][0]["kind"], "level_drift");
        assert_eq!(json["references"][0]["series"][0]["source"], Value::Null);
    }

    #[test]
    fn a_scan_counts_as_what_its_correction_says_and_not_before_its_moment_or_if_it_lacks_data() {
        let history = History::default();
        for (scan, surface) in [(1, "oak"), (2, "oak"), (3, "ash"), (4, "oak")] {
            history.answered(&answer(scan, surface, -20.0, None)).unwrap();
        }
        let spoiled = Answer { doubts: vec![Doubt::Cut], ..answer(5, "oak", -20.0, None) };
        history.answered(&spoiled).unwrap();
        assert!(history.drift().references.is_empty(), "no reference yet");
        history.refer(&oak_since(1002));
        let scans = || {
            let drift = history.drift();
            let points = drift.references[0].series.first().map(|of| of.points.clone());
            points.unwrap_or_default().iter().map(|point| point.unix_ms - 1000).collect::<Vec<_>>()
        };
        assert_eq!(scans(), [2, 4]);
        let said = |truth| Some(Correction { truth, person: None });
        let oak = said(Truth::Surface { surface: "oak".into() });
        history.correct(&answer(3, "", 0.0, None).id, oak).unwrap();
        history.correct(&answer(4, "", 0.0, None).id, said(Truth::Unknown)).unwrap();
        assert_eq!(scans(), [2, 3]);
    }

    #[test]
    fn the_first_reference_scans_outlast_the_space_of_the_answers_and_a_restart() {
        let folder = tempfile::tempdir().unwrap();
        let most_bytes = 8 * 100_000;
        {
            let history = History::open(folder.path(), most_bytes).unwrap();
            history.refer(&oak_since(0));
            for scan in 1..=600 {
                let surface = if scan <= 30 { "oak" } else { "ash" };
                history.answered(&answer(scan, surface, -20.0, None)).unwrap();
            }
            assert_eq!(history.drift().references[0].scans, 30);
        }
        let history = History::open(folder.path(), most_bytes).unwrap();
        history.refer(&oak_since(0));
        assert!(history.extent().scans < 600);
        assert_eq!(history.drift().references[0].scans, 30);
    }
}
