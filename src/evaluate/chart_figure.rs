//! The chart as a picture: accuracy against latency and against scan time.

use std::collections::BTreeMap;

use plotters::coord::ranged1d::Ranged;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

use super::chart::{Chart, Point, pareto};
use crate::draw::{Area, COLOURS, Drawn, FigureError, drawing, put, svg};

const WIDTH: u32 = 1400;
const HEAD: u32 = 78;
const PANEL: u32 = 520;
/// Height of a line of text below the panels.
const LINE: i32 = 20;
const MARGIN: i32 = 24;
const GREY: RGBColor = RGBColor(120, 120, 120);

type Panel<'a, 'b, X> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<X, RangedCoordf64>>;
type Colours<'a> = BTreeMap<&'a str, RGBColor>;

/// An SVG with accuracy against median latency (log axis) on the left and against scan time on the
/// right. Bars are 95 % Wilson intervals, the thick line is the front that nothing beats, whose
/// points are numbered and told below, dashed lines are negative controls, squares are programs of
/// others, and hollow points use only some of the sources.
///
/// # Errors
/// If there are no points.
pub fn figure(chart: &Chart) -> Result<String, FigureError> {
    let colours = colours(chart);
    let whole: Vec<&Point> =
        chart.methods().filter(|point| point.query_seconds.is_none()).collect();
    if whole.is_empty() {
        return Err(FigureError("the chart has no point for whole drags".into()));
    }
    let fronts = [front(&whole, |p| p.query_ms_p50), front(&timed(chart), |p| chart.scan_s(p))];
    let told = fronts.iter().map(Vec::len).max().unwrap_or(0) as i32;
    let below = (legend_rows(chart, &colours).len() as i32 + told + 2) * LINE + MARGIN;
    svg((WIDTH, HEAD + PANEL + below as u32), |root| {
        head(root, chart)?;
        let (_, rest) = root.split_vertically(HEAD);
        let (panels, _) = rest.split_vertically(PANEL);
        let (left, right) = panels.split_horizontally(WIDTH / 2);
        latency_panel(&left, chart, &whole, &colours)?;
        time_panel(&right, chart, &colours)?;
        let mut top = (HEAD + PANEL) as i32 + 8;
        for row in legend_rows(chart, &colours) {
            let mut x = MARGIN;
            for key in row {
                key.draw(root, (x, top))?;
                x += key.width();
            }
            top += LINE;
        }
        for (column, (front, what)) in fronts.iter().zip(["latency", "scan time"]).enumerate() {
            let x = MARGIN + column as i32 * WIDTH as i32 / 2;
            put(
                root,
                format!("Nothing measured here beats, in accuracy and {what}:"),
                (x, top),
                14,
            )?;
            for (row, point) in front.iter().enumerate() {
                let text = told_point(chart, row + 1, point);
                put(root, text, (x, top + LINE * (row as i32 + 1)), 13)?;
            }
        }
        Ok(())
    })
}

fn told_point(chart: &Chart, number: usize, point: &Point) -> String {
    let sources = if chart.is_subset(point) {
        format!(", {} alone", point.sources.join(" + "))
    } else {
        String::new()
    };
    let seconds = point.query_seconds.map(|s| format!(", first {s} s")).unwrap_or_default();
    format!(
        "{number}  {}{sources}{seconds}: {:.1} % ({:.1} to {:.1}), {} ms",
        point.name(),
        100.0 * point.accuracy,
        100.0 * point.accuracy_low,
        100.0 * point.accuracy_high,
        three_digits(point.query_ms_p50)
    )
}

fn three_digits(x: f64) -> String {
    let decimals = (2 - x.max(1e-3).log10().floor() as i32).clamp(0, 3) as usize;
    format!("{x:.decimals$}")
}

fn head(root: &Area<'_>, chart: &Chart) -> Drawn {
    put(
        root,
        format!("How well and how fast surfaces are named: {}", chart.data),
        (MARGIN, 12),
        20,
    )?;
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
    let key = "bars: 95 % Wilson interval over queries; thick line: what nothing beats, numbered \
               and told below; dashed: negative controls, what a room and a session give away";
    put(root, key, (MARGIN, 58), 13)
}

/// Methods in the order in which they come, each with its colour.
fn colours(chart: &Chart) -> Colours<'_> {
    let mut methods: Vec<&str> = Vec::new();
    for point in chart.methods() {
        if !methods.contains(&point.method.as_str()) {
            methods.push(&point.method);
        }
    }
    methods.into_iter().zip(COLOURS.into_iter().cycle()).collect()
}

/// Settings that were measured on several scan times.
fn timed(chart: &Chart) -> Vec<&Point> {
    let same = |a: &Point, b: &Point| {
        (&a.method, &a.setting, &a.sources) == (&b.method, &b.setting, &b.sources)
    };
    let has_others =
        |a: &&Point| chart.methods().any(|b| same(a, b) && a.query_seconds != b.query_seconds);
    chart.methods().filter(has_others).collect()
}

fn front<'a>(points: &[&'a Point], cost: impl Fn(&Point) -> f64) -> Vec<&'a Point> {
    let owned: Vec<Point> = points.iter().map(|&p| p.clone()).collect();
    pareto(&owned, cost).into_iter().map(|i| points[i]).collect()
}

/// The accuracies that an axis shows, controls included.
fn axis(chart: &Chart, points: &[&Point]) -> std::ops::Range<f64> {
    let all = points.iter().copied().chain(chart.controls());
    let low = all.map(|p| p.accuracy_low).fold(1.0, f64::min);
    (low * 10.0 - 0.01).floor().max(0.0) / 10.0..1.03
}

fn latency_panel(area: &Area<'_>, chart: &Chart, whole: &[&Point], colours: &Colours<'_>) -> Drawn {
    let ms = |p: &Point| p.query_ms_p50.max(1e-3);
    let from = whole.iter().map(|p| ms(p)).fold(f64::INFINITY, f64::min) / 1.6;
    let to = whole.iter().map(|p| ms(p)).fold(0.0, f64::max) * 1.6;
    let mut panel = builder(area)
        .build_cartesian_2d((from..to).log_scale(), axis(chart, whole))
        .map_err(drawing)?;
    (panel.configure_mesh())
        .light_line_style(TRANSPARENT)
        .bold_line_style(BLACK.mix(0.08))
        .x_desc("median latency of a query [ms], from raw samples to the answer, whole drag")
        .y_desc("accuracy")
        .x_label_formatter(&|x| three_digits(*x).trim_end_matches('0').trim_end_matches('.').into())
        .y_label_formatter(&|y| percent(*y))
        .label_style(("sans-serif", 14))
        .draw()
        .map_err(drawing)?;
    marks(area, &mut panel, chart, (from, to), whole, colours, ms)
}

fn time_panel(area: &Area<'_>, chart: &Chart, colours: &Colours<'_>) -> Drawn {
    let shown = timed(chart);
    let end = chart.points.iter().map(|p| chart.scan_s(p)).fold(0.1, f64::max) * 1.06;
    let mut panel =
        builder(area).build_cartesian_2d(0.0..end, axis(chart, &shown)).map_err(drawing)?;
    (panel.configure_mesh())
        .light_line_style(TRANSPARENT)
        .bold_line_style(BLACK.mix(0.08))
        .x_desc("scan time used [s]; settings that were measured on several")
        .y_desc("accuracy")
        .y_label_formatter(&|y| percent(*y))
        .label_style(("sans-serif", 14))
        .draw()
        .map_err(drawing)?;
    let mut lines: BTreeMap<(&str, &str), Vec<(f64, f64)>> = BTreeMap::new();
    for point in &shown {
        let line = lines.entry((&point.method, &point.setting)).or_default();
        line.push((chart.scan_s(point), point.accuracy));
    }
    for ((method, _), mut line) in lines {
        line.sort_by(|a, b| a.0.total_cmp(&b.0));
        let style = colours[method].mix(0.6).stroke_width(1);
        panel.draw_series(LineSeries::new(line, style)).map_err(drawing)?;
    }
    marks(area, &mut panel, chart, (0.0, end), &shown, colours, |p| chart.scan_s(p))
}

fn builder<'a, 'b>(area: &'a Area<'b>) -> ChartBuilder<'a, 'b, SVGBackend<'b>> {
    let mut builder = ChartBuilder::on(area);
    builder.margin(14).x_label_area_size(46).y_label_area_size(64);
    builder
}

fn percent(y: f64) -> String {
    if y > 1.001 { String::new() } else { format!("{:.0} %", y * 100.0) }
}

/// Controls, front and points.
fn marks<X: Ranged<ValueType = f64>>(
    area: &Area<'_>,
    panel: &mut Panel<'_, '_, X>,
    chart: &Chart,
    ends: (f64, f64),
    points: &[&Point],
    colours: &Colours<'_>,
    x: impl Fn(&Point) -> f64,
) -> Drawn {
    let place = |panel: &Panel<'_, '_, X>, x: f64, y: f64| {
        let ((left, top), at) = (area.get_base_pixel(), panel.backend_coord(&(x, y)));
        (at.0 - left, at.1 - top)
    };
    let mut above = i32::MAX;
    let mut controls: Vec<&Point> = chart.controls().collect();
    controls.sort_by(|a, b| a.accuracy.total_cmp(&b.accuracy));
    for control in controls {
        let (from, to) =
            (place(panel, ends.0, control.accuracy), place(panel, ends.1, control.accuracy));
        for dash in (from.0..to.0).step_by(10) {
            let line = [(dash, from.1), ((dash + 5).min(to.0), from.1)];
            area.draw(&PathElement::new(line, GREY.stroke_width(1))).map_err(drawing)?;
        }
        // Names do not run into each other.
        above = (from.1 - 15).min(above - 15);
        let text = format!("{}: {:.0} %", control.setting, 100.0 * control.accuracy);
        let text =
            Text::new(text, (from.0 + 8, above), ("sans-serif", 12).into_font().color(&GREY));
        area.draw(&text).map_err(drawing)?;
    }
    let front = front(points, &x);
    let line = front.iter().map(|p| (x(p), p.accuracy));
    panel.draw_series(LineSeries::new(line, BLACK.mix(0.3).stroke_width(3))).map_err(drawing)?;
    for point in points {
        let colour = colours[point.method.as_str()];
        let bar = [(x(point), point.accuracy_low), (x(point), point.accuracy_high)];
        let bar = PathElement::new(bar, colour.mix(0.45).stroke_width(1));
        panel.draw_series([bar]).map_err(drawing)?;
        let key = Mark { colour, square: point.peer, hollow: chart.is_subset(point) };
        key.draw(area, place(panel, x(point), point.accuracy))?;
    }
    let mut before = (i32::MIN / 2, 0);
    for (number, point) in front.iter().enumerate() {
        let at = place(panel, x(point), point.accuracy_high);
        // Close ones stand at different heights.
        let lift = if at.0 - before.0 < 16 { before.1 + 14 } else { 0 };
        before = (at.0, lift);
        put(area, (number + 1).to_string(), (at.0 - 4, at.1 - 16 - lift), 13)?;
    }
    Ok(())
}

/// How a point looks.
#[derive(Clone, Copy)]
struct Mark {
    colour: RGBColor,
    square: bool,
    hollow: bool,
}

impl Mark {
    fn draw(self, area: &Area<'_>, (x, y): (i32, i32)) -> Drawn {
        let style = if self.hollow { self.colour.stroke_width(2) } else { self.colour.filled() };
        if self.square {
            area.draw(&Rectangle::new([(x - 5, y - 5), (x + 5, y + 5)], style)).map_err(drawing)
        } else {
            area.draw(&Circle::new((x, y), 5, style)).map_err(drawing)
        }
    }
}

/// A name in the legend.
struct Key {
    name: String,
    mark: Mark,
}

impl Key {
    /// About what the text takes.
    fn width(&self) -> i32 {
        self.name.chars().count() as i32 * 7 + 40
    }

    fn draw(&self, area: &Area<'_>, (x, y): (i32, i32)) -> Drawn {
        self.mark.draw(area, (x + 6, y + 7))?;
        put(area, self.name.as_str(), (x + 18, y), 13)
    }
}

/// The legend, as many names in a row as fit.
fn legend_rows(chart: &Chart, colours: &Colours<'_>) -> Vec<Vec<Key>> {
    let mut keys: Vec<Key> = Vec::new();
    for point in chart.methods() {
        let colour = colours[point.method.as_str()];
        let hollow = chart.is_subset(point);
        let name = match (point.peer, hollow) {
            (true, _) => format!("{} (a peer)", point.method),
            (false, true) => format!("{}, some sources", point.method),
            (false, false) => point.method.clone(),
        };
        if !keys.iter().any(|key| key.name == name) {
            keys.push(Key { name, mark: Mark { colour, square: point.peer, hollow } });
        }
    }
    let mut rows: Vec<Vec<Key>> = Vec::new();
    let mut used = i32::MAX;
    for key in keys {
        if used + key.width() > WIDTH as i32 - 2 * MARGIN {
            rows.push(Vec::new());
            used = 0;
        }
        used += key.width();
        rows.extend(rows.is_empty().then(Vec::new));
        if let Some(row) = rows.last_mut() {
            row.push(key);
        }
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::super::chart::tests::{chart, point};
    use super::*;

    #[test]
    fn a_chart_names_its_methods_controls_and_kind_of_data() {
        let mut points = vec![point("reference", 300.0, 0.7), point("embedding", 2.0, 1.0)];
        points.push(Point { query_seconds: Some(0.5), ..point("embedding", 2.0, 0.95) });
        points.push(Point { sources: vec!["ac".into()], ..point("embedding", 1.0, 0.8) });
        let control = Point { control: true, ..point("control", 2.0, 0.5) };
        points.push(Point { setting: "loudness alone".into(), ..control });
        points.push(Point { peer: true, ..point("MiniRocket", 9.0, 0.98) });
        let chart = chart(points);
        let svg = figure(&chart).unwrap();
        for text in [
            "reference",
            "embedding, some sources",
            "loudness alone: 50 %",
            "MiniRocket (a peer)",
            "SYNTHETIC",
            "first 0.5 s",
            "a &lt;scene&gt;",
        ] {
            assert!(svg.contains(text), "{text}");
        }
        assert!(figure(&Chart { points: vec![], ..chart }).is_err());
    }

    #[test]
    fn numbers_have_three_digits() {
        assert_eq!(
            [0.1234, 1.234, 12.34, 1234.0].map(three_digits),
            ["0.123", "1.23", "12.3", "1234"]
        );
    }
}
