//! How a table is laid out, found out from its first lines: what separates the cells, which lines name
//! the columns and their units, and where the rows begin.

use super::cell::{
    BOTH_COMMAS, Beside, DELIMITERS, Numbers, is_missing, named, owned, shortened, shown, split,
    timed,
};
use super::heading::{Column, HeadLine, Names, distinct, is_time_name, names_in};
use super::stamp;
use crate::printable::counted;

/// The kind of a line below the names.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Line {
    Row,
    /// A blank line or a comment.
    Nothing,
    /// A text of another width without numbers, such as what a program prints between its rows.
    Text,
}

#[derive(Clone, Debug)]
pub struct Layout {
    /// The separator of cells; a space stands for any number of spaces and tabs.
    pub delimiter: u8,
    beside: Beside,
    pub columns: Vec<Column>,
    /// The line number of the first row, and of the last line of the names (0 without names).
    pub first: u64,
    pub names_at: u64,
    /// Remarks on how the table was understood.
    pub notes: Vec<String>,
    /// Rows a second, where the lines above the rows say it.
    pub rate_hz: Option<f64>,
    /// Whether the lines are made of cells with types: without comments and quotes.
    is_typed: bool,
}

impl Layout {
    /// Separates typed cells; none of them holds it.
    #[cfg(feature = "parquet")]
    pub(super) const BETWEEN: u8 = 0x1f;

    /// The layout of a table that says its columns itself.
    #[cfg(feature = "parquet")]
    pub(super) fn typed(mut columns: Vec<Column>) -> Self {
        let mut notes = Vec::new();
        distinct(&mut columns, &mut notes);
        let (delimiter, first) = (Self::BETWEEN, 1);
        let (beside, names_at, rate_hz) = (Beside::default(), 0, None);
        Self { delimiter, beside, columns, first, names_at, notes, rate_hz, is_typed: true }
    }

    /// Finds out the layout from the `head` of a file: its first lines with their numbers.
    pub(crate) fn of(head: &[(u64, Vec<u8>)]) -> Result<Self, String> {
        let time = are_timed(head);
        let split_by = |delimiter: u8, names: bool| {
            let lines = head.iter().filter(|(_, line)| !line.trim_ascii().is_empty());
            let lines = lines.filter(|(_, line)| !is_comment(line));
            let cells = |(number, line): &(u64, Vec<u8>)| HeadLine {
                number: *number,
                cells: owned(line, delimiter, Beside { time, names }),
            };
            lines.map(cells).collect::<Vec<_>>()
        };
        let (mut best, mut labels) = ((0.0, b',', Vec::new()), None);
        for delimiter in DELIMITERS {
            let mut lines = split_by(delimiter, false);
            let named = names_beside(&lines, time);
            if named.is_some() {
                lines = split_by(delimiter, true);
            }
            let fit = fit(&lines, delimiter);
            // Other separators say where a cell is empty.
            if fit > best.0 * if delimiter == b' ' { 1.1 } else { 1.0 } {
                (best, labels) = ((fit, delimiter, lines), named);
            }
        }
        let (fit, delimiter, mut lines) = best;
        if fit == 0.0 {
            lines = split_by(b',', false);
        }
        // LabVIEW's own settings: of the file, then of its first segment.
        let is_end =
            |line: &HeadLine| line.cells.first().is_some_and(|cell| cell == b"***End_of_Header***");
        if let Some(at) = (0..lines.len()).filter(|at| is_end(&lines[*at])).take(2).last() {
            lines.drain(..=at);
        }
        let mut width = usual_width(&lines, delimiter).ok_or_else(|| no_rows(head))?;
        let rate_hz = increment(&mut lines, delimiter);
        // An end of each row that is empty, and that nothing names, is no column.
        while width > 1
            && lines.iter().all(|line| line.cells.get(width - 1).is_none_or(Vec::is_empty))
        {
            width -= 1;
        }
        lines.iter_mut().for_each(|line| strip(&mut line.cells, width));
        if let Some(at) = cut_off(&lines, width, delimiter) {
            lines.remove(at);
        }
        let is_numeric = numeric_columns(&lines, width, delimiter);
        let is_row = |line: &HeadLine| {
            let mut numbers = Numbers::new(delimiter);
            let mut found = false;
            let mut fits = |(cell, is_numeric): (&Vec<u8>, &bool)| {
                let number = numbers.read(cell);
                found |= matches!(number, Ok(number) if !number.is_nan());
                // Cells that have two readings are refused later, by name.
                !is_numeric
                    || number.is_ok()
                    || cell.iter().any(u8::is_ascii_digit)
                        && !cell.iter().any(u8::is_ascii_alphabetic)
            };
            line.cells.len() == width && line.cells.iter().zip(&is_numeric).all(&mut fits) && found
        };
        let mut start = lines.iter().position(is_row).ok_or_else(|| no_rows(head))?;
        // A first row with a damaged cell is no line of names, if there are names above it.
        let holds = |line: &HeadLine| {
            let mut cells = line.cells.iter().zip(&is_numeric);
            line.cells.len() == width && cells.any(|(cell, is)| *is && is_number(cell, delimiter))
        };
        let is_named = |line: &HeadLine| line.cells.len() == width && !holds(line);
        while start > 1 && holds(&lines[start - 1]) && lines[..start - 1].iter().any(is_named) {
            start -= 1;
        }
        while start > 0 && is_nothing(&lines[start - 1], width) {
            start -= 1;
        }
        other_table(&lines[..start], lines[start].number, width, delimiter)?;
        if delimiter == b',' && start == 0 && has_split_decimals(&lines) {
            return Err(BOTH_COMMAS.to_string());
        }
        let mut notes = Vec::new();
        if start == 0 && numbers_as_names(&lines) {
            notes.push("the numbers in the first line are names of the columns".to_string());
            start = 1;
        }
        let (above, mut lines) = lines.split_at(start);
        if let Some(rate_hz) = rate_hz {
            notes.push(format!("its second line tells the rate, {rate_hz} Hz"));
        }
        let of_rows = start_and_rate(lines, delimiter);
        if let Some(rate_hz) = of_rows {
            notes.push(format!("the first two rows are when it began and its rate, {rate_hz} Hz"));
            lines = &lines[2..];
        }
        let rate_hz = rate_hz.or(of_rows);
        let Some(first) = lines.first().map(|line| line.number) else {
            return Err(no_rows(head));
        };
        let mut names = Names::of(above, width, &is_numeric, lines, delimiter)?;
        let beside = Beside { time, names: labels.is_some() };
        if let Some(labels) = labels.filter(|labels| names.rows.is_empty() && labels.len() == width)
        {
            names.rows.push(labels);
        } else if names.rows.is_empty() {
            let comments = head.iter().filter(|(number, line)| *number < first && is_comment(line));
            names = comments
                .rev()
                .find_map(|comment| names_in(comment, delimiter, width))
                .unwrap_or(names);
        }
        let mut columns = names.columns(width, time);
        for (column, is_numeric) in columns.iter_mut().zip(is_numeric) {
            column.is_numeric = is_numeric;
        }
        distinct(&mut columns, &mut notes);
        let names_at = names.at;
        Ok(Self { delimiter, beside, columns, first, names_at, notes, rate_hz, is_typed: false })
    }

    /// Splits a line into the cells of a row, and says what the line is.
    pub(crate) fn cells<'a>(
        &self,
        line: &'a [u8],
        cells: &mut Vec<&'a [u8]>,
    ) -> Result<Line, String> {
        cells.clear();
        let of = |cells: &[&[u8]]| match cells.iter().any(|cell| !cell.is_empty()) {
            true => Line::Row,
            false => Line::Nothing,
        };
        if self.is_typed {
            cells.extend(line.split(|byte| *byte == self.delimiter).map(<[u8]>::trim_ascii));
            return Ok(of(cells));
        }
        split(line, self.delimiter, self.beside, cells);
        let width = self.columns.len();
        if cells.len() != width {
            if is_comment(line) || of(cells) == Line::Nothing {
                return Ok(Line::Nothing);
            }
            strip(cells, width);
            let found = cells.len();
            if found != width {
                if !cells.iter().any(|cell| is_number(cell, self.delimiter)) {
                    return Ok(Line::Text);
                }
                let is_both = self.delimiter == b',' && found == 2 * width;
                let both = if is_both { format!("; {BOTH_COMMAS}") } else { String::new() };
                let found = counted(found, "column");
                return Err(format!("has {found}; the table has {width}{both}"));
            }
        }
        let begins_comment =
            matches!(cells.first(), Some([b'#' | b'%', ..]) | Some([b'/', b'/', ..]));
        if begins_comment && !is_missing(cells[0]) {
            return Ok(Line::Nothing);
        }
        Ok(of(cells))
    }

    /// The place of a column by its name, or by its name without unit.
    pub(crate) fn column(&self, name: &str) -> Result<usize, String> {
        if let Some(exact) = self.columns.iter().position(|column| column.name == name) {
            return Ok(exact);
        }
        let names =
            || self.columns.iter().map(|column| &*column.name).collect::<Vec<_>>().join(", ");
        let alike = self
            .columns
            .iter()
            .enumerate()
            .filter(|(_, column)| !name.is_empty() && column.base.eq_ignore_ascii_case(name));
        match alike.map(|(at, _)| at).collect::<Vec<_>>()[..] {
            [only] => Ok(only),
            [] => Err(format!("it has no column `{name}`; its columns: {}", names())),
            _ => Err(format!("several columns are called `{name}`; say which of {}", names())),
        }
    }
}

/// Whether a line holds the words of missing values alone, as of a sensor that is not ready yet.
fn is_nothing(line: &HeadLine, width: usize) -> bool {
    line.cells.len() == width
        && line
            .cells
            .iter()
            .all(|cell| is_missing(cell) && cell.iter().any(u8::is_ascii_alphabetic))
}

/// Refuses rows of numbers of another width above the rows of a table.
fn other_table(above: &[HeadLine], first: u64, width: usize, delimiter: u8) -> Result<(), String> {
    /// So many rows are no settings of an instrument.
    const FEWEST: usize = 3;
    let is_row = |line: &HeadLine| {
        let is_value = |cell: &Vec<u8>| is_number(cell, delimiter) || stamp::is_moment(cell);
        line.cells.len() > 1 && line.cells.len() != width && line.cells.iter().all(is_value)
    };
    let are_rows = |lines: &&[HeadLine]| {
        lines.iter().all(|line| is_row(line) && line.cells.len() == lines[0].cells.len())
    };
    let Some(rows) = above.windows(FEWEST).find(are_rows) else { return Ok(()) };
    Err(format!(
        "line {} begins rows of {}, and line {first} rows of {width}: these are several tables; put each \
         in a file of its own",
        rows[0].number,
        counted(rows[0].cells.len(), "column")
    ))
}

/// Whether each second column holds digits alone, some with zeros before them, as where commas are decimal
/// marks and separate columns, too.
fn has_split_decimals(lines: &[HeadLine]) -> bool {
    let digits = |cell: &Vec<u8>| !cell.is_empty() && cell.iter().all(u8::is_ascii_digit);
    let parts = || lines.iter().flat_map(|line| line.cells.iter().skip(1).step_by(2));
    let wholes = || lines.iter().flat_map(|line| line.cells.iter().step_by(2));
    let is_whole = |cell: &Vec<u8>| digits(&cell.iter().copied().filter(|b| *b != b'-').collect());
    lines.iter().all(|line| line.cells.len() % 2 == 0)
        && parts().all(digits)
        && wholes().all(is_whole)
        && parts().any(|cell| cell.len() > 1 && cell[0] == b'0')
        && !wholes().any(|cell| cell.len() > 1 && cell[0] == b'0')
}

/// The rate in Hz, if the first line names a start and an increment beyond the columns, as Rigol's oscilloscopes
/// do, and the second line tells them. Both are taken out.
fn increment(lines: &mut [HeadLine], delimiter: u8) -> Option<f64> {
    let [names, values, ..] = lines else { return None };
    let last = names.cells.iter().rposition(|cell| !cell.is_empty()).filter(|last| *last > 1)?;
    let is_told = names.cells[last - 1].eq_ignore_ascii_case(b"start")
        && names.cells[last].eq_ignore_ascii_case(b"increment");
    let step_s = Numbers::new(delimiter).read(values.cells.get(last)?).ok()?;
    let rate_hz = Some(1.0 / step_s).filter(|hz| is_told && (0.01..1e10).contains(hz))?;
    names.cells.truncate(last - 1);
    values.cells.truncate(last - 1);
    Some((rate_hz * 1e6).round() / 1e6)
}

/// The place of a line above the first row that is the end of a row, which a program met in the middle.
fn cut_off(lines: &[HeadLine], width: usize, delimiter: u8) -> Option<usize> {
    let are_numbers = |line: &HeadLine| line.cells.iter().all(|cell| is_number(cell, delimiter));
    let is_row = |line: &HeadLine| line.cells.len() == width && are_numbers(line);
    let above = lines.iter().position(is_row)?.checked_sub(1)?;
    (lines[above].cells.len() < width && are_numbers(&lines[above])).then_some(above)
}

/// The rate in Hz, if a first row repeats one time since 1970 and a second row one rate, as Empatica's wristbands
/// write them for each channel.
fn start_and_rate(rows: &[HeadLine], delimiter: u8) -> Option<f64> {
    let mut numbers = Numbers::new(delimiter);
    let mut repeated = |line: &HeadLine| {
        let (first, rest) = line.cells.split_first()?;
        rest.iter().all(|cell| cell == first).then(|| numbers.read(first).ok()).flatten()
    };
    let is_start = |x: f64| stamp::SINCE_1970_S.contains(&x);
    let [first, second, third, ..] = rows else { return None };
    repeated(first).filter(|x| is_start(*x))?;
    let goes_on = repeated(third).is_some_and(is_start);
    repeated(second).filter(|hz| !goes_on && (0.01..1e6).contains(hz))
}

fn no_rows(head: &[(u64, Vec<u8>)]) -> String {
    let first = head.iter().map(|(_, line)| line.trim_ascii()).find(|line| !line.is_empty());
    let first = shortened(first.unwrap_or_default());
    format!("it holds no rows of numbers; expected a line for each sample (it begins with {first})")
}

fn is_comment(line: &[u8]) -> bool {
    let line = line.trim_ascii_start();
    let line = line.strip_prefix(b"\"").filter(|rest| !rest.starts_with(b"#\"")).unwrap_or(line);
    // `Layout::cells` recognises a name such as `#` or `# of sample` alone before a separator.
    line.starts_with(b"#") || line.starts_with(b"%") || line.starts_with(b"//")
}

/// Whether a monitor or a log has written a time before most lines ([`timed`]).
fn are_timed(head: &[(u64, Vec<u8>)]) -> bool {
    let lines = || head.iter().filter(|(_, line)| !line.trim_ascii().is_empty());
    let with = lines().filter(|(_, line)| timed(line).is_some()).count();
    with > 0 && with * 5 >= lines().count() * 4
}

/// The names that stand before the numbers of nearly all lines ([`named`]), the same in each.
fn names_beside(lines: &[HeadLine], time: bool) -> Option<Vec<String>> {
    let names_of = |line: &HeadLine| -> Option<Vec<String>> {
        let names = line.cells.iter().skip(usize::from(time)).map(|cell| named(cell));
        let names =
            names.map(|named| Some(shown(named?.0).into_owned())).collect::<Option<Vec<_>>>()?;
        let time = time.then(|| "time".to_string());
        (!names.is_empty()).then(|| time.into_iter().chain(names).collect())
    };
    let first = lines.iter().find_map(names_of)?;
    let alike = lines.iter().filter(|line| names_of(line).as_ref() == Some(&first)).count();
    (alike * 5 >= lines.len() * 4).then_some(first)
}

/// Drops empty cells beyond `width`.
fn strip(cells: &mut Vec<impl AsRef<[u8]>>, width: usize) {
    while cells.len() > width && cells.last().is_some_and(|cell| cell.as_ref().is_empty()) {
        cells.pop();
    }
}

fn is_number(cell: &[u8], delimiter: u8) -> bool {
    Numbers::new(delimiter).read(cell).is_ok_and(|number| !number.is_nan())
}

/// How well a delimiter fits: the share of numbers, dates and missing values among the cells of lines
/// of the usual width, times the share of these lines. 0 if it separates nothing.
fn fit(lines: &[HeadLine], delimiter: u8) -> f64 {
    let Some(width) = usual_width(lines, delimiter).filter(|width| *width > 1) else { return 0.0 };
    let usual: Vec<&HeadLine> = lines.iter().filter(|line| line.cells.len() == width).collect();
    let cells = || usual.iter().flat_map(|line| &line.cells);
    let plain = cells()
        .filter(|cell| is_number(cell, delimiter) || is_missing(cell) || stamp::is_moment(cell));
    let share = plain.count() as f64 / cells().count() as f64;
    share * usual.len() as f64 / lines.len() as f64
}

/// The most frequent number of cells among the lines of the second half that hold a number.
fn usual_width(lines: &[HeadLine], delimiter: u8) -> Option<usize> {
    let mut counts = std::collections::BTreeMap::<usize, usize>::new();
    let holds = |line: &&HeadLine| line.cells.iter().any(|cell| is_number(cell, delimiter));
    for line in lines[lines.len() / 2..].iter().filter(holds) {
        *counts.entry(line.cells.len()).or_default() += 1;
    }
    counts.into_iter().max_by_key(|(width, count)| (*count, *width)).map(|(width, _)| width)
}

/// The columns that hold numbers in at least half of their cells, by the last 200 that are not missing.
fn numeric_columns(lines: &[HeadLine], width: usize, delimiter: u8) -> Vec<bool> {
    let fitting: Vec<&HeadLine> = lines.iter().filter(|line| line.cells.len() == width).collect();
    let is_numeric = |column: usize| {
        let cells = fitting.iter().rev().map(|line| &line.cells[column]);
        let (mut numbers, mut all) = (0, 0);
        for cell in cells.filter(|cell| !is_missing(cell)).take(200) {
            all += 1;
            numbers += usize::from(is_number(cell, delimiter));
        }
        // Settings, some of which are numbers, may stand beside the first rows.
        let are_many = numbers * 5 >= fitting.len().min(200);
        all > 0 && (numbers == all || 2 * numbers >= all && are_many)
    };
    (0..width).map(is_numeric).collect()
}

/// Whether the numbers of the first line are names: an empty name before 0, 1, 2 …, as pandas writes
/// unnamed columns, or 0, 1, 2 … (or 1, 2, 3 …) before rows that hold other numbers.
fn numbers_as_names(lines: &[HeadLine]) -> bool {
    let Some((first, rest)) = lines.split_first() else { return false };
    let whole = |cell: &Vec<u8>| std::str::from_utf8(cell).ok()?.parse::<u32>().ok();
    let counts = |cells: &[Vec<u8>]| {
        let from = cells.first().and_then(whole).filter(|from| *from < 2);
        from.is_some_and(|from| (from..).zip(cells).all(|(at, cell)| whole(cell) == Some(at)))
    };
    match first.cells.split_first() {
        Some((index, names)) if index.is_empty() => counts(names),
        // The name of a column of dates.
        Some((time, _)) if is_time_name(&shown(time)) => true,
        Some(_) if first.cells.len() > 2 && counts(&first.cells) => {
            let most = 4 * first.cells.len() as u32;
            let other = |cell: &Vec<u8>| !is_missing(cell) && whole(cell).is_none_or(|x| x > most);
            rest.iter().flat_map(|line| &line.cells).any(other)
        }
        _ => false,
    }
}
