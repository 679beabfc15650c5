//! From rows of numbers to frames of the streams: no I/O, no clock.
//!
//! A row is a frame of every stream. A counter or a column of microseconds shows exactly how many
//! frames are missing; without either, those of a silence of at least [`SILENCE_S`] are counted by
//! the clock. A row that cannot be used is a missing frame too, so that an index always means the
//! same moment.

use super::parser::{Line, LineParser};
use crate::device::serial::gap;
use crate::scene::SourceId;

/// Without a column that counts, a shorter silence is a delay and no loss, in seconds.
const SILENCE_S: f64 = 0.5;
/// This many rows of another width in a row, and the columns have changed.
const CHANGED: u32 = 20;
/// Where counters of the usual widths start again.
const WRAPS: [u64; 3] = [1 << 8, 1 << 16, 1 << 32];

/// A column, by its name in the header or by its place.
#[derive(Clone, Debug, PartialEq, Eq, serde::Deserialize)]
#[serde(untagged)]
pub enum Column {
    /// Its place, counted from 1.
    Place(usize),
    /// Its name.
    Name(String),
}

/// The column that counts.
#[derive(Clone, Debug, PartialEq)]
pub enum Count {
    /// A counter of rows.
    Rows(Column),
    /// Microseconds.
    Micros(Column),
}

/// A stream to be made of columns.
#[derive(Clone, Debug, PartialEq)]
pub struct LinesStream {
    pub id: SourceId,
    /// Its channels, at least one.
    pub columns: Vec<Column>,
    /// The factor that makes about ±1 of its values; measured where it is not given.
    pub scale: Option<f64>,
}

/// Counts of what came, since they were last taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LineCounts {
    /// Rows that became frames.
    pub rows: u64,
    pub garbage: u64,
    pub too_long: u64,
    /// Rows of another number of columns.
    pub other_width: u64,
    /// Rows in which a value of a stream, or of the column that counts, is no number.
    pub not_numbers: u64,
    pub gaps: u64,
    /// Frames that are missing in the longest gap.
    pub missing: u64,
    pub restarts: u64,
    /// Changes of the columns.
    pub changes: u64,
}

impl LineCounts {
    /// Adds those of a later time.
    pub fn add(&mut self, later: &Self) {
        self.rows += later.rows;
        self.garbage += later.garbage;
        self.too_long += later.too_long;
        self.other_width += later.other_width;
        self.not_numbers += later.not_numbers;
        self.gaps += later.gaps;
        self.missing = self.missing.max(later.missing);
        self.restarts += later.restarts;
        self.changes += later.changes;
    }
}

/// Events from the line.
#[derive(Debug, PartialEq)]
pub enum LinesEvent<'a> {
    /// Frames of a stream, interleaved.
    Frames { stream: usize, samples: &'a [f32] },
    /// Frames of all streams that never arrived, or could not be used.
    Missing(u64),
}

/// The columns of the rows, as they come now.
#[derive(Debug)]
struct Layout {
    width: usize,
    /// Of each stream: columns from 0, and the factor.
    picks: Vec<(Vec<usize>, f32)>,
    count: Option<usize>,
}

/// Turns bytes into frames.
#[derive(Debug)]
pub struct LinesIntake {
    streams: Vec<LinesStream>,
    count: Option<Count>,
    rate_hz: f64,
    parser: LineParser,
    names: Vec<String>,
    layout: Option<Layout>,
    /// Rows in a row that the layout does not fit.
    misfits: u32,
    /// Why rows cannot be used, if they cannot.
    refused: Option<String>,
    counts: LineCounts,
    /// Whether there were frames, and the last value of the column that counts.
    started: bool,
    last: f64,
    /// When the last frame came, in seconds.
    last_s: f64,
    reopened: bool,
    /// Lines that came at once.
    at_once: u64,
    /// Samples of each stream that were not passed on.
    blocks: Vec<Vec<f32>>,
}

impl LinesIntake {
    /// Makes these streams of rows at this rate in Hz. A scale that is not given is 1.
    pub fn new(streams: Vec<LinesStream>, count: Option<Count>, rate_hz: f64) -> Self {
        let blocks = vec![Vec::new(); streams.len()];
        Self {
            streams,
            count,
            rate_hz,
            parser: LineParser::default(),
            names: Vec::new(),
            layout: None,
            misfits: 0,
            refused: None,
            counts: LineCounts::default(),
            started: false,
            last: f64::NAN,
            last_s: 0.0,
            reopened: false,
            at_once: 0,
            blocks,
        }
    }

    /// The line was reopened; what comes next may begin within a line if `half`.
    pub fn reopened(&mut self, half: bool) {
        self.parser.reopened(half);
        self.reopened = true;
    }

    /// The names of the columns, so far as a header told.
    pub fn set_names(&mut self, names: &[String]) {
        self.names = names.to_vec();
    }

    /// Why no row can be used, where that is so.
    pub fn refused(&self) -> Option<&str> {
        self.refused.as_deref()
    }

    /// The counts since they were last taken.
    pub fn take_counts(&mut self) -> LineCounts {
        std::mem::take(&mut self.counts)
    }

    /// Takes bytes that came at `now_s` (seconds of any clock that does not go back), and passes
    /// `on` what they hold, in order. Returns whether there were frames.
    pub fn feed(&mut self, bytes: &[u8], now_s: f64, mut on: impl FnMut(LinesEvent<'_>)) -> bool {
        let rows = self.counts.rows;
        self.at_once = bytes.iter().filter(|byte| **byte == b'\n').count() as u64;
        // Taken out, so that a row that borrows from it leaves the rest usable.
        let mut parser = std::mem::take(&mut self.parser);
        parser.feed(bytes, |line| match line {
            Line::Row(row) => self.row(row, now_s, &mut on),
            Line::Header(names) => self.header(names, now_s),
            Line::Garbage => self.unusable(|counts| &mut counts.garbage, &mut on),
            Line::TooLong => self.unusable(|counts| &mut counts.too_long, &mut on),
        });
        self.parser = parser;
        self.flush(&mut on);
        self.counts.rows > rows
    }

    fn header(&mut self, names: &[String], now_s: f64) {
        // Some programs repeat it now and then; a reset takes time.
        self.counts.restarts += u64::from(self.started && now_s - self.last_s >= SILENCE_S);
        if self.names != names {
            self.names = names.to_vec();
            // Found anew from the next row, if that is as wide.
            self.layout = None;
        }
    }

    /// A line that is no frame, where rows are expected: a missing one, unless a column counts.
    fn unusable(
        &mut self,
        which: fn(&mut LineCounts) -> &mut u64,
        on: &mut impl FnMut(LinesEvent<'_>),
    ) {
        *which(&mut self.counts) += 1;
        if self.count.is_none() && self.started {
            self.miss(1, on);
        }
    }

    fn miss(&mut self, frames: u64, on: &mut impl FnMut(LinesEvent<'_>)) {
        self.flush(on);
        on(LinesEvent::Missing(frames));
    }

    fn flush(&mut self, on: &mut impl FnMut(LinesEvent<'_>)) {
        for (stream, block) in self.blocks.iter_mut().enumerate().filter(|(_, b)| !b.is_empty()) {
            on(LinesEvent::Frames { stream, samples: block });
            block.clear();
        }
    }

    fn row(&mut self, row: &[f64], now_s: f64, on: &mut impl FnMut(LinesEvent<'_>)) {
        if self.layout.as_ref().is_none_or(|layout| layout.width != row.len()) {
            self.misfits += 1;
            if self.layout.is_some() && self.misfits < CHANGED {
                return self.unusable(|counts| &mut counts.other_width, on);
            }
            match self.lay_out(row.len()) {
                Ok(layout) => {
                    self.counts.changes += u64::from(self.layout.is_some());
                    (self.layout, self.refused) = (Some(layout), None);
                }
                Err(why) => {
                    self.refused = Some(why);
                    return self.unusable(|counts| &mut counts.other_width, on);
                }
            }
        }
        self.misfits = 0;
        let Some(layout) = &self.layout else { return };
        let wanted = layout.picks.iter().flat_map(|(columns, _)| columns).chain(&layout.count);
        let fits = |x: f64| x.is_finite() && x.abs() <= f64::from(f32::MAX);
        if !wanted.map(|&column| row[column]).all(fits) {
            return self.unusable(|counts| &mut counts.not_numbers, on);
        }
        let counted = layout.count.map(|column| row[column]);
        let (missing, restarted) = self.missing_before(counted, now_s);
        self.counts.restarts += u64::from(restarted);
        if missing > 0 {
            self.counts.gaps += 1;
            self.counts.missing = self.counts.missing.max(missing);
            self.miss(missing, on);
        }
        self.last_s = now_s;
        self.reopened = false;
        self.counts.rows += 1;
        let Some(layout) = &self.layout else { return };
        for (block, (columns, factor)) in self.blocks.iter_mut().zip(&layout.picks) {
            // Within f32, as looked at above; the factor only makes it smaller.
            block.extend(columns.iter().map(|&column| row[column] as f32 * factor));
        }
    }

    /// Frames missing before a row, and whether its counter restarted.
    fn missing_before(&mut self, counted: Option<f64>, now_s: f64) -> (u64, bool) {
        let silent_s = now_s - self.last_s;
        let first = !std::mem::replace(&mut self.started, true);
        let Some(value) = counted else {
            // What comes at once after a silence was late and not lost.
            let silent = silent_s >= SILENCE_S || self.reopened;
            let by_clock = (silent_s * self.rate_hz).round().max(0.0) as u64;
            return match silent && !first {
                true => (by_clock.saturating_sub(self.at_once), false),
                false => (0, false),
            };
        };
        let before = std::mem::replace(&mut self.last, value);
        if first {
            return (0, false);
        }
        let by_time = matches!(self.count, Some(Count::Micros(_)));
        let rows = if by_time { 1e-6 * self.rate_hz } else { 1.0 };
        // A little early is the next row nevertheless.
        let steps = |to: f64| ((to - before) * rows).round().max(f64::from(u8::from(by_time)));
        let most = (silent_s + 1.0) * self.rate_hz + 1.0;
        let wrapped = WRAPS.iter().map(|wrap| *wrap as f64).filter(|wrap| before < *wrap);
        let mut wrapped = wrapped.map(|wrap| steps(value + wrap));
        // The row before is number 0, so one that follows it directly is number 1.
        let index = match value > before {
            true => steps(value) as u64,
            false => wrapped.find(|steps| *steps <= most).unwrap_or(0.0) as u64,
        };
        gap(Some(1), index, 1, silent_s, self.rate_hz, self.reopened)
    }

    /// Where the columns are in rows of this width.
    fn lay_out(&self, width: usize) -> Result<Layout, String> {
        let named = self.names.len() == width;
        let place = |column: &Column| match column {
            Column::Place(place @ 1..) if *place <= width => Ok(place - 1),
            Column::Place(place) => Err(format!(
                "a line has {width} columns, and the configuration wants number {place}"
            )),
            Column::Name(name) => {
                let at = self.names.iter().position(|other| other == name);
                at.filter(|_| named).ok_or_else(|| {
                    let known = match named {
                        true => format!("they are called {}", self.names.join(", ")),
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
        let picks = self.streams.iter().map(picks).collect::<Result<_, _>>()?;
        let count = match &self.count {
            Some(Count::Rows(column) | Count::Micros(column)) => Some(place(column)?),
            None => None,
        };
        Ok(Layout { width, picks, count })
    }
}

#[cfg(test)]
mod tests;
