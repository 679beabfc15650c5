//! Draws dependence against the lag, with a mark at T*, and accuracy against scan time.

use plotters::element::DashedPathElement;
use plotters::prelude::*;

use super::algorithm1::CurvePoint;
use super::pooled::PooledDependence;
use super::report::{ByRule, PooledRow, SourceDuration};
use crate::draw::{
    Area, COLOURS, Drawn, FigureError, GREY, Look, axes, plain, three_digits, titled,
};
use crate::recognise::AccuracyAt;
use crate::scene::SourceId;

/// Width of the figure on a screen, least width of a panel, and a panel's height.
const WIDTH: u32 = 1280;
const LEAST: u32 = 400;
const PANEL: u32 = 380;
/// Height of a line of text above a panel, and its font.
const LINE: i32 = 18;
const SMALL: i32 = 13;
const FONT: &str = "sans-serif";

type DrawnPanel<'a> = Box<dyn Fn(&Area<'_>) -> Drawn + 'a>;

/// An SVG with two panels a row. `pooled` has a panel for each source, with all surfaces; Algorithm
/// 1 has one for each surface and source. The last panel has accuracy against scan time. `data` is
/// their name, which is the title, and whether they are synthetic.
///
/// # Errors
/// If no surface and source has a curve.
pub fn figure(
    durations: &[SourceDuration],
    accuracy: Option<&AccuracyCurve>,
    data: (&str, bool),
    look: Look,
) -> Result<String, FigureError> {
    let mut panels: Vec<DrawnPanel<'_>> = Vec::new();
    for (i, row) in durations.iter().enumerate() {
        match &row.by_rule {
            ByRule::Algorithm1 { curve, .. } if curve.len() > 1 => {
                panels.push(Box::new(move |area| algorithm1_panel(area, row, curve)));
            }
            // All rows of a source share one panel, which is added at the first of these rows.
            ByRule::Pooled(_) if durations[..i].iter().all(|d| d.source != row.source) => {
                let rows = rows_of(durations, &row.source);
                if !rows.is_empty() {
                    panels.push(Box::new(move |area| dependence_panel(area, &rows)));
                }
            }
            _ => {}
        }
    }
    if panels.is_empty() {
        return Err(FigureError("no surface and source has a curve".into()));
    }
    if let Some(curve) = accuracy.filter(|curve| !curve.points.is_empty()) {
        panels.push(Box::new(move |area| accuracy_panel(area, curve)));
    }
    let width = look.pixels(if panels.len() > 1 { WIDTH } else { WIDTH / 2 });
    let columns = panels.len().min((width / LEAST) as usize).clamp(1, 2);
    let rows = panels.len().div_ceil(columns);
    titled(data, (width, PANEL * rows as u32), look, |area| {
        let areas = area.split_evenly((rows, columns));
        areas.iter().zip(&panels).try_for_each(|(area, panel)| panel(area))
    })
}

#[derive(Clone, Debug, PartialEq)]
pub struct AccuracyCurve {
    /// Accuracy at each scan time, in ascending order of scan time.
    pub points: Vec<AccuracyAt>,
    pub target: f64,
    pub enough_s: Option<f64>,
}

/// Writes lines above a panel, each in its colour, and returns the area of the panel.
fn headed<'a>(area: &Area<'a>, lines: &[(String, RGBColor)]) -> Result<Area<'a>, FigureError> {
    for (row, (text, colour)) in (0..).zip(lines) {
        let style = (FONT, SMALL).into_font().color(colour);
        area.draw(&Text::new(text.as_str(), (24, 8 + row * LINE), style))?;
    }
    Ok(area.split_vertically(8 + LINE * lines.len() as i32).1)
}

/// Draws accuracy against scan time, its confidence band, the target, and how long to drag.
fn accuracy_panel(area: &Area<'_>, curve: &AccuracyCurve) -> Drawn {
    let colour = COLOURS[2];
    let end = curve.points.last().map_or(1.0, |p| p.scan_s) * 1.05;
    let low = curve.points.iter().map(|p| p.accuracy_low).fold(curve.target, f64::min);
    let bottom = (10.0 * low).floor() / 10.0;
    let x = (0.0..end, "scan time [s]");
    let y = (100.0 * bottom..100.5, "left-out scans named right [%]");
    let drag = match curve.enough_s {
        Some(at) => format!("scans named right: drag for {at:.1} s"),
        None => "scans named right".into(),
    };
    let area = headed(area, &[(drag, BLACK)])?;
    let mut chart = axes(&area, x, y, plain)?;
    let line =
        |f: fn(&AccuracyAt) -> f64| curve.points.iter().map(move |p| (p.scan_s, 100.0 * f(p)));
    let band = line(|p| p.accuracy_high).chain(line(|p| p.accuracy_low).rev());
    chart.draw_series([Polygon::new(band.collect::<Vec<_>>(), colour.mix(0.2))])?;
    chart.draw_series(LineSeries::new(line(|p| p.accuracy), colour.stroke_width(2)))?;
    let target = 100.0 * curve.target;
    let across = [(0.0, target), (end, target)];
    chart.draw_series(DashedLineSeries::new(across, 5, 4, BLACK.mix(0.6).stroke_width(1)))?;
    if let Some(at) = curve.enough_s {
        let mark = PathElement::new([(at, 100.0 * bottom), (at, target)], BLACK.stroke_width(1));
        chart.draw_series([mark])?;
    }
    Ok(())
}

const HSIC: RGBColor = COLOURS[0];
const KAPPA: RGBColor = COLOURS[1];

fn algorithm1_panel(area: &Area<'_>, row: &SourceDuration, curve: &[CurvePoint]) -> Drawn {
    let rate_hz = row.rate_hz.unwrap_or(1.0);
    let ms = |lag: usize| lag as f64 / rate_hz * 1e3;
    // The curve is flat far beyond T*, so it is drawn only up to four times T*.
    let last = curve.last().map_or(1, |p| p.lag);
    let end = row.t_star_samples.map_or(last, |t| last.min((4 * t).max(20)));
    let inside: Vec<&CurvePoint> = curve.iter().filter(|p| p.lag <= end).collect();
    let top = inside.iter().map(|p| p.hsic_high.max(p.hsic_quantile).max(p.kappa));
    let top = 1.25 * top.fold(f64::MIN_POSITIVE, f64::max);
    let t_star_ms = row.t_star_samples.map(ms);
    let found = t_star_ms.map_or("no T* within the range".into(), |ms| format!("T* = {ms:.2} ms"));
    let title = format!("{} · {} (Q = {}): {found}", row.surface, row.source, row.trials);
    let area = headed(area, &[(title, BLACK)])?;
    let x = (0.0..ms(end) * 1.02, "time between samples [ms]");
    let mut chart = axes(&area, x, (0.0..top, "HSIC"), plain)?;
    let line = |f: fn(&CurvePoint) -> f64| inside.iter().map(move |p| (ms(p.lag), f(p)));
    let band = line(|p| p.hsic_high).chain(line(|p| p.hsic_low).rev());
    let key = |style: ShapeStyle, dash: i32| {
        move |(x, y): (i32, i32)| DashedPathElement::new([(x, y), (x + 22, y)], dash, 4, style)
    };
    chart
        .draw_series([Polygon::new(band.collect::<Vec<_>>(), HSIC.mix(0.25))])?
        .label("interval of the mean")
        .legend(|(x, y)| Rectangle::new([(x, y - 4), (x + 22, y + 4)], HSIC.mix(0.25).filled()));
    for (label, style, dash, f) in [
        ("mean HSIC", HSIC.stroke_width(2), 22, (|p| p.hsic_mean) as fn(&CurvePoint) -> f64),
        ("quantile of HSIC", HSIC.stroke_width(1), 3, |p| p.hsic_quantile),
        ("mean threshold κ", KAPPA.stroke_width(2), 9, |p| p.kappa),
    ] {
        let points: Vec<(f64, f64)> = line(f).collect();
        let drawn = match dash {
            22 => chart.draw_series(LineSeries::new(points, style))?,
            dash => chart.draw_series(DashedLineSeries::new(points, dash, 4, style))?,
        };
        drawn.label(label).legend(key(style, dash));
    }
    if let Some(at) = t_star_ms {
        let line = [(at, 0.0), (at, 0.55 * top)];
        chart.draw_series([PathElement::new(line, BLACK.stroke_width(1))])?;
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperRight)
        .background_style(WHITE.mix(0.85))
        .border_style(BLACK.mix(0.2))
        .label_font((FONT, 13))
        .draw()?;
    Ok(())
}

/// The rows of a source that have a curve, by T*; those without, and then the longest T*, are at the end.
fn rows_of<'a>(
    durations: &'a [SourceDuration],
    source: &SourceId,
) -> Vec<(&'a SourceDuration, &'a PooledRow)> {
    let mut rows: Vec<_> = (durations.iter().filter(|d| d.source == *source))
        .filter_map(|d| match &d.by_rule {
            ByRule::Pooled(row) if row.dependence.len() > 1 => Some((d, row)),
            _ => None,
        })
        .collect();
    rows.sort_by(|(a, _), (b, _)| {
        let length = |d: &SourceDuration| d.t_star_s.unwrap_or(f64::INFINITY);
        length(a).total_cmp(&length(b))
    });
    // The last row is drawn in full, so it should have a T* to mark.
    if let Some(last) = rows.iter().rposition(|(d, _)| d.t_star_s.is_some()) {
        let longest = rows.remove(last);
        rows.push(longest);
    }
    rows
}

/// A line for each surface; the last one also gets a confidence band, the threshold, T* and its bound.
fn dependence_panel(area: &Area<'_>, rows: &[(&SourceDuration, &PooledRow)]) -> Drawn {
    let Some(((longest, row), others)) = rows.split_last() else { return Ok(()) };
    let ms = |s: f64| 1e3 * s;
    let lags = || rows.iter().flat_map(|(_, row)| &row.dependence).map(|d| ms(d.lag_s));
    let (first, last) = lags().fold((f64::INFINITY, 0.0f64), |(l, h), x| (l.min(x), h.max(x)));
    let t_star = match (longest.t_star_s, row.t_star_upper_s) {
        (Some(t_star), Some(upper)) => {
            let [t_star, upper] = [t_star, upper].map(|s| three_digits(ms(s)));
            format!("T* = {t_star} ms, surely by {upper} ms")
        }
        _ => "no T*".into(),
    };
    let (source, threshold) = (&longest.source, row.threshold);
    let mut lines = vec![
        (format!("{source}, {} (Q = {}): {t_star}", longest.surface, longest.trials), COLOURS[0]),
        (format!("dashed, small enough: {threshold}"), BLACK),
    ];
    if !others.is_empty() {
        let name = if others.len() == 1 { "the other surface" } else { "the other surfaces" };
        lines[1].0 += &format!("; grey: {name}");
    }
    let area = headed(area, &lines)?;
    let x = ((first..last).log_scale(), "time between two moments [ms]");
    let y = (0.0..1.0, "dependence (as a correlation)");
    let mut chart = axes(&area, x, y, plain)?;
    let line = |row: &PooledRow, f: fn(&PooledDependence) -> f64| {
        row.dependence.iter().map(|d| (ms(d.lag_s), f(d))).collect::<Vec<_>>()
    };
    for (_, row) in others {
        let faint = GREY.mix(0.55).stroke_width(1);
        chart.draw_series(LineSeries::new(line(row, |d| d.fitted), faint))?;
    }
    let colour = COLOURS[0];
    let band = [line(row, |d| d.high), line(row, |d| d.low).into_iter().rev().collect()].concat();
    chart.draw_series([Polygon::new(band, colour.mix(0.22))])?;
    chart.draw_series(LineSeries::new(line(row, |d| d.fitted), colour.stroke_width(2)))?;
    let measured = line(row, |d| d.dependence).into_iter();
    chart.draw_series(measured.map(|at| Circle::new(at, 2, colour.filled())))?;
    let across = [(first, threshold), (last, threshold)];
    chart.draw_series(DashedLineSeries::new(across, 5, 4, BLACK.mix(0.6).stroke_width(1)))?;
    for (seconds, width) in [(longest.t_star_s, 2), (row.t_star_upper_s, 1)] {
        let line = |x: f64| PathElement::new([(x, 0.0), (x, threshold)], BLACK.stroke_width(width));
        chart.draw_series(seconds.map(ms).map(line))?;
    }
    Ok(())
}
