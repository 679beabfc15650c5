//! The chart: its measured points, the Pareto front among them, and its picture, which shows accuracy
//! against latency and against scan time.

use std::collections::BTreeMap;
use std::ops::Range;

use plotters::coord::ranged1d::Ranged;
use plotters::prelude::*;

use crate::draw::{Area, COLOURS, Drawn, FigureError, GREY, Panel, axes, put, svg, three_digits};
use crate::evaluate::{FoldAccuracy, Interval, Outcome, Over};
use crate::scene::SourceId;

/// The measured accuracy and latency of one setting of one method.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub(crate) struct ChartPoint {
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

impl ChartPoint {
    pub(crate) fn new(
        outcome: &Outcome,
        over: Over,
        setting: &str,
        query_seconds: Option<f64>,
        control: bool,
    ) -> Self {
        let users = if over == Over::People { outcome.folds.clone() } else { Vec::new() };
        let interval = Interval::of(&outcome.folds, over);
        Self {
            method: if control { "control".into() } else { outcome.method.clone() },
            setting: setting.into(),
            sources: outcome.sources.iter().map(SourceId::to_string).collect(),
            query_seconds,
            accuracy: outcome.share.value(),
            interval,
            users,
            query_ms_p50: outcome.query_ms_p50,
            query_ms_p99: outcome.query_ms_p99,
            queries: outcome.queries,
            control,
            peer: false,
        }
    }

    /// Name of the method, followed by its options, if the setting has any.
    pub(crate) fn name(&self) -> String {
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
pub(crate) struct Chart {
    pub data: String,
    pub synthetic: bool,
    pub protocol: String,
    /// Which trials are left out, and what that leaves untold.
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

    /// The points of all settings that were measured at several scan times.
    pub(crate) fn timed(&self) -> Vec<&ChartPoint> {
        let same = |a: &ChartPoint, b: &ChartPoint| {
            (&a.method, &a.setting, &a.sources) == (&b.method, &b.setting, &b.sources)
        };
        let has_others = |a: &&ChartPoint| {
            self.methods().any(|b| same(a, b) && a.query_seconds != b.query_seconds)
        };
        self.methods().filter(has_others).collect()
    }

    /// The kind of interval that the bars show, for the legend.
    pub(super) fn bars(&self) -> String {
        let over = self.points.first().map_or(Over::Queries, |point| point.interval.over);
        format!("95 % interval over {}", over.plural())
    }

    /// Whether a point used only some of the sources.
    pub(crate) fn is_subset(&self, point: &ChartPoint) -> bool {
        point.sources.len() < self.sources.len()
    }

    /// Scan time of a point in seconds, which is the length of the part of the drag that was used.
    pub(crate) fn scan_s(&self, point: &ChartPoint) -> f64 {
        point.query_seconds.or(self.drag_s).unwrap_or(0.0)
    }
}

const WIDTH: u32 = 1400;
const HEAD: u32 = 78;
const PANEL: u32 = 520;
/// Height of a line of text below the panels.
const LINE: i32 = 20;
const MARGIN: i32 = 24;

/// An SVG with accuracy against median latency (log axis) on the left, and against scan time on the
/// right. Bars are 95 % intervals, and ticks are users. The thick line is the Pareto front; its points
/// are numbered and listed below. Dashed lines with letters are negative controls. Hollow points use
/// only some of the sources.
pub(crate) fn figure(chart: &Chart) -> Result<String, FigureError> {
    let colours = colours(chart);
    let whole: Vec<&ChartPoint> =
        chart.methods().filter(|point| point.query_seconds.is_none()).collect();
    if whole.is_empty() {
        return Err(FigureError("the chart has no point for whole drags".into()));
    }
    let fronts = [front(&whole, |p| p.query_ms_p50), front(&chart.timed(), |p| chart.scan_s(p))];
    let longest = fronts.iter().map(Vec::len).max().unwrap_or(0) as i32;
    let controls = chart.controls().count() as i32;
    let below = (controls + longest + 2) * LINE + 24 + MARGIN;
    svg((WIDTH, HEAD + PANEL + below as u32), |root| {
        head(root, chart)?;
        let (_, rest) = root.split_vertically(HEAD);
        let (panels, _) = rest.split_vertically(PANEL);
        let (left, right) = panels.split_horizontally(WIDTH / 2);
        latency_panel(&left, chart, &whole, &colours)?;
        time_panel(&right, chart, &colours)?;
        let mut top = (HEAD + PANEL) as i32 + 8;
        legend(root, chart, &colours, (MARGIN, top))?;
        top += LINE;
        for (letter, control) in lettered(chart) {
            let text = format!("{letter}  negative control, {}", line(chart, control));
            put(root, text, (MARGIN, top), 13)?;
            top += LINE;
        }
        top += 8;
        for (column, (front, what)) in fronts.iter().zip(["latency", "scan time"]).enumerate() {
            let x = MARGIN + column as i32 * WIDTH as i32 / 2;
            let text = format!("Best trade-offs of accuracy and {what} (Pareto front):");
            put(root, text, (x, top), 14)?;
            for (row, point) in front.iter().enumerate() {
                let text = format!("{}  {}", row + 1, line(chart, point));
                put(root, text, (x, top + LINE * (row as i32 + 1)), 13)?;
            }
        }
        Ok(())
    })
}

fn line(chart: &Chart, point: &ChartPoint) -> String {
    let name = if point.control { point.setting.clone() } else { point.name() };
    let sources = match !point.control && chart.is_subset(point) {
        true => format!(", {} alone", point.sources.join(" + ")),
        false => String::new(),
    };
    let seconds = point.query_seconds.map(|s| format!(", first {s} s")).unwrap_or_default();
    let [accuracy, low, high] =
        [point.accuracy, point.interval.low, point.interval.high].map(|share| 100.0 * share);
    let ms = three_digits(point.query_ms_p50);
    format!("{name}{sources}{seconds}: {accuracy:.1} % ({low:.1} to {high:.1}), {ms} ms")
}

fn head(root: &Area<'_>, chart: &Chart) -> Drawn {
    let title = format!("How well and how fast surfaces are named: {}", chart.data);
    put(root, title, (MARGIN, 12), 20)?;
    let kind =
        if chart.synthetic { "SYNTHETIC data, made by a generator" } else { "recorded data" };
    let queries = chart.points.iter().map(|p| p.queries).max().unwrap_or(0);
    let facts = format!(
        "{kind} · {} · {} surfaces, {} library trials, {queries} queries · sources {}",
        chart.protocol,
        chart.surfaces,
        chart.library_trials,
        chart.sources.join(", ")
    );
    put(root, facts, (MARGIN, 38), 14)?;
    let has_users = chart.points.iter().any(|point| !point.users.is_empty());
    let key = format!(
        "bars: {}{}; thick line: Pareto front, numbered and listed below; dashed: negative \
         controls, what a room or a session may give away",
        chart.bars(),
        if has_users { "; ticks: each user's share" } else { "" }
    );
    put(root, key, (MARGIN, 58), 13)
}

type Colours<'a> = BTreeMap<&'a str, RGBColor>;

fn colours(chart: &Chart) -> Colours<'_> {
    let mut methods: Vec<&str> = Vec::new();
    for point in chart.methods() {
        if !methods.contains(&point.method.as_str()) {
            methods.push(&point.method);
        }
    }
    methods.into_iter().zip(COLOURS.into_iter().cycle()).collect()
}

/// The negative controls, each with the letter that its line has in the chart.
fn lettered(chart: &Chart) -> impl Iterator<Item = (String, &ChartPoint)> {
    ('a'..='z').map(String::from).zip(chart.controls())
}

/// A dot in a colour; `hollow` if its point uses only some of the sources.
fn dot<C>(at: C, colour: RGBColor, hollow: bool) -> Circle<C, i32> {
    Circle::new(at, 5, if hollow { colour.stroke_width(2) } else { colour.filled() })
}

/// Draws a row with the colour and the name of each method; its upper left corner is `(x, top)`.
fn legend(
    area: &Area<'_>,
    chart: &Chart,
    colours: &Colours<'_>,
    (mut x, top): (i32, i32),
) -> Drawn {
    let mut named: Vec<String> = Vec::new();
    for point in chart.methods() {
        let hollow = chart.is_subset(point);
        let name = format!("{}{}", point.method, if hollow { ", some sources" } else { "" });
        if !named.contains(&name) {
            area.draw(&dot((x + 6, top + 7), colours[point.method.as_str()], hollow))?;
            put(area, name.as_str(), (x + 18, top), 13)?;
            // A letter is about 7 pixels wide.
            x += name.chars().count() as i32 * 7 + 40;
            named.push(name);
        }
    }
    Ok(())
}

/// The range of an accuracy axis: from below all intervals (also of controls) to above 100 %.
fn axis(chart: &Chart, points: &[&ChartPoint]) -> Range<f64> {
    let all = points.iter().copied().chain(chart.controls());
    let low = all.map(|p| p.interval.low).fold(1.0, f64::min);
    (low * 10.0 - 0.01).floor().max(0.0) / 10.0..1.08
}

/// Draws accuracy against median latency, on a logarithmic axis.
fn latency_panel(
    area: &Area<'_>,
    chart: &Chart,
    whole: &[&ChartPoint],
    colours: &Colours<'_>,
) -> Drawn {
    let ms = |p: &ChartPoint| p.query_ms_p50.max(1e-3);
    let from = whole.iter().map(|p| ms(p)).fold(f64::INFINITY, f64::min) / 1.6;
    let to = whole.iter().map(|p| ms(p)).fold(0.0, f64::max) * 1.6;
    let of_x = "median latency of a query [ms], from raw samples to the answer, whole drag";
    let (x, y) = (((from..to).log_scale(), of_x), (axis(chart, whole), "accuracy"));
    let mut panel = axes(area, "", x, y, percent)?;
    marks(&mut panel, chart, (from, to), whole, colours, ms)
}

fn time_panel(area: &Area<'_>, chart: &Chart, colours: &Colours<'_>) -> Drawn {
    let shown = chart.timed();
    let end = chart.points.iter().map(|p| chart.scan_s(p)).fold(0.1, f64::max) * 1.06;
    let of_x = "scan time used [s]; settings measured at several scan times";
    let (x, y) = ((0.0..end, of_x), (axis(chart, &shown), "accuracy"));
    let mut panel = axes(area, "", x, y, percent)?;
    let mut lines: BTreeMap<(&str, &str), Vec<(f64, f64)>> = BTreeMap::new();
    for point in &shown {
        let line = lines.entry((&point.method, &point.setting)).or_default();
        line.push((chart.scan_s(point), point.accuracy));
    }
    for ((method, _), mut line) in lines {
        line.sort_by(|a, b| a.0.total_cmp(&b.0));
        let style = colours[method].mix(0.6).stroke_width(1);
        panel.draw_series(LineSeries::new(line, style))?;
    }
    marks(&mut panel, chart, (0.0, end), &shown, colours, |p| chart.scan_s(p))
}

fn percent(y: &f64) -> String {
    if *y > 1.001 { String::new() } else { format!("{:.0} %", y * 100.0) }
}

/// Draws the controls as dashed lines, the Pareto front, and each point with its interval and a tick
/// for each user. `ends` are those of the axis of `x`.
fn marks<X: Ranged<ValueType = f64>>(
    panel: &mut Panel<'_, '_, X>,
    chart: &Chart,
    ends: (f64, f64),
    points: &[&ChartPoint],
    colours: &Colours<'_>,
    x: impl Fn(&ChartPoint) -> f64,
) -> Drawn {
    let font = ("sans-serif", 13);
    for (letter, control) in lettered(chart) {
        let line = [ends.0, ends.1].map(|x| (x, control.accuracy));
        panel.draw_series(DashedLineSeries::new(line, 5, 5, GREY.stroke_width(1)))?;
        panel.draw_series([EmptyElement::at(line[0]) + Text::new(letter, (4, -16), font)])?;
    }
    let front = front(points, &x);
    let line = front.iter().map(|p| (x(p), p.accuracy));
    panel.draw_series(LineSeries::new(line, BLACK.mix(0.3).stroke_width(3)))?;
    for point in points {
        let (x, colour) = (x(point), colours[point.method.as_str()]);
        let bar = [point.interval.low, point.interval.high].map(|y| (x, y));
        panel.draw_series([PathElement::new(bar, colour.mix(0.5).stroke_width(2))])?;
        panel.draw_series(point.users.iter().map(|user| {
            let tick = PathElement::new([(-6, 0), (6, 0)], colour.mix(0.7).stroke_width(1));
            EmptyElement::at((x, user.share.value())) + tick
        }))?;
        panel.draw_series([dot((x, point.accuracy), colour, chart.is_subset(point))])?;
    }
    let mut before = (i32::MIN / 2, 0);
    for (number, point) in (1..).zip(front) {
        let at = (x(point), point.interval.high);
        let (left, y) = panel.backend_coord(&at);
        // Numbers of points that are close together go one above the other.
        let top = if left - before.0 < 18 { (y - 16).min(before.1 - 13) } else { y - 16 };
        before = (left, top);
        let number = Text::new(number.to_string(), (-4, top - y), font);
        panel.draw_series([EmptyElement::at(at) + number])?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(method: &str, ms: f64, accuracy: f64) -> ChartPoint {
        ChartPoint {
            method: method.into(),
            sources: vec!["ac".into(), "mi2".into()],
            accuracy,
            interval: Interval {
                low: accuracy - 0.05,
                high: (accuracy + 0.02).min(1.0),
                ..Interval::default()
            },
            query_ms_p50: ms,
            queries: 200,
            ..ChartPoint::default()
        }
    }

    fn chart(points: Vec<ChartPoint>) -> Chart {
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

    #[test]
    fn a_chart_names_its_methods_controls_and_kind_of_data() {
        let mut points = vec![point("reference", 300.0, 0.7), point("embedding", 2.0, 1.0)];
        points.push(ChartPoint { query_seconds: Some(0.5), ..point("embedding", 2.0, 0.95) });
        points.push(ChartPoint { sources: vec!["ac".into()], ..point("embedding", 1.0, 0.8) });
        let control = ChartPoint { control: true, ..point("control", 2.0, 0.5) };
        points.push(ChartPoint { setting: "loudness alone".into(), ..control });
        let chart = chart(points);
        let svg = figure(&chart).unwrap();
        for text in [
            "reference",
            "embedding, some sources",
            "negative control, loudness alone: 50.0 %",
            "SYNTHETIC",
            "first 0.5 s",
            "a &lt;scene&gt;",
        ] {
            assert!(svg.contains(text), "{text}");
        }
        assert!(figure(&Chart { points: vec![], ..chart }).is_err());
    }
}
