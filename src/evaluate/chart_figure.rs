//! The chart as a picture: accuracy against latency and against scan time.

use std::collections::BTreeMap;

use plotters::coord::Shift;
use plotters::coord::ranged1d::Ranged;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

use super::chart::{Chart, Point, pareto};

const PANEL: (u32, u32) = (640, 520);
const GREY: RGBColor = RGBColor(120, 120, 120);
/// Distinct also for the colour-blind (Okabe & Ito 2008).
pub(super) const COLOURS: [RGBColor; 10] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(150, 110, 0),
    RGBColor(0, 0, 0),
    RGBColor(230, 159, 0),
    RGBColor(120, 94, 240),
    RGBColor(128, 60, 40),
];

/// Why a chart cannot be drawn.
#[derive(Debug, thiserror::Error)]
#[error("the chart cannot be drawn: {0}")]
pub struct ChartError(pub(super) String);

pub(super) fn drawing(error: impl std::fmt::Display) -> ChartError {
    ChartError(error.to_string())
}

pub(super) type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Panel<'a, 'b, X> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<X, RangedCoordf64>>;

/// An SVG with accuracy against median latency (log axis) on the left and against scan time on the
/// right. Bars are 95 % Wilson intervals, the line is the front that nothing beats, hollow grey
/// points are negative controls, squares are programs of others.
///
/// # Errors
/// If there are no points.
pub fn figure(chart: &Chart) -> Result<String, ChartError> {
    if chart.points.is_empty() {
        return Err(ChartError("it has no points".into()));
    }
    let mut svg = String::new();
    {
        let size = (2 * PANEL.0, PANEL.1 + 40);
        let root = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        root.fill(&WHITE).map_err(drawing)?;
        let mark = if chart.synthetic { " (synthetic data)" } else { "" };
        let title = format!("{}{mark} · {}", chart.data, chart.protocol);
        let root = root.titled(&title, ("sans-serif", 20)).map_err(drawing)?;
        let (left, right) = root.split_horizontally(PANEL.0);
        latency_panel(&left, chart)?;
        time_panel(&right, chart)?;
        root.present().map_err(drawing)?;
    }
    Ok(svg)
}

fn colours(chart: &Chart) -> BTreeMap<&str, RGBColor> {
    let mut methods: Vec<&str> = Vec::new();
    for point in chart.points.iter().filter(|p| !p.control) {
        if !methods.contains(&point.method.as_str()) {
            methods.push(&point.method);
        }
    }
    methods.into_iter().zip(COLOURS.into_iter().cycle()).collect()
}

fn lowest(points: &[&Point]) -> f64 {
    let low = points.iter().map(|p| p.accuracy_low).fold(1.0, f64::min);
    (low * 10.0).floor() / 10.0
}

fn latency_panel(area: &Area<'_>, chart: &Chart) -> Result<(), ChartError> {
    let whole: Vec<&Point> = chart.points.iter().filter(|p| p.query_seconds.is_none()).collect();
    let times = || whole.iter().map(|p| p.query_ms_p50.max(1e-3));
    let from = times().fold(f64::INFINITY, f64::min) / 1.6;
    let to = times().fold(0.0, f64::max) * 1.6;
    let mut panel = ChartBuilder::on(area)
        .margin(14)
        .x_label_area_size(46)
        .y_label_area_size(64)
        .build_cartesian_2d((from..to).log_scale(), lowest(&whole)..1.005)
        .map_err(drawing)?;
    panel
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(BLACK.mix(0.08))
        .x_desc("median latency of a query [ms], whole drag")
        .y_desc("accuracy")
        .x_label_formatter(&|x| if *x < 1.0 { format!("{x:.1}") } else { format!("{x:.0}") })
        .y_label_formatter(&|y| format!("{:.0} %", y * 100.0))
        .label_style(("sans-serif", 14))
        .draw()
        .map_err(drawing)?;
    let owned: Vec<Point> = whole.iter().map(|p| (*p).clone()).collect();
    let front = pareto(&owned, |p| p.query_ms_p50);
    let line = front.iter().map(|&i| (owned[i].query_ms_p50, owned[i].accuracy));
    panel.draw_series(LineSeries::new(line, BLACK.mix(0.35).stroke_width(2))).map_err(drawing)?;
    scatter(&mut panel, chart, &whole, |p| p.query_ms_p50.max(1e-3))
}

fn time_panel(area: &Area<'_>, chart: &Chart) -> Result<(), ChartError> {
    // For each method and scan time its best point: the others crowd the panel.
    let mut best: BTreeMap<(&str, bool, u64), &Point> = BTreeMap::new();
    for point in &chart.points {
        let key = (point.method.as_str(), point.control, (chart.scan_s(point) * 1e3) as u64);
        let kept = best.entry(key).or_insert(point);
        if point.accuracy > kept.accuracy {
            *kept = point;
        }
    }
    let shown: Vec<&Point> = best.into_values().collect();
    let end = shown.iter().map(|p| chart.scan_s(p)).fold(0.0, f64::max).max(0.1) * 1.05;
    let mut panel = ChartBuilder::on(area)
        .margin(14)
        .x_label_area_size(46)
        .y_label_area_size(64)
        .build_cartesian_2d(0.0..end, lowest(&shown)..1.005)
        .map_err(drawing)?;
    panel
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(BLACK.mix(0.08))
        .x_desc("scan time used [s]; the best setting of each method")
        .y_desc("accuracy")
        .y_label_formatter(&|y| format!("{:.0} %", y * 100.0))
        .label_style(("sans-serif", 14))
        .draw()
        .map_err(drawing)?;
    for (method, colour) in colours(chart) {
        let mut line: Vec<(f64, f64)> = (shown.iter())
            .filter(|p| p.method == method && !p.control)
            .map(|p| (chart.scan_s(p), p.accuracy))
            .collect();
        line.sort_by(|a, b| a.0.total_cmp(&b.0));
        panel
            .draw_series(LineSeries::new(line, colour.mix(0.5).stroke_width(1)))
            .map_err(drawing)?;
    }
    scatter(&mut panel, chart, &shown, |p| chart.scan_s(p))
}

/// How a point looks, and what the legend calls it.
fn look(point: &Point, colours: &BTreeMap<&str, RGBColor>) -> (String, ShapeStyle) {
    match colours.get(point.method.as_str()) {
        Some(colour) if !point.control => (point.method.clone(), colour.filled()),
        _ => (format!("control: {}", point.setting), GREY.stroke_width(2)),
    }
}

fn scatter<'a, 'b: 'a, X>(
    panel: &mut Panel<'a, 'b, X>,
    chart: &Chart,
    points: &[&Point],
    x: impl Fn(&Point) -> f64,
) -> Result<(), ChartError>
where
    X: Ranged<ValueType = f64>,
{
    let colours = colours(chart);
    let mut named = Vec::new();
    for point in points {
        let (name, style) = look(point, &colours);
        let bar = [(x(point), point.accuracy_low), (x(point), point.accuracy_high)];
        let thin = style.color.mix(0.45).stroke_width(1);
        let at = (x(point), point.accuracy);
        panel.draw_series([PathElement::new(bar, thin)]).map_err(drawing)?;
        let series = if point.peer {
            let square = EmptyElement::at(at) + Rectangle::new([(-5, -5), (5, 5)], style);
            panel.draw_series([square])
        } else {
            panel.draw_series([Circle::new(at, 5, style)])
        };
        let series = series.map_err(drawing)?;
        if !named.contains(&name) {
            series.label(name.clone()).legend(move |(x, y)| Circle::new((x + 8, y), 5, style));
            named.push(name);
        }
    }
    panel
        .configure_series_labels()
        .position(SeriesLabelPosition::LowerRight)
        .background_style(WHITE.mix(0.85))
        .border_style(BLACK.mix(0.2))
        .label_font(("sans-serif", 13))
        .draw()
        .map_err(drawing)
}

#[cfg(test)]
mod tests {
    use super::super::chart::tests::point;
    use super::*;

    #[test]
    fn a_chart_names_its_methods_controls_and_kind_of_data() {
        let mut points = vec![point("reference", 300.0, 0.7), point("embedding", 2.0, 1.0)];
        points.push(Point { query_seconds: Some(0.5), ..point("embedding", 2.0, 0.95) });
        let control = Point { control: true, ..point("embedding", 2.0, 0.5) };
        points.push(Point { setting: "loudness alone".into(), ..control });
        points.push(Point { peer: true, ..point("MiniRocket", 9.0, 0.98) });
        let chart = Chart {
            data: "a <scene>".into(),
            synthetic: true,
            protocol: "leave-one-trial-out".into(),
            library_trials: 180,
            drag_s: Some(4.8),
            points,
        };
        let svg = figure(&chart).unwrap();
        for text in ["reference", "embedding", "control: loudness alone", "MiniRocket", "synthetic"]
        {
            assert!(svg.contains(text), "{text}");
        }
        assert!(svg.contains("a &lt;scene&gt;"));
        assert!(figure(&Chart { points: vec![], ..chart }).is_err());
    }
}
