//! Finds out what an undescribed device sends: its columns, their ranges, the rate, and which
//! columns count rows, tell the time or never change. Does no I/O and has no clock.

use super::clocks::{FEWEST, MICROS, ROWS, Steps, rounded};
use super::layout::{Column, Count, LinesStream};
use super::parser::{Line, LineParser, no_form, shown};
use crate::scene::SourceId;

pub const SURVEY_S: f64 = 3.0;
/// Seconds at the start that do not count for the rate, since early rows may come from a buffer.
const SETTLE_S: f64 = 0.3;
/// Most bytes of a survey, so that memory is bounded.
const MOST_BYTES: u64 = 64 << 20;
/// Lowest and highest rate of a sensor, in Hz; faster lines come from a file. The lowest is 1 Hz, as
/// it is measured.
const RATES_HZ: (f64, f64) = (0.98, 200_000.0);
/// Usual rates in Hz that are no whole numbers.
const FRACTIONS_HZ: [f64; 6] = [1.5625, 3.125, 6.25, 12.5, 31.25, 62.5];
/// Largest share of full scale that the last printed digit may stand for (a few 16-bit steps).
const STEP: f64 = 1e-4;
/// Least ratio of full scale to the highest number seen, since sensors are mostly at rest.
const ROOM: f64 = 3.0;
/// Number of first lines that are kept as they came.
const FIRST_LINES: usize = 5;
/// Number of rows whose words are looked at.
const KINDS: u64 = 1000;
/// Least share of lines that fit, below which that is said.
const FITTING: f64 = 0.9;

#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct ColumnSurvey {
    pub name: Option<String>,
    /// The lowest number in the column; `None` if there was none. `highest` is the opposite.
    pub lowest: Option<f64>,
    pub highest: Option<f64>,
    pub decimals: i32,
    /// The unit in which the column counts: `rows`, `seconds`, `milliseconds`, `microseconds`,
    /// `nanoseconds`, or `time` for any other clock.
    pub counts: Option<&'static str>,
    /// Whether all numbers in the column are the same.
    pub constant: bool,
    #[serde(skip)]
    steps: Steps,
}

#[derive(Debug, Default)]
pub struct Survey {
    parser: LineParser,
    names: Vec<String>,
    columns: Vec<ColumnSurvey>,
    /// Time of the first row, in seconds; `None` before it.
    began_s: Option<f64>,
    rows: u64,
    /// Number of lines that are not rows, or have another form.
    others: u64,
    bytes: u64,
    /// Number of bytes that plain text does not hold.
    strange: u64,
    pub first_lines: Vec<String>,
    /// The first line that is a row, and the first that is neither row nor header.
    fit: Option<String>,
    misfit: Option<String>,
    unclear: Option<String>,
    /// The last line of words alone.
    heading: Vec<u8>,
    /// The heading and the words of the last row whose lines name its columns, those of the one
    /// before that had others, and the number of rows that had others than the row before.
    kinds: [String; 2],
    turns: u64,
    /// Sums of 1, t, rows, t² and t·rows over arrivals after [`SETTLE_S`], to fit a line to them.
    line: [f64; 5],
    last_s: f64,
}

impl Survey {
    /// An empty survey. `half` says that the first bytes may begin within a line, and
    /// `decimal_comma` whether commas are decimal commas (`None` to find out).
    pub fn new(half: bool, decimal_comma: Option<bool>) -> Self {
        let mut survey = Self { parser: LineParser::new(decimal_comma), ..Self::default() };
        survey.parser.reopened(half);
        survey
    }

    pub fn feed(&mut self, bytes: &[u8], now_s: f64) {
        self.bytes += bytes.len() as u64;
        let is_text = |byte: &u8| matches!(byte, b' '..=b'~' | b'\t' | b'\r' | b'\n' | 0x1b);
        self.strange += bytes.iter().filter(|byte| !is_text(byte)).count() as u64;
        let (mut parser, before) = (std::mem::take(&mut self.parser), self.rows);
        parser.feed(bytes, |text, line| {
            if self.first_lines.len() < FIRST_LINES && !text.is_empty() {
                self.first_lines.push(shown(text));
            }
            match line {
                Line::Row(row) => return self.row(row, text),
                Line::Header(names) => return self.names = names.to_vec(),
                Line::Words => self.heading = text.to_vec(),
                Line::Unclear(why) => drop(self.unclear.get_or_insert_with(|| why.into())),
                _ => {}
            }
            self.others += 1;
            if !text.is_empty() {
                self.misfit.get_or_insert_with(|| shown(text));
            }
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

    fn row(&mut self, row: &[f64], text: &[u8]) {
        if self.columns.len() != row.len() {
            // The lines have another form from here on.
            self.others += self.rows;
            self.misfit = self.fit.take().or_else(|| self.misfit.take());
            (self.rows, self.line) = (0, [0.0; 5]);
            self.columns = row.iter().map(|_| ColumnSurvey::default()).collect();
        }
        self.rows += 1;
        if self.rows <= KINDS {
            let kind = format!("{} {}", String::from_utf8_lossy(&self.heading), words_of(text));
            if kind.trim() != self.kinds[0] {
                self.turns += 1;
                self.kinds.swap(0, 1);
                self.kinds[0] = kind.trim().into();
            }
        }
        self.fit.get_or_insert_with(|| shown(text));
        for (column, &x) in self.columns.iter_mut().zip(row).filter(|(_, x)| x.is_finite()) {
            column.add(x);
        }
    }

    /// Whether rows have come for [`SURVEY_S`] seconds, and at least `FEWEST` of them, or more bytes
    /// than a survey takes.
    pub fn is_complete(&self) -> bool {
        self.last_s >= SURVEY_S && self.rows >= FEWEST || self.bytes >= MOST_BYTES
    }

    pub fn has_rows(&self) -> bool {
        self.rows > 0
    }

    pub fn is_text(&self) -> bool {
        const LEAST: u64 = 20;
        self.bytes >= LEAST && !self.is_noise()
    }

    pub fn is_empty(&self) -> bool {
        self.bytes == 0
    }

    /// Whether noise came rather than text, as at a wrong speed of a port.
    pub fn is_noise(&self) -> bool {
        5 * self.strange > self.bytes
    }

    /// Share of the lines that are rows, headers aside.
    pub fn fitting_share(&self) -> f64 {
        self.rows as f64 / (self.rows + self.others).max(1) as f64
    }

    pub fn has_decimal_commas(&self) -> bool {
        self.parser.has_decimal_commas()
    }

    /// The reason why no rows can be made of the lines, and what to do; `None` if they can.
    pub fn problem(&self) -> Option<String> {
        if let Some(why) = self.unclear.as_ref().filter(|_| self.rows <= self.others) {
            return Some(why.clone());
        }
        let line = self.misfit.as_ref().or(self.first_lines.first());
        let line = line.map(|line| format!("`{line}`")).unwrap_or_default();
        let why = || self.parser.no_form().unwrap_or_else(|| no_form(&line));
        (!self.has_rows()).then(why)
    }

    /// Findings that a user should know: one line for each subject.
    pub fn remarks(&self) -> Vec<String> {
        let columns = self.columns();
        let mut remarks = Vec::new();
        if let (Some(fit), Some(misfit)) = (&self.fit, &self.misfit)
            && self.fitting_share() < FITTING
        {
            remarks.push(format!(
                "only {:.0} % of the lines are rows: `{fit}` is one, and `{misfit}` is not",
                100.0 * self.fitting_share()
            ));
        }
        remarks.extend(self.unclear.clone().filter(|_| !self.has_decimal_commas()));
        if self.has_decimal_commas() {
            remarks.push("commas are read as decimal commas".into());
        }
        let list = |wanted: &dyn Fn(&ColumnSurvey) -> bool| {
            let all = columns.iter().enumerate().filter(|(_, column)| wanted(column));
            let called = |(at, column): (usize, &ColumnSurvey)| match &column.name {
                Some(name) => format!("{} ({name})", at + 1),
                None => (at + 1).to_string(),
            };
            all.map(called).collect::<Vec<_>>().join(", ")
        };
        let clocks = list(&|column| column.counts.is_some());
        if !clocks.is_empty() {
            remarks.push(format!(
                "only count or tell the time, so they are no channels: columns {clocks}; name them \
                 in [lines.sources] to change that"
            ));
        }
        let [one, other] = &self.kinds;
        let names_itself = self.parser.names_itself() && self.rows >= FEWEST;
        if names_itself && 10 * self.turns > 8 * self.rows.min(KINDS) {
            remarks.push(format!(
                "rows with `{other}` and with `{one}` come in turn and share their columns; if these \
                 are different quantities, print them under different names"
            ));
        }
        let empty = list(&|column| column.lowest.is_none());
        if !empty.is_empty() {
            remarks.push(format!("hold no numbers, so they are left out: columns {empty}"));
        }
        let share = |column: &ColumnSurvey| column.steps.numbers as f64 / self.rows.max(1) as f64;
        let patchy = list(&|column| column.lowest.is_some() && share(column) < FITTING);
        if !patchy.is_empty() {
            let least = columns.iter().map(share).filter(|share| *share > 0.0).fold(1.0, f64::min);
            remarks.push(format!(
                "numbers are missing in up to {:.0} % of the rows, which cannot be used where these \
                 columns are wanted: columns {patchy}",
                100.0 * (1.0 - least)
            ));
        }
        let constant = list(&|column| column.constant);
        if !constant.is_empty() {
            let all = columns.iter().all(|column| column.constant || !column.measures());
            remarks.push(match all {
                true => format!("constant: columns {constant}; move the sensor to see it work"),
                false => format!(
                    "constant, so they are left out: columns {constant}; name them in \
                     [lines.sources] to change that"
                ),
            });
        }
        remarks
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
            column.constant = column.steps.is_constant();
        }
        columns
    }

    /// The first column that counts in the unit `kind`; columns are counted from 0.
    fn counter(&self, kind: &str) -> Option<usize> {
        // A time that repeats, as of samples that are read in batches, tells no single rows.
        let tells = |steps: &Steps| kind != MICROS || steps.zeros * 10 < steps.numbers;
        let counts = |column: &ColumnSurvey| column.counts == Some(kind) && tells(&column.steps);
        self.columns().iter().position(counts)
    }

    /// A column by its name, if each line names it, or else by its place.
    fn column(&self, at: usize) -> Column {
        let name = self.names().get(at).filter(|name| {
            let same = self.names.iter().filter(|other| other == name).count();
            self.parser.names_itself() && same == 1
        });
        name.map_or(Column::Place(at + 1), |name| Column::Name(name.clone()))
    }

    /// The column that shows exactly how many rows are lost; `None` if no column does.
    pub fn count(&self) -> Option<Count> {
        let place = |kind| self.counter(kind).map(|at| self.column(at));
        place(ROWS).map(Count::Rows).or_else(|| place(MICROS).map(Count::Micros))
    }

    /// The columns that measure something. Constant ones are left out, unless all are.
    pub fn measuring(&self) -> Vec<Column> {
        let columns = self.columns();
        let all_constant = columns.iter().all(|column| column.constant || !column.measures());
        let wanted =
            |column: &ColumnSurvey| column.measures() && (all_constant || !column.constant);
        let columns = columns.iter().enumerate().filter(|(_, column)| wanted(column));
        columns.map(|(at, _)| self.column(at)).collect()
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
                false => "too few lines come to measure their rate; if a program holds them back, let it send \
                          each at once (`python3 -u`), or give rate_hz in [[lines]] of the configuration"
                    .into(),
            });
        }
        Ok(round_rate(rate_hz))
    }

    /// A power of ten that brings `columns` to about ±1, with room above the highest number seen.
    pub fn scale(&self, columns: &[Column]) -> f64 {
        let place = |column: &Column| match column {
            Column::Place(place) => place.checked_sub(1),
            Column::Name(name) => self.names().iter().position(|other| other == name),
        };
        let all = self.columns();
        let mut seen: Vec<_> =
            columns.iter().filter_map(|column| all.get(place(column)?)).collect();
        // A clock that was configured as a channel does not count beside others.
        if seen.iter().any(|column| column.counts.is_none()) {
            seen.retain(|column| column.counts.is_none());
        }
        let decimals = seen.iter().map(|column| column.decimals).max().unwrap_or(0);
        let ends = seen.iter().flat_map(|column| [column.lowest, column.highest]).flatten();
        let highest = ends.map(f64::abs).fold(0.0, f64::max);
        let by_step = STEP.log10() as i32 + decimals;
        let by_range = -(ROOM * highest).max(1.0).log10().ceil() as i32;
        let exponent = by_step.min(by_range).clamp(-30, 0);
        // The closest f64, such as 0.001 and not 0.0010000000000000002.
        format!("1e{exponent}").parse().unwrap_or(1.0)
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

/// The words of a line that are no names of values.
fn words_of(line: &[u8]) -> String {
    let line = String::from_utf8_lossy(line);
    let words = line.split_inclusive(|c: char| !c.is_alphanumeric() && c != '_' && c != '"');
    let is_word = |word: &&str| {
        word.starts_with(|c: char| c.is_alphabetic() || c == '"') && !word.ends_with([':', '='])
    };
    let bare = |word: &str| word.trim_matches(|c: char| !c.is_alphanumeric()).to_string();
    words.filter(is_word).map(bare).collect::<Vec<_>>().join(" ")
}

/// Rounds a rate to a usual fraction or to two digits if the error is at most 0.5 %, otherwise to
/// three; from 50 Hz on, without decimals.
fn round_rate(rate_hz: f64) -> f64 {
    let near = |hz: &f64| (hz - rate_hz).abs() <= 5e-3 * rate_hz;
    if let Some(fraction) = FRACTIONS_HZ.into_iter().find(near) {
        return fraction;
    }
    let found = Some(rounded(rate_hz, 2)).filter(near).unwrap_or(rounded(rate_hz, 3));
    (if rate_hz < 50.0 { found } else { found.round() }).max(1.0)
}

impl ColumnSurvey {
    fn add(&mut self, x: f64) {
        self.lowest = Some(self.lowest.map_or(x, |low| low.min(x)));
        self.highest = Some(self.highest.map_or(x, |high| high.max(x)));
        // Display prints a number with the decimals that were read, except zeros at the end.
        let decimals = |x: f64| x.to_string().split_once('.').map_or(0, |(_, d)| d.len() as i32);
        self.decimals = self.decimals.max(decimals(x));
        self.steps.add(x);
    }

    /// Whether the column holds numbers, and does not only count.
    fn measures(&self) -> bool {
        self.counts.is_none() && self.lowest.is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A survey of four seconds of lines, or of 25, that arrive in bursts, 16 ms apart.
    fn survey(rate_hz: f64, line: impl Fn(u64) -> String) -> Survey {
        let (mut survey, mut sent) = (Survey::new(true, None), 0);
        for burst in 1..250.max((25.0 / rate_hz / 0.016) as i32) {
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
        let fractions = [6.25, 12.5, 5.3, 3.3, 1.5625, 1.0, 3.125, 26.7];
        let whole = [400.0, 119.0, 860.0, 3_200.0, 10_000.0, 80.0, 104.0];
        for rate_hz in whole.into_iter().chain(fractions) {
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
        assert_eq!(counts, [Some(ROWS), Some(MICROS), Some("seconds"), None, None]);
        assert_eq!(survey.measuring(), [Column::Place(4)]);
        assert_eq!(survey.count(), Some(Count::Rows(Column::Place(1))));
        assert_eq!(survey.rate_hz(), Ok(400.0));
    }

    #[test]
    fn what_begins_anew_often_or_beats_with_the_rows_counts_none() {
        let is_time = |rate_hz: f64, first: fn(u64) -> u64| {
            let survey = survey(rate_hz, |i| format!("{},{:.2}\n", first(i), wave(i)));
            assert_eq!((survey.count(), survey.measuring()), (None, vec![Column::Place(2)]));
        };
        is_time(50.0, |i| i % 50 * 20_000_000);
        is_time(50.0, |i| i % 50 * 20_000);
        is_time(100.0, |i| i % 60);
        is_time(960.0, |i| i * 1000 / 960);
        is_time(1040.0, |i| i * 1000 / 1040);
        let short = survey(100.0, |i| format!("{},{:.2}\n", i % 16, wave(i)));
        assert_eq!(short.count(), Some(Count::Rows(Column::Place(1))));
    }

    #[test]
    fn a_time_that_repeats_in_batches_tells_no_single_rows() {
        let line = |i: u64| format!("{},{:.2}\n", i / 10 * 25_000 + 123, wave(i));
        let survey = survey(400.0, line);
        assert_eq!((survey.rate_hz(), survey.count()), (Ok(400.0), None));
        assert_eq!(survey.measuring(), [Column::Place(2)]);
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
        let mut survey = Survey::new(false, None);
        for at in 0..2_000 {
            survey.feed("1,2\n".repeat(1000).as_bytes(), f64::from(at) * 2e-3);
        }
        assert!(survey.rate_hz().unwrap_err().contains("rate_hz in [[lines]]"));
    }
}
