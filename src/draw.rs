//! Helpers to draw the project's SVG figures.

use plotters::coord::Shift;
use plotters::prelude::*;

/// The reason why a figure cannot be drawn.
#[derive(Debug, thiserror::Error)]
#[error("the figure cannot be drawn: {0}")]
pub struct FigureError(pub(crate) String);

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
