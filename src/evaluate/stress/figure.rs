//! Draws the stress chart: a small panel for each disturbance, a line for each method.

use plotters::prelude::*;

use super::report::{MethodReport, StressCell, StressReport};
use crate::draw::{Area, COLOURS, Drawn, FigureError, put, svg};

const PANEL: (u32, u32) = (300, 230);
const COLUMNS: usize = 4;
const TITLE: u32 = 44;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Measure {
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

    fn of(self, cell: &StressCell) -> Option<f64> {
        match self {
            Self::Accuracy => Some(cell.accuracy),
            Self::UnknownRejected => cell.unknown_rejected,
            Self::CalibrationError => cell.calibration_error,
        }
    }
}

/// An SVG with a panel for each disturbance: `measure` against severity, from undisturbed.
pub(crate) fn figure(report: &StressReport, measure: Measure) -> Result<String, FigureError> {
    let shown: Vec<(usize, &MethodReport)> =
        report.methods.iter().enumerate().filter(|(_, m)| measure.of(&m.clean).is_some()).collect();
    let panels = shown.first().map_or(0, |(_, m)| m.disturbances.len());
    if panels == 0 {
        return Err(FigureError(format!("there is nothing to draw of: {}", measure.title())));
    }
    // One more panel holds the legend.
    let rows = (panels + 1).div_ceil(COLUMNS);
    let size = (PANEL.0 * COLUMNS as u32, PANEL.1 * rows as u32 + TITLE);
    svg(size, |root| {
        let mark = if report.synthetic { " (synthetic data)" } else { "" };
        let title = format!(
            "{}{mark} · {} · {} queries · {}",
            report.data,
            report.protocol,
            report.queries,
            measure.title()
        );
        let areas = root.titled(&title, ("sans-serif", 20))?.split_evenly((rows, COLUMNS));
        for (at, area) in areas.iter().enumerate().take(panels) {
            panel(area, &shown, at, measure)?;
        }
        legend(&areas[panels], &shown)
    })
}

fn colour(index: usize) -> RGBColor {
    COLOURS[index % COLOURS.len()]
}

fn panel(area: &Area<'_>, shown: &[(usize, &MethodReport)], at: usize, measure: Measure) -> Drawn {
    let axis = &shown[0].1.disturbances[at];
    let places = axis.levels.len() as f64;
    let mut chart = ChartBuilder::on(area)
        .margin(8)
        .caption(format!("{} ({})", axis.name, axis.axis), ("sans-serif", 14))
        .x_label_area_size(20)
        .y_label_area_size(34)
        .build_cartesian_2d(-0.2..places + 0.2, 0.0..1.02)?;
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
    // The legend's first method is drawn last, so that it stays visible where lines coincide.
    for (index, method) in shown.iter().rev() {
        let cells = method.disturbances[at].levels.iter().map(|level| &level.cell);
        let line: Vec<(f64, f64)> = std::iter::once(&method.clean)
            .chain(cells)
            .enumerate()
            .filter_map(|(place, cell)| Some((place as f64, measure.of(cell)?)))
            .collect();
        let style = colour(*index).stroke_width(2);
        chart.draw_series(LineSeries::new(line.clone(), style))?;
        let dots = line.into_iter().map(|at| Circle::new(at, 2, colour(*index).filled()));
        chart.draw_series(dots)?;
    }
    Ok(())
}

fn legend(area: &Area<'_>, shown: &[(usize, &MethodReport)]) -> Drawn {
    for (line, (index, method)) in shown.iter().enumerate() {
        let y = 24 + 20 * line as i32;
        let stroke = PathElement::new([(44, y), (74, y)], colour(*index).stroke_width(3));
        area.draw(&stroke)?;
        put(area, method.method.as_str(), (82, y - 7), 14)?;
    }
    Ok(())
}
