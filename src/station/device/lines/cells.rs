//! Finds the numbers in a line of text, and what stands around them: separators, names, units,
//! words. Does no I/O. Once its buffers have grown, it allocates for decimal commas only.

use super::numbers::{begins_number, digits_of, is_stuck_unit, number_of, time_of};

/// Most cells of a line; a line with more is refused.
pub(super) const MOST_CELLS: usize = 512;

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Kind {
    Number,
    /// An empty cell, a word such as `nan`, or a damaged number.
    Missing,
    /// Text between separators.
    Word,
}

/// A piece of the line, as a range of its bytes.
pub(super) type Piece = (usize, usize);

#[derive(Clone, Copy, Debug)]
pub(super) struct Cell {
    /// NaN unless `kind` is `Number`.
    pub value: f64,
    pub kind: Kind,
    /// Hash of the name, with the place after it; [`LEAD`] and the place before any name.
    pub name: u64,
    /// Hash of the unit that is stuck to the number; 0 without a unit.
    pub unit: u64,
    /// Words that hold for all names until the next such words, and the name itself.
    pub label: [Piece; 2],
    /// Place after the name, counted from 0.
    pub place: u32,
    /// The groups of thousands that the digits show ([`digits_of`]).
    pub digits: u8,
}

/// Base of the names of cells before the first name.
pub(super) const LEAD: u64 = 1 << 63;

#[derive(Debug, Default)]
pub(super) struct Cells {
    pub cells: Vec<Cell>,
    /// Hash of all that stands between the numbers, except blanks and units.
    pub shape: u64,
    /// Whether names with a colon or an equals sign stand before numbers.
    pub named: bool,
    /// Whether the line has words, units or hexadecimal numbers, as only some lines of numbers do.
    pub worded: bool,
    /// Whether commas, semicolons or bars separate.
    pub hard: bool,
    /// Whether the line ends with a separator.
    pub open: bool,
    /// Whether the line has a form that is recognised and not supported.
    pub odd: bool,
}

/// The state between two cells of a line.
#[derive(Default)]
struct Between {
    /// Words since the last number or separator; begin of the last word.
    words: Option<Piece>,
    last_word: usize,
    /// Whether the words end with a colon or an equals sign.
    hard: bool,
    /// Whether the separated cell has a number so far, or text in place of one.
    filled: bool,
    /// The separator before this place, unless something came after it.
    separator: Option<u8>,
    /// The name in force: its hash, pieces and number of cells; 0 without one.
    name: u64,
    label: [Piece; 2],
    place: u32,
    /// Words before the last name of several words.
    prefix: Piece,
    last_bracket: u8,
    /// Whether a minus sign stands before the number, apart from it.
    negative: bool,
    /// Whether the last value is a time.
    timed: bool,
    /// Whether a value has had a timestamp.
    stamped: bool,
}

pub(super) fn mix(hash: u64, bytes: &[u8]) -> u64 {
    bytes.iter().fold(hash, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(0x100_0000_01b3))
}

const SEED: u64 = 0xcbf2_9ce4_8422_2325;

fn is_blank(byte: u8) -> bool {
    // As in `x=1&y=2`, as forms on web pages are sent.
    matches!(byte, b' ' | b'\t' | 0x0b | 0x0c | b'&')
}

fn is_bracket(byte: u8) -> bool {
    matches!(byte, b'(' | b')' | b'[' | b']' | b'{' | b'}' | b'<' | b'>' | b'"' | b'\'' | b'`')
}

fn is_separator(byte: u8) -> bool {
    matches!(byte, b',' | b';' | b'|')
}

/// Whether a word can go no further than before `byte`.
fn ends_word(byte: u8) -> bool {
    is_blank(byte) || is_bracket(byte) || is_separator(byte) || matches!(byte, b':' | b'=')
}

/// Words in place of a number that is missing.
fn is_missing(word: &[u8]) -> bool {
    const WORDS: &str = "nan inf infinity ovf ovl null none na n/a - -- --- undefined overflow";
    WORDS.split(' ').any(|missing| word.eq_ignore_ascii_case(missing.as_bytes()))
}

/// Units that may stand after a number and a blank, where they would read as the next name; also
/// with a letter for thousands, millions and the like.
pub(super) fn is_unit(word: &[u8]) -> bool {
    const UNITS: [&str; 56] = [
        "g", "mg", "m/s", "m/s2", "m/s^2", "m/s²", "m/s/s", "dps", "deg", "deg/s", "°", "°/s",
        "rad", "rad/s", "uT", "µT", "μT", "nT", "T", "gauss", "V", "mV", "A", "mA", "C", "°C",
        "degC", "K", "F", "°F", "Pa", "hPa", "kPa", "bar", "mbar", "%", "N", "mN", "kg", "cm",
        "mm", "m", "Hz", "LSB", "Ohm", "ohm", "Ω", "W", "ms", "us", "µs", "gf", "kgf", "lbf", "lb",
        "oz",
    ];
    let is = |word: &[u8]| UNITS.iter().any(|unit| word == unit.as_bytes());
    is(word) || matches!(word, [b'k' | b'M' | b'G' | b'm' | b'u' | b'n', rest @ ..] if is(rest))
}

impl Cells {
    /// Takes a line without its end, without blanks around it.
    pub(super) fn read(&mut self, line: &[u8], decimal_comma: bool) {
        self.cells.clear();
        (self.shape, self.named, self.worded) = (SEED, false, false);
        (self.hard, self.open, self.odd) = (false, false, false);
        let (mut between, mut at) = (Between::default(), 0);
        while let Some(&byte) = line.get(at) {
            if self.cells.len() > MOST_CELLS {
                self.odd = true;
                break;
            }
            at = match byte {
                _ if is_blank(byte) => at + 1,
                _ if is_separator(byte) => {
                    self.separate(line, byte, &mut between);
                    at + 1
                }
                b'"' => self.quoted(line, at, &mut between),
                _ if is_bracket(byte) => {
                    if between.last_bracket != byte || at == 0 || line[at - 1] != byte {
                        self.shape = mix(self.shape, &[byte]);
                    }
                    between.last_bracket = byte;
                    at + 1
                }
                b':' | b'=' => {
                    between.hard |= between.words.is_some();
                    if between.words.is_none() {
                        self.shape = mix(self.shape, &[byte]);
                    }
                    at + 1
                }
                b'-' if line.get(at + 1) == Some(&b'>') => {
                    self.shape = mix(self.shape, b"->");
                    at + 2
                }
                _ if begins_number(&line[at..]) => {
                    self.number(line, at, decimal_comma, &mut between)
                }
                b'+' | b'-' if is_sign(line, at, &between) => {
                    between.negative = byte == b'-';
                    at + 1
                }
                b'0'..=b'9' | b'a'..=b'z' | b'A'..=b'Z' | b'_' | 0x80.. => {
                    self.word(line, at, &mut between)
                }
                b'+' | b'-' if line.get(at + 1).is_some_and(u8::is_ascii_alphabetic) => at + 1,
                b'-' => self.word(line, at, &mut between),
                _ => {
                    self.token(&mut between);
                    self.shape = mix(self.shape, &[byte]);
                    at + 1
                }
            };
        }
        self.open = between.separator.is_some();
        if !self.open {
            self.end_cell(line, &mut between);
        }
        if self.named {
            self.keep_named();
        }
    }

    /// Notes that something follows the last separator.
    fn token(&mut self, between: &mut Between) {
        if let Some(separator) = between.separator.take() {
            self.shape = mix(self.shape, &[separator]);
            self.hard = true;
        }
    }

    fn separate(&mut self, line: &[u8], separator: u8, between: &mut Between) {
        let empty = between.words.is_none() && !between.filled;
        if !empty {
            self.end_cell(line, between);
        } else if separator != b'|' {
            self.token(between);
            self.push(f64::NAN, Kind::Missing, 0, between);
        }
        self.token(between);
        between.separator = Some(separator);
        (between.words, between.hard) = (None, false);
        between.filled = false;
    }

    /// Ends a separated cell. Words of a cell without numbers are a cell of their own.
    fn end_cell(&mut self, line: &[u8], between: &mut Between) {
        let Some((begin, end)) = between.words.take() else { return };
        if between.hard && !between.filled {
            between.words = Some((begin, end));
            self.name(line, between);
            return self.push(f64::NAN, Kind::Missing, 0, between);
        }
        let first = self.cells.is_empty();
        if between.filled || first {
            self.shape = mix(self.shape, &line[begin..end]);
        }
        if !between.filled {
            self.push(f64::NAN, Kind::Word, 0, between);
            if let Some(word) = self.cells.last_mut() {
                word.label = [(0, 0), (begin, end)];
            }
        }
    }

    fn push(&mut self, value: f64, kind: Kind, unit: u64, between: &mut Between) {
        let name = match between.name {
            0 => LEAD + self.cells.len() as u64,
            name => mix(name, &between.place.to_le_bytes()) & !LEAD,
        };
        let (label, place) = (between.label, between.place);
        between.place += 1;
        between.filled = true;
        let kind = if kind == Kind::Number && !value.is_finite() { Kind::Missing } else { kind };
        let value = if kind == Kind::Number { value } else { f64::NAN };
        self.cells.push(Cell { value, kind, name, unit, label, place, digits: 0 });
    }

    /// Makes the words before a value its name.
    fn name(&mut self, line: &[u8], between: &mut Between) {
        let Some((mut begin, end)) = between.words.take() else { return };
        let hard = std::mem::take(&mut between.hard);
        let last = between.last_word;
        if !hard {
            self.shape = mix(self.shape, &line[begin..end]);
            if between.name == 0 && !between.filled {
                (between.label, between.place) = ([(0, 0), (begin, end)], 0);
            }
            return;
        }
        if between.filled && last > begin {
            let words = line[begin..last].split(|byte| is_blank(*byte));
            // The words are contiguous, so their lengths lead to the first that is no unit.
            let units = words.take_while(|word| word.is_empty() || is_unit(word));
            begin = (begin + units.map(|word| word.len() + 1).sum::<usize>()).min(last);
        }
        if begin < last {
            between.prefix = (begin, last);
        }
        let prefix = &line[between.prefix.0..between.prefix.1];
        let prefix = prefix.split(|byte| ends_word(*byte)).filter(|word| !word.is_empty());
        let hash = prefix.fold(SEED, |hash, word| mix(mix(hash, word), b" "));
        between.name = mix(hash, &line[last..end]) | 1;
        (between.label, between.place) = ([between.prefix, (last, end)], 0);
        self.named = true;
        self.shape = mix(self.shape, &line[begin..end]);
    }

    /// Reads a word at `at`, which may be a name or stand for a missing number. Returns its end.
    fn word(&mut self, line: &[u8], at: usize, between: &mut Between) -> usize {
        let length = line[at..].iter().position(|byte| ends_word(*byte));
        let mut end = length.map_or(line.len(), |length| at + length);
        // A comment's end is no part of the word in it.
        if let Some(star) = line[at..end].windows(2).position(|two| two == b"*/")
            && star > 0
        {
            end = at + star;
        }
        self.take_word(line, (at, end), end, between);
        end
    }

    /// Takes the word in a piece of the line; `next` is where the line goes on.
    fn take_word(&mut self, line: &[u8], word: Piece, next: usize, between: &mut Between) {
        self.token(between);
        let rest = line[next..].trim_ascii_start();
        let names = matches!(rest.first(), Some(b':' | b'='));
        let (begin, end) = word;
        if !names && is_missing(&line[begin..end]) {
            self.name(line, between);
            return self.push(f64::NAN, Kind::Missing, 0, between);
        }
        self.worded = true;
        if between.name != 0
            && between.filled
            && between.words.is_none()
            && !names
            && is_unit(&line[begin..end])
            && let Some(last) = self.cells.last_mut().filter(|last| last.kind == Kind::Number)
        {
            last.unit = mix(SEED, &line[begin..end]);
        }
        if !names && between.hard {
            // A value that is a word, as in `state: idle`.
            (between.words, between.hard) = (None, false);
            let hard = matches!(rest.first(), Some(b',' | b';' | b'}'));
            if hard && !between.filled {
                between.words = Some(word);
            }
            return;
        }
        between.words = Some((between.words.map_or(begin, |(first, _)| first), end));
        between.last_word = begin;
        between.hard = false;
    }

    /// Reads a quoted text, unless it holds a number, whose quotes do not matter.
    fn quoted(&mut self, line: &[u8], at: usize, between: &mut Between) -> usize {
        let inner = &line[at + 1..];
        let Some(length) = inner.iter().position(|byte| *byte == b'"') else { return at + 1 };
        let text = inner[..length].trim_ascii();
        let is_text =
            text.first().is_some_and(|first| first.is_ascii_alphabetic() || *first == b'_');
        if !is_text || is_missing(text) || text.iter().any(|byte| matches!(byte, b':' | b'=')) {
            return at + 1;
        }
        let begin = at + 1 + inner.iter().position(|byte| !is_blank(*byte)).unwrap_or(0);
        self.take_word(line, (begin, begin + text.len()), at + length + 2, between);
        at + length + 2
    }

    /// Reads the number at `at`; returns where the line goes on.
    fn number(&mut self, line: &[u8], at: usize, comma: bool, between: &mut Between) -> usize {
        self.token(between);
        let rest = &line[at..];
        let negative = std::mem::take(&mut between.negative);
        between.timed = false;
        if let Some((value, length)) = time_of(rest) {
            self.name(line, between);
            self.push(value, Kind::Number, 0, between);
            between.timed = true;
            return at + length;
        }
        let (value, mut length) = number_of(rest, comma);
        let value = if negative { -value } else { value };
        let digits = digits_of(&rest[..length]);
        self.worded |=
            !value.is_nan() && rest[..length].iter().any(|byte| matches!(byte, b'x' | b'X'));
        let tail = &rest[length..];
        let stuck = tail.iter().position(|byte| ends_word(*byte) || *byte == b'\\');
        let mut stuck = &tail[..stuck.unwrap_or(tail.len())];
        if let Some(star) = stuck.windows(2).position(|two| two == b"*/") {
            stuck = &stuck[..star];
        }
        length += stuck.len();
        let blanks = rest[length..].iter().take_while(|byte| is_blank(**byte)).count();
        let next = rest.get(length + blanks).copied();
        if matches!(next, Some(b':' | b'=')) && begins_value(&rest[length + blanks + 1..]) {
            if between.words.is_some() && between.hard && stuck.is_empty() && blanks == 0 {
                // `name:timestamp:value`: the timestamp has a column of its own. Three numbers are
                // neither that nor, out of range, a time of day.
                self.odd |= line[between.last_word].is_ascii_digit();
                return self.stamp(line, at + length + 1, value, between);
            }
            // A name that begins with a digit, as in `0:512`; or another value of `name:t:x;t:x`.
            self.odd |= between.stamped;
            self.worded = true;
            between.words = Some((between.words.map_or(at, |(first, _)| first), at + length));
            between.last_word = at;
            return at + length;
        }
        self.name(line, between);
        self.worded |= !stuck.is_empty();
        if stuck.is_empty() {
            self.push(value, Kind::Number, 0, between);
        } else if is_stuck_unit(stuck) {
            self.push(value, Kind::Number, mix(SEED, stuck), between);
        } else {
            self.push(f64::NAN, Kind::Missing, 0, between);
        }
        if let Some(cell) = self.cells.last_mut() {
            cell.digits = digits;
        }
        at + length
    }

    fn stamp(&mut self, line: &[u8], next: usize, value: f64, between: &mut Between) -> usize {
        between.stamped = true;
        let (name, kind, label) = (LEAD, Kind::Number, [(0, 0); 2]);
        self.cells.push(Cell { value, kind, name, unit: 0, label, place: 0, digits: 0 });
        // Flags after a bar say how to draw the value; of these, `xy` gives it another meaning.
        if let Some(bar) = line.iter().position(|byte| *byte == b'|') {
            self.odd |= line[bar..].windows(2).any(|two| two == b"xy");
        }
        next
    }

    /// In a line with names, only cells with names count, and cells before the first name.
    fn keep_named(&mut self) {
        let lead = |cell: &Cell| cell.name & LEAD != 0;
        let first = self.cells.iter().position(|cell| !lead(cell)).unwrap_or(self.cells.len());
        // A list of names before one of numbers: `yaw, pitch, roll: 1, 2, 3`.
        let (words, numbers) = self.cells.split_at_mut(first);
        let is_list = !words.is_empty()
            && words.iter().all(|cell| cell.kind == Kind::Word)
            && numbers.len() == words.len() + 1
            && numbers.iter().all(|cell| cell.label == numbers[0].label);
        if is_list {
            numbers.iter_mut().zip(words).for_each(|(cell, word)| cell.label = word.label);
            numbers.iter_mut().for_each(|cell| cell.place = 0);
        }
        let mut at = 0;
        self.cells.retain(|cell| {
            at += 1;
            cell.kind == Kind::Number && (at <= first || !lead(cell))
                || cell.kind == Kind::Missing && !lead(cell)
        });
    }
}

/// Whether the sign at `at` belongs to a number that follows after blanks, as balances print it.
/// The dashes between the parts of a log's line are none.
fn is_sign(line: &[u8], at: usize, between: &Between) -> bool {
    let blanks = line[at + 1..].iter().take_while(|byte| **byte == b' ').count();
    let rest = &line[at + 1 + blanks..];
    let number = begins_number(rest) && !matches!(rest[0], b'+' | b'-');
    let parts = |four: &[u8]| four.starts_with(b" - ") && four[3].is_ascii_alphabetic();
    let word = between.words.map_or(0, |(_, end)| end - between.last_word);
    let alone = blanks == 1 && word > 2 && !between.hard && line[..at].ends_with(b" ");
    // As in `500 - 511 - 920`; where signs stand apart, some are `+`.
    let apart = blanks == 1 && between.filled && between.words.is_none() && !line.contains(&b'+');
    let apart = apart && line[..at].ends_with(b" ") && begins_number(line);
    let log = line[at] == b'-'
        && (between.timed
            || (alone || apart) && !line[..at].ends_with(b"  ")
            || line.windows(4).any(parts));
    number && blanks > 0 && !log
}

fn begins_value(text: &[u8]) -> bool {
    let text = text.trim_ascii_start();
    begins_number(text) || is_missing(&text[..text.len().min(3)])
}
