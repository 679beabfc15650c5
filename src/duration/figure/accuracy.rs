//! Accuracy against scan time.

use plotters::prelude::*;

use crate::draw::{Area, COLOURS, Drawn, drawing};
use crate::duration::need::Second;
use crate::recognise::AccuracyAt;

/// Accuracy over the scan time, and the answer read from it.
#[derive(Clone, Debug, PartialEq)]
pub struct AccuracyCurve {
    /// By scan time, upwards.
    pub points: Vec<AccuracyAt>,
    /// The share that is aimed at.
    pub target: f64,
    /// How long to drag for it.
    pub enough_s: Option<Second>,
}

/// A panel with the curve, its band, the target, and how long to drag.
pub(super) fn panel(area: &Area<'_>, curve: &AccuracyCurve) -> Drawn {
    let colour = COLOURS[2];
    let end = curve.points.last().map_or(1.0, |p| p.scan_s) * 1.05;
    let low = curve.points.iter().map(|p| p.accuracy_low).fold(curve.target, f64::min);
    let bottom = (10.0 * low).floor() / 10.0;
    let mut chart = ChartBuilder::on(area)
        .caption("scans named right", ("sans-serif", 20))
        .margin(14)
        .x_label_area_size(46)
        .y_label_area_size(62)
        .build_cartesian_2d(0.0..end, 100.0 * bottom..100.5)
        .map_err(drawing)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(BLACK.mix(0.08))
        .x_desc("scan time [s]")
        .y_desc("left-out scans named right [%]")
        .x_labels(8)
        .y_labels(6)
        .label_style(("sans-serif", 15))
        .draw()
        .map_err(drawing)?;
    let line =
        |f: fn(&AccuracyAt) -> f64| curve.points.iter().map(move |p| (p.scan_s, 100.0 * f(p)));
    let mut band: Vec<(f64, f64)> = line(|p| p.accuracy_high).collect();
    band.extend(line(|p| p.accuracy_low).collect::<Vec<_>>().into_iter().rev());
    chart.draw_series([Polygon::new(band, colour.mix(0.2))]).map_err(drawing)?;
    chart
        .draw_series(LineSeries::new(line(|p| p.accuracy), colour.stroke_width(2)))
        .map_err(drawing)?;
    let target = 100.0 * curve.target;
    let across = LineSeries::new([(0.0, target), (end, target)], BLACK.mix(0.5));
    chart.draw_series(across).map_err(drawing)?;
    if let Some(at) = curve.enough_s {
        let mark = PathElement::new([(at, 100.0 * bottom), (at, target)], BLACK.stroke_width(1));
        chart.draw_series([mark]).map_err(drawing)?;
        let text = format!("drag for {at:.1} s");
        let beside = (at + 0.01 * end, 100.0 * bottom + 0.08 * (100.0 - 100.0 * bottom));
        chart.draw_series([Text::new(text, beside, ("sans-serif", 16))]).map_err(drawing)?;
    }
    Ok(())
}
