//! The two panels of a chart, and how points and lines look.

use std::collections::BTreeMap;

use plotters::coord::ranged1d::Ranged;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

use super::point::{Chart, ChartPoint, front};
use crate::draw::{Area, COLOURS, Drawn, drawing, put};

const GREY: RGBColor = RGBColor(120, 120, 120);

/// The colour of each method.
pub(super) type Colours<'a> = BTreeMap<&'a str, RGBColor>;

/// Methods in their order in the chart, each with its colour.
pub(super) fn colours(chart: &Chart) -> Colours<'_> {
    let mut methods: Vec<&str> = Vec::new();
    for point in chart.methods() {
        if !methods.contains(&point.method.as_str()) {
            methods.push(&point.method);
        }
    }
    methods.into_iter().zip(COLOURS.into_iter().cycle()).collect()
}

/// The controls, each with the letter of its line.
pub(super) fn lettered(chart: &Chart) -> impl Iterator<Item = (String, &ChartPoint)> {
    ('a'..='z').map(String::from).zip(chart.controls())
}

/// Draws a point; `hollow` if it uses only some of the sources.
fn mark(area: &Area<'_>, at: (i32, i32), colour: RGBColor, hollow: bool) -> Drawn {
    let style = if hollow { colour.stroke_width(2) } else { colour.filled() };
    area.draw(&Circle::new(at, 5, style)).map_err(drawing)
}

/// A row that names the marks, with its upper left corner at `(x, top)`.
pub(super) fn legend(
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
            mark(area, (x + 6, top + 7), colours[point.method.as_str()], hollow)?;
            put(area, name.as_str(), (x + 18, top), 13)?;
            // About the width of the text.
            x += name.chars().count() as i32 * 7 + 40;
            named.push(name);
        }
    }
    Ok(())
}

type Panel<'a, 'b, X> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<X, RangedCoordf64>>;

/// The accuracies that an axis shows, controls included.
fn axis(chart: &Chart, points: &[&ChartPoint]) -> std::ops::Range<f64> {
    let all = points.iter().copied().chain(chart.controls());
    let low = all.map(|p| p.accuracy_low).fold(1.0, f64::min);
    (low * 10.0 - 0.01).floor().max(0.0) / 10.0..1.08
}

/// Accuracy against median latency, on a logarithmic axis.
pub(super) fn latency_panel(
    area: &Area<'_>,
    chart: &Chart,
    whole: &[&ChartPoint],
    colours: &Colours<'_>,
) -> Drawn {
    let ms = |p: &ChartPoint| p.query_ms_p50.max(1e-3);
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
        .x_label_formatter(&|x| x.to_string())
        .y_label_formatter(&|y| percent(*y))
        .label_style(("sans-serif", 14))
        .draw()
        .map_err(drawing)?;
    marks(area, &mut panel, chart, (from, to), whole, colours, ms)
}

/// Accuracy against scan time.
pub(super) fn time_panel(area: &Area<'_>, chart: &Chart, colours: &Colours<'_>) -> Drawn {
    let shown = chart.timed();
    let end = chart.points.iter().map(|p| chart.scan_s(p)).fold(0.1, f64::max) * 1.06;
    let mut panel =
        builder(area).build_cartesian_2d(0.0..end, axis(chart, &shown)).map_err(drawing)?;
    (panel.configure_mesh())
        .light_line_style(TRANSPARENT)
        .bold_line_style(BLACK.mix(0.08))
        .x_desc("scan time used [s]; settings measured at several scan times")
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

/// Where a value lies in an area.
fn place<X: Ranged<ValueType = f64>>(
    area: &Area<'_>,
    panel: &Panel<'_, '_, X>,
    x: f64,
    y: f64,
) -> (i32, i32) {
    let ((left, top), at) = (area.get_base_pixel(), panel.backend_coord(&(x, y)));
    (at.0 - left, at.1 - top)
}

/// Dashed lines, each with its letter.
fn controls<X: Ranged<ValueType = f64>>(
    area: &Area<'_>,
    panel: &Panel<'_, '_, X>,
    chart: &Chart,
    ends: (f64, f64),
) -> Drawn {
    for (letter, control) in lettered(chart) {
        let ends = [ends.0, ends.1].map(|end| place(area, panel, end, control.accuracy));
        for dash in (ends[0].0..ends[1].0).step_by(10) {
            let line = [(dash, ends[0].1), ((dash + 5).min(ends[1].0), ends[0].1)];
            area.draw(&PathElement::new(line, GREY.stroke_width(1))).map_err(drawing)?;
        }
        put(area, letter, (ends[0].0 + 4, ends[0].1 - 16), 13)?;
    }
    Ok(())
}

/// A point's interval, and a tick for each user's share.
fn bar<X: Ranged<ValueType = f64>>(
    area: &Area<'_>,
    panel: &Panel<'_, '_, X>,
    point: &ChartPoint,
    x: f64,
    colour: RGBColor,
) -> Drawn {
    let ends = [point.accuracy_low, point.accuracy_high].map(|y| place(area, panel, x, y));
    area.draw(&PathElement::new(ends, colour.mix(0.5).stroke_width(2))).map_err(drawing)?;
    for user in &point.users {
        let (x, y) = place(area, panel, x, user.share.value());
        let tick = PathElement::new([(x - 6, y), (x + 6, y)], colour.mix(0.7).stroke_width(1));
        area.draw(&tick).map_err(drawing)?;
    }
    Ok(())
}

/// Controls, front and points.
fn marks<X: Ranged<ValueType = f64>>(
    area: &Area<'_>,
    panel: &mut Panel<'_, '_, X>,
    chart: &Chart,
    ends: (f64, f64),
    points: &[&ChartPoint],
    colours: &Colours<'_>,
    x: impl Fn(&ChartPoint) -> f64,
) -> Drawn {
    controls(area, panel, chart, ends)?;
    let front = front(points, &x);
    let line = front.iter().map(|p| (x(p), p.accuracy));
    panel.draw_series(LineSeries::new(line, BLACK.mix(0.3).stroke_width(3))).map_err(drawing)?;
    for point in points {
        let colour = colours[point.method.as_str()];
        bar(area, panel, point, x(point), colour)?;
        mark(area, place(area, panel, x(point), point.accuracy), colour, chart.is_subset(point))?;
    }
    let mut before = (i32::MIN / 2, 0);
    for (number, point) in front.iter().enumerate() {
        let at = place(area, panel, x(point), point.accuracy_high);
        // Numbers of points that lie close together stand one above the other.
        let top = if at.0 - before.0 < 18 { (at.1 - 16).min(before.1 - 13) } else { at.1 - 16 };
        before = (at.0, top);
        put(area, (number + 1).to_string(), (at.0 - 4, top), 13)?;
    }
    Ok(())
}
