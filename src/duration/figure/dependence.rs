//! Dependence against the lag by the rule `pooled`: all surfaces of a source in one panel.

use plotters::prelude::*;

use crate::draw::{Area, COLOURS, Drawn, drawing};
use crate::duration::pooled::PooledDependence;
use crate::duration::report::{ByRule, PooledRow, SourceDuration};
use crate::scene::SourceId;

const GREY: RGBColor = RGBColor(150, 150, 150);
const FONT: &str = "sans-serif";

/// The rows of a source that have a curve, the one with the longest T* last; without T* counts as
/// longer than any.
pub(super) fn rows<'a>(
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
    // One that has a T* can show it.
    if let Some(last) = rows.iter().rposition(|(d, _)| d.t_star_s.is_some()) {
        let longest = rows.remove(last);
        rows.push(longest);
    }
    rows
}

/// A panel with a line for each surface, and a band and T* for the last.
pub(super) fn panel(area: &Area<'_>, rows: &[(&SourceDuration, &PooledRow)]) -> Drawn {
    let Some(((longest, row), others)) = rows.split_last() else { return Ok(()) };
    let ms = |s: f64| 1e3 * s;
    let lags = || rows.iter().flat_map(|(_, row)| &row.dependence).map(|d| ms(d.lag_s));
    let (first, last) = lags().fold((f64::INFINITY, 0.0f64), |(l, h), x| (l.min(x), h.max(x)));
    let mut chart = ChartBuilder::on(area)
        .caption(format!("{}: how long a moment lasts", longest.source), (FONT, 20))
        .margin(14)
        .x_label_area_size(46)
        .y_label_area_size(62)
        .build_cartesian_2d((first..last).log_scale(), 0.0..1.0)
        .map_err(drawing)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(BLACK.mix(0.08))
        .x_desc("time between two moments [ms]")
        .y_desc("dependence (as a correlation)")
        .x_label_formatter(&|x| format!("{}", (x * 1e6).round() / 1e6))
        .y_labels(6)
        .label_style((FONT, 15))
        .draw()
        .map_err(drawing)?;
    let line = |row: &PooledRow, f: fn(&PooledDependence) -> f64| {
        row.dependence.iter().map(|d| (ms(d.lag_s), f(d))).collect::<Vec<_>>()
    };
    for (_, row) in others {
        let faint = GREY.mix(0.55).stroke_width(1);
        chart.draw_series(LineSeries::new(line(row, |d| d.fitted), faint)).map_err(drawing)?;
    }
    let colour = COLOURS[0];
    let mut band = line(row, |d| d.high);
    band.extend(line(row, |d| d.low).into_iter().rev());
    chart.draw_series([Polygon::new(band, colour.mix(0.22))]).map_err(drawing)?;
    let fitted = LineSeries::new(line(row, |d| d.fitted), colour.stroke_width(2));
    chart.draw_series(fitted).map_err(drawing)?;
    let measured = line(row, |d| d.dependence);
    chart
        .draw_series(measured.into_iter().map(|at| Circle::new(at, 2, colour.filled())))
        .map_err(drawing)?;
    mark(&mut chart, longest, row, others.len(), first, last)
}

type DependenceChart<'a, 'b> = ChartContext<
    'a,
    SVGBackend<'b>,
    Cartesian2d<
        plotters::coord::combinators::LogCoord<f64>,
        plotters::coord::types::RangedCoordf64,
    >,
>;

/// The threshold, T* and its upper bound, and what the lines are.
fn mark(
    chart: &mut DependenceChart<'_, '_>,
    longest: &SourceDuration,
    row: &PooledRow,
    others: usize,
    first: f64,
    last: f64,
) -> Drawn {
    let threshold = row.threshold;
    let across =
        LineSeries::new([(first, threshold), (last, threshold)], COLOURS[1].stroke_width(1));
    chart.draw_series(across).map_err(drawing)?;
    // Upper right, where the curves have fallen; times on a log axis, as shares of it.
    let at = |share: f64| first * (last / first).powf(share);
    let mut put = |text: String, y: f64, colour: RGBColor| {
        let style = (FONT, 16).into_font().color(&colour);
        chart.draw_series([Text::new(text, (at(0.5), y), style)]).map(|_| ()).map_err(drawing)
    };
    put(format!("{} (Q = {})", longest.surface, longest.trials), 0.97, COLOURS[0])?;
    match (longest.t_star_s, row.t_star_upper_s) {
        (Some(t_star), Some(upper)) => put(
            format!("T* = {} ms, surely by {} ms", short(1e3 * t_star), short(1e3 * upper)),
            0.90,
            BLACK,
        )?,
        _ => put("no T*".into(), 0.90, BLACK)?,
    }
    put(format!("small enough: {threshold}"), 0.83, COLOURS[1])?;
    if others > 0 {
        let name = if others == 1 { "the other surface" } else { "the other surfaces" };
        put(name.into(), 0.76, GREY)?;
    }
    for (seconds, width) in [(longest.t_star_s, 2), (row.t_star_upper_s, 1)] {
        let Some(x) = seconds.map(|s| 1e3 * s) else { continue };
        let style = BLACK.stroke_width(width);
        chart
            .draw_series([PathElement::new([(x, 0.0), (x, threshold)], style)])
            .map_err(drawing)?;
    }
    Ok(())
}

/// Three digits.
fn short(ms: f64) -> String {
    let decimals = (2 - ms.log10().floor() as i32).clamp(0, 4) as usize;
    format!("{ms:.decimals$}")
}
