//! Reads recordings from CSV tables: one file for each trial, or a long file with columns that name
//! the trials. Columns become sources; the rows have a fixed rate, or a column of times.

use std::collections::BTreeMap;
use std::path::Path;

use super::table::line_of;
use crate::library::LibraryError;
use crate::library::files;
use crate::scene::SourceId;
use crate::trial::{EXPERT, Series, Signal, Trial, TrialKey, normal};

/// The line number of a row, and its cells.
type NumberedRow = (u64, Vec<String>);

/// How the times of a table's rows are known.
#[derive(Clone, Debug, PartialEq)]
pub enum Clock {
    /// The number of rows a second.
    Rate(f64),
    /// A column of times.
    Times {
        /// name of the column
        column: String,
        /// length of the column's time unit in seconds
        unit_s: f64,
    },
}

/// What the columns of a table and the name of its file mean.
#[derive(Clone, Debug, PartialEq)]
pub struct CsvForm {
    /// Each source, and the columns that are its channels.
    pub sources: Vec<(SourceId, Vec<String>)>,
    /// The times of the rows.
    pub clock: Clock,
    /// The columns that name the surface, the user and the trial, where there are any.
    pub labels: [Option<String>; 3],
    /// Where the file's name tells the surface, the user and the trial.
    pub names: NamePattern,
}

/// The trials read from one file.
#[derive(Debug)]
pub struct CsvTrials {
    /// The trials, in the order of the file.
    pub trials: Vec<Trial>,
    /// Mean rate of the rows in Hz before resampling, if rows were resampled.
    pub uneven_hz: Option<f64>,
}

/// A table whose cells are still text.
pub struct CsvTable {
    /// The names of the columns; their numbers from 1 on, if the file has no names.
    pub header: Vec<String>,
    rows: Vec<NumberedRow>,
    /// Whether a comma may be the decimal mark.
    comma: bool,
}

impl CsvTable {
    /// Reads a table whose columns are separated by commas, semicolons, tabs or spaces.
    ///
    /// # Errors
    /// If the file cannot be read, is not text, or has lines with different numbers of columns.
    pub fn read(path: &Path) -> Result<Self, LibraryError> {
        let bytes = files::read_bytes(path, files::MOST_TEXT)?;
        let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&bytes);
        Self::parse(bytes).map_err(|problem| LibraryError::file(path, problem))
    }

    fn parse(bytes: &[u8]) -> Result<Self, String> {
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
                if cells.iter().all(|cell| table.number(cell).is_none()) {
                    table.header = cells;
                    continue;
                }
                table.header = (1..=cells.len()).map(|column| column.to_string()).collect();
            }
            let (found, expected) = (cells.len(), table.header.len());
            if found != expected {
                return Err(format!("line {line} has {found} columns; the first has {expected}"));
            }
            table.rows.push((line, cells));
        }
        match table.rows.is_empty() {
            true => Err("it holds no rows of numbers; expected a line for each sample".into()),
            false => Ok(table),
        }
    }

    /// The columns whose first cell is a number.
    pub fn numeric(&self) -> Vec<String> {
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

    fn value(&self, (line, cells): &NumberedRow, column: usize) -> Result<f64, String> {
        let name = &self.header[column];
        self.number(&cells[column]).filter(|value| value.is_finite()).ok_or_else(|| {
            format!("line {line}, column `{name}`: `{}` is not a finite number", cells[column])
        })
    }

    /// The trials of the table; `name` is the path of its file without extension.
    ///
    /// # Errors
    /// If a column is missing, a cell is no finite number, the name does not fit the pattern, times
    /// do not rise, or a trial has fewer than two rows.
    pub fn trials(&self, name: &str, form: &CsvForm) -> Result<CsvTrials, String> {
        let labels = form
            .labels
            .each_ref()
            .map(|column| column.as_ref().map(|column| self.column(column)).transpose());
        let [surface, user, trial] = labels;
        let (surface, user, trial) = (surface?, user?, trial?);
        let of_name = match surface {
            Some(_) => NameParts::default(),
            None => form.names.parts(name).ok_or_else(|| {
                format!("its name does not fit the pattern `{}`; see --names", form.names.0)
            })?,
        };
        let mut groups: Vec<(TrialKey, Vec<&NumberedRow>)> = Vec::new();
        let mut place: BTreeMap<TrialKey, usize> = BTreeMap::new();
        for row in &self.rows {
            let cell = |column: Option<usize>| column.map(|at| row.1[at].as_str());
            let number = cell(trial).or(of_name.trial.as_deref());
            let number = number.map(|text| number_of(text).ok_or(text)).transpose();
            let number = number.map_err(|text| {
                format!("line {}: the trial is `{text}`; expected a whole number", row.0)
            })?;
            let surface = cell(surface).or(of_name.surface.as_deref()).unwrap_or_default();
            let user = cell(user).or(of_name.user.as_deref()).unwrap_or(EXPERT);
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
        let mut found = CsvTrials { trials: Vec::new(), uneven_hz: None };
        for (key, rows) in groups {
            let (trial, uneven_hz) = self.trial(key, &rows, form)?;
            found.trials.push(trial);
            found.uneven_hz = found.uneven_hz.or(uneven_hz);
        }
        Ok(found)
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
                // WAV files hold whole rates.
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

/// Rows at evenly spaced times, by linear interpolation between the rows at `times`, which rise.
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

/// The number that a text ends with.
fn number_of(text: &str) -> Option<u32> {
    let stem = text.trim_end_matches(|c: char| c.is_ascii_digit());
    text[stem.len()..].parse().ok()
}

/// A pattern of file paths: text with the fields `{surface}`, `{user}` and `{trial}`, and `*` for
/// any text. Fields and `*` match at least one character, but no `/`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NamePattern(pub String);

/// The labels found in a file's path.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NameParts {
    pub surface: Option<String>,
    pub user: Option<String>,
    /// A text that ends with the trial's number.
    pub trial: Option<String>,
}

impl NamePattern {
    /// The labels in a path; `None` if its last parts, as many as the pattern has, do not fit. Each
    /// field takes the shortest text with which the rest fits.
    pub fn parts(&self, name: &str) -> Option<NameParts> {
        let depth = self.0.matches('/').count();
        let from = name.rmatch_indices('/').nth(depth).map_or(0, |(at, _)| at + 1);
        let mut parts = NameParts::default();
        fits(&self.0, &name[from..], &mut parts).then_some(parts)
    }
}

fn fits(pattern: &str, name: &str, parts: &mut NameParts) -> bool {
    let fields = ["{surface}", "{user}", "{trial}", "*"];
    let Some(field) = fields.into_iter().find(|field| pattern.starts_with(field)) else {
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
        if fits(&pattern[field.len()..], &name[end..], parts) {
            let text = Some(name[..end].to_string());
            match field {
                "{surface}" => parts.surface = text,
                "{user}" => parts.user = text,
                "{trial}" => parts.trial = text,
                _ => {}
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

    fn series(trial: &Trial) -> &Series {
        let Signal::Series(series) = &trial.signals["acc"] else { panic!("no series") };
        series
    }

    #[test]
    fn names_are_read_by_their_pattern() {
        let parts = |pattern: &str, name: &str| {
            let found = NamePattern(pattern.into()).parts(name)?;
            Some([found.surface, found.user, found.trial].map(Option::unwrap_or_default))
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
        let german = CsvTable::parse("x;y\n0,5;-1\n1,5;2\n".as_bytes()).unwrap();
        let found = german.trials("oak_2", &form(Clock::Rate(100.0))).unwrap().trials;
        assert_eq!(found[0].key, TrialKey::new("oak", EXPERT, 2));
        assert_eq!(series(&found[0]).samples(), [0.5, -1.0, 1.5, 2.0]);
        assert_eq!(CsvTable::parse(b"1 2\n3 4\n").unwrap().header, ["1", "2"]);
    }

    #[test]
    fn uneven_times_are_resampled_by_straight_lines() {
        let clock = Clock::Times { column: "t".into(), unit_s: 1e-3 };
        let table = CsvTable::parse(b"t,x,y\n0,0,0\n10,1,0\n20,2,0\n40,4,0\n").unwrap();
        let found = table.trials("oak_1", &form(clock.clone())).unwrap();
        let expected: Vec<f32> =
            [0.0, 1.0, 2.0, 3.0, 4.0].into_iter().flat_map(|x| [x, 0.0]).collect();
        let got = series(&found.trials[0]);
        assert_eq!(got.rate_hz(), 100.0);
        assert!(got.samples().iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-5), "{got:?}");
        assert!((found.uneven_hz.unwrap() - 75.0).abs() < 1e-9);
        let back = CsvTable::parse(b"t,x,y\n0,0,0\n10,1,0\n5,2,0\n").unwrap();
        let error = back.trials("oak_1", &form(clock)).unwrap_err();
        assert!(error.contains("line 4") && error.contains("does not rise"), "{error}");
    }

    #[test]
    fn rows_of_a_long_table_go_to_their_trials_and_bad_cells_are_named() {
        let labels = ["s", "u", "n"].map(|name| Some(name.to_string()));
        let form = CsvForm { labels, ..form(Clock::Rate(10.0)) };
        let text = "s,u,n,x,y\noak,anna,1,1,2\nash,ben,1,5,6\noak,anna,1,3,4\nash,ben,1,7,8\n";
        let found = CsvTable::parse(text.as_bytes()).unwrap().trials("all", &form).unwrap().trials;
        assert_eq!(found.len(), 2);
        assert_eq!(found[0].key, TrialKey::new("oak", "anna", 1));
        assert_eq!(series(&found[0]).samples(), [1.0, 2.0, 3.0, 4.0]);
        let bad = CsvTable::parse(text.replace("3,4", "3,nan").as_bytes()).unwrap();
        let error = bad.trials("all", &form).unwrap_err();
        assert!(error.contains("line 4, column `y`: `nan`"), "{error}");
    }
}
