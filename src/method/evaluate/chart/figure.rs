//! The chart: its measured points, the Pareto front among them, and its picture, which shows accuracy
//! against latency and against scan time.

use std::collections::BTreeMap;
use std::ops::Range;

use plotters::coord::ranged1d::Ranged;
use plotters::prelude::*;

use crate::draw::{
    Area, Drawn, FigureError, GREY, Labels, Look, Panel, PixelBox, apart, axes, colour, line,
    marker, put, text_width, titled,
};
use crate::evaluate::{FoldAccuracy, Interval, Over};

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
    #[serde(flatten)]
    pub interval: Interval,
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
    pub left_out: String,
    /// All sources; a point may have used fewer.
    pub sources: Vec<String>,
    pub surfaces: usize,
    pub library_trials: usize,
    pub threads: usize,
    /// Length of a whole drag in seconds, if there is one.
    pub drag_s: Option<f64>,
    pub points: Vec<ChartPoint>,
}

impl Chart {
    pub(crate) fn methods(&self) -> impl Iterator<Item = &ChartPoint> {
        self.points.iter().filter(|point| !point.control)
    }

    pub(crate) fn controls(&self) -> impl Iterator<Item = &ChartPoint> {
        self.points.iter().filter(|point| point.control)
    }

    /// The kind of interval that the bars show.
    pub fn bars(&self) -> String {
        let over = self.points.first().map_or(Over::Queries, |point| point.interval.over);
        format!("95 % interval over {}", over.plural())
    }

    /// Whether a point used only some of the sources.
    pub(crate) fn is_subset(&self, point: &ChartPoint) -> bool {
        point.sources.len() < self.sources.len()
    }

    /// Scan time of a point in seconds, which is the length of the part of the drag that was used.
    pub fn scan_s(&self, point: &ChartPoint) -> f64 {
        point.query_seconds.or(self.drag_s).unwrap_or(0.0)
    }
}

/// Width of the figure on a screen, and from which width on the panels stand side by side.
const WIDTH: u32 = 1400;
const SIDE_BY_SIDE: u32 = 800;
const FONT: i32 = 13;
/// Distance in pixels between the points of different methods at one scan time.
const BESIDE: f64 = 7.0;

/// An SVG with accuracy against median latency (log axis), and accuracy against scan time if there are
/// several. Bars are intervals, and ticks are users. The grey line is the Pareto front, grey dashed lines
/// are negative controls. Hollow points use only some of the sources.
pub fn figure(chart: &Chart, look: Look) -> Result<String, FigureError> {
    let whole: Vec<_> = chart.methods().filter(|point| point.query_seconds.is_none()).collect();
    if whole.is_empty() {
        return Err(FigureError("the chart has no point for whole drags".into()));
    }
    let all: Vec<&ChartPoint> = chart.methods().filter(|point| !chart.is_subset(point)).collect();
    let is_timed = all.iter().any(|point| point.query_seconds.is_some());
    let width = look.pixels(WIDTH);
    let columns = if is_timed && width >= SIDE_BY_SIDE { 2 } else { 1 };
    let rows = if is_timed { 3 - columns } else { 1 };
    let panel = (width / columns * 3 / 4).clamp(300, 520);
    titled((&title(chart), chart.synthetic), (width, panel * rows), look, |area| {
        let areas = area.split_evenly((rows as usize, columns as usize));
        latency_panel(&areas[0], chart, &whole)?;
        areas.get(1).map_or(Ok(()), |area| time_panel(area, chart, &all))
    })
}

fn title(chart: &Chart) -> String {
    let queries = chart.points.iter().map(|p| p.queries).max().unwrap_or(0);
    format!(
        "{} · {} · {} surfaces, {} library trials, n = {queries} queries · {} · bars: {}",
        chart.data,
        chart.protocol,
        chart.surfaces,
        chart.library_trials,
        chart.sources.join(", "),
        chart.bars()
    )
}

/// The number of a method's curve, by which it is drawn.
fn curve(chart: &Chart, method: &str) -> usize {
    let mut methods: Vec<&str> = Vec::new();
    for point in chart.methods() {
        if !methods.contains(&point.method.as_str()) {
            methods.push(&point.method);
        }
    }
    methods.iter().position(|name| *name == method).unwrap_or(0)
}

/// The range of an accuracy axis: from below all intervals (also of controls) to above 100 %.
fn axis(chart: &Chart, points: &[&ChartPoint]) -> Range<f64> {
    let all = points.iter().copied().chain(chart.controls());
    let low = all.map(|p| p.interval.low).fold(1.0, f64::min);
    (low * 10.0 - 0.01).floor().max(0.0) / 10.0..1.04
}

/// Draws accuracy against median latency, on a logarithmic axis. Each method is named at its most
/// accurate point, and each part of the sources at its own.
fn latency_panel(area: &Area<'_>, chart: &Chart, whole: &[&ChartPoint]) -> Drawn {
    let ms = |p: &ChartPoint| p.query_ms_p50.max(1e-3);
    let from = whole.iter().map(|p| ms(p)).fold(f64::INFINITY, f64::min) / 1.8;
    let to = whole.iter().map(|p| ms(p)).fold(0.0, f64::max) * 1.8;
    let of_x = "median latency of a query [ms]";
    let (x, y) = (((from..to).log_scale(), of_x), (axis(chart, whole), "accuracy"));
    let mut panel = axes(area, x, y, percent)?;
    let line = front(whole, ms).into_iter().map(|p| (ms(p), p.accuracy));
    panel.draw_series(LineSeries::new(line, BLACK.mix(0.18).stroke_width(4)))?;
    let mut labels = controls(area, &mut panel, chart, (from, to))?;
    let at = |point: &&ChartPoint| place(area, &panel, ms(point), point.accuracy);
    for point in whole {
        bar(area, &panel, chart, point, ms(point))?;
        let (x, y) = at(point);
        labels.take([x - 7, y - 7, x + 7, y + 7]);
    }
    let best = |point: &&&ChartPoint| {
        let same = whole.iter().filter(|p| p.method == point.method && !chart.is_subset(p));
        let most = same.max_by(|a, b| a.accuracy.total_cmp(&b.accuracy));
        most.is_some_and(|most| std::ptr::eq(*most, **point))
    };
    for point in whole.iter().filter(best) {
        labels.put(area, &point.method, at(point), FONT)?;
    }
    for point in whole.iter().filter(|point| chart.is_subset(point)) {
        labels.put(area, &point.sources.join("+"), at(point), FONT - 2)?;
    }
    Ok(())
}

/// Draws accuracy against scan time for `points`, with a line for each setting of a method that was
/// measured at several times. Methods are named at the right, in the order of their last points.
fn time_panel(area: &Area<'_>, chart: &Chart, points: &[&ChartPoint]) -> Drawn {
    let end = points.iter().map(|p| chart.scan_s(p)).fold(0.1, f64::max);
    // Names take a third of a narrow panel.
    let names = points.iter().map(|p| text_width(&p.method, FONT)).max().unwrap_or(0) + 50;
    let share = f64::from(names) / f64::from(area.dim_in_pixel().0 - 100);
    let to = end / (1.0 - share.min(0.5));
    let (x, y) = ((0.0..to, "scan time used [s]"), (axis(chart, points), "accuracy"));
    let mut panel = axes(area, x, y, percent)?;
    // Methods stand beside each other, so that their intervals can be told apart.
    let count = points.iter().map(|p| curve(chart, &p.method)).max().unwrap_or(0) as f64;
    let [left, top, right, bottom] = frame(area, &panel);
    let step = BESIDE * to / f64::from(right - left);
    let x = |point: &ChartPoint| {
        chart.scan_s(point) + step * (curve(chart, &point.method) as f64 - count / 2.0)
    };
    let mut lines: BTreeMap<(&str, &str), Vec<(f64, f64)>> = BTreeMap::new();
    for point in points {
        let line = lines.entry((&point.method, &point.setting)).or_default();
        line.push((x(point), point.accuracy));
    }
    for ((method, _), mut points) in lines.into_iter().filter(|(_, points)| points.len() > 1) {
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        line(&mut panel, points, curve(chart, method))?;
    }
    controls(area, &mut panel, chart, (0.0, end))?;
    let mut last: BTreeMap<usize, (&ChartPoint, (i32, i32))> = BTreeMap::new();
    for point in points {
        bar(area, &panel, chart, point, x(point))?;
        let number = curve(chart, &point.method);
        let is_last = |(best, _): &(&ChartPoint, _)| {
            (chart.scan_s(best), best.accuracy) <= (chart.scan_s(point), point.accuracy)
        };
        if last.get(&number).is_none_or(is_last) {
            last.insert(number, (point, place(area, &panel, x(point), point.accuracy)));
        }
    }
    // Of points at one height, the rightmost has the highest name, so that lines do not cross.
    let heights: Vec<i32> = last.values().rev().map(|(_, (_, y))| *y).collect();
    let moved = apart(&heights, FONT + 3, top + FONT / 2..bottom - FONT / 2);
    let right = place(area, &panel, end + step * count / 2.0, 0.5).0 + 26;
    for ((point, at), y) in last.values().rev().zip(moved) {
        area.draw(&PathElement::new([*at, (right - 3, y)], GREY.stroke_width(1)))?;
        put(area, point.method.as_str(), (right, y - FONT / 2), FONT)?;
    }
    // Leading lines must not hide the points.
    last.iter().try_for_each(|(number, (_, at))| marker(area, *at, *number, false))
}

fn percent(y: &f64) -> String {
    if *y > 1.001 { String::new() } else { format!("{:.0} %", y * 100.0) }
}

fn place<X: Ranged<ValueType = f64>>(
    area: &Area<'_>,
    panel: &Panel<'_, '_, X>,
    x: f64,
    accuracy: f64,
) -> (i32, i32) {
    let ((x, y), (left, top)) = (panel.backend_coord(&(x, accuracy)), area.get_base_pixel());
    (x - left, y - top)
}

fn frame<X: Ranged<ValueType = f64>>(area: &Area<'_>, panel: &Panel<'_, '_, X>) -> PixelBox {
    let ((x, y), (left, top)) = (panel.plotting_area().get_pixel_range(), area.get_base_pixel());
    [x.start - left, y.start - top, x.end - left, y.end - top]
}

/// Draws the controls as dashed lines with their names. Returns where labels may go.
fn controls<X: Ranged<ValueType = f64>>(
    area: &Area<'_>,
    panel: &mut Panel<'_, '_, X>,
    chart: &Chart,
    ends: (f64, f64),
) -> Result<Labels, FigureError> {
    let mut labels = Labels::new(frame(area, panel));
    for control in chart.controls() {
        let line = [ends.0, ends.1].map(|x| (x, control.accuracy));
        panel.draw_series(DashedLineSeries::new(line, 3, 4, GREY.stroke_width(1)))?;
        let (x, y) = place(area, panel, ends.0, control.accuracy);
        labels.take([x, y - 2, place(area, panel, ends.1, control.accuracy).0, y + 2]);
        let text = format!("control: {}", control.setting.trim_end_matches(" alone"));
        let width = text_width(&text, FONT - 2);
        labels.put(area, &text, (x + width / 2 + 2, y), FONT - 2)?;
    }
    Ok(labels)
}

/// Draws a point with its interval, and a tick for each user.
fn bar<X: Ranged<ValueType = f64>>(
    area: &Area<'_>,
    panel: &Panel<'_, '_, X>,
    chart: &Chart,
    point: &ChartPoint,
    x: f64,
) -> Drawn {
    let at = |accuracy: f64| place(area, panel, x, accuracy);
    let number = curve(chart, &point.method);
    let ends = [point.interval.low, point.interval.high].map(at);
    area.draw(&PathElement::new(ends, colour(number).mix(0.6).stroke_width(1)))?;
    for user in &point.users {
        let (x, y) = at(user.share.value());
        let tick =
            PathElement::new([(x - 4, y), (x + 4, y)], colour(number).mix(0.6).stroke_width(1));
        area.draw(&tick)?;
    }
    marker(area, at(point.accuracy), number, chart.is_subset(point))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(method: &str, ms: f64, accuracy: f64) -> ChartPoint {
        let (low, high) = (accuracy - 0.05, (accuracy + 0.02).min(1.0));
        ChartPoint {
            method: method.into(),
            sources: vec!["ac".into(), "mi2".into()],
            accuracy,
            interval: Interval { low, high, over: Over::Queries },
            query_ms_p50: ms,
            queries: 200,
            ..ChartPoint::default()
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
    fn a_chart_names_its_methods_controls_and_kind_of_data() {
        let mut points = vec![point("reference", 300.0, 0.7), point("embedding", 2.0, 1.0)];
        points.push(ChartPoint { query_seconds: Some(0.5), ..point("embedding", 2.0, 0.95) });
        points.push(ChartPoint { sources: vec!["ac".into()], ..point("embedding", 1.0, 0.8) });
        let control = ChartPoint { control: true, ..point("control", 2.0, 0.5) };
        points.push(ChartPoint { setting: "loudness alone".into(), ..control });
        let mut chart = Chart {
            data: "a <scene>".into(),
            synthetic: true,
            sources: vec!["ac".into(), "mi2".into()],
            drag_s: Some(4.8),
            points,
            ..Chart::default()
        };
        let svg = figure(&chart, Look::default()).unwrap();
        for text in [
            "reference",
            "embedding",
            "control: loudness",
            "SYNTHETIC",
            "a &lt;scene&gt;",
            "scan time used",
            "bars: 95 % interval over queries",
        ] {
            assert!(svg.contains(text), "{text}");
        }
        let look = Look { no_title: true, ..Look::default() };
        chart.points.retain(|point| point.query_seconds.is_none());
        let svg = figure(&chart, look).unwrap();
        assert!(svg.contains("SYNTHETIC") && !svg.contains("a &lt;scene&gt;"));
        assert!(!svg.contains("scan time used"), "a panel without a line is not drawn");
        assert!(figure(&Chart { points: vec![], ..chart }, look).is_err());
    }
}
