//! Reads recordings from CSV tables. A table holds one trial, or many trials named by columns.
//! Other columns become sources. The rows have a fixed rate, or a column of times.

use std::collections::BTreeMap;
use std::path::Path;

use ndarray::Array2;

use crate::library::LibraryError;
use crate::library::files::{self, number_in};
use crate::printable::counted;
use crate::scene::SourceId;
use crate::trial::{EXPERT, Series, Signal, Trial, TrialKey, normal};

/// A row of a table: its line number in the file, and its cells.
pub(crate) type NumberedRow = (u64, Vec<String>);

/// How to find the time of each row of a table.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Clock {
    Rate(f64),
    Times {
        column: String,
        /// time unit of the column, in seconds
        unit_s: f64,
    },
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct CsvForm {
    /// Each source, with the names of the columns that are its channels.
    pub sources: Vec<(SourceId, Vec<String>)>,
    pub clock: Clock,
    /// The columns with the names of surface, user and trial; `None` if there is no such column.
    pub labels: [Option<String>; 3],
    /// Pattern of the file's path, which names the trial if no column names the surface.
    pub names: NamePattern,
}

/// A CSV table whose cells are still text.
pub(crate) struct CsvTable {
    /// Names of the columns; `1`, `2`, … if the file does not name them.
    pub header: Vec<String>,
    pub rows: Vec<NumberedRow>,
    /// Whether a comma may be the decimal mark: true unless commas separate the columns.
    comma: bool,
}

impl CsvTable {
    /// Reads a table, whose columns commas, semicolons, tabs or spaces separate.
    pub(crate) fn read(path: &Path) -> Result<Self, LibraryError> {
        let bytes = files::read_bytes(path, files::MOST_TEXT)?;
        Self::parse(&bytes, false).map_err(|problem| LibraryError::file(path, problem))
    }

    /// Parses the text of a table. The first line names the columns if `named` is true, or if none
    /// of its cells is a number.
    pub(crate) fn parse(bytes: &[u8], named: bool) -> Result<Self, String> {
        let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
        let first = bytes.split(|&byte| byte == b'\n').find(|line| !line.trim_ascii().is_empty());
        let first = first.unwrap_or_default();
        let count = |mark: u8| first.iter().filter(|&&byte| byte == mark).count();
        let delimiter = [b';', b'\t', b',', b' '].into_iter().find(|&mark| count(mark) > 0);
        let delimiter = delimiter.unwrap_or(b',');
        let mut reader = csv::ReaderBuilder::new()
            .flexible(true)
            .has_headers(false)
            .delimiter(delimiter)
            .trim(csv::Trim::All)
            .from_reader(bytes);
        let mut table = Self { header: Vec::new(), rows: Vec::new(), comma: delimiter != b',' };
        for record in reader.records() {
            let record = record.map_err(|error| error.to_string())?;
            let line = line_of(bytes, &record);
            let cells: Vec<String> = record.iter().map(String::from).collect();
            if cells.iter().all(String::is_empty) {
                continue;
            }
            if table.header.is_empty() {
                if named || cells.iter().all(|cell| table.number(cell).is_none()) {
                    table.header = cells;
                    continue;
                }
                table.header = (1..=cells.len()).map(|column| column.to_string()).collect();
            }
            let (found, expected) = (cells.len(), table.header.len());
            if found != expected {
                let found = counted(found, "column");
                return Err(format!("line {line} has {found}; the first has {expected}"));
            }
            table.rows.push((line, cells));
        }
        match table.rows.is_empty() {
            true => Err("it holds no rows of numbers; expected a line for each sample".into()),
            false => Ok(table),
        }
    }

    /// Names of the columns whose first cell is a number.
    pub(crate) fn numeric(&self) -> Vec<String> {
        let is_numeric = |at: &usize| self.number(&self.rows[0].1[*at]).is_some();
        (0..self.header.len()).filter(is_numeric).map(|at| self.header[at].clone()).collect()
    }

    fn number(&self, cell: &str) -> Option<f64> {
        let plain = cell.parse::<f64>().ok();
        plain.or_else(|| self.comma.then(|| cell.replace(',', ".").parse().ok()).flatten())
    }

    fn column(&self, name: &str) -> Result<usize, String> {
        self.header.iter().position(|column| column == name).ok_or_else(|| {
            format!("it has no column `{name}`; its columns: {}", self.header.join(", "))
        })
    }

    /// The number in the cell of a row; an error if it is no number or not finite.
    pub(crate) fn value(&self, (line, cells): &NumberedRow, column: usize) -> Result<f64, String> {
        let name = &self.header[column];
        self.number(&cells[column]).filter(|value| value.is_finite()).ok_or_else(|| {
            format!("line {line}, column `{name}`: `{}` is not a finite number", cells[column])
        })
    }

    /// All cells as finite numbers, shape (rows, columns).
    pub(crate) fn values(&self) -> Result<Array2<f64>, String> {
        let (rows, columns) = (self.rows.len(), self.header.len());
        let cells =
            self.rows.iter().flat_map(|row| (0..columns).map(move |at| self.value(row, at)));
        let values = cells.collect::<Result<Vec<f64>, String>>()?;
        // This cannot fail: `parse` checked that all rows have the same number of columns.
        Ok(Array2::from_shape_vec((rows, columns), values).expect("rows of equal length"))
    }

    /// The trials of the table and, for a table with times, the mean rate of the first trial's rows
    /// in Hz. `name` is the path of the table's file without extension.
    pub(crate) fn trials(
        &self,
        name: &str,
        form: &CsvForm,
    ) -> Result<(Vec<Trial>, Option<f64>), String> {
        let mut columns = [None; 3];
        for (column, label) in columns.iter_mut().zip(&form.labels) {
            *column = label.as_ref().map(|label| self.column(label)).transpose()?;
        }
        let of_name = match columns[0] {
            Some(_) => Default::default(),
            None => form.names.parts(name).ok_or_else(|| {
                format!("its name does not fit the pattern `{}`; see --names", form.names.0)
            })?,
        };
        let mut groups: Vec<(TrialKey, Vec<&NumberedRow>)> = Vec::new();
        let mut place: BTreeMap<TrialKey, usize> = BTreeMap::new();
        for row in &self.rows {
            let cell = |at: usize| columns[at].map(|at| &*row.1[at]).or(of_name[at].as_deref());
            let number = cell(2).map(|text| number_in(text).ok_or(text)).transpose();
            let number = number.map_err(|text| {
                format!("line {}: the trial is `{text}`; expected a whole number", row.0)
            })?;
            let (surface, user) = (cell(0).unwrap_or_default(), cell(1).unwrap_or(EXPERT));
            if surface.is_empty() || user.is_empty() {
                return Err(format!("line {}: no surface or no user is named", row.0));
            }
            let key = TrialKey::new(normal(surface), normal(user), number.unwrap_or(1));
            let at = *place.entry(key.clone()).or_insert(groups.len());
            if at == groups.len() {
                groups.push((key, Vec::new()));
            }
            groups[at].1.push(row);
        }
        let (mut trials, mut uneven_hz) = (Vec::new(), None);
        for (key, rows) in groups {
            let (trial, rate_hz) = self.trial(key, &rows, form)?;
            trials.push(trial);
            uneven_hz = uneven_hz.or(rate_hz);
        }
        Ok((trials, uneven_hz))
    }

    fn trial(
        &self,
        key: TrialKey,
        rows: &[&NumberedRow],
        form: &CsvForm,
    ) -> Result<(Trial, Option<f64>), String> {
        if rows.len() < 2 {
            return Err(format!("{key} has a single row; expected a row for each sample"));
        }
        let (rate_hz, times) = match &form.clock {
            Clock::Rate(rate_hz) => (*rate_hz, None),
            Clock::Times { column, unit_s } => {
                let column = self.column(column)?;
                let times = rows.iter().map(|row| Ok(self.value(row, column)? * unit_s));
                let times = times.collect::<Result<Vec<f64>, String>>()?;
                let back = times.windows(2).position(|two| two[1] <= two[0]);
                if let Some(at) = back {
                    let (line, name) = (rows[at + 1].0, &self.header[column]);
                    return Err(format!("line {line}, column `{name}`: the time does not rise"));
                }
                let mut steps: Vec<f64> = times.windows(2).map(|two| two[1] - two[0]).collect();
                steps.sort_by(f64::total_cmp);
                // The rate is 1/median step, rounded since WAV files hold whole rates.
                ((1.0 / steps[steps.len() / 2]).round().max(1.0), Some(times))
            }
        };
        let mut signals = BTreeMap::new();
        for (source, columns) in &form.sources {
            let columns = columns.iter().map(|name| self.column(name));
            let columns = columns.collect::<Result<Vec<usize>, String>>()?;
            let values = rows.iter().map(|row| {
                columns.iter().map(|&column| self.value(row, column)).collect::<Result<Vec<_>, _>>()
            });
            let mut values = values.collect::<Result<Vec<Vec<f64>>, String>>()?;
            if let Some(times) = &times {
                values = resampled(times, &values, rate_hz);
            }
            let samples = values.concat().into_iter().map(|value| value as f32).collect();
            let series = Series::new(rate_hz, columns.len(), samples);
            let series = series.map_err(|error| format!("{key}, source `{source}`: {error}"))?;
            signals.insert(source.clone(), Signal::Series(series));
        }
        let uneven_hz =
            times.map(|times| (times.len() - 1) as f64 / (times[times.len() - 1] - times[0]));
        Ok((Trial { key, signals }, uneven_hz))
    }
}

/// Resamples rows to `rate_hz` by linear interpolation. `times` are the rows' times in s, rising.
fn resampled(times: &[f64], rows: &[Vec<f64>], rate_hz: f64) -> Vec<Vec<f64>> {
    let last = times.len() - 1;
    let count = ((times[last] - times[0]) * rate_hz + 1e-6).floor() as usize + 1;
    let mut before = 0;
    let at = |step: usize| {
        let time = times[0] + step as f64 / rate_hz;
        while before + 2 <= last && times[before + 1] <= time {
            before += 1;
        }
        let (from, to) = (times[before], times[before + 1]);
        let share = ((time - from) / (to - from)).clamp(0.0, 1.0);
        let (a, b) = (&rows[before], &rows[before + 1]);
        a.iter().zip(b).map(|(a, b)| a + share * (b - a)).collect()
    };
    (0..count).map(at).collect()
}

/// The line number, from 1 on, of a row of a CSV text. If blank lines precede the row, the crate
/// `csv` gives the number of the first blank line instead.
fn line_of(text: &[u8], row: &csv::StringRecord) -> u64 {
    let Some(start) = row.position() else { return 0 };
    let after = text.get(start.byte() as usize..).unwrap_or_default();
    let blank = after.iter().take_while(|byte| matches!(byte, b'\r' | b'\n'));
    start.line() + blank.filter(|byte| **byte == b'\n').count() as u64
}

/// A pattern for file paths: text, the fields `{surface}`, `{user}` and `{trial}`, and `*` for any
/// text. Fields and `*` match at least one character, but no `/`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct NamePattern(pub String);

impl NamePattern {
    /// Reads surface, user and trial (text that ends with the number) from the path `name`.
    /// Compares as many of the path's last components as the pattern has; `None` if they do not
    /// fit. Each field takes the shortest text that lets the rest of the path fit.
    pub(crate) fn parts(&self, name: &str) -> Option<[Option<String>; 3]> {
        let depth = self.0.matches('/').count();
        let from = name.rmatch_indices('/').nth(depth).map_or(0, |(at, _)| at + 1);
        let mut parts = [None, None, None];
        fits(&self.0, &name[from..], &mut parts).then_some(parts)
    }
}

fn fits(pattern: &str, name: &str, parts: &mut [Option<String>; 3]) -> bool {
    let fields = ["{surface}", "{user}", "{trial}", "*"];
    let Some(field) = fields.iter().position(|field| pattern.starts_with(field)) else {
        return match (pattern.chars().next(), name.chars().next()) {
            (None, None) => true,
            (Some(a), Some(b)) if a == b => {
                fits(&pattern[a.len_utf8()..], &name[b.len_utf8()..], parts)
            }
            _ => false,
        };
    };
    let ends = name.char_indices().map(|(at, c)| (at + c.len_utf8(), c));
    for (end, _) in ends.take_while(|(_, c)| *c != '/') {
        if fits(&pattern[fields[field].len()..], &name[end..], parts) {
            if let Some(part) = parts.get_mut(field) {
                *part = Some(name[..end].to_string());
            }
            return true;
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    fn form(clock: Clock) -> CsvForm {
        CsvForm {
            sources: vec![(SourceId::new("acc").unwrap(), vec!["x".into(), "y".into()])],
            clock,
            labels: [None, None, None],
            names: NamePattern("{surface}_{trial}".into()),
        }
    }

    #[test]
    fn samples_may_be_separated_in_any_way_and_blank_lines_do_not_count() {
        for text in ["1,2\n3,4\n", "1; 2\n\n3;4", "\u{feff}1\t2\r\n3\t4\r\n  \n"] {
            let samples = CsvTable::parse(text.as_bytes(), false).unwrap().values().unwrap();
            assert_eq!(samples, ndarray::array![[1.0, 2.0], [3.0, 4.0]], "{text:?}");
        }
        for (text, part) in [
            ("1,2\n\n3,x\n", "line 3, column `2`: `x` is not a finite number"),
            ("1,2\n3\n", "line 2 has 1 column; the first has 2"),
            ("1,2\n3,\n", "line 2, column `2`: `` is not"),
            ("\n\n", "no rows"),
        ] {
            let said = CsvTable::parse(text.as_bytes(), false).and_then(|table| table.values());
            assert!(said.as_ref().unwrap_err().contains(part), "{text:?}: {said:?}");
        }
    }

    fn series(trial: &Trial) -> &Series {
        let Signal::Series(series) = &trial.signals["acc"] else { panic!("no series") };
        series
    }

    #[test]
    fn names_are_read_by_their_pattern() {
        let parts = |pattern: &str, name: &str| {
            let found = NamePattern(pattern.into()).parts(name)?;
            Some(found.map(Option::unwrap_or_default))
        };
        let of = |a: &str, b: &str, c: &str| Some([a, b, c].map(String::from));
        assert_eq!(parts("{surface}/{trial}", "a/Eiche/3"), of("Eiche", "", "3"));
        assert_eq!(parts("{surface}_{user}_{trial}", "oak_anna_07"), of("oak", "anna", "07"));
        assert_eq!(
            parts("{user}/*-{surface}_{trial}", "x/ben/run-oak 2_4"),
            of("oak 2", "ben", "4")
        );
        assert_eq!(parts("{surface}_{trial}", "oak"), None);
    }

    #[test]
    fn a_decimal_comma_and_a_table_without_names_are_read() {
        let german = CsvTable::parse("x;y\n0,5;-1\n1,5;2\n".as_bytes(), false).unwrap();
        let found = german.trials("oak_2", &form(Clock::Rate(100.0))).unwrap().0;
        assert_eq!(found[0].key, TrialKey::new("oak", EXPERT, 2));
        assert_eq!(series(&found[0]).samples(), [0.5, -1.0, 1.5, 2.0]);
        assert_eq!(CsvTable::parse(b"1 2\n3 4\n", false).unwrap().header, ["1", "2"]);
    }

    #[test]
    fn uneven_times_are_resampled_by_straight_lines() {
        let clock = Clock::Times { column: "t".into(), unit_s: 1e-3 };
        let table = CsvTable::parse(b"t,x,y\n0,0,0\n10,1,0\n20,2,0\n40,4,0\n", false).unwrap();
        let (trials, uneven_hz) = table.trials("oak_1", &form(clock.clone())).unwrap();
        let expected: Vec<f32> =
            [0.0, 1.0, 2.0, 3.0, 4.0].into_iter().flat_map(|x| [x, 0.0]).collect();
        let got = series(&trials[0]);
        assert_eq!(got.rate_hz(), 100.0);
        assert!(got.samples().iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-5), "{got:?}");
        assert!((uneven_hz.unwrap() - 75.0).abs() < 1e-9);
        let back = CsvTable::parse(b"t,x,y\n0,0,0\n10,1,0\n5,2,0\n", false).unwrap();
        let error = back.trials("oak_1", &form(clock)).unwrap_err();
        assert!(error.contains("line 4") && error.contains("does not rise"), "{error}");
    }

    #[test]
    fn rows_of_a_long_table_go_to_their_trials_and_bad_cells_are_named() {
        let labels = ["s", "u", "n"].map(|name| Some(name.to_string()));
        let form = CsvForm { labels, ..form(Clock::Rate(10.0)) };
        let text = "s,u,n,x,y\noak,anna,1,1,2\nash,ben,1,5,6\noak,anna,1,3,4\nash,ben,1,7,8\n";
        let found =
            CsvTable::parse(text.as_bytes(), false).unwrap().trials("all", &form).unwrap().0;
        assert_eq!(found.len(), 2);
        assert_eq!(found[0].key, TrialKey::new("oak", "anna", 1));
        assert_eq!(series(&found[0]).samples(), [1.0, 2.0, 3.0, 4.0]);
        let bad = CsvTable::parse(text.replace("3,4", "3,nan").as_bytes(), false).unwrap();
        let error = bad.trials("all", &form).unwrap_err();
        assert!(error.contains("line 4, column `y`: `nan`"), "{error}");
    }
}
