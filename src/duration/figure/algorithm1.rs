//! The curve of HSIC against the lag, as the paper's Fig. 7 shows it: mean with its band, κ, T*.

use plotters::prelude::*;

use crate::draw::{Area, Drawn, drawing};
use crate::duration::algorithm1::CurvePoint;
use crate::duration::report::SourceDuration;

const HSIC: RGBColor = RGBColor(0, 90, 160);
const KAPPA: RGBColor = RGBColor(200, 70, 0);
const MARK: RGBColor = RGBColor(30, 30, 30);

/// A panel for one surface and source.
pub(super) fn panel(area: &Area<'_>, row: &SourceDuration, curve: &[CurvePoint]) -> Drawn {
    let rate_hz = row.rate_hz.unwrap_or(1.0);
    let ms = |lag: usize| lag as f64 / rate_hz * 1e3;
    // The curve far beyond T* is flat: four times T* shows what matters.
    let last = curve.last().map_or(1, |p| p.lag);
    let end = row.t_star_samples.map_or(last, |t| last.min((4 * t).max(20)));
    let inside: Vec<&CurvePoint> = curve.iter().filter(|p| p.lag <= end).collect();
    let top = inside.iter().map(|p| p.hsic_high.max(p.hsic_quantile).max(p.kappa));
    let top = 1.25 * top.fold(f64::MIN_POSITIVE, f64::max);
    let title = format!("{} · {} (Q = {})", row.surface, row.source, row.trials);
    let mut chart = ChartBuilder::on(area)
        .caption(title, ("sans-serif", 20))
        .margin(14)
        .x_label_area_size(46)
        .y_label_area_size(72)
        .build_cartesian_2d(0.0..ms(end) * 1.02, 0.0..top)
        .map_err(drawing)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(BLACK.mix(0.08))
        .x_desc("time between samples [ms]")
        .y_desc("HSIC")
        .x_labels(8)
        .y_labels(6)
        .y_label_formatter(&|y| if top < 0.01 { format!("{y:.4}") } else { format!("{y:.3}") })
        .label_style(("sans-serif", 14))
        .draw()
        .map_err(drawing)?;

    let line = |f: fn(&CurvePoint) -> f64| inside.iter().map(move |p| (ms(p.lag), f(p)));
    let mut band: Vec<(f64, f64)> = line(|p| p.hsic_high).collect();
    band.extend(inside.iter().rev().map(|p| (ms(p.lag), p.hsic_low)));
    let key = |style: ShapeStyle| {
        move |(x, y): (i32, i32)| PathElement::new([(x, y), (x + 22, y)], style)
    };
    chart
        .draw_series(std::iter::once(Polygon::new(band, HSIC.mix(0.25))))
        .map_err(drawing)?
        .label("interval of the mean")
        .legend(|(x, y)| Rectangle::new([(x, y - 4), (x + 22, y + 4)], HSIC.mix(0.25).filled()));
    for (label, style, f) in [
        ("mean HSIC", HSIC.stroke_width(2), (|p| p.hsic_mean) as fn(&CurvePoint) -> f64),
        ("quantile of HSIC", HSIC.mix(0.45).stroke_width(1), |p| p.hsic_quantile),
        ("mean threshold κ", KAPPA.stroke_width(2), |p| p.kappa),
    ] {
        chart
            .draw_series(LineSeries::new(line(f), style))
            .map_err(drawing)?
            .label(label)
            .legend(key(style));
    }
    if let Some(t) = row.t_star_samples {
        let at = ms(t);
        let style = MARK.stroke_width(1);
        chart
            .draw_series(std::iter::once(PathElement::new([(at, 0.0), (at, 0.55 * top)], style)))
            .map_err(drawing)?;
        let text = format!("T* = {at:.2} ms");
        // Low in the panel, where no curve is.
        let beside = (at + 0.01 * ms(end), 0.1 * top);
        chart
            .draw_series(std::iter::once(Text::new(text, beside, ("sans-serif", 15))))
            .map_err(drawing)?;
    } else {
        let text = "no T* within the range";
        let at = (0.03 * ms(end), 0.07 * top);
        chart
            .draw_series(std::iter::once(Text::new(text, at, ("sans-serif", 15))))
            .map_err(drawing)?;
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperRight)
        .background_style(WHITE.mix(0.85))
        .border_style(BLACK.mix(0.2))
        .label_font(("sans-serif", 13))
        .draw()
        .map_err(drawing)
}
