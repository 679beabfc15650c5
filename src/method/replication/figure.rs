//! Draws the paper's two figures of results: bars of accuracy, and the confusion of surfaces.

use plotters::prelude::*;

use super::report::{PaperReport, ReportRow};
use crate::draw::{Area, COLOURS, Drawn, FigureError, Look, put, svg};
use crate::evaluate::Confusion;

const OURS: RGBColor = COLOURS[0];
const PAPER: RGBColor = COLOURS[1];
const ROW: i32 = 22;
const WIDTH: u32 = 960;
const LEFT: i32 = 390;
const RIGHT: i32 = 60;

/// The materials of the dataset LMT108, by the digit (from 1) after the G in a surface's name.
const MATERIALS: [&str; 9] = [
    "meshes",
    "stones",
    "glossy",
    "woods",
    "rubbers",
    "carpets",
    "foams",
    "plastics and papers",
    "textiles",
];

/// An SVG with our accuracies (bars) and the paper's (marks), with standard deviations over folds.
pub fn bars(report: &PaperReport) -> Result<String, FigureError> {
    let shown: Vec<&ReportRow> =
        report.rows.iter().filter(|row| row.accuracy_mean.is_some()).collect();
    let height = 90 + ROW * shown.len() as i32;
    svg((WIDTH, height as u32), Look::default(), |area| {
        let mark = if report.synthetic { " · synthetic data, no test of the method" } else { "" };
        put(area, format!("Accuracy in percent: {}{mark}", report.data), (20, 14), 18)?;
        let key = "bars: ours; marks: the paper; whiskers: standard deviation over folds";
        put(area, key, (20, 38), 13)?;
        let scale = f64::from(WIDTH as i32 - LEFT - RIGHT) / 100.0;
        let x = |percent: f64| LEFT + (percent.clamp(0.0, 100.0) * scale).round() as i32;
        for percent in (0..=100).step_by(20) {
            let at = x(f64::from(percent));
            let line = PathElement::new([(at, 60), (at, height - 24)], BLACK.mix(0.12));
            area.draw(&line)?;
            put(area, percent.to_string(), (at - 8, height - 20), 12)?;
        }
        for (at, row) in shown.iter().enumerate() {
            bar(area, row, 64 + ROW * at as i32, &x)?;
        }
        Ok(())
    })
}

fn bar(area: &Area<'_>, row: &ReportRow, top: i32, x: &dyn Fn(f64) -> i32) -> Drawn {
    let mut name = row.row.name.clone();
    if !row.missing.is_empty() {
        name.push_str(&format!(" (lacks {})", row.missing.join(", ")));
    }
    put(area, name, (20, top + 2), 13)?;
    put(area, row.row.protocol.name(), (LEFT - 112, top + 4), 10)?;
    let ours = 100.0 * row.accuracy_mean.unwrap_or(0.0);
    let std = 100.0 * row.accuracy_std.unwrap_or(0.0);
    let whisker = |y: i32, mean: f64, std: f64, colour: RGBColor| -> Drawn {
        let line =
            PathElement::new([(x(mean - std), y), (x(mean + std), y)], colour.stroke_width(1));
        Ok(area.draw(&line)?)
    };
    let box_of = [(x(0.0), top + 2), (x(ours), top + 12)];
    area.draw(&Rectangle::new(box_of, OURS.mix(0.6).filled()))?;
    whisker(top + 7, ours, std, BLACK)?;
    if let Some(published) = row.row.published {
        let at = x(published.accuracy);
        let mark = Rectangle::new([(at - 2, top + 1), (at + 2, top + 17)], PAPER.filled());
        area.draw(&mark)?;
        whisker(top + 15, published.accuracy, published.std.unwrap_or(0.0), PAPER)?;
    }
    put(area, format!("{ours:.1}"), (WIDTH as i32 - RIGHT + 10, top + 2), 12)
}

/// Index of a surface's material in [`MATERIALS`], or `MATERIALS.len()` for a name not from LMT108.
fn material(surface: &str) -> usize {
    let digit = surface.strip_prefix('G').and_then(|rest| rest.bytes().next());
    match digit {
        Some(digit @ b'1'..=b'9') => usize::from(digit - b'1'),
        _ => MATERIALS.len(),
    }
}

/// An SVG of a confusion matrix (truth against answer), with the surfaces grouped by material.
pub fn confusion(confusion: &Confusion) -> Result<String, FigureError> {
    let mut order: Vec<usize> = (0..confusion.labels.len()).collect();
    order.sort_by_key(|&at| (material(&confusion.labels[at]), &confusion.labels[at]));
    // LMT108's 108 surfaces take 864 pixels; with fewer surfaces, cells grow up to 22 pixels.
    let cell = (864 / order.len().max(1) as i32).clamp(8, 22);
    let (left, top) = (340, 190);
    let side = cell * order.len() as i32;
    let size = ((left + side + 30).max(640) as u32, (top + side + 40) as u32);
    svg(size, Look::default(), |area| {
        put(area, "Truth (rows) against answer (columns), by material", (20, 14), 18)?;
        put(area, "blue: right; orange: wrong; the darker, the more often", (20, 40), 12)?;
        let frame = Rectangle::new([(left, top), (left + side, top + side)], BLACK.mix(0.5));
        area.draw(&frame)?;
        for (row, &truth) in order.iter().enumerate() {
            let y = top + cell * row as i32;
            put(area, confusion.labels[truth].as_str(), (150, y), cell.min(12))?;
            let total: u32 = confusion.counts[truth].iter().sum();
            for (column, &answer) in order.iter().enumerate() {
                let count = confusion.counts[truth][answer];
                if count > 0 {
                    let share = f64::from(count) / f64::from(total.max(1));
                    let colour = if truth == answer { OURS } else { PAPER };
                    let x = left + cell * column as i32;
                    let of_cell = [(x, y), (x + cell, y + cell)];
                    let shade = colour.mix(0.25 + 0.75 * share).filled();
                    area.draw(&Rectangle::new(of_cell, shade))?;
                }
            }
        }
        groups(area, &order, confusion, (left, top, side, cell))
    })
}

/// Draws the names of the materials, and lines between the materials.
fn groups(
    area: &Area<'_>,
    order: &[usize],
    confusion: &Confusion,
    (left, top, side, cell): (i32, i32, i32, i32),
) -> Drawn {
    let of = |at: usize| material(&confusion.labels[order[at]]);
    for at in 0..order.len() {
        if at > 0 && of(at) == of(at - 1) {
            continue;
        }
        let offset = cell * at as i32;
        let name = MATERIALS.get(of(at)).copied().unwrap_or("others");
        put(area, name, (10, top + offset), 11)?;
        let upright = ("sans-serif", 11).into_font().transform(FontTransform::Rotate270);
        let text = Text::new(name, (left + offset, top - 6), upright.into_text_style(area));
        area.draw(&text)?;
        for line in [
            [(left, top + offset), (left + side, top + offset)],
            [(left + offset, top), (left + offset, top + side)],
        ] {
            area.draw(&PathElement::new(line, BLACK.mix(0.5)))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn surfaces_stand_by_material() {
        let labels = ["G9Cloth", "G1Mesh", "Other"].map(String::from).to_vec();
        let counts = vec![vec![2, 0, 0], vec![1, 1, 0], vec![0, 0, 2]];
        let svg = confusion(&Confusion { labels, counts }).unwrap();
        let at = |name: &str| svg.find(name).unwrap();
        assert!(at("G1Mesh") < at("G9Cloth") && at("G9Cloth") < at("Other"));
        assert!(svg.contains("meshes") && svg.contains("others"));
    }
}
