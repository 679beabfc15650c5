//! Parses bytes into rows of numbers, without I/O and without a clock.
//!
//! A line ends with `\n` or `\r`. Commas, semicolons, tabs or spaces separate its fields; blanks
//! around a comma or semicolon are ignored. A field may have a label, as in `ax:0.5`.

/// Longest line in bytes; longer lines are dropped.
pub(super) const LONGEST_LINE: usize = 4096;

#[derive(Debug, PartialEq)]
pub(super) enum Line<'a> {
    /// A line with a number or a missing value (NaN). Any field that is no finite number is NaN.
    Row(&'a [f64]),
    /// A line without numbers, whose fields can all be names of columns.
    Header(&'a [String]),
    /// A line that is neither a row nor a header.
    Garbage,
    TooLong,
}

#[derive(Debug, Default)]
pub(super) struct LineParser {
    line: Vec<u8>,
    /// Whether the incomplete line is too long, and will be dropped.
    too_long: bool,
    /// Whether the incomplete line may lack its beginning.
    half: bool,
    row: Vec<f64>,
    names: Vec<String>,
}

impl LineParser {
    /// To be called when the line was reopened. `half` says that the next bytes may begin within a
    /// line; this first line then counts only if it is a header.
    pub(super) fn reopened(&mut self, half: bool) {
        self.line.clear();
        (self.too_long, self.half) = (false, half);
    }

    /// Takes bytes, and passes each completed line to `on`. Skips empty lines.
    pub(super) fn feed(&mut self, bytes: &[u8], mut on: impl FnMut(Line<'_>)) {
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
                    on(Line::TooLong);
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
        match self.too_long {
            true => self.line.clear(),
            false => self.line.extend_from_slice(part),
        }
    }

    fn finish(&mut self, line: &[u8], on: &mut impl FnMut(Line<'_>)) {
        if line.len() > LONGEST_LINE {
            self.half = false;
            return on(Line::TooLong);
        }
        let line = line.trim_ascii();
        if line.is_empty() {
            return;
        }
        let half = std::mem::take(&mut self.half);
        self.row.clear();
        self.row.extend(Fields(Some(line)).map(|field| value_of(field).unwrap_or(f64::NAN)));
        // Fields are parsed again only if none is a finite number, which is rare.
        let has_number = self.row.iter().any(|x| !x.is_nan());
        if has_number || Fields(Some(line)).any(|field| value_of(field).is_some()) {
            if !half {
                on(Line::Row(&self.row));
            }
            return;
        }
        self.names.clear();
        self.names.extend(Fields(Some(line)).map_while(name_of).map(String::from));
        match self.names.len() == self.row.len() {
            true => on(Line::Header(&self.names)),
            false if !half => on(Line::Garbage),
            false => {}
        }
    }
}

/// Iterates over the fields of a line that is not empty. Removes blanks around fields.
struct Fields<'a>(Option<&'a [u8]>);

impl<'a> Iterator for Fields<'a> {
    type Item = &'a [u8];

    fn next(&mut self) -> Option<&'a [u8]> {
        let rest = self.0.take()?;
        let is_mark = |byte: &u8| matches!(byte, b',' | b';');
        let end = rest.iter().position(|byte| is_mark(byte) || byte.is_ascii_whitespace());
        let Some(end) = end else { return Some(rest) };
        let (field, tail) = rest.split_at(end);
        let tail = tail.trim_ascii_start();
        let tail = match tail.first().is_some_and(is_mark) {
            true => tail[1..].trim_ascii_start(),
            false => tail,
        };
        // Ignores a separator at the end of the line, which many programs print.
        self.0 = (!tail.is_empty()).then_some(tail);
        Some(field)
    }
}

/// The number in a field, after its label. NaN for an empty field or a word such as `nan`.
fn value_of(field: &[u8]) -> Option<f64> {
    let text = std::str::from_utf8(field).ok()?;
    let text = text.rsplit_once([':', '=']).map_or(text, |(_, value)| value);
    if let Ok(value) = text.parse::<f64>() {
        return Some(if value.is_finite() { value } else { f64::NAN });
    }
    let missing = ["", "-", "--", "none", "null", "na", "n/a", "ovf"];
    missing.iter().any(|word| text.eq_ignore_ascii_case(word)).then_some(f64::NAN)
}

fn name_of(field: &[u8]) -> Option<&str> {
    const LONGEST: usize = 64;
    let text = std::str::from_utf8(field).ok()?.trim_matches(|c| matches!(c, '"' | '#' | ':'));
    let fits = text.len() <= LONGEST && text.starts_with(|c: char| c.is_alphabetic() || c == '_');
    (fits && !text.contains(char::is_control)).then_some(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Parses bytes, and returns the debug text of each completed line.
    fn lines(parser: &mut LineParser, bytes: &[u8]) -> Vec<String> {
        let mut out = Vec::new();
        parser.feed(bytes, |line| out.push(format!("{line:?}")));
        out
    }

    fn rows(text: &str) -> Vec<Vec<f64>> {
        let mut out = Vec::new();
        LineParser::default().feed(text.as_bytes(), |line| match line {
            Line::Row(row) => out.push(row.to_vec()),
            other => panic!("{text:?}: {other:?}"),
        });
        out
    }

    #[test]
    fn every_usual_separator_is_understood() {
        let plain = ["1,-2.5,3e-2\n", "1;-2.5;3E-2\r\n", "1\t-2.5\t.03\r", " 1  -2.5 +0.03 \n"];
        let padded = ["1, -2.5 ,3e-2,\n", "1 ; -2.5 ;\t3e-2\n", "ax:1 ay:-2.5 az:0.03\n"];
        for text in plain.into_iter().chain(padded) {
            assert_eq!(rows(text), [[1.0, -2.5, 0.03]], "{text:?}");
        }
        assert_eq!(rows("ax=1,ay=2\n\n\r\n3,4\n"), [[1.0, 2.0], [3.0, 4.0]]);
    }

    #[test]
    fn a_missing_number_keeps_its_column() {
        for word in ["", "nan", "NaN", "inf", "-inf", "ovf", "null", "imu_link", "1x3", "\u{b5}"] {
            let row = &rows(&format!("1,{word},3\n"))[0];
            assert!(row[0] == 1.0 && row[1].is_nan() && row[2] == 3.0, "{word}: {row:?}");
        }
        // Missing values in all fields are a row of a failing sensor, not a header.
        assert!(rows("nan,nan\n")[0].iter().all(|x| x.is_nan()));
    }

    #[test]
    fn a_header_is_words_alone() {
        let mut parser = LineParser::default();
        assert_eq!(lines(&mut parser, b"\"t\",ax, ay\n"), ["Header([\"t\", \"ax\", \"ay\"])"]);
        assert_eq!(lines(&mut parser, b"# ax ay\n"), ["Garbage"]);
        assert_eq!(lines(&mut parser, b"\x00\xff\x13\n\xfe,??\n"), ["Garbage", "Garbage"]);
    }

    #[test]
    fn a_half_line_at_the_begin_is_dropped_unless_it_is_a_header() {
        let mut parser = LineParser::default();
        parser.reopened(true);
        assert_eq!(lines(&mut parser, b"2.5,3\n1,2\n"), ["Row([1.0, 2.0])"]);
        parser.reopened(true);
        let with_header = lines(&mut parser, b"ax,ay\n1,2\n");
        assert_eq!(with_header, ["Header([\"ax\", \"ay\"])", "Row([1.0, 2.0])"]);
        lines(&mut parser, b"7,");
        parser.reopened(false);
        assert_eq!(lines(&mut parser, b"1,2\n"), ["Row([1.0, 2.0])"]);
    }

    #[test]
    fn a_line_that_is_too_long_costs_itself_alone() {
        let mut parser = LineParser::default();
        let mut flood = "1,".repeat(1_000_000).into_bytes();
        flood.extend(b"\n1,2\n");
        for bytes in [flood.len(), 100] {
            let out: Vec<_> =
                flood.chunks(bytes).flat_map(|part| lines(&mut parser, part)).collect();
            assert_eq!(out, ["TooLong", "Row([1.0, 2.0])"]);
        }
        assert!(parser.line.capacity() <= 2 * LONGEST_LINE);
    }

    proptest! {
        #[test]
        fn numbers_come_out_as_they_were_written_however_the_bytes_are_cut(
            table in prop::collection::vec(prop::collection::vec(-1e9..1e9f64, 1..6), 0..20),
            mark in prop::sample::select(vec![",", ";", "\t", " ", ", "]),
            cut in 1usize..40,
        ) {
            let line = |row: &Vec<f64>| {
                row.iter().map(f64::to_string).collect::<Vec<_>>().join(mark) + "\n"
            };
            let text: String = table.iter().map(line).collect();
            let (mut parser, mut got) = (LineParser::default(), Vec::new());
            for part in text.as_bytes().chunks(cut) {
                parser.feed(part, |line| match line {
                    Line::Row(row) => got.push(row.to_vec()),
                    other => panic!("{other:?}"),
                });
            }
            prop_assert_eq!(got, table);
        }

        #[test]
        fn any_bytes_give_the_same_lines_however_they_are_cut(
            bytes in prop::collection::vec(
                prop_oneof![any::<u8>(), prop::sample::select(b"\n\r,; \t.-1eE:n".to_vec())], 0..300,
            ),
            cut in 1usize..40,
        ) {
            let whole = lines(&mut LineParser::default(), &bytes);
            let mut parser = LineParser::default();
            let parts: Vec<_> =
                bytes.chunks(cut).flat_map(|part| lines(&mut parser, part)).collect();
            prop_assert_eq!(whole, parts);
        }
    }
}
