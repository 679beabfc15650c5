//! Several charts in one picture: accuracy against latency, a panel each, and one table of numbers.

use plotters::prelude::*;

use super::figure::three_digits;
use super::legend::{PointMark, lettered};
use super::panel::{bar, controls, percent, place};
use super::point::{Chart, ChartPoint};
use crate::draw::{Area, COLOURS, Drawn, FigureError, drawing, put, svg};

const WIDTH: u32 = 960;
const HEAD: u32 = 62;
const COLUMNS: usize = 2;
const PANEL: (u32, u32) = (WIDTH / COLUMNS as u32, 350);
/// Height of a row of the table.
const ROW: i32 = 22;
const MARGIN: i32 = 16;
/// Where the table's columns begin.
const CELLS: i32 = 250;

/// A setting's method and options, the same in every chart.
type SettingKey<'a> = (&'a str, &'a str);

/// An SVG with a panel for each chart, all with the same axes: accuracy against median latency (log
/// axis), on whole drags with all sources. Bars are 95 % intervals, ticks are users, squares are
/// programs of others, dashed lines with letters are negative controls. Marks are numbered as the
/// rows of the table below.
///
/// # Errors
/// If a chart has no point for whole drags.
pub fn side_by_side(charts: &[Chart]) -> Result<String, FigureError> {
    let rows = rows(charts);
    if charts.iter().any(|chart| shown(chart).next().is_none()) {
        return Err(FigureError("a chart has no point for whole drags".into()));
    }
    let axes = Axes::of(charts);
    let panels = HEAD + charts.len().div_ceil(COLUMNS) as u32 * PANEL.1;
    let controls = charts.iter().map(|chart| chart.controls().count()).max().unwrap_or(0);
    let table = (rows.len() + controls + 2) as i32 * ROW + 2 * MARGIN;
    svg((WIDTH, panels + table as u32), |root| {
        head(root, charts)?;
        for (i, chart) in charts.iter().enumerate() {
            let (column, row) = ((i % COLUMNS) as u32, (i / COLUMNS) as u32);
            let area = root.clone().shrink((column * PANEL.0, HEAD + row * PANEL.1), PANEL);
            panel(&area, chart, &axes, &rows)?;
        }
        numbers(root, charts, &rows, panels as i32 + MARGIN)
    })
}

/// The points that are drawn.
fn shown(chart: &Chart) -> impl Iterator<Item = &ChartPoint> {
    chart.methods().filter(|point| point.query_seconds.is_none() && !chart.is_subset(point))
}

/// The settings of all charts, in the order in which they come.
fn rows(charts: &[Chart]) -> Vec<&ChartPoint> {
    let mut rows: Vec<&ChartPoint> = Vec::new();
    for point in charts.iter().flat_map(shown) {
        if !rows.iter().any(|row| key(row) == key(point)) {
            rows.push(point);
        }
    }
    rows
}

fn key(point: &ChartPoint) -> SettingKey<'_> {
    (&point.method, &point.setting)
}

fn colour(row: usize) -> RGBColor {
    COLOURS[row % COLOURS.len()]
}

fn ms(point: &ChartPoint) -> f64 {
    point.query_ms_p50.max(1e-3)
}

/// What the axes of all panels show.
struct Axes {
    ms: (f64, f64),
    accuracy: (f64, f64),
}

impl Axes {
    fn of(charts: &[Chart]) -> Self {
        let points = || charts.iter().flat_map(shown);
        let least = points().map(ms).fold(f64::INFINITY, f64::min) / 1.6;
        let most = points().map(ms).fold(0.0, f64::max) * 1.6;
        let users = points().flat_map(|point| point.users.iter().map(|user| user.accuracy));
        let low = points().chain(charts.iter().flat_map(Chart::controls));
        let low = low.map(|point| point.accuracy_low).chain(users).fold(1.0, f64::min);
        Self { ms: (least, most), accuracy: ((low * 10.0 - 0.01).floor().max(0.0) / 10.0, 1.04) }
    }
}

fn head(root: &Area<'_>, charts: &[Chart]) -> Drawn {
    put(root, "How well and how fast surfaces are named", (MARGIN, 10), 20)?;
    // An interval over users anywhere is named, beside the other kind.
    let mut bars: Vec<&str> = charts.iter().map(Chart::bars).collect();
    bars.sort_unstable();
    bars.dedup();
    let ticks = if charts.iter().any(Chart::has_users) { "ticks: each user's share; " } else { "" };
    let is_controlled = charts.iter().any(|chart| chart.controls().next().is_some());
    let dashed = if is_controlled { "; dashed: negative controls" } else { "" };
    let key = format!("bars: {}; {ticks}squares: programs of others{dashed}", bars.join(" or "));
    put(root, key, (MARGIN, 38), 13)
}

fn panel(area: &Area<'_>, chart: &Chart, axes: &Axes, rows: &[&ChartPoint]) -> Drawn {
    let kind = if chart.synthetic { "SYNTHETIC " } else { "" };
    put(area, format!("{kind}{}, {}", chart.data, chart.protocol), (56, 4), 15)?;
    let queries = shown(chart).map(|point| point.queries).max().unwrap_or(0);
    let users = shown(chart).map(|point| point.users.len()).max().unwrap_or(0);
    let by = if users > 0 { format!(" by {users} users") } else { String::new() };
    let facts = format!(
        "{} surfaces, {} library trials, {queries} queries{by}",
        chart.surfaces, chart.library_trials
    );
    put(area, facts, (56, 24), 13)?;
    let (ms_axis, accuracy) = (axes.ms.0..axes.ms.1, axes.accuracy.0..axes.accuracy.1);
    let mut panel = ChartBuilder::on(area)
        .margin(8)
        .margin_top(44)
        .x_label_area_size(38)
        .y_label_area_size(48)
        .build_cartesian_2d(ms_axis.log_scale(), accuracy)
        .map_err(drawing)?;
    (panel.configure_mesh())
        .light_line_style(TRANSPARENT)
        .bold_line_style(BLACK.mix(0.08))
        .x_desc("median latency of a query [ms]")
        .x_label_formatter(&|x| x.to_string())
        .y_label_formatter(&|y| percent(*y))
        .label_style(("sans-serif", 13))
        .draw()
        .map_err(drawing)?;
    controls(area, &panel, chart, axes.ms)?;
    for point in shown(chart) {
        let Some(row) = rows.iter().position(|row| key(row) == key(point)) else { continue };
        bar(area, &panel, point, ms(point), colour(row))?;
        let at = place(area, &panel, ms(point), point.accuracy);
        mark(row, point).draw(area, at)?;
        put(area, (row + 1).to_string(), (at.0 + 8, at.1 - 14), 12)?;
    }
    Ok(())
}

fn mark(row: usize, point: &ChartPoint) -> PointMark {
    PointMark { colour: colour(row), square: point.peer, hollow: false }
}

/// The table: a row for each setting, a column for each chart.
fn numbers(root: &Area<'_>, charts: &[Chart], rows: &[&ChartPoint], top: i32) -> Drawn {
    let width = (WIDTH as i32 - CELLS - MARGIN) / charts.len().max(1) as i32;
    let cells = |row: i32, of: &dyn Fn(&Chart) -> Option<String>| {
        for (column, chart) in charts.iter().enumerate() {
            let at = (CELLS + column as i32 * width, top + row * ROW);
            put(root, of(chart).unwrap_or_else(|| "–".into()), at, 13)?;
        }
        Ok(())
    };
    cells(0, &|chart| Some(chart.data.clone()))?;
    cells(1, &|chart| Some(chart.protocol.clone()))?;
    for (i, row) in rows.iter().enumerate() {
        let line = i as i32 + 2;
        let y = top + line * ROW;
        put(root, (i + 1).to_string(), (MARGIN, y), 13)?;
        mark(i, row).draw(root, (MARGIN + 28, y + 7))?;
        put(root, row.method.as_str(), (MARGIN + 42, y), 13)?;
        cells(line, &|chart| shown(chart).find(|point| key(point) == key(row)).map(value))?;
    }
    let most = charts.iter().max_by_key(|chart| chart.controls().count());
    for (i, (letter, control)) in most.into_iter().flat_map(lettered).enumerate() {
        let line = (rows.len() + 2 + i) as i32;
        put(root, format!("{letter}  {}", control.setting), (MARGIN, top + line * ROW), 13)?;
        cells(line, &|chart| lettered(chart).nth(i).map(|(_, control)| value(control)))?;
    }
    Ok(())
}

fn value(point: &ChartPoint) -> String {
    format!("{:.1} %, {} ms", 100.0 * point.accuracy, three_digits(point.query_ms_p50))
}

#[cfg(test)]
mod tests {
    use super::super::point::tests::{chart, point};
    use super::*;
    use crate::evaluate::FoldAccuracy;

    #[test]
    fn every_chart_has_its_panel_and_every_setting_its_row() {
        let users = ["user1", "user2"].map(|name| FoldAccuracy {
            name: name.into(),
            accuracy: 0.31,
            queries: 9,
        });
        let mut ours = point("embedding", 2.0, 0.9);
        ours.users = users.to_vec();
        let first =
            chart(vec![ours.clone(), ChartPoint { peer: true, ..point("quant", 20.0, 0.8) }]);
        let control = ChartPoint { control: true, ..point("control", 2.0, 0.5) };
        let control = ChartPoint { setting: "loudness alone".into(), ..control };
        let second = chart(vec![ours, control]);
        let second = Chart { data: "other".into(), synthetic: false, ..second };
        let svg = side_by_side(&[first.clone(), second]).unwrap();
        for text in [
            "SYNTHETIC a &lt;scene&gt;, leave-one-trial-out",
            "other, leave-one-trial-out",
            "200 queries by 2 users",
            "90.0 %, 2.00 ms",
            "80.0 %, 20.0 ms",
            "a  loudness alone",
            "95 % interval over queries; ticks",
            // The axis reaches down to the user who fared worst.
            "30 %",
        ] {
            assert!(svg.contains(text), "{text}");
        }
        let empty = Chart { points: vec![], ..first.clone() };
        assert!(side_by_side(&[first, empty]).is_err());
    }
}
