//! Turns rows of numbers into frames of the streams, without I/O and without a clock.
//!
//! A row is one frame of every stream. A column that counts rows or microseconds shows exactly how
//! many frames are missing. Without such a column, a silence of at least [`SILENCE_S`] counts as
//! missing frames, as far as the rows that come after it do not make up for it: such rows were only
//! late, so they are held back until this shows. An unusable row also counts as missing, so that
//! indexes keep time.

pub(super) mod count;

use super::lateness::{Lateness, RowClock};
use super::layout::{Column, Count, Layout, LinesStream};
use super::parser::{Line, LineParser, header_of, shown};
use super::swaps::Swaps;
use crate::device::serial::{ErrorCounts, LEAST_RESTART_S};

/// Seconds of silence, and its least number of rows, from which frames may be missing, if no column
/// tells their number.
const SILENCE_S: f64 = 0.1;
const SILENCE_ROWS: f64 = 4.0;
/// Rows are held back until they come no less late for this many seconds, but at most for
/// [`MOST_HELD_S`].
const SETTLED_S: f64 = 0.25;
const MOST_HELD_S: f64 = 10.0;
/// Rows this much later than before a silence, in seconds and as a share of the silence, lack nothing.
const LATE_S: f64 = 0.05;
const LATE: f64 = 0.02;
/// Seconds over which the lateness of rows is compared.
const LOOKBACK_S: f64 = 1.0;
/// Seconds without rows before a header that shows a restart.
const RESTART_S: f64 = 0.5;

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
const OUT_OF_ORDER: &str = "lines came twice or out of order";

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
    /// Examples that were not taken yet.
    pub next: Vec<String>,
}

impl Examples {
    fn add(&mut self, why: &'static str, text: &[u8]) {
        if !text.is_empty() && !self.had.contains(&why) {
            self.had.push(why);
            self.next.push(format!("{why}, for example `{}`", shown(text)));
        }
    }
}

/// Rows that are held back, since it is not clear yet how many were lost before them.
#[derive(Debug)]
struct Held {
    /// Times of the last row before the silence, and of the first after it.
    silent_s: f64,
    since_s: f64,
    /// The least lateness before the silence, and since then.
    before_s: f64,
    least_s: f64,
    /// The lateness to which the rows have last made up noticeably, and when that was.
    progress: (f64, f64),
    /// Number of missing frames, if that is known up to a multiple of `unit`.
    counted: u64,
    unit: f64,
    reopened: bool,
}

impl Held {
    /// Seconds by which the rows stay later than those before the silence.
    fn late_s(&self) -> f64 {
        self.least_s - self.before_s
    }

    fn in_time(&self) -> bool {
        self.late_s() <= LATE_S + LATE * self.silent_s
    }
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
    pub(super) examples: Examples,
    swaps: Swaps,
    /// A warning, not taken yet, that the header has moved a column that is configured by its place.
    moved: Option<String>,
    pub(in crate::device) errors: ErrorCounts,
    rows: u64,
    /// The column (counted from 0) that made the last row unusable, if it was.
    dead: Option<usize>,
    /// The last value in the column of row numbers or microseconds.
    last: f64,
    last_s: f64,
    reopened: bool,
    /// Number of frames so far, missing ones included.
    pub frames: u64,
    /// Number of rows that came twice or out of order since the last row that did not.
    out_of_order: u32,
    /// The number of values of the column of row numbers, once it has begun again.
    wrap: Option<f64>,
    clock: Option<RowClock>,
    lateness: Option<Lateness>,
    held: Option<Held>,
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
    pub fn feed(&mut self, bytes: &[u8], now_s: f64, mut on: impl FnMut(LinesEvent<'_>)) -> u64 {
        let rows = self.rows;
        self.settle(now_s, &mut on);
        // Rows borrow from the parser, so it is taken out while `self` is used.
        let mut parser = std::mem::take(&mut self.parser);
        parser.feed(bytes, |text, line| {
            let why = match line {
                Line::Row(row) => return self.row(row, (text, now_s), &mut on),
                Line::Header(names) => return self.header(names, (text, now_s)),
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
        self.settle(now_s, &mut on);
        if self.held.is_none() {
            self.flush(&mut on);
        }
        self.rows - rows
    }

    fn header(&mut self, names: &[String], (text, now_s): (&[u8], f64)) {
        // Only a header after a silence is a restart, since some programs repeat their header.
        let restarted = self.rows > 0 && now_s - self.last_s >= RESTART_S;
        self.errors.add(RESTARTS, u64::from(restarted));
        let count = self.count.as_ref().map(Count::column);
        let columns = || self.streams.iter().flat_map(|s| &s.columns).chain(count);
        let known = |name: &String| {
            self.names.contains(name)
                || columns().any(|column| matches!(column, Column::Name(wanted) if wanted == name))
        };
        // A log's words, with as many cells as the rows have, hold no name that is known.
        let words = header_of(text).1 == names && self.names.len() == names.len();
        if words && !restarted && !self.reopened && !names.iter().any(known) {
            return;
        }
        let moved = columns().find_map(|column| {
            let Column::Place(place) = column else { return None };
            let name = self.names.get(place.checked_sub(1)?)?;
            let now = names.iter().position(|other| other == name)? + 1;
            (now != *place).then(|| (place, name.clone(), now))
        });
        if let Some((place, name, now)) = moved.filter(|_| self.names != names) {
            self.moved = Some(format!(
                "the header has changed: {name} was column {place} and is now column {now}, but \
                 the configuration wants column {place}; name the columns in [lines.sources], \
                 which follows them"
            ));
        }
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
        // While rows are held back, it shows in their lateness.
        if self.count.is_none() && self.rows > 0 && self.held.is_none() {
            self.miss(1, on);
        }
    }

    fn miss(&mut self, frames: u64, on: &mut impl FnMut(LinesEvent<'_>)) {
        self.flush(on);
        self.frames += frames;
        on(LinesEvent::Missing(frames));
    }

    fn gap(&mut self, missing: u64, on: &mut impl FnMut(LinesEvent<'_>)) {
        if missing > 0 {
            self.errors.add(GAPS, 1);
            self.errors.highest(LONGEST_GAP, missing);
            self.miss(missing, on);
        }
    }

    /// Passes on the rows that are held back, once it is clear how many frames are missing before them.
    fn settle(&mut self, now_s: f64, on: &mut impl FnMut(LinesEvent<'_>)) {
        let is_settled = |held: &Held| {
            let settled = now_s - held.progress.1 >= SETTLED_S;
            held.in_time() || settled || now_s - held.since_s >= MOST_HELD_S
        };
        if self.held.as_ref().is_some_and(is_settled) {
            self.release(on);
        }
    }

    fn release(&mut self, on: &mut impl FnMut(LinesEvent<'_>)) {
        let Some(held) = self.held.take() else { return };
        let late_s = if held.in_time() && !held.reopened { 0.0 } else { held.late_s() };
        let by_time = late_s * self.rate_hz;
        let more = ((by_time - held.counted as f64) / held.unit).round().max(0.0) * held.unit;
        let least = if held.reopened { LEAST_RESTART_S * self.rate_hz } else { 0.0 };
        let missing = (held.counted + more as u64).max(least.ceil() as u64);
        // The gap comes before the rows that were held back.
        let rows = std::mem::replace(&mut self.blocks, vec![Vec::new(); self.streams.len()]);
        self.gap(missing, on);
        self.blocks = rows;
        self.flush(on);
        let mut lateness = Lateness::new(LOOKBACK_S);
        lateness.add(held.progress.1, held.least_s - missing as f64 / self.rate_hz);
        self.lateness = Some(lateness);
    }

    fn is_after_silence(&self, now_s: f64) -> bool {
        let least_s = SILENCE_S.max(SILENCE_ROWS / self.rate_hz);
        self.rows > 0 && (now_s - self.last_s >= least_s || self.reopened)
    }

    /// Notes a row that came at `now_s`. After a silence, holds back the rows from this one on if the
    /// number of missing ones is `unknown`: a number, plus any multiple of a unit.
    fn arrived(
        &mut self,
        now_s: f64,
        unknown: Option<(u64, f64)>,
        on: &mut impl FnMut(LinesEvent<'_>),
    ) {
        if self.reopened || unknown.is_some_and(|(counted, _)| counted > 0) {
            self.release(on);
        }
        let late_s = now_s - self.frames as f64 / self.rate_hz;
        let silent_s = now_s - self.last_s;
        if let Some((counted, unit)) = unknown.filter(|_| self.is_after_silence(now_s))
            && self.held.is_none()
        {
            self.flush(on);
            let before_s = self.lateness.as_ref().and_then(Lateness::least);
            self.held = Some(Held {
                silent_s,
                since_s: now_s,
                before_s: before_s.unwrap_or(late_s - silent_s),
                least_s: late_s,
                progress: (late_s, now_s),
                counted,
                unit,
                reopened: self.reopened,
            });
        }
        match &mut self.held {
            Some(held) => {
                held.least_s = held.least_s.min(late_s);
                if held.least_s < held.progress.0 - 0.5 * LATE_S {
                    held.progress = (held.least_s, now_s);
                }
            }
            None => {
                let lateness = self.lateness.get_or_insert_with(|| Lateness::new(LOOKBACK_S));
                lateness.add(now_s, late_s);
            }
        }
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
            match Layout::new(&self.streams, self.count.as_ref(), &self.names, row.len()) {
                Ok(layout) => {
                    self.errors.add(CHANGES, u64::from(self.layout.is_some()));
                    self.layout = Some(layout);
                }
                Err(why) => {
                    self.layout = None;
                    self.refused = Some(why);
                    return self.unusable(OTHER_FORM, text, on);
                }
            }
        }
        let Some(layout) = &self.layout else { return };
        self.refused = None;
        let wanted = layout.picks.iter().flat_map(|(columns, _)| columns).chain(&layout.count);
        let fits = |x: f64| x.is_finite() && x.abs() <= f64::from(f32::MAX);
        if let Some(&column) = wanted.clone().find(|column| !fits(row[**column])) {
            self.dead = Some(column);
            return self.unusable(NOT_NUMBERS, text, on);
        }
        self.dead = None;
        if layout.count.is_some_and(|column| self.is_out_of_order(row[column], now_s)) {
            self.out_of_order += 1;
            return self.errors.add(OUT_OF_ORDER, 1);
        }
        self.out_of_order = 0;
        self.swaps.add(wanted.map(|&column| row[column]), now_s);
        let counted = layout.count.map(|column| row[column]);
        let (missing, restarted, unknown) = self.missing_before(counted, now_s);
        self.errors.add(RESTARTS, u64::from(restarted));
        if missing > 0 {
            self.release(on);
            self.gap(missing, on);
        }
        self.arrived(now_s, unknown, on);
        self.last_s = now_s;
        self.reopened = false;
        self.rows += 1;
        self.frames += 1;
        let Some(layout) = &self.layout else { return };
        for (block, (columns, factor)) in self.blocks.iter_mut().zip(&layout.picks) {
            // The cast is safe: values fit into f32, and a measured factor makes them smaller.
            block.extend(columns.iter().map(|&column| row[column] as f32 * factor));
        }
    }

    /// Notes that the system has dropped this many rows just now.
    pub(super) fn dropped(&mut self, rows: u64, mut on: impl FnMut(LinesEvent<'_>)) {
        if rows > 0 && self.count.is_none() && self.rows > 0 && self.held.is_none() {
            self.gap(rows, &mut on);
        }
    }

    /// Whether rows are held back, since it is not known yet how many frames a silence lacked.
    pub(super) fn is_unsettled(&self) -> bool {
        self.held.is_some()
    }

    /// The rate in Hz by the column of microseconds; `None` if there is none, or too few rows.
    pub(super) fn clock_hz(&self) -> Option<f64> {
        self.clock.as_ref()?.measured_hz
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
        self.refused.clone().or_else(|| self.dead.map(dead)).or_else(|| self.parser.no_form())
    }

    /// A warning if two columns seem to have changed places since the last call.
    pub(super) fn swapped(&mut self) -> Option<String> {
        if let Some(moved) = self.moved.take() {
            return Some(moved);
        }
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
