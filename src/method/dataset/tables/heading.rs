//! The names and units of a table's columns, in the lines above its rows.

use super::cell::{BOTH_COMMAS, Beside, DELIMITERS, counts, owned, shown};
use super::stamp;
use crate::printable::counted;

/// Names of columns of times: letters and digits alone, in small letters.
const TIMES: &str = "time t timestamp timestamps ts zeit zeitstempel uhrzeit temps tiempo xvalue \
    elapsed elapsedtime secondselapsed timeelapsed relativetime epoch unixtime utc datetime date \
    datum millis micros nanos uptime sec seconds ms us ns milliseconds microseconds nanoseconds \
    timems timeus xaxis sampletime loggingtime systemtime stamp nanosec nsec nsecs";

/// Units of measures that may stand after an underscore or in a row of their own.
const UNITS: [&str; 71] = [
    "g", "mg", "m/s^2", "m/s²", "m/s2", "m/s", "mm/s", "v", "mv", "volt", "volts", "a", "ma", "n",
    "mn", "kn", "pa", "kpa", "hpa", "mbar", "bar", "psi", "°c", "degc", "k", "°f", "%", "hz",
    "khz", "deg", "°", "deg/s", "°/s", "rad", "rad/s", "dps", "t", "mt", "µt", "μt", "ut", "gauss",
    "m", "mm", "cm", "db", "lx", "counts", "raw", "-", "ω", "kω", "mω", "ohm", "kohm", "lsb",
    "adc", "digits", "strain", "µε", "με", "nm", "n·m", "kg", "kgf", "lb", "lbf", "rpm", "ppm",
    "lux", "a.u.",
];

pub(super) fn is_among(words: &str, word: &str) -> bool {
    words.split(' ').any(|known| known == word)
}

pub(super) fn plain(name: &str) -> String {
    // Before a colon stands what was measured when, such as `Run 1: Time`.
    let name = name.rsplit(": ").next().unwrap_or(name);
    name.chars().filter(char::is_ascii_alphanumeric).collect::<String>().to_ascii_lowercase()
}

/// Whether a name, without its unit, is one of times.
pub(super) fn is_time_name(name: &str) -> bool {
    let base = plain(name);
    is_among(TIMES, &base)
        || is_among(TIMES, base.trim_end_matches(|c: char| c.is_ascii_digit()))
            && base.starts_with("time")
}

#[derive(Clone, Debug, PartialEq)]
pub struct Column {
    /// The name in the file, with its unit; `1`, `2`, … if the file gives no names.
    pub name: String,
    /// The name without its unit.
    pub base: String,
    /// The unit in the file, in brackets, after an underscore or in a row of units.
    pub unit: Option<String>,
    /// Whether most of the first cells are numbers.
    pub is_numeric: bool,
}

#[cfg(feature = "parquet")]
impl Column {
    /// The columns of these names.
    pub fn named(names: Vec<String>) -> Vec<Self> {
        let width = names.len();
        Names { rows: vec![names], ..Names::default() }.columns(width, false)
    }
}

pub(super) struct HeadLine {
    pub number: u64,
    pub cells: Vec<Vec<u8>>,
}

/// The rows of names above a table, from the upper to the lower, and a row of units.
#[derive(Default)]
pub(super) struct Names {
    pub rows: Vec<Vec<String>>,
    units: Option<Vec<String>>,
    /// The line number of the lowest of them.
    pub at: u64,
}

impl Names {
    pub(super) fn of(
        above: &[HeadLine],
        width: usize,
        is_numeric: &[bool],
        rows: &[HeadLine],
        delimiter: u8,
    ) -> Result<Self, String> {
        let mut names = Self::default();
        for line in above.iter().rev() {
            let mut cells: Vec<String> =
                line.cells.iter().map(|cell| shown(cell).replace("\"\"", "\"")).collect();
            if let (true, Some(first)) = (names.rows.is_empty(), cells.first_mut()) {
                *first = first.trim_start_matches(['#', '%']).trim().to_string();
            }
            // A name without rows is that of a column of remarks, which nothing fills.
            let is_remark = |name: &String| name.eq_ignore_ascii_case("comment");
            if cells.len() == width + 1 && cells.last().is_some_and(is_remark) {
                cells.pop();
            }
            let written = cells.iter().filter(|cell| !cell.is_empty()).count();
            // A row above the names without a first name names groups; another is the program's own.
            let is_group = cells.len() == width && written > 0 && cells[0].is_empty();
            if !names.rows.is_empty() && names.are_distinct(is_numeric) && !is_group {
                break;
            }
            let first = rows.iter().filter_map(|line| line.cells.first());
            if names.rows.is_empty() && cells.len() + 1 == width && written > 0 && counts(first) {
                // R writes no name for the numbers of rows.
                cells.insert(0, String::new());
            }
            if cells.len() != width {
                let halved = delimiter == b',' && 2 * cells.len() == width;
                let advice = match names.rows.is_empty() {
                    true if halved => BOTH_COMMAS,
                    true if written > 1 => "expected a name for each",
                    _ => break,
                };
                let (line, found) = (line.number, counted(cells.len(), "column"));
                return Err(format!(
                    "line {line} names {found}, but the rows have {width}; {advice}"
                ));
            }
            let upper = || {
                let is_upper = |other: &&HeadLine| other.number < line.number;
                above.iter().filter(is_upper).filter(|other| other.cells.len() == width)
            };
            // Below the name of a time, a unit of time begins a row of units, known or not.
            let has_time = line.cells.len() == width
                && stamp::unit_ns(bare(&cells[0])).is_some()
                && upper().any(|other| is_time_name(&shown(&other.cells[0])));
            let is_unit = |cell: &String| has_time || cell.is_empty() || is_unit(bare(cell));
            if names.units.is_none()
                && names.rows.is_empty()
                && written > 0
                && cells.iter().all(is_unit)
                && upper().next().is_some()
            {
                names.units = Some(cells.iter().map(|cell| bare(cell).to_string()).collect());
                names.at = line.number;
                continue;
            }
            names.at = names.at.max(line.number);
            names.rows.insert(0, cells);
        }
        Ok(names)
    }

    /// Whether the names so far, joined, name each column of numbers but the first, and differ.
    fn are_distinct(&self, is_numeric: &[bool]) -> bool {
        let mut seen = std::collections::BTreeSet::new();
        let lowest = self.rows.last().map_or(&[][..], Vec::as_slice);
        let unnamed =
            lowest.iter().zip(is_numeric).skip(1).any(|(name, is)| *is && name.is_empty());
        !unnamed && self.joined().into_iter().all(|name| seen.insert(name))
    }

    fn joined(&self) -> Vec<String> {
        let width = self.rows.first().map_or(0, Vec::len);
        let name = |column: usize| {
            let mut parts: Vec<&str> = Vec::new();
            for (row, cells) in self.rows.iter().enumerate() {
                // Upper rows name several columns at once, the first of which holds the name.
                let is_lowest = row + 1 == self.rows.len();
                if column == 0 && !is_lowest && !self.rows[self.rows.len() - 1][0].is_empty() {
                    continue;
                }
                let is_upper = !is_lowest && column > 0;
                let from = if is_upper { &cells[1..=column] } else { &cells[column..=column] };
                let part = from.iter().rev().find(|cell| !cell.is_empty()).map_or("", |cell| cell);
                let is_new = !part.is_empty() && parts.last() != Some(&part);
                parts.extend(is_new.then_some(part));
            }
            parts.join("_")
        };
        (0..width).map(name).collect()
    }

    pub(super) fn columns(&self, width: usize, is_timed: bool) -> Vec<Column> {
        let mut names = self.joined();
        names.resize(width, String::new());
        if self.rows.is_empty() {
            names = (1..=width).map(|column| column.to_string()).collect();
        }
        if is_timed {
            names[0] = "time".to_string();
        }
        let column = |(at, mut name): (usize, String)| {
            let (base, unit) = base_and_unit(&name);
            if name.is_empty() {
                name = format!("column {}", at + 1);
            }
            let of_row = self.units.as_ref().map(|units| units[at].clone());
            let unit = unit.or(of_row.filter(|unit| !unit.is_empty()));
            Column { base, unit, name, is_numeric: true }
        };
        names.into_iter().enumerate().map(column).collect()
    }
}

/// The names in a comment above a table, if it has one for each column.
pub(super) fn names_in(
    (number, line): &(u64, Vec<u8>),
    delimiter: u8,
    width: usize,
) -> Option<Names> {
    let text = line.trim_ascii();
    let start = text.iter().position(|byte| !b"#%/ \t\"".contains(byte))?;
    let other = [delimiter].into_iter().chain(DELIMITERS);
    let mut cells = other.flat_map(|delimiter| {
        [&text[start..], text].map(|text| owned(text, delimiter, Beside::default()))
    });
    let cells = cells.find(|cells| cells.len() == width)?;
    let names: Vec<String> = cells.iter().map(|cell| shown(cell).into_owned()).collect();
    let are_names = names.iter().all(|name| !name.is_empty() && name.parse::<f64>().is_err());
    are_names.then(|| Names { rows: vec![names], units: None, at: *number })
}

/// Gives columns of one name different names: the second `x` becomes `x (2)`.
pub(super) fn distinct(columns: &mut [Column], notes: &mut Vec<String>) {
    for at in 1..columns.len() {
        let name = columns[at].name.clone();
        let before = columns[..at].iter().filter(|column| column.name == name).count();
        if before > 0 && !name.is_empty() {
            // Earlier ones of the name are renamed already, so this counts up by those.
            let is_taken = |name: &str| columns.iter().any(|column| column.name == name);
            let fresh =
                (2..).map(|number| format!("{name} ({number})")).find(|name| !is_taken(name));
            // The numbers from 2 on do not end.
            let fresh = fresh.unwrap_or_default();
            notes.push(format!("two columns are called `{name}`; the second is `{fresh}` here"));
            columns[at].name = fresh;
        }
    }
}

/// A name without its unit in brackets, after a slash or after an underscore, and the unit.
fn base_and_unit(name: &str) -> (String, Option<String>) {
    let name = name.trim();
    let last = name.char_indices().last();
    let open = match last {
        Some((_, ']')) => name.rfind('['),
        Some((_, ')')) => name.rfind('('),
        _ => None,
    };
    if let (Some(open), Some((close, _))) = (open, last) {
        let unit = name[open + 1..close].trim();
        let base = name[..open].trim().trim_end_matches('_');
        let is_number = unit.bytes().all(|byte| byte.is_ascii_digit());
        if !base.is_empty() && !is_number {
            return (base.to_string(), Some(unit.to_string()));
        }
    }
    for mark in ["_", " / ", "/", " in "] {
        if let Some((base, unit)) = name.rsplit_once(mark)
            && !base.trim().is_empty()
            && is_unit(unit.trim())
        {
            return (base.trim().to_string(), Some(unit.trim().to_string()));
        }
    }
    (name.to_string(), None)
}

fn bare(cell: &str) -> &str {
    cell.trim_matches(['[', ']', '(', ')', ' '])
}

pub(super) fn is_unit(text: &str) -> bool {
    stamp::unit_ns(text).is_some() || UNITS.contains(&&*text.to_lowercase())
}
