//! The measured points of a chart, and the Pareto front among them.

use crate::evaluate::{FoldAccuracy, Outcome, Protocol, interval_over_users, is_over_users};
use crate::scene::SourceId;

/// The measured accuracy and latency of one setting of one method.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct ChartPoint {
    pub method: String,
    /// The command-line options that reproduce this point, or the name of a control.
    pub setting: String,
    pub sources: Vec<String>,
    /// The part of each query's drag that was used, in seconds; `None` for the whole drag.
    pub query_seconds: Option<f64>,
    pub accuracy: f64,
    /// Lower end of the 95 % interval, taken over users if there are at least 5, else over queries.
    pub accuracy_low: f64,
    pub accuracy_high: f64,
    /// Accuracy of each user, if queries and library are split by user.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub users: Vec<FoldAccuracy>,
    /// Median time from raw samples to the answer, in milliseconds.
    pub query_ms_p50: f64,
    pub query_ms_p99: f64,
    pub queries: usize,
    /// Whether the point is of another program. Always false here; `tools/peers` adds such points to
    /// the JSON.
    pub peer: bool,
    /// Whether the point is a negative control, which shows how much room and session alone reveal.
    pub control: bool,
}

impl ChartPoint {
    pub fn new(
        outcome: &Outcome,
        protocol: Protocol,
        setting: &str,
        query_seconds: Option<f64>,
        control: bool,
    ) -> Self {
        let (users, (accuracy_low, accuracy_high)) = if protocol.folds_are_users() {
            (outcome.folds.clone(), interval_over_users(&outcome.folds))
        } else {
            (Vec::new(), outcome.share.interval())
        };
        Self {
            method: if control { "control".into() } else { outcome.method.clone() },
            setting: setting.into(),
            sources: outcome.sources.iter().map(SourceId::to_string).collect(),
            query_seconds,
            accuracy: outcome.share.value(),
            accuracy_low,
            accuracy_high,
            users,
            query_ms_p50: outcome.query_ms_p50,
            query_ms_p99: outcome.query_ms_p99,
            queries: outcome.queries,
            control,
            peer: false,
        }
    }

    /// Name of the method, followed by its options, if the setting has any.
    pub fn name(&self) -> String {
        let options = self.setting.trim_start_matches("--method ");
        let options = options.strip_prefix(self.method.as_str()).unwrap_or(options).trim();
        let options = options.replace("--repetitions ", "R = ").replace("--n ", "n = ");
        let options = options.replace("--", "");
        if options.is_empty() {
            self.method.clone()
        } else {
            format!("{} ({options})", self.method)
        }
    }
}

/// The points that no other point beats in both `cost` (smaller is better) and accuracy, by
/// ascending cost.
pub(super) fn front<'a>(
    points: &[&'a ChartPoint],
    cost: impl Fn(&ChartPoint) -> f64,
) -> Vec<&'a ChartPoint> {
    let mut front = points.to_vec();
    front.sort_by(|a, b| cost(a).total_cmp(&cost(b)).then(b.accuracy.total_cmp(&a.accuracy)));
    let mut best = f64::NEG_INFINITY;
    front.retain(|point| {
        let better = point.accuracy > best;
        best = best.max(point.accuracy);
        better
    });
    front
}

/// A whole chart, as the JSON file beside the SVG holds it.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct Chart {
    pub data: String,
    pub synthetic: bool,
    pub protocol: String,
    /// All sources; a point may have used fewer.
    pub sources: Vec<String>,
    /// Number of surfaces that could be the answer.
    pub surfaces: usize,
    /// Number of trials in the library of a fold.
    pub library_trials: usize,
    pub threads: usize,
    /// Length of a whole drag in seconds, if there is one.
    pub drag_s: Option<f64>,
    pub points: Vec<ChartPoint>,
}

impl Chart {
    pub fn methods(&self) -> impl Iterator<Item = &ChartPoint> {
        self.points.iter().filter(|point| !point.control)
    }

    pub fn controls(&self) -> impl Iterator<Item = &ChartPoint> {
        self.points.iter().filter(|point| point.control)
    }

    /// The points of all settings that were measured at several scan times.
    pub fn timed(&self) -> Vec<&ChartPoint> {
        let same = |a: &ChartPoint, b: &ChartPoint| {
            (&a.method, &a.setting, &a.sources) == (&b.method, &b.setting, &b.sources)
        };
        let has_others = |a: &&ChartPoint| {
            self.methods().any(|b| same(a, b) && a.query_seconds != b.query_seconds)
        };
        self.methods().filter(has_others).collect()
    }

    /// The kind of interval that the bars show, for the legend.
    pub(super) fn bars(&self) -> &'static str {
        if self.points.iter().any(|point| is_over_users(&point.users)) {
            "95 % interval over users"
        } else {
            "95 % interval over queries"
        }
    }

    /// Whether a point used only some of the sources.
    pub fn is_subset(&self, point: &ChartPoint) -> bool {
        point.sources.len() < self.sources.len()
    }

    /// Scan time of a point in seconds, which is the length of the part of the drag that was used.
    pub fn scan_s(&self, point: &ChartPoint) -> f64 {
        point.query_seconds.or(self.drag_s).unwrap_or(0.0)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub(crate) fn point(method: &str, ms: f64, accuracy: f64) -> ChartPoint {
        ChartPoint {
            method: method.into(),
            sources: vec!["ac".into(), "mi2".into()],
            accuracy,
            accuracy_low: accuracy - 0.05,
            accuracy_high: (accuracy + 0.02).min(1.0),
            query_ms_p50: ms,
            queries: 200,
            ..ChartPoint::default()
        }
    }

    pub(crate) fn chart(points: Vec<ChartPoint>) -> Chart {
        Chart {
            data: "a <scene>".into(),
            synthetic: true,
            sources: vec!["ac".into(), "mi2".into()],
            drag_s: Some(4.8),
            points,
            ..Chart::default()
        }
    }

    #[test]
    fn the_front_holds_what_nothing_beats() {
        let points = [
            point("slow and good", 10.0, 0.9),
            point("fast and good", 1.0, 0.9),
            point("fastest", 0.5, 0.4),
            point("slowest and best", 20.0, 0.95),
            point("slow and bad", 30.0, 0.1),
        ];
        let shown: Vec<&ChartPoint> = points.iter().collect();
        let names = front(&shown, |p| p.query_ms_p50).into_iter().map(|p| p.method.as_str());
        let names: Vec<&str> = names.collect();
        assert_eq!(names, ["fastest", "fast and good", "slowest and best"]);
    }

    #[test]
    fn a_name_is_short_and_differs_between_settings() {
        let name = |method: &str, setting: &str| {
            ChartPoint { setting: setting.into(), ..point(method, 1.0, 1.0) }.name()
        };
        assert_eq!(name("svm", "--method svm"), "svm");
        assert_eq!(
            name("reference", "--method reference --n 100 --repetitions 10 --halving"),
            "reference (n = 100 R = 10 halving)"
        );
        assert_eq!(name("lda", "log bands"), "lda (log bands)");
    }
}
