//! Helpers to draw the project's SVG figures.

use std::ops::Range;

use plotters::coord::Shift;
use plotters::coord::ranged1d::{AsRangedCoord, ValueFormatter};
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

/// The reason why a figure cannot be drawn.
#[derive(Debug, thiserror::Error)]
#[error("the figure cannot be drawn: {0}")]
pub(crate) struct FigureError(pub(crate) String);

/// Colours of curves; the first six and black are safe for colour-blind readers (Okabe & Ito 2008).
pub(crate) const COLOURS: [RGBColor; 10] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
    RGBColor(110, 80, 40),
    RGBColor(0, 0, 0),
    RGBColor(120, 94, 240),
    RGBColor(160, 160, 0),
];

pub(crate) const GREY: RGBColor = RGBColor(120, 120, 120);

/// A drawing area: a whole picture or a part of it.
pub(crate) type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
pub(crate) type Drawn = Result<(), FigureError>;

impl From<DrawingAreaErrorKind<std::io::Error>> for FigureError {
    fn from(error: DrawingAreaErrorKind<std::io::Error>) -> Self {
        Self(error.to_string())
    }
}

/// Makes a white picture of `size` in pixels, calls `draw` on it, and returns its SVG text.
pub(crate) fn svg(
    size: (u32, u32),
    draw: impl FnOnce(&Area<'_>) -> Drawn,
) -> Result<String, FigureError> {
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        area.fill(&WHITE)?;
        draw(&area)?;
        area.present()?;
    }
    Ok(svg)
}

/// Writes text with its upper left corner at `at`, in pixels.
pub(crate) fn put(area: &Area<'_>, text: impl Into<String>, at: (i32, i32), size: i32) -> Drawn {
    Ok(area.draw(&Text::new(text.into(), at, ("sans-serif", size)))?)
}

pub(crate) type Panel<'a, 'b, X> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<X, RangedCoordf64>>;

/// Draws the title, if there is one, the grid, and the axes of a panel. `x` and `y` are the ranges of
/// the axes, each with a description; `name_y` names the grid lines of `y`.
pub(crate) fn axes<'a, 'b, X: AsRangedCoord<Value = f64>>(
    area: &'a Area<'b>,
    title: &str,
    (x, of_x): (X, &str),
    (y, of_y): (Range<f64>, &str),
    name_y: fn(&f64) -> String,
) -> Result<Panel<'a, 'b, X::CoordDescType>, FigureError>
where
    X::CoordDescType: ValueFormatter<f64>,
{
    let mut chart = ChartBuilder::on(area);
    chart.margin(14).x_label_area_size(46).y_label_area_size(72);
    if !title.is_empty() {
        chart.caption(title, ("sans-serif", 20));
    }
    let mut chart = chart.build_cartesian_2d(x, y)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(BLACK.mix(0.08))
        .x_desc(of_x)
        .y_desc(of_y)
        .x_labels(8)
        .y_labels(8)
        .x_label_formatter(&plain)
        .y_label_formatter(&name_y)
        .label_style(("sans-serif", 15))
        .draw()?;
    Ok(chart)
}

/// Formats a number without the digits that come from rounding errors.
pub(crate) fn plain(x: &f64) -> String {
    ((x * 1e9).round() / 1e9).to_string()
}

pub(crate) fn three_digits(x: f64) -> String {
    let decimals = (2 - x.max(1e-3).log10().floor() as i32).clamp(0, 4) as usize;
    format!("{x:.decimals$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_three_digits() {
        let shown = [0.1234, 1.234, 12.34, 1234.0].map(three_digits);
        assert_eq!(shown, ["0.123", "1.23", "12.3", "1234"]);
    }
}
