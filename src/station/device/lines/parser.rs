//! Parses bytes into rows of numbers, without I/O and without a clock.
//!
//! A line ends with `\n` or `\r`. The first lines show their form, which all others then must have:
//! what separates the columns, what stands around the numbers, names, units, decimal commas. A line
//! of another form is no row, and its numbers count for nothing; only when many such lines follow
//! each other, they become the form.

use super::cells::{Cells, Kind, is_unit};
use super::commas::Commas;
use super::form::{Form, FormFinder};

/// Longest line in bytes; longer lines are dropped.
pub(super) const LONGEST_LINE: usize = 4096;
/// Most bytes of lines that wait until their form is found.
const MOST_HELD: usize = 4 * LONGEST_LINE;
/// Most lines of words that are kept as possible names of columns.
const MOST_HEADERS: usize = 4;

#[derive(Debug, PartialEq)]
pub(super) enum Line<'a> {
    /// A row, which the line completes. A cell that holds no finite number is NaN.
    Row(&'a [f64]),
    /// A line of words that can be names of columns, or the names that the lines themselves give.
    /// Names that no longer hold come as an empty list.
    Header(&'a [String]),
    /// A line of words between the rows, as of a log.
    Words,
    /// A line of numbers in another form than that of the rows.
    Other,
    /// A line that is none of these.
    Garbage,
    /// A line whose checksum is wrong.
    Damaged,
    TooLong,
    /// A line that has two readings, with what to do.
    Unclear(&'a str),
}

#[derive(Debug, Default)]
pub(super) struct LineParser {
    line: Vec<u8>,
    /// Whether the incomplete line is too long, and will be dropped.
    too_long: bool,
    /// Whether the incomplete line may lack its beginning.
    half: bool,
    reader: Reader,
}

/// Reads whole lines.
#[derive(Debug, Default)]
struct Reader {
    /// The line without colour codes, if it had any.
    plain: Vec<u8>,
    cells: Cells,
    commas: Commas,
    form: Option<Form>,
    finder: FormFinder,
    /// Lines that wait until their form is found, each with a line end.
    held: Vec<u8>,
    /// Possible headers, the latest last, each with whether commas, semicolons or bars separate.
    headers: Vec<(bool, Vec<String>)>,
    /// The names that were passed on last.
    told: Vec<String>,
    /// Number of checksums that were right, and wrong.
    sums: [u64; 2],
    unclear: String,
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

/// Says that `lines` have no form in common.
pub(super) fn no_form(lines: &str) -> String {
    let but = if lines.is_empty() { String::new() } else { format!(", but for example {lines}") };
    format!(
        "no lines of numbers in one form come{but}; print the same names or the same number of \
         values in each line"
    )
}

impl LineParser {
    /// A parser to which `decimal_comma` says whether commas are decimal; `None` to find out.
    pub(super) fn new(decimal_comma: Option<bool>) -> Self {
        let mut parser = Self::default();
        parser.reader.commas.given = decimal_comma;
        parser
    }

    /// To be called when the line was reopened. `half` says that the next bytes may begin within a
    /// line; this first line then counts only if it is a header.
    pub(super) fn reopened(&mut self, half: bool) {
        self.line.clear();
        (self.too_long, self.half) = (false, half);
    }

    /// Whether the lines themselves name the columns.
    pub(super) fn names_itself(&self) -> bool {
        self.reader.form.as_ref().is_some_and(|form| form.named)
    }

    /// The reason why lines of numbers wait for their form, if they do: they have none in common.
    pub(super) fn no_form(&self) -> Option<String> {
        let lines = self.reader.held.split(|byte| *byte == b'\n').filter(|line| !line.is_empty());
        let lines: Vec<String> = lines.take(2).map(|line| format!("`{}`", shown(line))).collect();
        (!lines.is_empty()).then(|| no_form(&lines.join(" and ")))
    }

    /// Whether decimal commas were found.
    pub(super) fn has_decimal_commas(&self) -> bool {
        self.reader.commas.were_decimal()
    }

    /// Takes bytes, and passes each completed line to `on`, with its text. Skips empty lines.
    pub(super) fn feed(&mut self, bytes: &[u8], mut on: impl FnMut(&[u8], Line<'_>)) {
        let is_end = |byte: &u8| matches!(byte, b'\n' | b'\r');
        let mut rest = bytes;
        while let Some(end) = rest.iter().position(is_end) {
            let (head, tail) = rest.split_at(end);
            rest = &tail[1..];
            if self.line.is_empty() && !self.too_long {
                // Usually, `head` is a whole line, which needs no copy.
                self.finish(head, &mut on);
                continue;
            }
            self.keep(head);
            let line = std::mem::take(&mut self.line);
            match std::mem::take(&mut self.too_long) {
                true => {
                    self.half = false;
                    on(&[], Line::TooLong);
                }
                false => self.finish(&line, &mut on),
            }
            self.line = line;
            self.line.clear();
        }
        self.keep(rest);
    }

    fn keep(&mut self, part: &[u8]) {
        self.too_long |= self.line.len() + part.len() > LONGEST_LINE;
        if self.too_long { self.line.clear() } else { self.line.extend_from_slice(part) }
    }

    fn finish(&mut self, line: &[u8], on: &mut impl FnMut(&[u8], Line<'_>)) {
        if line.len() > LONGEST_LINE {
            self.half = false;
            return on(&[], Line::TooLong);
        }
        let line = line.strip_prefix(b"\xef\xbb\xbf").unwrap_or(line);
        // Some balances frame lines by STX and ETX, and some programs send the end of a string in C.
        let is_text = |byte: &u8| !byte.is_ascii_whitespace() && !matches!(byte, 0 | 2 | 3);
        let Some(first) = line.iter().position(is_text) else { return };
        let line = &line[first..=line.iter().rposition(is_text).unwrap_or(first)];
        let half = std::mem::take(&mut self.half);
        if !line.contains(&0x1b) {
            return self.reader.line(line, half, on);
        }
        let mut plain = std::mem::take(&mut self.reader.plain);
        without_colours(line, &mut plain);
        let text = plain.trim_ascii();
        if !text.is_empty() {
            self.reader.line(text, half, on);
        }
        self.reader.plain = plain;
    }
}

/// Copies `line` to `plain` without the codes by which terminals set colours or move the cursor.
fn without_colours(line: &[u8], plain: &mut Vec<u8>) {
    plain.clear();
    let mut rest = line;
    while let Some(at) = rest.iter().position(|byte| *byte == 0x1b) {
        plain.extend_from_slice(&rest[..at]);
        let code = rest[at + 1..].strip_prefix(b"[").unwrap_or_default();
        // A code ends with a byte from `@` to `~` (ECMA-48, 5.4).
        let end = code.iter().position(|byte| matches!(byte, b'@'..=b'~'));
        rest = end.map_or(&rest[at + 1..], |end| &code[end + 1..]);
    }
    plain.extend_from_slice(rest);
}

/// Takes the checksum of NMEA 0183 from `$…*HH`. Returns the line without it, and whether it is
/// right: the XOR of all bytes between `$` and `*`.
fn without_checksum(line: &[u8]) -> (&[u8], Option<bool>) {
    let [b'$' | b'!', inner @ .., b'*', high, low] = line else { return (line, None) };
    let digit = |byte: u8| char::from(byte).to_digit(16);
    let (Some(high), Some(low)) = (digit(*high), digit(*low)) else { return (line, None) };
    let sum = inner.iter().fold(0, |sum, byte| sum ^ u32::from(*byte));
    (&line[..line.len() - 3], Some(sum == high * 16 + low))
}

impl Reader {
    /// Reads a line that is not empty. `half`: it may lack its beginning.
    fn line(&mut self, line: &[u8], half: bool, on: &mut impl FnMut(&[u8], Line<'_>)) {
        if line.iter().any(|byte| byte.is_ascii_control() && *byte != b'\t') {
            if !half {
                on(line, Line::Garbage);
            }
            return;
        }
        let (text, right) = without_checksum(line);
        if let Some(right) = right {
            self.sums[usize::from(!right)] += 1;
            // If no checksum was ever right, it is of another kind.
            if !right && self.sums[0] * 2 > self.sums[1] {
                return on(line, Line::Damaged);
            }
        }
        let decimal = self.commas.are_decimal(text);
        self.cells.read(text, decimal.unwrap_or(false));
        if !text.iter().any(|byte| byte.is_ascii_alphanumeric() || *byte >= 0x80) {
            // A rule, a bracket or the like, unless it is a row without any value.
            if let Some(form) = self.form.as_mut().filter(|_| !half) {
                form.take(&self.cells, |row| on(line, Line::Row(row)));
            }
            return;
        }
        let any = |kind| self.cells.cells.iter().any(|cell| cell.kind == kind);
        // Beside a word that can be a name, words such as `none` make no row.
        let is_row = any(Kind::Number) || any(Kind::Missing) && !any(Kind::Word);
        if !is_row || self.cells.odd {
            return self.words(text, half, on);
        }
        if half {
            return;
        }
        let points = self.commas.given.is_none()
            && self.form.as_mut().is_some_and(|form| form.may_have_thousands(&self.cells));
        if decimal.is_none() || points {
            self.tell_readings(text, if points { b'.' } else { b',' });
            return on(line, Line::Unclear(&self.unclear));
        }
        if let Some(form) = &mut self.form
            && form.take(&self.cells, |row| on(line, Line::Row(row)))
        {
            return self.finder.clear();
        }
        let Some(form) = self.finder.take(&self.cells, text, self.form.as_ref()) else {
            return self.no_row(line, on);
        };
        let names = self.names_of(&form);
        self.form = Some(form);
        if names != self.told {
            self.told = names;
            on(line, Line::Header(&self.told));
        }
        self.held.extend_from_slice(line);
        self.held.push(b'\n');
        // Now that the form is found, the lines that waited for it are read.
        let held = std::mem::take(&mut self.held);
        for line in held.split(|byte| *byte == b'\n').filter(|line| !line.is_empty()) {
            self.line(line, false, on);
        }
    }

    /// Takes a line of numbers that does not fit.
    fn no_row(&mut self, line: &[u8], on: &mut impl FnMut(&[u8], Line<'_>)) {
        if let Some(form) = &self.form {
            // Words in a line show a log, unless the rows hold words, too, or the line is mostly
            // numbers, as a damaged row is.
            let count = |is: fn(&u8) -> bool| line.iter().filter(|byte| is(byte)).count();
            let log = self.cells.worded
                && (form.named || !form.worded)
                && 3 * count(u8::is_ascii_alphabetic) >= count(u8::is_ascii_digit)
                && !form.resembles(&self.cells);
            return on(line, if log { Line::Words } else { Line::Other });
        }
        self.held.extend_from_slice(line);
        self.held.push(b'\n');
        if self.held.len() > MOST_HELD {
            let held = std::mem::take(&mut self.held);
            let lines = held.split(|byte| *byte == b'\n').filter(|line| !line.is_empty());
            lines.for_each(|line| on(line, Line::Other));
        }
    }

    /// Takes a line without numbers.
    fn words(&mut self, line: &[u8], half: bool, on: &mut impl FnMut(&[u8], Line<'_>)) {
        let (hard, names) = header_of(line);
        // A row of units below a header names no columns.
        let units = names.iter().all(|name| is_unit(name.as_bytes()))
            && self.headers.iter().any(|(_, other)| other.len() == names.len());
        let (renames, may_name) = match &self.form {
            _ if units || names.is_empty() => (false, false),
            Some(form) if form.named => (false, false),
            Some(form) => {
                // A log's words that happen to be as many as the columns are no names.
                let known =
                    self.told.is_empty() || names.iter().any(|name| self.told.contains(name));
                (form.width() == names.len() && form.hard == hard && (hard || known), hard || known)
            }
            None => (true, true),
        };
        // A header with other columns may stand before rows of another form.
        if may_name {
            self.headers.retain(|(_, other)| *other != names);
            self.headers.push((hard, names.clone()));
            if self.headers.len() > MOST_HEADERS {
                self.headers.remove(0);
            }
        }
        if renames {
            self.told = names;
            return on(line, Line::Header(&self.told));
        }
        let letters =
            line.iter().filter(|byte| byte.is_ascii_alphabetic() || **byte == b' ').count();
        match half {
            true => {}
            false if 2 * letters >= line.len() => on(line, Line::Words),
            false => on(line, Line::Garbage),
        }
    }

    fn names_of(&self, form: &Form) -> Vec<String> {
        let fits = |(hard, names): &&(bool, Vec<String>)| {
            names.len() == form.width() && *hard == form.hard
        };
        match form.named {
            true => form.names(),
            false => {
                let header = self.headers.iter().rev().find(fits);
                header.map(|(_, names)| names.clone()).unwrap_or_default()
            }
        }
    }

    /// `mark` may separate thousands in the line.
    fn tell_readings(&mut self, line: &[u8], mark: u8) {
        let mut reading = |line: &[u8], decimal| {
            self.cells.read(line, decimal);
            let numbers = self.cells.cells.iter().map(|cell| cell.value.to_string());
            numbers.collect::<Vec<_>>().join(" | ")
        };
        let group = |at: usize| {
            let digits = line[at + 1..].iter().take_while(|byte| byte.is_ascii_digit()).count();
            line[at] == mark && digits == 3 && at > 0 && line[at - 1].is_ascii_digit()
        };
        let kept = (0..line.len()).filter(|at| !group(*at)).map(|at| line[at]);
        let whole = reading(&kept.collect::<Vec<_>>(), false);
        let separate = reading(line, false);
        let mut readings = separate.clone();
        let others = [("decimal commas", reading(line, true)), ("marks of thousands", whole)];
        for (with, other) in others {
            if other != separate && !other.contains("NaN") {
                readings += &format!(", or with {with} {other}");
            }
        }
        self.unclear = format!(
            "`{}` can be the numbers {readings}; print decimals with a point and no marks of \
             thousands, or give decimal = \",\" or decimal = \".\" in its [[lines]] of the \
             configuration",
            String::from_utf8_lossy(line)
        );
    }
}

/// The names in a line of words, and whether commas, semicolons or bars separate them; no names if
/// a word cannot be one.
pub(super) fn header_of(line: &[u8]) -> (bool, Vec<String>) {
    let text = line.strip_prefix(b"//").unwrap_or(line);
    let text = text.strip_prefix(b"#").or(text.strip_prefix(b"%")).unwrap_or(text).trim_ascii();
    let is_hard = |byte: &u8| matches!(byte, b',' | b';' | b'|');
    let text = if text.last().is_some_and(is_hard) { &text[..text.len() - 1] } else { text };
    let hard = text.iter().any(is_hard);
    let tabs = !hard && text.contains(&b'\t');
    let is_end = |byte: &u8| match (hard, tabs) {
        (true, _) => is_hard(byte),
        (false, true) => *byte == b'\t',
        (false, false) => *byte == b' ',
    };
    let fields =
        text.split(is_end).map(<[u8]>::trim_ascii).filter(|field| hard || !field.is_empty());
    let names: Option<Vec<String>> = fields.map(|field| name_of(field).map(String::from)).collect();
    (hard, names.unwrap_or_default())
}

fn name_of(field: &[u8]) -> Option<&str> {
    const LONGEST: usize = 64;
    let text = std::str::from_utf8(field).ok()?;
    let text = text.trim_matches(|c| matches!(c, '"' | '\'' | ':')).trim();
    let fits = text.len() <= LONGEST && text.starts_with(|c: char| c.is_alphabetic() || c == '_');
    (fits && !text.contains(char::is_control)).then_some(text)
}

#[cfg(test)]
mod tests;
