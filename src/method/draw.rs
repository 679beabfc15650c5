//! Helpers to draw the project's SVG figures.

use std::ops::Range;

use plotters::coord::Shift;
use plotters::coord::ranged1d::{AsRangedCoord, ValueFormatter};
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

/// The reason why a figure cannot be drawn.
#[derive(Debug, thiserror::Error)]
#[error("the figure cannot be drawn: {0}")]
pub struct FigureError(pub(crate) String);

/// Colours of curves, beside markers and dashes; the first six and black are safe for colour-blind readers (Okabe & Ito 2008).
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

/// How a figure looks.
#[derive(Clone, Copy, Debug, Default)]
pub struct Look {
    /// Printed width of the figure in millimetres; `None` for screens.
    pub width_mm: Option<u32>,
    /// Draws no title; synthetic data are marked all the same.
    pub no_title: bool,
}

/// Pixels of a printed millimetre, by which text of 13 pixels is printed at 7.4 points.
const PER_MM: u32 = 5;

impl Look {
    /// The figure's width in pixels, if it has `screen` pixels on a screen.
    pub(crate) fn pixels(self, screen: u32) -> u32 {
        self.width_mm.map_or(screen, |width| width * PER_MM)
    }

    /// The lines above a figure, each at most `pixels` wide. Synthetic data are always marked.
    fn head(self, title: &str, synthetic: bool, pixels: u32) -> Vec<String> {
        let text = match (self.no_title, synthetic) {
            (true, false) => return Vec::new(),
            (true, true) => "SYNTHETIC data".into(),
            (false, false) => title.to_string(),
            (false, true) => format!("{title} · SYNTHETIC data"),
        };
        let most = (f64::from(pixels) / (HEAD_FONT as f64 * LETTER)) as usize;
        let mut lines: Vec<String> = Vec::new();
        for word in text.split(' ') {
            match lines.last_mut() {
                Some(line) if line.chars().count() + word.chars().count() < most => {
                    *line += " ";
                    *line += word;
                }
                _ => lines.push(word.into()),
            }
        }
        lines
    }
}

const HEAD_FONT: i32 = 15;
/// Mean width of a letter, in font sizes.
const LETTER: f64 = 0.54;
/// Distance of the head from the left edge.
const MARGIN: i32 = 12;

/// Like [`svg`], with the lines of a [`Look::head`] above a figure of this size.
pub(crate) fn titled(
    (title, synthetic): (&str, bool),
    (width, height): (u32, u32),
    look: Look,
    draw: impl FnOnce(&Area<'_>) -> Drawn,
) -> Result<String, FigureError> {
    let lines = look.head(title, synthetic, width);
    let gap = if lines.is_empty() { 0 } else { 8 };
    let head = (lines.len() as i32 * (HEAD_FONT + 5) + gap) as u32;
    svg((width, head + height), look, |root| {
        for (row, line) in (0..).zip(lines) {
            put(root, line, (MARGIN, 8 + row * (HEAD_FONT + 5)), HEAD_FONT)?;
        }
        draw(&root.split_vertically(head).1)
    })
}

/// Makes a white picture of `size` in pixels, calls `draw` on it, and returns its SVG text.
pub(crate) fn svg(
    size: (u32, u32),
    look: Look,
    draw: impl FnOnce(&Area<'_>) -> Drawn,
) -> Result<String, FigureError> {
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        area.fill(&WHITE)?;
        draw(&area)?;
        area.present()?;
    }
    if look.width_mm.is_some() {
        let [width, height] = [size.0, size.1].map(|pixels| f64::from(pixels) / f64::from(PER_MM));
        let pixels = format!(r#"width="{}" height="{}""#, size.0, size.1);
        svg = svg.replacen(&pixels, &format!(r#"width="{width}mm" height="{height}mm""#), 1);
    }
    Ok(svg)
}

/// Outlines of markers in pixels, which differ without colours too.
const MARKERS: [&[(i32, i32)]; 8] = [
    &[(-2, -5), (2, -5), (5, -2), (5, 2), (2, 5), (-2, 5), (-5, 2), (-5, -2)],
    &[(-4, -4), (4, -4), (4, 4), (-4, 4)],
    &[(0, -6), (5, 4), (-5, 4)],
    &[(0, -6), (5, 0), (0, 6), (-5, 0)],
    &[(0, 6), (5, -4), (-5, -4)],
    &[
        (-2, -6),
        (2, -6),
        (2, -2),
        (6, -2),
        (6, 2),
        (2, 2),
        (2, 6),
        (-2, 6),
        (-2, 2),
        (-6, 2),
        (-6, -2),
        (-2, -2),
    ],
    &[(-5, -5), (5, -5), (1, 0), (5, 5), (-5, 5), (-1, 0)],
    &[(-6, -4), (-1, 0), (-6, 4), (6, 0)],
];
/// Lengths of dashes and gaps in pixels; `None` is a solid line.
const DASHES: [Option<(u32, u32)>; 5] =
    [None, Some((9, 4)), Some((2, 3)), Some((14, 5)), Some((5, 6))];

pub(crate) fn colour(curve: usize) -> RGBColor {
    COLOURS[curve % COLOURS.len()]
}

/// Draws the marker of a curve, which is counted from 0.
pub(crate) fn marker(area: &Area<'_>, (x, y): (i32, i32), curve: usize, hollow: bool) -> Drawn {
    let outline = MARKERS[curve % MARKERS.len()].iter().map(|(dx, dy)| (x + dx, y + dy));
    let mut outline: Vec<(i32, i32)> = outline.collect();
    let fill = if hollow { WHITE } else { colour(curve) };
    area.draw(&Polygon::new(outline.clone(), fill.filled()))?;
    outline.push(outline[0]);
    Ok(area.draw(&PathElement::new(outline, colour(curve).stroke_width(1)))?)
}

/// Draws a line with the dashes of a curve.
pub(crate) fn line<X: Ranged<ValueType = f64>>(
    panel: &mut Panel<'_, '_, X>,
    points: Vec<(f64, f64)>,
    curve: usize,
) -> Drawn {
    let style = colour(curve).stroke_width(2);
    match DASHES[curve % DASHES.len()] {
        None => panel.draw_series(LineSeries::new(points, style))?,
        Some((dash, gap)) => panel.draw_series(DashedLineSeries::new(points, dash, gap, style))?,
    };
    Ok(())
}

/// Width of a text in pixels, about.
pub(crate) fn text_width(text: &str, size: i32) -> i32 {
    (text.chars().count() as f64 * f64::from(size) * LETTER).ceil() as i32
}

/// A box in pixels: left, top, right, bottom.
pub(crate) type PixelBox = [i32; 4];

/// Finds room for the labels of points, beside what is there already.
pub(crate) struct Labels {
    frame: PixelBox,
    taken: Vec<PixelBox>,
}

impl Labels {
    pub(crate) fn new(frame: PixelBox) -> Self {
        Self { frame, taken: Vec::new() }
    }

    pub(crate) fn take(&mut self, part: PixelBox) {
        self.taken.push(part);
    }

    /// The upper left corner of the nearest free place of a text beside a point; `None` if all are taken.
    fn place(&mut self, (x, y): (i32, i32), (width, height): (i32, i32)) -> Option<(i32, i32)> {
        let (half_w, half_h) = (width / 2, height / 2);
        let places = [9, 16, 24, 34, 46, 60].into_iter().flat_map(|d| {
            let straight =
                [(d, -half_h), (-half_w, -d - height), (-half_w, d), (-d - width, -half_h)];
            let askew = [d, -d - width].map(|x| [(x, -d - half_h), (x, d - half_h)]);
            straight.into_iter().chain(askew.into_iter().flatten())
        });
        let mut places = places.map(|(dx, dy)| (x + dx, y + dy));
        let [left, top, right, bottom] = self.frame;
        let found = places.find(|&(x, y)| {
            let inside = x >= left && y >= top && x + width <= right && y + height <= bottom;
            let meets =
                |&[l, t, r, b]: &PixelBox| x < r && l < x + width && y < b && t < y + height;
            inside && !self.taken.iter().any(meets)
        })?;
        self.take([found.0, found.1, found.0 + width, found.1 + height]);
        Some(found)
    }

    /// Writes a text beside a point, if there is room, with a line to the point if it is not close.
    pub(crate) fn put(&mut self, area: &Area<'_>, text: &str, at: (i32, i32), size: i32) -> Drawn {
        let (width, height) = (text_width(text, size), size + 1);
        let Some((x, y)) = self.place(at, (width, height)) else { return Ok(()) };
        let end = (at.0.clamp(x, x + width), at.1.clamp(y, y + height));
        if (end.0 - at.0).abs().max((end.1 - at.1).abs()) > 12 {
            area.draw(&PathElement::new([at, end], GREY.stroke_width(1)))?;
        }
        put(area, text, (x, y), size)
    }
}

/// Moves heights apart, so that neighbours are at least `gap` apart and all stay within `range` if there is
/// room. Their order stays, so that lines to them do not cross.
pub(crate) fn apart(heights: &[i32], gap: i32, range: Range<i32>) -> Vec<i32> {
    let mut order: Vec<usize> = (0..heights.len()).collect();
    order.sort_by_key(|&at| heights[at]);
    let mut moved = heights.to_vec();
    let mut least = range.start;
    for &at in &order {
        moved[at] = moved[at].max(least);
        least = moved[at] + gap;
    }
    let mut most = range.end;
    for &at in order.iter().rev() {
        moved[at] = moved[at].min(most);
        most = moved[at] - gap;
    }
    moved
}

/// Writes text with its upper left corner at `at`, in pixels.
pub(crate) fn put(area: &Area<'_>, text: impl Into<String>, at: (i32, i32), size: i32) -> Drawn {
    Ok(area.draw(&Text::new(text.into(), at, ("sans-serif", size)))?)
}

pub(crate) type Panel<'a, 'b, X> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<X, RangedCoordf64>>;

/// `x` and `y` are the ranges of the axes, each with a description; `name_y` names the grid lines of `y`.
pub(crate) fn axes<'a, 'b, X: AsRangedCoord<Value = f64>>(
    area: &'a Area<'b>,
    (x, of_x): (X, &str),
    (y, of_y): (Range<f64>, &str),
    name_y: fn(&f64) -> String,
) -> Result<Panel<'a, 'b, X::CoordDescType>, FigureError>
where
    X::CoordDescType: ValueFormatter<f64>,
{
    let mut chart = ChartBuilder::on(area);
    chart.margin(14).x_label_area_size(46).y_label_area_size(72);
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
    fn labels_stand_apart_within_the_frame_and_keep_their_order() {
        assert_eq!(apart(&[50, 52, 10, 51], 10, 0..100), [50, 70, 10, 60]);
        assert_eq!(apart(&[95, 99, 98], 10, 0..100), [80, 100, 90]);
        let mut labels = Labels::new([0, 0, 200, 100]);
        let places: Vec<_> = (0..4).map(|_| labels.place((100, 50), (60, 14)).unwrap()).collect();
        for (at, a) in places.iter().enumerate() {
            assert!(a.0 >= 0 && a.0 + 60 <= 200 && a.1 >= 0 && a.1 + 14 <= 100, "{places:?}");
            let meets = |b: &(i32, i32)| (a.0 - b.0).abs() < 60 && (a.1 - b.1).abs() < 14;
            assert!(!places[at + 1..].iter().any(meets), "{places:?}");
        }
        assert_eq!(Labels::new([0, 0, 20, 20]).place((10, 10), (60, 14)), None);
    }

    #[test]
    fn a_printed_figure_has_its_width_and_synthetic_data_are_always_marked() {
        let look = Look { width_mm: Some(85), no_title: true };
        let drawn = svg((look.pixels(1400), 500), look, |_| Ok(())).unwrap();
        assert!(drawn.contains(r#"width="85mm" height="100mm" viewBox="0 0 425 500""#), "{drawn}");
        assert_eq!(look.head("title", true, 425), ["SYNTHETIC data"]);
        assert!(look.head("title", false, 425).is_empty());
        let long = Look::default().head(&"word ".repeat(30), true, 425);
        assert!(long.len() > 2 && long.iter().all(|line| text_width(line, 15) <= 425), "{long:?}");
    }

    #[test]
    fn numbers_have_three_digits() {
        let shown = [0.1234, 1.234, 12.34, 1234.0].map(three_digits);
        assert_eq!(shown, ["0.123", "1.23", "12.3", "1234"]);
    }
}
