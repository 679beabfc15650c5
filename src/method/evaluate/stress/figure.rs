//! Draws the stress chart: a small panel for each disturbance, a line for each method.

use plotters::prelude::*;

use super::report::{MethodReport, StressCell, StressReport};
use crate::draw::{Area, Drawn, FigureError, Look, colour, line, marker, put, titled};

/// Width of the figure on a screen.
const WIDTH: u32 = 1200;
/// Least width of a panel, and its height.
const PANEL: (u32, u32) = (210, 230);
const MOST_COLUMNS: u32 = 4;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Measure {
    Accuracy,
    /// Share of queries of unknown surfaces that would be called unknown.
    UnknownRejected,
    CalibrationError,
}

impl Measure {
    fn title(self) -> &'static str {
        match self {
            Self::Accuracy => "accuracy",
            Self::UnknownRejected => "unknown surfaces rejected, at 5 % of known ones rejected",
            Self::CalibrationError => "expected calibration error of the stated probability",
        }
    }

    /// The measured value, and the 95 % interval of a share of queries.
    fn of(self, cell: &StressCell) -> Option<(f64, Option<(f64, f64)>)> {
        match self {
            Self::Accuracy => Some((cell.accuracy, cell.accuracy_interval)),
            Self::UnknownRejected => Some((cell.unknown_rejected?, cell.unknown_interval)),
            Self::CalibrationError => Some((cell.calibration_error?, None)),
        }
    }

    /// The number of queries that a share is of.
    fn queries(self, report: &StressReport) -> usize {
        match self {
            Self::UnknownRejected => report.unknown_queries,
            Self::Accuracy | Self::CalibrationError => report.queries,
        }
    }
}

/// An SVG with a panel for each disturbance: `measure` against severity, from undisturbed. Bars are 95 %
/// intervals over queries.
pub fn figure(report: &StressReport, measure: Measure, look: Look) -> Result<String, FigureError> {
    let shown: Vec<(usize, &MethodReport)> =
        report.methods.iter().enumerate().filter(|(_, m)| measure.of(&m.clean).is_some()).collect();
    let panels = shown.first().map_or(0, |(_, m)| m.disturbances.len());
    if panels == 0 {
        return Err(FigureError(format!("there is nothing to draw of: {}", measure.title())));
    }
    let width = look.pixels(WIDTH);
    // One more panel holds the names of the methods.
    let columns = (width / PANEL.0).clamp(1, MOST_COLUMNS).min(panels as u32 + 1) as usize;
    let rows = (panels + 1).div_ceil(columns);
    let bars = match measure {
        Measure::CalibrationError => "",
        _ => " · bars: 95 % interval over queries",
    };
    let title = format!(
        "{} · {} · n = {} queries · {}{bars}",
        report.data,
        report.protocol,
        measure.queries(report),
        measure.title()
    );
    titled((&title, report.synthetic), (width, PANEL.1 * rows as u32), look, |area| {
        let areas = area.split_evenly((rows, columns));
        for (at, area) in areas.iter().enumerate().take(panels) {
            panel(area, &shown, at, measure)?;
        }
        legend(&areas[panels], &shown)
    })
}

fn panel(area: &Area<'_>, shown: &[(usize, &MethodReport)], at: usize, measure: Measure) -> Drawn {
    let axis = &shown[0].1.disturbances[at];
    let places = axis.levels.len() as f64;
    let mut chart = ChartBuilder::on(area)
        .margin(8)
        .caption(format!("{} ({})", axis.name, axis.axis), ("sans-serif", 13))
        .x_label_area_size(20)
        .y_label_area_size(38)
        .build_cartesian_2d(-0.3..places + 0.3, 0.0..1.02)?;
    let label = |x: &f64| {
        let place = x.round();
        match place as usize {
            _ if (x - place).abs() > 1e-6 || place < 0.0 => String::new(),
            0 => "none".into(),
            place => axis.levels.get(place - 1).map(|l| l.level.to_string()).unwrap_or_default(),
        }
    };
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(BLACK.mix(0.08))
        .axis_style(BLACK.mix(0.4))
        .x_labels(axis.levels.len() + 2)
        .x_label_formatter(&label)
        .y_labels(5)
        .y_label_formatter(&|y| format!("{:.0} %", 100.0 * y))
        .label_style(("sans-serif", 11))
        .draw()?;
    // The first method is drawn last, so that it stays visible where lines coincide. Methods stand
    // beside each other, so that their intervals can be told apart.
    for (row, (index, method)) in shown.iter().enumerate().rev() {
        let beside = (row as f64 - (shown.len() as f64 - 1.0) / 2.0) * 0.4 / shown.len() as f64;
        let cells = method.disturbances[at].levels.iter().map(|level| &level.cell);
        let mut points = Vec::new();
        for (place, cell) in std::iter::once(&method.clean).chain(cells).enumerate() {
            let (x, Some((y, interval))) = (place as f64 + beside, measure.of(cell)) else {
                continue;
            };
            points.push((x, y));
            let bar = interval.map(|(low, high)| [(x, low), (x, high)]);
            let style = colour(*index).mix(0.5).stroke_width(1);
            chart.draw_series(bar.map(|bar| PathElement::new(bar, style)))?;
        }
        line(&mut chart, points.clone(), *index)?;
        let (left, top) = area.get_base_pixel();
        for point in points {
            let (x, y) = chart.backend_coord(&point);
            marker(area, (x - left, y - top), *index, false)?;
        }
    }
    Ok(())
}

fn legend(area: &Area<'_>, shown: &[(usize, &MethodReport)]) -> Drawn {
    let mut chart = ChartBuilder::on(area).build_cartesian_2d(0.0..1.0, 0.0..1.0)?;
    for (row, (index, method)) in shown.iter().enumerate() {
        let y = 24 + 22 * row as i32;
        let height = f64::from(y) / f64::from(area.dim_in_pixel().1);
        line(&mut chart, vec![(0.06, 1.0 - height), (0.28, 1.0 - height)], *index)?;
        let x = (0.17 * f64::from(area.dim_in_pixel().0)) as i32;
        marker(area, (x, y), *index, false)?;
        put(area, method.method.as_str(), (2 * x, y - 7), 13)?;
    }
    Ok(())
}
