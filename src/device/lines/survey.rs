//! Finds out what an undescribed device sends: its columns, their ranges, the rate, and which
//! column counts rows or time. Does no I/O and has no clock.

use super::intake::{Column, Count, LinesStream};
use super::parser::{Line, LineParser};
use crate::scene::SourceId;

pub const SURVEY_S: f64 = 3.0;
/// Seconds at the start that do not count for the rate, since early rows may come from a buffer.
const SETTLE_S: f64 = 0.3;
/// Fewest rows that suffice to measure a rate.
const FEWEST: u64 = 20;
/// Most differences between successive numbers of a column that are kept.
const MOST_STEPS: usize = 4096;
/// Lowest and highest rate of a sensor, in Hz; faster lines come from a file.
const RATES_HZ: (f64, f64) = (1.0, 200_000.0);
/// Largest share of full scale that the last printed digit may stand for (a few 16-bit steps).
const STEP: f64 = 1e-4;
/// Least ratio of full scale to the highest number seen, since sensors are mostly at rest.
const ROOM: f64 = 3.0;

#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct ColumnSurvey {
    pub name: Option<String>,
    /// The lowest number in the column; `None` if there was none. `highest` is the opposite.
    pub lowest: Option<f64>,
    pub highest: Option<f64>,
    pub decimals: i32,
    /// The unit in which the column counts: `rows`, `microseconds`, or `time` for any other clock.
    pub counts: Option<&'static str>,
    #[serde(skip)]
    steps: Steps,
}

/// The steps (differences) from each number of a column to the next.
#[derive(Clone, Debug, Default, PartialEq)]
struct Steps {
    first: f64,
    last: f64,
    numbers: u64,
    /// Number of steps of exactly 1; `down` is the number of steps that are 0 or negative.
    ones: u64,
    down: u64,
    /// The first steps that go up. Steps near their median are usual, even if rows are lost.
    up: Vec<f64>,
}

#[derive(Debug, Default)]
pub struct Survey {
    parser: LineParser,
    names: Vec<String>,
    columns: Vec<ColumnSurvey>,
    /// Time of the first row, in seconds; `None` before it.
    began_s: Option<f64>,
    rows: u64,
    /// Number of lines that are not rows, or have another number of columns.
    others: u64,
    bytes: u64,
    /// Sums of 1, t, rows, t² and t·rows over arrivals after [`SETTLE_S`], to fit a line to them.
    line: [f64; 5],
    last_s: f64,
}

impl Survey {
    /// An empty survey. `half` says that the first bytes may begin within a line.
    pub fn new(half: bool) -> Self {
        let mut survey = Self::default();
        survey.parser.reopened(half);
        survey
    }

    pub fn feed(&mut self, bytes: &[u8], now_s: f64) {
        self.bytes += bytes.len() as u64;
        let (mut parser, before) = (std::mem::take(&mut self.parser), self.rows);
        parser.feed(bytes, |line| match line {
            Line::Row(row) => self.row(row),
            Line::Header(names) => self.names = names.to_vec(),
            Line::Garbage | Line::TooLong => self.others += 1,
        });
        self.parser = parser;
        if self.rows == before {
            return;
        }
        let since_s = now_s - *self.began_s.get_or_insert(now_s);
        self.last_s = since_s;
        if since_s >= SETTLE_S {
            let (t, n) = (since_s, self.rows as f64);
            for (sum, x) in self.line.iter_mut().zip([1.0, t, n, t * t, t * n]) {
                *sum += x;
            }
        }
    }

    fn row(&mut self, row: &[f64]) {
        if self.columns.len() != row.len() {
            // The number of columns of most rows wins, so a cut row costs only a moment.
            self.others += u64::from(!self.columns.is_empty());
            if self.rows > 2 * self.others {
                return;
            }
            self.columns = row.iter().map(|_| ColumnSurvey::default()).collect();
        }
        self.rows += 1;
        for (column, &x) in self.columns.iter_mut().zip(row).filter(|(_, x)| x.is_finite()) {
            column.add(x);
        }
    }

    /// Whether rows have come for [`SURVEY_S`] seconds, and at least `FEWEST` of them.
    pub fn is_complete(&self) -> bool {
        self.last_s >= SURVEY_S && self.rows >= FEWEST
    }

    pub fn has_rows(&self) -> bool {
        self.rows > 0
    }

    pub fn is_garbage(&self) -> bool {
        self.bytes > 0 && !self.has_rows()
    }

    pub fn names(&self) -> &[String] {
        if self.names.len() == self.columns.len() { &self.names } else { &[] }
    }

    /// The columns, each with the unit in which it counts, if any.
    pub fn columns(&self) -> Vec<ColumnSurvey> {
        let arrivals_hz = self.arrivals_hz();
        let mut columns = self.columns.clone();
        for (at, column) in columns.iter_mut().enumerate() {
            column.name = self.names().get(at).cloned();
            column.counts = column.steps.kind(arrivals_hz);
        }
        columns
    }

    /// The first column that counts in the unit `kind`; columns are counted from 0.
    fn counter(&self, kind: &str) -> Option<usize> {
        self.columns().iter().position(|column| column.counts == Some(kind))
    }

    /// The column that shows exactly how many rows are lost; `None` if no column does.
    pub fn count(&self) -> Option<Count> {
        let place = |kind| self.counter(kind).map(|at| Column::Place(at + 1));
        place(ROWS).map(Count::Rows).or_else(|| place(MICROS).map(Count::Micros))
    }

    /// The columns that measure something, by their places (counted from 1).
    pub fn measuring(&self) -> Vec<Column> {
        let columns = self.columns().into_iter().enumerate();
        let measures = columns.filter(|(_, c)| c.counts.is_none() && c.lowest.is_some());
        measures.map(|(at, _)| Column::Place(at + 1)).collect()
    }

    fn arrivals_hz(&self) -> f64 {
        let [n, t, rows, tt, tr] = self.line;
        (n * tr - t * rows) / (n * tt - t * t)
    }

    /// Rows per second, rounded so that two surveys of a device agree. Includes lost rows if a
    /// column counts them. An error says what to do if no sensor can have this rate.
    pub fn rate_hz(&self) -> Result<f64, String> {
        let arrivals_hz = self.arrivals_hz();
        let steps = |kind| self.counter(kind).map(|at| &self.columns[at].steps);
        let rate_hz = match (steps(ROWS), steps(MICROS)) {
            (Some(s), _) if s.down == 0 => {
                arrivals_hz * (s.last - s.first) / (s.numbers - 1) as f64
            }
            (None, Some(s)) => 1e6 / s.usual(),
            _ => arrivals_hz,
        };
        let (least, most) = RATES_HZ;
        if !(least..=most).contains(&rate_hz) {
            return Err(match rate_hz > most {
                true => format!(
                    "{rate_hz:.0} lines come a second, faster than any sensor, so that their rate \
                     cannot be measured; give rate_hz in [[lines]] of the configuration"
                ),
                false => "too few lines come to measure their rate; give rate_hz in [[lines]] of \
                          the configuration"
                    .into(),
            });
        }
        Ok(round_rate(rate_hz))
    }

    /// A power of ten that brings `columns` to about ±1, with room above the highest number seen.
    pub fn scale(&self, columns: &[Column]) -> f64 {
        let named = |name: &String| self.names().iter().position(|other| other == name);
        let place = |column: &Column| match column {
            Column::Place(place) => place.checked_sub(1),
            Column::Name(name) => named(name),
        };
        let seen = columns.iter().filter_map(|column| self.columns.get(place(column)?));
        let (mut decimals, mut highest) = (0, 0.0_f64);
        for column in seen {
            decimals = decimals.max(column.decimals);
            let ends = [column.lowest, column.highest].into_iter().flatten();
            highest = ends.map(f64::abs).fold(highest, f64::max);
        }
        let by_step = STEP.log10() as i32 + decimals;
        let by_range = -(ROOM * highest).max(1.0).log10().ceil() as i32;
        power_of_ten(by_step.min(by_range).clamp(-30, 0))
    }

    pub fn scaled(&self, streams: &[LinesStream]) -> Vec<LinesStream> {
        let scale = |s: &LinesStream| s.scale.unwrap_or_else(|| self.scale(&s.columns));
        let scaled = |s: &LinesStream| LinesStream { scale: Some(scale(s)), ..s.clone() };
        streams.iter().map(scaled).collect()
    }

    /// A stream called `id` of all columns that measure something; `None` if there are none.
    pub fn stream(&self, id: SourceId) -> Option<LinesStream> {
        let columns = self.measuring();
        let scale = Some(self.scale(&columns));
        (!columns.is_empty()).then_some(LinesStream { id, columns, scale })
    }
}

/// The f64 closest to a power of ten, such as 0.001 and not 0.0010000000000000002.
fn power_of_ten(exponent: i32) -> f64 {
    format!("1e{exponent}").parse().unwrap_or(1.0)
}

/// Rounds a rate to two digits if the error is at most 0.5 %, otherwise to three; no decimals.
fn round_rate(rate_hz: f64) -> f64 {
    let digits = |n: i32| {
        let unit = 10_f64.powi(rate_hz.log10().floor() as i32 + 1 - n);
        (rate_hz / unit).round() * unit
    };
    let coarse = digits(2);
    let near = (coarse - rate_hz).abs() <= 5e-3 * rate_hz;
    (if near { coarse } else { digits(3) }).round().max(1.0)
}

const ROWS: &str = "rows";
const MICROS: &str = "microseconds";
const TIME: &str = "time";

impl ColumnSurvey {
    fn add(&mut self, x: f64) {
        self.lowest = Some(self.lowest.map_or(x, |low| low.min(x)));
        self.highest = Some(self.highest.map_or(x, |high| high.max(x)));
        // Display prints a number with the decimals that were read, except zeros at the end.
        let decimals = |x: f64| x.to_string().split_once('.').map_or(0, |(_, d)| d.len() as i32);
        self.decimals = self.decimals.max(decimals(x));
        self.steps.add(x);
    }
}

impl Steps {
    fn add(&mut self, x: f64) {
        if self.numbers == 0 {
            self.first = x;
        } else {
            let step = x - self.last;
            self.ones += u64::from(step == 1.0);
            self.down += u64::from(step <= 0.0);
            if step > 0.0 && self.up.len() < MOST_STEPS {
                self.up.push(step);
            }
        }
        self.last = x;
        self.numbers += 1;
    }

    fn usual(&self) -> f64 {
        let mut up = self.up.clone();
        up.sort_unstable_by(f64::total_cmp);
        let Some(median) = up.get(up.len() / 2).copied() else { return 0.0 };
        let near: Vec<f64> =
            up.into_iter().filter(|step| (step / median - 1.0).abs() < 0.25).collect();
        near.iter().sum::<f64>() / near.len() as f64
    }

    /// The unit in which the column counts, for rows at this rate; `None` if it does not count.
    fn kind(&self, rate_hz: f64) -> Option<&'static str> {
        let steps = self.numbers.saturating_sub(1).max(1);
        // Allows a few negative steps, since a counter of 8 bits starts again every 256 rows.
        if self.numbers < FEWEST || self.down * 100 > steps {
            return None;
        }
        let period_us = 1e6 / rate_hz;
        match () {
            () if self.ones * 10 >= steps * 9 => Some(ROWS),
            () if (self.usual() / period_us - 1.0).abs() < 0.2 => Some(MICROS),
            () if self.down == 0 => Some(TIME),
            () => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A survey of four seconds of lines that arrive in bursts, 16 ms apart.
    fn survey(rate_hz: f64, line: impl Fn(u64) -> String) -> Survey {
        let (mut survey, mut sent) = (Survey::new(true), 0);
        for burst in 1..250 {
            let due = (f64::from(burst) * 0.016 * rate_hz) as u64;
            let text: String = (sent..due).map(&line).collect();
            survey.feed(text.as_bytes(), f64::from(burst) * 0.016);
            sent = due;
        }
        assert!(survey.is_complete());
        survey
    }

    fn wave(i: u64) -> f64 {
        (i as f64 * 0.7).sin()
    }

    #[test]
    fn a_rate_is_found_to_the_digit_in_bursts_of_16_ms() {
        for rate_hz in [400.0, 119.0, 860.0, 3_200.0, 10_000.0, 80.0, 104.0] {
            let survey = survey(rate_hz, |i| format!("{:.2},0.5\n", wave(i)));
            assert_eq!(survey.rate_hz(), Ok(rate_hz));
        }
    }

    #[test]
    fn columns_that_count_are_told_from_those_that_measure() {
        let survey = survey(400.0, |i| {
            let micros = (4_294_000_000 + i * 2500) % (1 << 32);
            format!("{},{micros},{},{:.3},imu\n", i % 256, 1_700_000.0 + i as f64 / 400.0, wave(i))
        });
        let counts: Vec<_> = survey.columns().iter().map(|column| column.counts).collect();
        assert_eq!(counts, [Some(ROWS), Some(MICROS), Some(TIME), None, None]);
        assert_eq!(survey.measuring(), [Column::Place(4)]);
        assert_eq!(survey.count(), Some(Count::Rows(Column::Place(1))));
        assert_eq!(survey.rate_hz(), Ok(400.0));
    }

    #[test]
    fn lost_rows_do_not_lower_a_rate_that_a_column_shows() {
        for column in [1, 2500] {
            let line = |i: u64| match i % 20 {
                0 => String::new(),
                _ => format!("{},{:.2}\n", i * column, wave(i)),
            };
            assert_eq!(survey(400.0, line).rate_hz(), Ok(400.0), "{column}");
        }
    }

    #[test]
    fn a_scale_follows_from_the_printed_digits_and_the_range() {
        let of = |line: fn(u64) -> String| {
            let survey = survey(400.0, line);
            survey.scale(&survey.measuring())
        };
        assert_eq!(of(|i| format!("{}\n", 512 + (3.0 * wave(i)) as i64)), 1e-4, "10 bits");
        assert_eq!(of(|i| format!("{:.2}\n", 9.81 + wave(i))), 0.01, "m/s²");
        assert_eq!(of(|i| format!("{:.4}\n", wave(i) / 10.0)), 1.0, "g");
        assert_eq!(of(|i| format!("{}\n", 8_000_000 + (9e4 * wave(i)) as i64)), 1e-8, "24 bits");
    }

    #[test]
    fn a_file_that_comes_at_once_has_no_rate() {
        let mut survey = Survey::new(false);
        for at in 0..2_000 {
            survey.feed("1,2\n".repeat(1000).as_bytes(), f64::from(at) * 2e-3);
        }
        assert!(survey.rate_hz().unwrap_err().contains("rate_hz in [[lines]]"));
    }
}
