//! Turns rows of numbers into frames of the streams, without I/O and without a clock.
//!
//! A row is one frame of every stream. A column that counts rows or microseconds shows exactly how
//! many frames are missing. Without such a column, only a silence of at least [`SILENCE_S`] counts
//! as missing frames, by its duration. An unusable row also counts as missing, so that indexes keep
//! time.

use super::parser::{Line, LineParser};
use super::swaps::Swaps;
use crate::device::serial::{ErrorCounts, gap};
use crate::scene::SourceId;

/// Seconds of silence from which frames count as missing, if no column counts rows or time.
const SILENCE_S: f64 = 0.5;
/// Values at which counters of the usual widths (8, 16, 32 bits) start again from 0.
const WRAPS: [u64; 3] = [1 << 8, 1 << 16, 1 << 32];

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

#[derive(Clone, Debug, PartialEq)]
pub struct LinesStream {
    pub id: SourceId,
    /// The columns that are the stream's channels; at least one.
    pub columns: Vec<Column>,
    /// Factor that scales the stream's values to about ±1; `None` to measure the factor.
    pub scale: Option<f64>,
}

/// Errors in lines and frames, which are counted by these texts.
pub(super) const GARBAGE: &str = "lines held no numbers";
const TOO_LONG: &str = "lines were too long";
const OTHER_FORM: &str = "lines had another form";
const CHECKSUMS: &str = "lines had a wrong checksum";
const UNCLEAR: &str = "lines had two readings";
const WORDS: &str = "lines of words stood between the rows";
const NOT_NUMBERS: &str = "lines had a value that is no number";
const CHANGES: &str = "changes of the columns";
const GAPS: &str = "gaps in the lines";
const LONGEST_GAP: &str = "lines are missing in the longest gap";
const RESTARTS: &str = "restarts of the device";

#[derive(Debug, PartialEq)]
pub enum LinesEvent<'a> {
    Frames {
        stream: usize,
        samples: &'a [f32],
    },
    /// Number of frames that are missing or unusable, in all streams.
    Missing(u64),
}

/// The first unusable line of each kind.
#[derive(Debug, Default)]
pub(super) struct Examples {
    /// Kinds that have had their example.
    had: Vec<&'static str>,
    next: Vec<String>,
}

impl Examples {
    fn add(&mut self, why: &'static str, text: &[u8]) {
        if !text.is_empty() && !self.had.contains(&why) {
            self.had.push(why);
            self.next.push(format!("{why}, for example `{}`", shown(text)));
        }
    }

    /// Takes the examples that came since the last call.
    pub(super) fn take(&mut self) -> Vec<String> {
        std::mem::take(&mut self.next)
    }
}

/// A line as text, cut to what a message can hold.
pub(super) fn shown(line: &[u8]) -> String {
    const LONGEST: usize = 120;
    let text = String::from_utf8_lossy(line);
    let mut short: String = text.chars().take(LONGEST).collect();
    if short.len() < text.len() {
        short.push('…');
    }
    short
}

#[derive(Debug)]
struct Layout {
    width: usize,
    /// For each stream: its columns (counted from 0), and its factor.
    picks: Vec<(Vec<usize>, f32)>,
    count: Option<usize>,
}

#[derive(Debug, Default)]
pub struct LinesIntake {
    streams: Vec<LinesStream>,
    count: Option<Count>,
    pub rate_hz: f64,
    parser: LineParser,
    /// Names of the columns, from the header; empty without a header.
    pub names: Vec<String>,
    layout: Option<Layout>,
    /// The reason why rows cannot be used; `None` if they can be used.
    pub refused: Option<String>,
    /// The first lines of each kind that could not be used, with what they lack, to be shown.
    pub(super) examples: Examples,
    swaps: Swaps,
    pub(in crate::device) errors: ErrorCounts,
    rows: u64,
    /// The column (counted from 0) that made the last row unusable, if it was.
    dead: Option<usize>,
    /// The last value in the column of row numbers or microseconds.
    last: f64,
    last_s: f64,
    reopened: bool,
    /// Number of lines in the bytes of the latest `feed`.
    at_once: u64,
    /// Samples of each stream that are not passed on yet.
    blocks: Vec<Vec<f32>>,
}

impl LinesIntake {
    /// Makes `streams` of rows that come at `rate_hz`. A scale that is `None` counts as 1.
    pub fn new(streams: Vec<LinesStream>, count: Option<Count>, rate_hz: f64) -> Self {
        let blocks = vec![Vec::new(); streams.len()];
        Self { streams, count, rate_hz, blocks, ..Self::default() }
    }

    /// Says whether commas in the lines are decimal commas; `None` to find out.
    pub(super) fn decimal_comma(mut self, decimal_comma: Option<bool>) -> Self {
        self.parser = LineParser::new(decimal_comma);
        self
    }

    /// To be called when the line was reopened. `half`: the first bytes may begin within a line.
    pub fn reopened(&mut self, half: bool) {
        self.parser.reopened(half);
        self.reopened = true;
    }

    /// Parses bytes that arrived at `now_s` (seconds of any clock that never goes back); passes
    /// frames and gaps to `on`, in order. Returns the number of rows that became frames.
    pub fn feed(
        &mut self,
        bytes: &[u8],
        now_s: f64,
        mut on: impl FnMut(LinesEvent<'_>),
    ) -> u64 {
        let rows = self.rows;
        self.at_once = bytes.iter().filter(|byte| **byte == b'\n').count() as u64;
        // Rows borrow from the parser, so it is taken out while `self` is used.
        let mut parser = std::mem::take(&mut self.parser);
        parser.feed(bytes, |text, line| {
            let why = match line {
                Line::Row(row) => return self.row(row, (text, now_s), &mut on),
                Line::Header(names) => return self.header(names, now_s),
                Line::Words => return self.errors.add(WORDS, 1),
                Line::Unclear(why) => {
                    self.refused = Some(why.into());
                    UNCLEAR
                }
                Line::Other => OTHER_FORM,
                Line::Garbage => GARBAGE,
                Line::Damaged => CHECKSUMS,
                Line::TooLong => TOO_LONG,
            };
            self.unusable(why, text, &mut on);
        });
        self.parser = parser;
        self.flush(&mut on);
        self.rows - rows
    }

    fn header(&mut self, names: &[String], now_s: f64) {
        // Only a header after a silence is a restart, since some programs repeat their header.
        let restarted = self.rows > 0 && now_s - self.last_s >= SILENCE_S;
        self.errors.add(RESTARTS, u64::from(restarted));
        if self.names != names {
            self.names = names.to_vec();
            // The next row lays the columns out anew.
            self.layout = None;
        }
    }

    /// Counts an unusable line. Unless a column counts the rows, the line is a missing frame.
    fn unusable(&mut self, why: &'static str, text: &[u8], on: &mut impl FnMut(LinesEvent<'_>)) {
        self.errors.add(why, 1);
        self.examples.add(why, text);
        if self.count.is_none() && self.rows > 0 {
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

    fn row(
        &mut self,
        row: &[f64],
        (text, now_s): (&[u8], f64),
        on: &mut impl FnMut(LinesEvent<'_>),
    ) {
        if self.layout.as_ref().is_none_or(|layout| layout.width != row.len()) {
            match self.lay_out(row.len()) {
                Ok(layout) => {
                    self.errors.add(CHANGES, u64::from(self.layout.is_some()));
                    (self.layout, self.refused) = (Some(layout), None);
                }
                Err(why) => {
                    self.layout = None;
                    self.refused = Some(why);
                    return self.unusable(OTHER_FORM, text, on);
                }
            }
        }
        let Some(layout) = &self.layout else { return };
        let wanted = layout.picks.iter().flat_map(|(columns, _)| columns).chain(&layout.count);
        let fits = |x: f64| x.is_finite() && x.abs() <= f64::from(f32::MAX);
        if let Some(&column) = wanted.clone().find(|column| !fits(row[**column])) {
            self.dead = Some(column);
            return self.unusable(NOT_NUMBERS, text, on);
        }
        self.dead = None;
        self.swaps.add(wanted.map(|&column| row[column]), now_s);
        let counted = layout.count.map(|column| row[column]);
        let (missing, restarted) = self.missing_before(counted, now_s);
        self.errors.add(RESTARTS, u64::from(restarted));
        if missing > 0 {
            self.errors.add(GAPS, 1);
            self.errors.highest(LONGEST_GAP, missing);
            self.miss(missing, on);
        }
        self.last_s = now_s;
        self.reopened = false;
        self.rows += 1;
        let Some(layout) = &self.layout else { return };
        for (block, (columns, factor)) in self.blocks.iter_mut().zip(&layout.picks) {
            // The cast is safe: values fit into f32, and a measured factor makes them smaller.
            block.extend(columns.iter().map(|&column| row[column] as f32 * factor));
        }
    }

    /// Number of frames missing before a row, and whether the row's counter restarted.
    fn missing_before(&mut self, counted: Option<f64>, now_s: f64) -> (u64, bool) {
        let silent_s = now_s - self.last_s;
        let first = self.rows == 0;
        let Some(value) = counted else {
            // Rows that come together after a silence were only late, so they are subtracted.
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
        // By time, the least is 1: a row that comes a little early still is the next row.
        let steps = |to: f64| ((to - before) * rows).round().max(f64::from(u8::from(by_time)));
        let most = (silent_s + 1.0) * self.rate_hz + 1.0;
        let wrapped = WRAPS.iter().map(|wrap| *wrap as f64).filter(|wrap| before < *wrap);
        let mut wrapped = wrapped.map(|wrap| steps(value + wrap));
        // The row before has index 0, so a row that follows it directly has index 1.
        let index = match value > before {
            true => steps(value) as u64,
            false => wrapped.find(|steps| *steps <= most).unwrap_or(0.0) as u64,
        };
        gap(Some(1), index, 1, silent_s, self.rate_hz, self.reopened)
    }

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

    /// The name of a column (counted from 0), or its place.
    fn called(&self, column: usize) -> String {
        match self.names.get(column) {
            Some(name) => format!("column {} ({name})", column + 1),
            None => format!("column {}", column + 1),
        }
    }

    /// The reason why lines come, but no rows; `None` if the lines are not to blame.
    pub(super) fn why_silent(&self) -> Option<String> {
        let dead = |column| format!("{} holds no numbers; check its sensor", self.called(column));
        self.refused.clone().or_else(|| self.dead.map(dead))
    }

    /// A warning if two columns seem to have changed places since the last call.
    pub(super) fn swapped(&mut self) -> Option<String> {
        let (one, other) = self.swaps.found.take()?;
        let layout = self.layout.as_ref()?;
        let wanted: Vec<_> = layout.picks.iter().flat_map(|(columns, _)| columns).collect();
        let (one, other) = (self.called(**wanted.get(one)?), self.called(**wanted.get(other)?));
        Some(format!(
            "{one} and {other} seem to have changed places: each holds the numbers that the other \
             held; check what the device prints (or has the sensor been turned?)"
        ))
    }
}

#[cfg(test)]
mod tests;
