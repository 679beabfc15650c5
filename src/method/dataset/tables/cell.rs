//! The cells of a line, and the numbers in them, with a decimal point or a decimal comma.

use std::borrow::Cow;

use super::stamp;

/// The separators of cells, in the order in which they are tried.
pub(super) const DELIMITERS: [u8; 5] = [b';', b'\t', b',', b'|', b' '];

pub(super) const BOTH_COMMAS: &str = "commas may be decimal marks or separate columns: separate \
                                      columns by semicolons, or write decimal points";

/// The texts of a missing value in any letters; an empty cell is one, too. No sensor has measured an infinity.
const MISSING: &str = "nan na n/a #n/a #nv #div/0! #value! #num! #ref! null none - -- nan(ind) -nan \
                       -nan(ind) 1.#qnan 1.#ind -1.#ind inf -inf +inf infinity -infinity +infinity \
                       1.#inf -1.#inf";

/// Marks that may separate thousands, but are no decimal marks.
const SPACES: [char; 5] = [' ', '\u{a0}', '\u{202f}', '\'', '\u{2019}'];

pub(crate) fn is_missing(cell: &[u8]) -> bool {
    cell.len() < 10
        && (cell.is_empty()
            || MISSING.split(' ').any(|word| cell.eq_ignore_ascii_case(word.as_bytes())))
}

/// Reads the numbers of one table, which has one decimal mark: that of the first number with a mark.
#[derive(Clone, Debug)]
pub(crate) struct Numbers {
    mark: Option<u8>,
    /// Whether commas separate the cells, so that a comma in quotes may separate thousands.
    between_commas: bool,
}

impl Numbers {
    pub(crate) fn new(delimiter: u8) -> Self {
        Self { mark: None, between_commas: delimiter == b',' }
    }

    /// The number in a cell, without outer spaces; NaN if it is missing. The error, of one that is not
    /// finite or has two readings, continues a sentence that begins with the cell.
    pub(super) fn read(&mut self, cell: &[u8]) -> Result<f64, String> {
        let plain = std::str::from_utf8(cell).ok().and_then(|text| text.parse::<f64>().ok());
        match plain {
            Some(number) if number.is_finite() => {
                if self.mark != Some(b'.') && cell.contains(&b'.') {
                    self.marked(b'.', cell)?;
                }
                Ok(number)
            }
            None | Some(_) if is_missing(cell) => Ok(f64::NAN),
            Some(_) => Err("is not a finite number".into()),
            None => self.grouped(cell),
        }
    }

    /// Checks the decimal mark of a number that is read elsewhere, such as a time.
    pub(super) fn check(&mut self, cell: &[u8]) -> Result<(), String> {
        let mark = cell.iter().find(|byte| matches!(byte, b'.' | b','));
        mark.map_or(Ok(()), |mark| self.marked(*mark, cell))
    }

    /// Remembers the decimal mark, or refuses one that is not that of the numbers before.
    fn marked(&mut self, mark: u8, cell: &[u8]) -> Result<(), String> {
        let known = *self.mark.get_or_insert(mark);
        if known == mark {
            return Ok(());
        }
        let (mark, known) = (char::from(mark), char::from(known));
        let [decimal, whole] = [".", ""].map(|point| shown(cell).replace([',', '.'], point));
        Err(format!(
            "has a `{mark}`, but numbers before it have a decimal `{known}`: it may be {decimal} or \
             {whole}; write all numbers in one way"
        ))
    }

    /// A number with a comma, which is a decimal mark or separates thousands.
    fn grouped(&mut self, cell: &[u8]) -> Result<f64, String> {
        let no_number = || "is not a finite number".to_string();
        let mut text = shown(cell).replace('\u{2212}', "-");
        // Fortran's exponents.
        if let Some((number, exponent)) =
            text.split_once(['d', 'D']).filter(|(of, _)| of.contains('.'))
        {
            text = format!("{number}e{exponent}");
        }
        if let Some(apart) = text.find(SPACES).and_then(|at| text[at..].chars().next()) {
            let (whole, rest) = text.split_at(text.find([',', '.']).unwrap_or(text.len()));
            let are_groups =
                !whole.contains([',', '.']) && by_thousands(&whole.replace(apart, ","));
            text = are_groups.then(|| whole.replace(apart, "") + rest).ok_or_else(no_number)?;
        }
        let is_mark = |c: char| c == ',' || c == '.';
        let number = |text: &str| text.parse::<f64>().ok().filter(|number| number.is_finite());
        let (Some(last), true) = (text.rfind(is_mark), text.bytes().any(|b| b.is_ascii_digit()))
        else {
            return number(&text).ok_or_else(no_number);
        };
        if text.matches(is_mark).count() == 1 {
            let value = number(&text.replace(',', ".")).ok_or_else(no_number)?;
            let mark = text.as_bytes()[last];
            if self.mark.is_none() && self.between_commas && mark == b',' && by_thousands(&text) {
                return Err(may_be(&value.to_string(), &text.replace(',', "")));
            }
            self.marked(mark, cell)?;
            return Ok(value);
        }
        // Several marks: the last is the decimal one, unless all are alike.
        let is_decimal = !text[..last].contains(&text[last..=last]);
        let (whole, rest) = if is_decimal { text.split_at(last) } else { (&*text, "") };
        if !by_thousands(whole) || rest.bytes().skip(1).any(|byte| byte == b',' || byte == b'.') {
            return Err(no_number());
        }
        let value = number(&(whole.replace(is_mark, "") + &rest.replace(',', ".")));
        let value = value.ok_or_else(no_number)?;
        let mark = match (is_decimal, text.as_bytes()[last]) {
            (true, mark) => mark,
            (false, b',') => b'.',
            (false, _) => b',',
        };
        self.marked(mark, cell)?;
        Ok(value)
    }
}

/// Refuses a column whose marks may separate thousands: `999` and `1,000`, if all numbers with a mark have
/// groups of three digits, and those without have fewer digits. The error continues a sentence that begins
/// with the column.
pub(super) fn thousands(cells: &[Vec<u8>]) -> Result<(), String> {
    let texts = cells.iter().filter(|cell| !is_missing(cell)).map(|cell| shown(cell));
    let (marked, plain): (Vec<_>, Vec<_>) = texts.partition(|text| text.contains([',', '.']));
    let value = |text: &Cow<'_, str>| text.parse::<i64>().ok().map(i64::abs);
    let are_short = plain.iter().all(|text| value(text).is_some_and(|value| value < 1000));
    let long = plain.iter().find(|text| value(text).is_some_and(|value| value >= 100));
    let are_grouped = are_short && marked.iter().all(|text| by_thousands(text));
    match long.zip(marked.first()).filter(|_| are_grouped) {
        None => Ok(()),
        Some((long, marked)) => Err(format!(
            "holds `{long}` and `{marked}`, which {}",
            may_be(&marked.replace(',', "."), &marked.replace([',', '.'], ""))
        )),
    }
}

fn may_be(decimal: &str, whole: &str) -> String {
    format!("may be {decimal} or {whole}; write numbers without separators of thousands")
}

/// Whether one kind of mark separates the digits of a whole number into thousands.
fn by_thousands(text: &str) -> bool {
    let digits = text.trim_start_matches(['-', '+']);
    let Some(mark) = digits.find([',', '.']).map(|at| &digits[at..=at]) else { return false };
    let mut groups = digits.split(mark);
    let is_number = |group: &str| group.bytes().all(|byte| byte.is_ascii_digit());
    groups.next().is_some_and(|first| {
        (1..=3).contains(&first.len()) && is_number(first) && !first.starts_with('0')
    }) && groups.all(|group| group.len() == 3 && is_number(group))
}

/// The time that a monitor or a log writes before each line, and the rest of the line: `TIME -> `, `[TIME] ` or
/// `TIME - LEVEL - `.
pub(super) fn timed(line: &[u8]) -> Option<(&[u8], &[u8])> {
    let line = line.trim_ascii_start();
    let start = &line[..line.len().min(60)];
    let dash = |text: &[u8]| memchr::memmem::find(&text[..text.len().min(60)], b" - ");
    if start.starts_with(b"[") {
        let end = memchr::memchr(b']', start)?;
        let (time, rest) = (line[1..end].trim_ascii(), &line[end + 1..]);
        // Tera Term writes the day before it and the year behind it.
        let of_day = || time.split(|byte| *byte == b' ').find(|word| stamp::is_clock(word));
        return Some((if stamp::is_moment(time) { time } else { of_day()? }, rest));
    }
    let (time, mut rest) = match memchr::memmem::find(start, b"->") {
        Some(at) => (&line[..at], &line[at + 2..]),
        None => dash(start).map(|at| (&line[..at], &line[at + 3..]))?,
    };
    // Levels and names of a log.
    while let Some(at) = dash(rest).filter(|at| !rest[..*at].iter().any(u8::is_ascii_digit)) {
        rest = &rest[at + 3..];
    }
    stamp::is_moment(time.trim_ascii()).then_some((time.trim_ascii(), rest))
}

/// Text that a program has written beside the numbers of each line.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Beside {
    /// A time before the line ([`timed`]).
    pub time: bool,
    /// A name before each number ([`named`]).
    pub names: bool,
}

/// The name and the number of a cell as for a serial plotter: `x:0.5`.
pub(super) fn named(cell: &[u8]) -> Option<(&[u8], &[u8])> {
    let at = memchr::memchr(b':', cell).filter(|_| cell[0].is_ascii_alphabetic())?;
    let number = cell[at + 1..].trim_ascii();
    let is_number = std::str::from_utf8(number).is_ok_and(|text| text.parse::<f64>().is_ok());
    is_number.then_some((cell[..at].trim_ascii(), number))
}

/// Appends the cells of a line, without outer spaces and quotes, and without what stands beside numbers.
pub(super) fn split<'a>(line: &'a [u8], delimiter: u8, beside: Beside, cells: &mut Vec<&'a [u8]>) {
    let from = cells.len();
    split_raw(line, delimiter, beside.time, cells);
    if beside.names {
        cells[from..].iter_mut().for_each(|cell| *cell = named(cell).map_or(*cell, |(_, x)| x));
    }
}

fn split_raw<'a>(line: &'a [u8], delimiter: u8, is_timed: bool, cells: &mut Vec<&'a [u8]>) {
    let mut rest = line;
    if is_timed && let Some((time, after)) = timed(line) {
        cells.push(time);
        rest = after;
    }
    if memchr::memchr(b'"', rest).is_some() {
        return split_quoted(rest, delimiter, cells);
    }
    if delimiter == b' ' {
        let words = rest.split(|byte| matches!(byte, b' ' | b'\t'));
        cells.extend(words.filter(|word| !word.is_empty()));
        return;
    }
    let mut start = 0;
    for at in memchr::memchr_iter(delimiter, rest) {
        cells.push(rest[start..at].trim_ascii());
        start = at + 1;
    }
    cells.push(rest[start..].trim_ascii());
}

fn split_quoted<'a>(line: &'a [u8], delimiter: u8, cells: &mut Vec<&'a [u8]>) {
    let (mut start, mut is_quoted) = (0, false);
    let is_mark = |byte: u8| byte == delimiter || delimiter == b' ' && byte == b'\t';
    for at in 0..=line.len() {
        match line.get(at) {
            Some(b'"') => is_quoted = !is_quoted,
            Some(&byte) if is_quoted || !is_mark(byte) => {}
            _ => {
                let cell = line[start..at].trim_ascii();
                start = at + 1;
                if delimiter == b' ' && cell.is_empty() {
                    continue;
                }
                let bare = cell.strip_prefix(b"\"").and_then(|cell| cell.strip_suffix(b"\""));
                cells.push(bare.map_or(cell, <[u8]>::trim_ascii));
            }
        }
    }
}

pub(super) fn owned(line: &[u8], delimiter: u8, beside: Beside) -> Vec<Vec<u8>> {
    let mut cells = Vec::new();
    split(line, delimiter, beside, &mut cells);
    cells.into_iter().map(<[u8]>::to_vec).collect()
}

pub(super) fn whole(cell: &[u8]) -> Option<i64> {
    let value = shown(cell).parse::<f64>().ok()?;
    (value.fract() == 0.0 && value.abs() < 1e15).then_some(value as i64)
}

/// Whether cells rise by 1 from each to the next.
pub(super) fn counts<'a>(cells: impl Iterator<Item = &'a Vec<u8>>) -> bool {
    let numbers: Option<Vec<i64>> = cells.map(|cell| whole(cell)).collect();
    numbers.is_some_and(|numbers| {
        numbers.len() > 1 && numbers.windows(2).all(|two| two[1] - two[0] == 1)
    })
}

/// Bytes as text: UTF-8, or else Latin-1.
pub(crate) fn shown(bytes: &[u8]) -> Cow<'_, str> {
    match std::str::from_utf8(bytes) {
        Ok(text) => Cow::Borrowed(text),
        Err(_) => bytes.iter().map(|&byte| char::from(byte)).collect::<String>().into(),
    }
}

/// The start of a line in quotes, for messages.
pub(super) fn shortened(line: &[u8]) -> String {
    let start: String = shown(line).chars().take(60).collect();
    format!("`{}`", start.escape_debug())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_read_by_the_mark_of_their_table() {
        for (delimiter, cells) in [
            (b';', &[("0,5", 0.5), ("1.234,5", 1234.5), ("-7", -7.0), ("1,5E-2", 0.015)][..]),
            (b',', &[("0.5", 0.5), ("1,234.5", 1234.5), ("1,234,567", 1_234_567.0), (".5", 0.5)]),
            (b',', &[("0,5", 0.5), ("\u{2212}1,25", -1.25), ("12,345", 12.345)]),
            (b';', &[("1 234,5", 1234.5), ("-12\u{202f}345", -12345.0), ("0,5", 0.5)]),
            (b',', &[("1'234.5", 1234.5), ("1'234'567", 1_234_567.0)]),
            (b'\t', &[("+1e3", 1000.0), ("5.", 5.0), ("1,234.5", 1234.5)]),
        ] {
            let mut numbers = Numbers::new(delimiter);
            for (cell, value) in cells {
                assert_eq!(numbers.read(cell.as_bytes()), Ok(*value), "{cell}");
            }
        }
        for cell in ["", "NaN", "n/a", "#N/A", "-nan(ind)", "NULL", "-Infinity"] {
            assert!(Numbers::new(b',').read(cell.as_bytes()).unwrap().is_nan(), "{cell}");
        }
    }

    #[test]
    fn thousands_are_told_from_decimals_by_shorter_numbers_without_a_mark() {
        for (cells, expected) in [
            (&["999", "1,000", "-1,001"][..], true),
            (&["999", "1.000"], true),
            (&["1,000", "1,001"], false),
            (&["99", "1,000"], false),
            (&["999", "1,000", "1,5"], false),
            (&["999.125", "1000", "1.000"], false),
        ] {
            let cells: Vec<Vec<u8>> = cells.iter().map(|cell| cell.as_bytes().to_vec()).collect();
            assert_eq!(thousands(&cells).is_err(), expected, "{cells:?}");
        }
    }

    #[test]
    fn what_has_two_readings_or_none_is_refused() {
        for (delimiter, cells, part) in [
            (b';', &["0,5", "1.234"][..], "may be 1.234 or 1234"),
            (b';', &["0.5", "1,234"], "may be 1.234 or 1234"),
            (b',', &["1,234"], "may be 1.234 or 1234"),
            (b',', &["0.5g"], "not a finite"),
            (b';', &["1,2,3"], "not a finite"),
            (b';', &["1 23"], "not a finite"),
            (b';', &["1 2 345"], "not a finite"),
            (b';', &["1.2.3"], "not a finite"),
            (b';', &["1e999"], "not a finite"),
        ] {
            let mut numbers = Numbers::new(delimiter);
            let (last, first) = cells.split_last().unwrap();
            assert!(first.iter().all(|cell| numbers.read(cell.as_bytes()).is_ok()));
            let said = numbers.read(last.as_bytes()).unwrap_err();
            assert!(said.contains(part), "{cells:?}: {said}");
        }
    }
}
