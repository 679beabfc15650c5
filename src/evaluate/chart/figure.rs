//! The chart as a picture: accuracy against latency and against scan time.

use super::panel::{colours, latency_panel, legend, lettered, time_panel};
use super::point::{Chart, ChartPoint, front};
use crate::draw::{Area, Drawn, FigureError, put, svg};

const WIDTH: u32 = 1400;
const HEAD: u32 = 78;
const PANEL: u32 = 520;
/// Height of a line of text below the panels.
const LINE: i32 = 20;
const MARGIN: i32 = 24;

/// An SVG with accuracy against median latency (log axis) on the left and against scan time on the
/// right. Bars are 95 % intervals, ticks are users, the thick line is the Pareto front, whose points are
/// numbered and listed below, dashed lines with letters are negative controls, and hollow points use only some of the sources.
///
/// # Errors
/// If there are no points.
pub fn figure(chart: &Chart) -> Result<String, FigureError> {
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
            put(
                root,
                format!("Best trade-offs of accuracy and {what} (Pareto front):"),
                (x, top),
                14,
            )?;
            for (row, point) in front.iter().enumerate() {
                let text = format!("{}  {}", row + 1, line(chart, point));
                put(root, text, (x, top + LINE * (row as i32 + 1)), 13)?;
            }
        }
        Ok(())
    })
}

/// A line about a point.
fn line(chart: &Chart, point: &ChartPoint) -> String {
    let name = if point.control { point.setting.clone() } else { point.name() };
    let some = !point.control && chart.is_subset(point);
    let sources =
        if some { format!(", {} alone", point.sources.join(" + ")) } else { String::new() };
    let seconds = point.query_seconds.map(|s| format!(", first {s} s")).unwrap_or_default();
    format!(
        "{name}{sources}{seconds}: {:.1} % ({:.1} to {:.1}), {} ms",
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
    let key = format!(
        "bars: {}{}; thick line: Pareto front, numbered and listed below; dashed: negative \
         controls, what a room or a session may give away",
        chart.bars(),
        if chart.has_users() { "; ticks: each user's share" } else { "" }
    );
    put(root, key, (MARGIN, 58), 13)
}

#[cfg(test)]
mod tests {
    use super::super::point::tests::{chart, point};
    use super::*;

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

    #[test]
    fn numbers_have_three_digits() {
        assert_eq!(
            [0.1234, 1.234, 12.34, 1234.0].map(three_digits),
            ["0.123", "1.23", "12.3", "1234"]
        );
    }
}
