//! The columns of a row: those that are channels of a stream, and the one that counts.

use crate::scene::SourceId;

/// A column, given by its place (counted from 1) or by its name in the header.
#[derive(Clone, Debug, PartialEq, Eq, serde::Deserialize)]
#[serde(untagged)]
pub enum Column {
    Place(usize),
    Name(String),
}

#[derive(Clone, Debug, PartialEq)]
pub enum Count {
    Rows(Column),
    Micros(Column),
}

impl Count {
    pub(super) fn column(&self) -> &Column {
        let (Self::Rows(column) | Self::Micros(column)) = self;
        column
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct LinesStream {
    pub id: SourceId,
    /// The columns that are the stream's channels; at least one.
    pub columns: Vec<Column>,
    /// Factor that scales the stream's values to about ±1; `None` to measure the factor.
    pub scale: Option<f64>,
}

#[derive(Debug)]
pub(super) struct Layout {
    pub width: usize,
    /// For each stream: its columns (counted from 0), and its factor.
    pub picks: Vec<(Vec<usize>, f32)>,
    pub count: Option<usize>,
}

impl Layout {
    /// The layout of rows of `width` values, whose columns have these names; empty without a header.
    pub(super) fn new(
        streams: &[LinesStream],
        count: Option<&Count>,
        names: &[String],
        width: usize,
    ) -> Result<Self, String> {
        let named = names.len() == width;
        let place = |column: &Column| match column {
            Column::Place(place @ 1..) if *place <= width => Ok(place - 1),
            Column::Place(place) => Err(format!(
                "a line has {width} columns, and the configuration wants number {place}"
            )),
            Column::Name(name) => {
                let mut all = (0..names.len()).filter(|at| names[*at] == *name);
                let (at, twice) = (all.next(), all.next());
                if let (true, Some(at), Some(twice)) = (named, at, twice) {
                    let (one, two) = (at + 1, twice + 1);
                    return Err(format!(
                        "columns {one} and {two} are both called {name}; give the place of the one \
                         that is meant in the configuration"
                    ));
                }
                at.filter(|_| named).ok_or_else(|| {
                    let known = match named {
                        true => format!("they are called {}", names.join(", ")),
                        false => "no header has named them; reset the device, or give their \
                                  places in the configuration"
                            .into(),
                    };
                    format!("no column is called {name}: {known}")
                })
            }
        };
        let picks = |stream: &LinesStream| {
            let columns = stream.columns.iter().map(place).collect::<Result<Vec<_>, _>>()?;
            Ok::<_, String>((columns, stream.scale.unwrap_or(1.0) as f32))
        };
        let picks = streams.iter().map(picks).collect::<Result<_, _>>()?;
        let count = match count {
            Some(count) => Some(place(count.column())?),
            None => None,
        };
        Ok(Self { width, picks, count })
    }
}
