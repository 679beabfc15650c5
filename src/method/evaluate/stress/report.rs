//! The result of a stress run.

use std::fmt::Write as _;

use serde::{Deserialize, Serialize};

use crate::evaluate::Share;

/// A method counts as failing if it loses at least this much accuracy, as a fraction.
const LOSS: f64 = 0.05;
/// Fewest queries that it must lose, too: one is often lost by chance.
const FEWEST_LOST: f64 = 2.0;

/// Results of one method under one disturbance at one level of severity. Shares are from 0 to 1.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StressCell {
    pub accuracy: f64,
    /// The 95 % Wilson interval of the accuracy, over queries.
    #[serde(default)]
    pub accuracy_interval: Option<(f64, f64)>,
    /// Share of queries of known surfaces that would be called unknown.
    pub known_rejected: f64,
    /// Share of queries of unknown surfaces that would be called unknown, if there are any.
    pub unknown_rejected: Option<f64>,
    #[serde(default)]
    pub unknown_interval: Option<(f64, f64)>,
    /// Expected calibration error of the stated probability, for methods that state one.
    pub calibration_error: Option<f64>,
    /// Number of queries that could not be compared at all; they count as named wrong.
    pub refused: usize,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DisturbanceLevel {
    pub level: f64,
    #[serde(flatten)]
    pub cell: StressCell,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DisturbanceSeries {
    pub name: String,
    /// The quantity and unit of the severity, such as `SNR, dB`.
    pub axis: String,
    pub levels: Vec<DisturbanceLevel>,
    /// The first level that costs 5 percentage points of accuracy or more, and two queries or more; `None` if
    /// no level does.
    pub loses_5_points_at: Option<f64>,
}

impl DisturbanceSeries {
    /// Results at all levels of a disturbance, compared with the undisturbed accuracy of some queries.
    pub fn new(name: &str, axis: &str, levels: Vec<DisturbanceLevel>, clean: Share) -> Self {
        let loss = LOSS.max(FEWEST_LOST / clean.of.max(1) as f64);
        let lost = |level: &&DisturbanceLevel| level.cell.accuracy <= clean.value() - loss + 1e-9;
        let loses_5_points_at = levels.iter().find(lost).map(|level| level.level);
        Self { name: name.into(), axis: axis.into(), levels, loses_5_points_at }
    }

    /// Index of the first level that costs 5 percentage points of accuracy.
    fn breaks_at(&self) -> Option<usize> {
        self.levels.iter().position(|level| Some(level.level) == self.loses_5_points_at)
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MethodReport {
    pub method: String,
    /// Whether chance may explain the undisturbed accuracy: the lower end of its interval reaches no further
    /// than the share that is right if the most frequent surface is always named.
    #[serde(default)]
    pub may_be_chance: bool,
    pub clean: StressCell,
    pub disturbances: Vec<DisturbanceSeries>,
}

impl MethodReport {
    /// The disturbances that cost 5 points of accuracy earliest, counting from the mildest level.
    pub fn fails_first(&self) -> Vec<&str> {
        let Some(first) = self.disturbances.iter().filter_map(DisturbanceSeries::breaks_at).min()
        else {
            return Vec::new();
        };
        let there = |series: &&DisturbanceSeries| series.breaks_at() == Some(first);
        self.disturbances.iter().filter(there).map(|series| series.name.as_str()).collect()
    }
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StressReport {
    pub data: String,
    pub synthetic: bool,
    pub protocol: String,
    #[serde(default)]
    pub left_out: String,
    pub sources: Vec<String>,
    pub queries: usize,
    /// Number of queries that were also compared with a library without their surface.
    pub unknown_queries: usize,
    pub methods: Vec<MethodReport>,
}

impl StressReport {
    /// A table in Markdown: for each disturbance and method the first level that costs 5 points,
    /// and for each method the disturbances at which it fails first.
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        if self.synthetic {
            text += "SYNTHETIC data\n\n";
        }
        let mut line = |cells: Vec<String>| {
            // Writing to a String cannot fail.
            let _ = writeln!(text, "| {} |", cells.join(" | "));
        };
        let row = |head: &str, cell: &dyn Fn(&MethodReport) -> String| {
            [vec![head.to_string()], self.methods.iter().map(cell).collect()].concat()
        };
        line(row("loses 5 points at", &|m| format!("`{}`", m.method)));
        line(vec!["---".into(); self.methods.len() + 1]);
        let undisturbed =
            format!("undisturbed, %, of n = {} queries (95 % interval)", self.queries);
        line(row(&undisturbed, &|m| {
            let shown = |(low, high)| format!(" ({:.0} to {:.0})", 100.0 * low, 100.0 * high);
            let interval = m.clean.accuracy_interval.map(shown).unwrap_or_default();
            format!("{:.1}{interval}", 100.0 * m.clean.accuracy)
        }));
        let first = self.methods.first().map_or(&[][..], |m| &m.disturbances);
        for (at, series) in first.iter().enumerate() {
            line(row(&format!("{} ({})", series.name, series.axis), &|m| {
                if m.may_be_chance {
                    return "not shown".into();
                }
                let lost = m.disturbances.get(at).and_then(|s| s.loses_5_points_at);
                lost.map_or("–".into(), |level| level.to_string())
            }));
        }
        line(row("unknown surfaces rejected, %", &|m| {
            m.clean.unknown_rejected.map_or("–".into(), |share| format!("{:.0}", 100.0 * share))
        }));
        line(row("**fails first**", &|m| match m.fails_first().as_slice() {
            _ if m.may_be_chance => "not shown: undisturbed, it may name by chance".into(),
            [] => "nowhere".into(),
            names => names.join(", "),
        }));
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn series(name: &str, accuracies: &[f64]) -> DisturbanceSeries {
        let level = |(i, &accuracy): (usize, &f64)| DisturbanceLevel {
            level: i as f64,
            cell: StressCell { accuracy, ..StressCell::default() },
        };
        let levels = accuracies.iter().enumerate().map(level).collect();
        DisturbanceSeries::new(name, "unit", levels, Share { right: 90, of: 100 })
    }

    #[test]
    fn a_method_fails_first_where_the_mildest_level_costs_five_points() {
        let disturbances = vec![
            series("a", &[0.9, 0.86, 0.2]),
            series("b", &[0.9, 0.85, 0.9]),
            series("c", &[0.9, 0.9, 0.88]),
        ];
        assert_eq!(disturbances[0].loses_5_points_at, Some(2.0));
        assert_eq!(disturbances[2].loses_5_points_at, None);
        let clean = disturbances[0].levels[0].cell.clone();
        let may_be_chance = false;
        let method = MethodReport { method: "joint".into(), may_be_chance, clean, disturbances };
        assert_eq!(method.fails_first(), ["b"]);
        let chance = MethodReport { may_be_chance: true, ..method.clone() };
        let table = |method| StressReport { methods: vec![method], ..StressReport::default() };
        let at_chance = table(chance).markdown();
        for row in ["| b (unit) | not shown |", "| **fails first** | not shown: "] {
            assert!(at_chance.contains(row), "{at_chance}");
        }
        let table = table(method).markdown();
        for row in ["| b (unit) | 1 |", "| c (unit) | – |"] {
            assert!(table.contains(row), "{table}");
        }
    }

    #[test]
    fn the_loss_of_one_query_is_no_failure() {
        let level = |(level, accuracy)| DisturbanceLevel {
            level,
            cell: StressCell { accuracy, ..StressCell::default() },
        };
        let levels = [(1.0, 0.75), (2.0, 0.625)].map(level).to_vec();
        let found = DisturbanceSeries::new("a", "unit", levels, Share { right: 7, of: 8 });
        assert_eq!(found.loses_5_points_at, Some(2.0));
    }
}
