//! Tells decimal commas from commas that separate columns, without I/O.
//!
//! Points in the numbers, brackets of a list, or two commas without another separator between them
//! show that commas separate. Semicolons or tabs beside commas show decimal commas. Otherwise, a
//! fraction that begins with 0 (as in `9,05`) shows decimal commas, since no program pads integers
//! so by default. Commas with three digits after each may separate thousands. What stays ambiguous is
//! refused, never guessed.

/// How the commas of one line read, by this line alone.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Look {
    /// No comma stands between digits, or the commas can only separate.
    Separate,
    /// The commas separate integers, as far as this line shows.
    Integers,
    Decimal,
    /// All numbers have as many decimals, which is a hint and no proof.
    Likely,
    Unsure,
    /// The commas separate integers that are padded with zeros.
    Padded,
    /// Commas are decimal commas and separators at once, or seem to separate thousands.
    Both,
    /// Points are decimal points, and commas can only separate.
    Apart,
}

/// Reads the commas of successive lines.
#[derive(Clone, Debug, Default)]
pub(super) struct Commas {
    /// The configured sign; `None` to find it out.
    pub given: Option<bool>,
    /// Whether a line has shown decimal commas beyond doubt.
    proved: bool,
    /// Whether commas were read as decimal commas by a hint alone.
    guessed: bool,
    /// Whether a line has contradicted the hint.
    doubted: bool,
    /// Whether a line had commas that separate integers.
    separated: bool,
    /// Whether integers are padded with zeros.
    padded: bool,
    /// Whether a line has commas in both roles.
    both: bool,
    /// Whether a line has shown beyond doubt that commas separate.
    apart: bool,
}

impl Commas {
    /// Whether a line was read with decimal commas.
    pub(super) fn were_decimal(&self) -> bool {
        self.given.unwrap_or(self.proved || self.guessed)
    }

    /// Whether commas in this line are decimal commas; `None` if that is ambiguous.
    pub(super) fn are_decimal(&mut self, line: &[u8]) -> Option<bool> {
        if self.given.is_some() {
            return self.given;
        }
        match look(line) {
            Look::Separate => Some(false),
            Look::Integers => {
                self.separated = true;
                (!self.both).then_some(false)
            }
            Look::Padded => {
                (self.padded, self.both) = (true, false);
                Some(false)
            }
            Look::Apart => {
                (self.apart, self.both) = (true, false);
                Some(false)
            }
            Look::Both if self.padded => Some(false),
            Look::Likely | Look::Unsure | Look::Both if self.apart && !self.proved => Some(false),
            Look::Decimal => {
                self.proved = true;
                Some(true)
            }
            Look::Likely if self.proved || !self.doubted => {
                self.guessed = true;
                Some(true)
            }
            Look::Likely => None,
            Look::Unsure if self.proved => Some(true),
            // A damaged line can look so where commas separate.
            Look::Unsure if self.separated && !self.guessed && !self.both => Some(false),
            Look::Unsure => {
                self.doubted |= self.guessed;
                None
            }
            Look::Both => {
                self.both = true;
                None
            }
        }
    }
}

/// Whether `text` is a number whose thousands `mark` separates, with a fraction after the sign
/// `decimal` or without one.
pub(super) fn is_grouped(text: &[u8], mark: u8, decimal: u8) -> bool {
    let digits = |part: &[u8]| part.iter().all(u8::is_ascii_digit);
    let text = text.strip_prefix(b"-").or(text.strip_prefix(b"+")).unwrap_or(text);
    let mut parts = text.splitn(2, |byte| *byte == decimal);
    let mut groups = parts.next().unwrap_or(text).split(|byte| *byte == mark);
    let first = groups.next().unwrap_or(text);
    let begins = (1..=3).contains(&first.len()) && digits(first) && first[0] != b'0';
    begins
        && groups.clone().next().is_some()
        && groups.all(|group| group.len() == 3 && digits(group))
        && parts.next().is_none_or(digits)
}

/// Counts over the runs of digits, points, signs and commas of a line.
#[derive(Default)]
struct Runs {
    numbers: usize,
    /// Runs with exactly one comma between digits, and runs with more.
    one: usize,
    many: usize,
    points: bool,
    /// A fraction of two or more digits begins with 0.
    padded: bool,
    /// An integer part begins with a needless 0, so that integers are padded.
    integers: bool,
    /// Lengths of the fractions: the first, and whether all are alike.
    decimals: Option<usize>,
    alike: bool,
    /// Whether an integer part has fewer than three digits.
    short: bool,
    /// Runs like `1.234,5`, and runs with commas that are all like `1,234` or `1,234.5`.
    thousands: usize,
    groups: usize,
    /// A run is like `1,050.5`: with a zero that shows that the comma separates thousands.
    grouped: bool,
    /// A point stands where no thousands end.
    pointed: bool,
}

fn look(line: &[u8]) -> Look {
    if !line.contains(&b',') {
        return Look::Separate;
    }
    // Quotes hold one value.
    let mut quoted = line.split(|byte| *byte == b'"').skip(1).step_by(2);
    if quoted.clone().any(|text| is_decimal(text) && !is_grouped(text, b',', b'.')) {
        return Look::Decimal;
    }
    if let Some(text) = quoted.find(|text| is_grouped(text, b',', b'.')) {
        return if text.contains(&b'.') { Look::Both } else { Look::Unsure };
    }
    let mut runs = Runs { alike: true, ..Runs::default() };
    let in_run = |byte: &u8| matches!(byte, b'0'..=b'9' | b'.' | b',' | b'-' | b'+' | b':');
    let mut next = 0;
    for run in line.split(|byte| !in_run(byte)) {
        let at = next;
        next += run.len() + 1;
        // Digits that end a word, a unit or an exponent are no number's begin.
        let stuck = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'^' | b'_' | 0x80..);
        let run = match !run.starts_with(b":") && at > 0 && stuck(line[at - 1]) {
            true => {
                run.iter().position(|byte| *byte == b',').map_or(&[][..], |comma| &run[comma + 1..])
            }
            false => run,
        };
        // A comma at an end stands beside a blank or a letter, so it separates.
        let run = run.strip_suffix(b",").unwrap_or(run);
        let run = run.strip_prefix(b",").unwrap_or(run);
        // A label's colon begins a new number; two colons are a time of day.
        let run = match run.iter().filter(|byte| **byte == b':').count() {
            0 => run,
            1 => run.rsplit(|byte| *byte == b':').next().unwrap_or(run),
            _ => continue,
        };
        // A date such as `12.03.2024` is no number.
        let date = run.iter().filter(|byte| **byte == b'.').count() > 1 && !run.contains(&b',');
        if !date && run.iter().any(u8::is_ascii_digit) {
            runs.add(run);
        }
    }
    let tail = line.trim_ascii_end().strip_suffix(b";").unwrap_or(line);
    // A tab beside a comma is padding.
    let is_tab = |three: &[u8]| three[1] == b'\t' && three[0] != b',' && three[2] != b',';
    let other = tail.contains(&b';') || line.windows(3).any(is_tab);
    // In the brackets of a list, commas separate, unless blanks do.
    let list = line.iter().any(|byte| matches!(byte, b'[' | b'{'));
    let named = line.iter().any(|byte| matches!(byte, b':' | b'='));
    runs.look(other, list && !has_blank_between(line), named)
}

/// Whether `text` is a number with a decimal comma.
fn is_decimal(text: &[u8]) -> bool {
    let text = text.strip_prefix(b"-").unwrap_or(text);
    let mut parts = text.split(|byte| *byte == b',');
    parts.clone().count() == 2 && parts.all(digits)
}

fn digits(text: &[u8]) -> bool {
    !text.is_empty() && text.iter().all(u8::is_ascii_digit)
}

/// Whether only blanks stand between two cells.
fn has_blank_between(line: &[u8]) -> bool {
    // A comma, a name or a list's end needs no blank behind it.
    let alone = |byte: &u8| !matches!(byte, b',' | b';' | b':' | b'=' | b']' | b'}' | b'[' | b'{');
    let mut pieces =
        line.split(u8::is_ascii_whitespace).filter(|piece| !piece.is_empty()).peekable();
    std::iter::from_fn(|| {
        let piece = pieces.next()?;
        Some((piece, pieces.peek()?.starts_with(b",")))
    })
    .any(|(piece, comma)| piece.last().is_some_and(alone) && !comma)
}

impl Runs {
    fn add(&mut self, run: &[u8]) {
        self.numbers += 1;
        self.points |= run.contains(&b'.');
        let mut parts = run.split(|byte| *byte == b',');
        let (whole, fraction) = (parts.next().unwrap_or(run), parts.next());
        let is_point = |part: &[u8]| part.contains(&b'.') && !is_grouped(part, b'.', b',');
        self.pointed = self.pointed || run.split(|byte| *byte == b',').any(is_point);
        let Some(fraction) = fraction else { return };
        let is_us = is_grouped(run, b',', b'.');
        self.groups += usize::from(is_us);
        self.grouped |= is_us && run.contains(&b'.') && run.windows(2).any(|two| two == b",0");
        self.thousands += usize::from(run.contains(&b'.') && is_grouped(run, b'.', b','));
        let is_padded = |part: &[u8]| digits(part) && part.len() > 1 && part[0] == b'0';
        self.integers |= is_padded(whole) && (whole.len() > 2 || parts.clone().next().is_some());
        let unsigned = whole.strip_prefix(b"-").or(whole.strip_prefix(b"+")).unwrap_or(whole);
        if parts.next().is_some() {
            self.many += 1;
            self.padded |= run.split(|byte| *byte == b',').skip(1).any(is_padded);
        } else if digits(fraction) {
            self.one += 1;
            self.padded |= is_padded(fraction);
            self.alike &= *self.decimals.get_or_insert(fraction.len()) == fraction.len();
            self.short |= unsigned.len() < 3;
        } else {
            // A sign after the comma, as in `1,-2`, begins another number; so does a point.
            self.many += 1;
        }
    }

    /// `other` says that a semicolon or tab separates, `list` that the line has a list's bracket,
    /// and `named` that it has a name's colon.
    fn look(&self, other: bool, list: bool, named: bool) -> Look {
        let likely = self.alike && self.decimals > Some(1) && self.short;
        let if_padded = |padded, otherwise| if self.padded { padded } else { otherwise };
        // Three digits stand after each comma, and something else shows where numbers end.
        let groups = self.groups == self.one + self.many;
        let thousands = groups && (other || named || self.groups > 1);
        let maybe = groups && (other || self.many == 0 && (named || self.numbers > 1));
        match () {
            () if self.one + self.many == 0 || list && !other => Look::Separate,
            () if self.integers && (self.many > 0 || self.numbers == 1) => Look::Padded,
            () if self.grouped || self.points && thousands => Look::Both,
            () if self.points && self.thousands > 0 && self.many == 0 => Look::Both,
            () if self.pointed && !groups => Look::Apart,
            () if self.points => Look::Separate,
            () if maybe => Look::Unsure,
            () if self.many > 0 => if_padded(Look::Both, Look::Integers),
            () if other => Look::Decimal,
            () if self.numbers == 1 && named => if_padded(Look::Decimal, Look::Unsure),
            () if self.numbers == 1 => if_padded(Look::Both, Look::Integers),
            () if self.padded => Look::Decimal,
            () if likely && self.one == self.numbers => Look::Likely,
            () => Look::Unsure,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_line_looks_as_its_commas_are_used() {
        let decimal = [
            "9,81;0,50",
            "1;0,12;9,81;",
            "0,12\t9,81",
            "ax:0,12;ay:-9,81",
            "1,05 2",
            "12.03.2024;0,12",
            "08,50;09,81",
            "\"0,1\",\"9,8\"",
        ];
        let separate = ["1,982.19", "1, 2, 3", "[1,2] [3,4]", "a:1,b:2", "12:30:01,250 1", "1;2"];
        let mut both = vec!["0,12,9,05", "1.234,56;2.000,10", "9,05"];
        both.extend(["1,050.5 2,000.5", "1,982.19;5", "F: 1,982.19 N", "\"1,982.1\",\"5\""]);
        let mut unsure = vec!["1,2 3,4", "512,498 601,330", "1, 2,3"];
        unsure.extend(["-50;1,000", "4 1,000", "6,411\t99,446", "F: 1,050", "\"1,982\""]);
        for (expected, lines) in [
            (Look::Decimal, &decimal[..]),
            (Look::Likely, &["0,12 9,81 3,10", "9,81, 0,50"]),
            (Look::Separate, &separate),
            (Look::Apart, &["0.5,1;2,3"]),
            (Look::Integers, &["1,2,3", "1,2", "1,-2", "1,2,3;4,5,6", "$512,300,200;"]),
            (Look::Both, &both),
            (Look::Unsure, &unsure),
        ] {
            for line in lines {
                assert_eq!(look(line.as_bytes()), expected, "{line}");
            }
        }
    }

    #[test]
    fn what_is_ambiguous_is_no_guess() {
        let mut commas = Commas::default();
        assert_eq!(commas.are_decimal(b"512,0498"), None);
        assert_eq!(commas.are_decimal(b"0512,0498"), Some(false));
        assert_eq!(commas.are_decimal(b"512,0498"), Some(false));
        let mut commas = Commas::default();
        assert_eq!(commas.are_decimal(b"12,34 56,78"), Some(true));
        assert_eq!(commas.are_decimal(b"12,3 56,78"), None);
        assert_eq!(commas.are_decimal(b"12,34 56,78"), None);
        assert_eq!(commas.are_decimal(b"12,04 56,78"), Some(true));
        assert_eq!(commas.are_decimal(b"12,3 56,78"), Some(true));
        // Other rows prove what one leaves open.
        let mut commas = Commas::default();
        assert_eq!(commas.are_decimal(b"1.280,486"), None);
        assert_eq!(commas.are_decimal(b"0.280,486"), Some(false));
        assert_eq!(commas.are_decimal(b"1.280,486"), Some(false));
        let mut commas = Commas::default();
        assert_eq!(commas.are_decimal(b"6,411;5,123"), None);
        assert_eq!(commas.are_decimal(b"6,411;0,123"), Some(true));
        assert_eq!(commas.are_decimal(b"6,411;5,123"), Some(true));
    }
}
