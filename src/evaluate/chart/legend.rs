//! How the points and lines of a chart look, and what they are called.

use std::collections::BTreeMap;

use plotters::prelude::*;

use super::point::{Chart, ChartPoint};
use crate::draw::{Area, COLOURS, Drawn, drawing, put};

/// The colour of each method.
pub(super) type Colours<'a> = BTreeMap<&'a str, RGBColor>;

/// Methods in the order in which they come, each with its colour.
pub(super) fn colours(chart: &Chart) -> Colours<'_> {
    let mut methods: Vec<&str> = Vec::new();
    for point in chart.methods() {
        if !methods.contains(&point.method.as_str()) {
            methods.push(&point.method);
        }
    }
    methods.into_iter().zip(COLOURS.into_iter().cycle()).collect()
}

/// The controls, each with the letter that its line bears.
pub(super) fn lettered(chart: &Chart) -> impl Iterator<Item = (String, &ChartPoint)> {
    ('a'..='z').map(String::from).zip(chart.controls())
}

/// How a point looks.
#[derive(Clone, Copy)]
pub(super) struct PointMark {
    pub colour: RGBColor,
    /// A program of others.
    pub square: bool,
    /// By some of the sources.
    pub hollow: bool,
}

impl PointMark {
    pub fn draw(self, area: &Area<'_>, (x, y): (i32, i32)) -> Drawn {
        let style = if self.hollow { self.colour.stroke_width(2) } else { self.colour.filled() };
        if self.square {
            area.draw(&Rectangle::new([(x - 5, y - 5), (x + 5, y + 5)], style)).map_err(drawing)
        } else {
            area.draw(&Circle::new((x, y), 5, style)).map_err(drawing)
        }
    }
}

/// A name in the legend.
pub(super) struct LegendKey {
    name: String,
    mark: PointMark,
}

impl LegendKey {
    /// About what the text takes.
    pub fn width(&self) -> i32 {
        self.name.chars().count() as i32 * 7 + 40
    }

    pub fn draw(&self, area: &Area<'_>, (x, y): (i32, i32)) -> Drawn {
        self.mark.draw(area, (x + 6, y + 7))?;
        put(area, self.name.as_str(), (x + 18, y), 13)
    }
}

/// The legend, as many names in a row as fit into a width.
pub(super) fn legend_rows(
    chart: &Chart,
    colours: &Colours<'_>,
    within: i32,
) -> Vec<Vec<LegendKey>> {
    let mut keys: Vec<LegendKey> = Vec::new();
    for point in chart.methods() {
        let colour = colours[point.method.as_str()];
        let hollow = chart.is_subset(point);
        let name = match (point.peer, hollow) {
            (true, _) => format!("{} (a peer)", point.method),
            (false, true) => format!("{}, some sources", point.method),
            (false, false) => point.method.clone(),
        };
        if !keys.iter().any(|key| key.name == name) {
            keys.push(LegendKey { name, mark: PointMark { colour, square: point.peer, hollow } });
        }
    }
    let mut rows: Vec<Vec<LegendKey>> = Vec::new();
    let mut used = 0;
    for key in keys {
        let width = key.width();
        match rows.last_mut().filter(|_| used + width <= within) {
            Some(row) => {
                used += width;
                row.push(key);
            }
            None => {
                used = width;
                rows.push(vec![key]);
            }
        }
    }
    rows
}
