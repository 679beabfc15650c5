//! Reads text files: one file for each channel, with one number in each line.

use std::path::PathBuf;

use super::{LibraryError, files};
use crate::trial::Series;

/// Reads one text file for each channel, and cuts all channels to the length of the shortest.
pub(crate) fn read(paths: &[PathBuf], rate_hz: f64) -> Result<Series, LibraryError> {
    let column = |path: &PathBuf| {
        let bytes = files::read_bytes(path, files::MOST_TEXT)?;
        parse(&bytes).map_err(|problem| LibraryError::file(path, problem))
    };
    let columns = paths.iter().map(column).collect::<Result<Vec<_>, _>>()?;
    let frames = columns.iter().map(Vec::len).min().unwrap_or(0);
    let mut samples = Vec::with_capacity(frames * columns.len());
    for frame in 0..frames {
        samples.extend(columns.iter().map(|column| column[frame]));
    }
    Series::new(rate_hz, columns.len(), samples)
        .map_err(|error| LibraryError::file(&paths[0], error))
}

/// The number of frames that [`read`] would give: the non-blank lines of the shortest file.
pub(crate) fn frames(paths: &[PathBuf]) -> Result<usize, LibraryError> {
    let lines = |path: &PathBuf| -> Result<usize, LibraryError> {
        let bytes = files::read_bytes(path, files::MOST_TEXT)?;
        let lines = bytes.split(|&byte| byte == b'\n');
        Ok(lines.filter(|line| !line.trim_ascii().is_empty()).count())
    };
    let lengths = paths.iter().map(lines).collect::<Result<Vec<_>, _>>()?;
    Ok(lengths.into_iter().min().unwrap_or(0))
}

/// Parses a text with one number in each line; blank lines are allowed only at the end.
fn parse(bytes: &[u8]) -> Result<Vec<f32>, String> {
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    let mut numbers = Vec::with_capacity(bytes.len() / 8);
    let mut blank = None;
    for (line, text) in (1..).zip(bytes.split(|&byte| byte == b'\n')) {
        let text = text.trim_ascii();
        if text.is_empty() {
            blank = blank.or(Some(line));
            continue;
        }
        if let Some(line) = blank {
            return Err(format!(
                "line {line}: blank, but numbers follow; expected one number a line"
            ));
        }
        let number = std::str::from_utf8(text).ok().and_then(|text| text.parse::<f64>().ok());
        match number.map(|number| number as f32) {
            Some(number) if number.is_finite() => numbers.push(number),
            Some(_) => {
                return Err(format!(
                    "line {line}: {}; expected a finite number (a broken cable gives such values: \
                     check the connector, then record again or remove the file)",
                    String::from_utf8_lossy(text)
                ));
            }
            None => return Err(format!("line {line}: {}", not_a_number(text))),
        }
    }
    if numbers.is_empty() {
        return Err("it holds no numbers; record again, or remove the file".into());
    }
    Ok(numbers)
}

fn not_a_number(text: &[u8]) -> String {
    let shown: String = String::from_utf8_lossy(text).chars().take(40).collect();
    let hint = if text.contains(&b',') { "; write decimals with a point, not a comma" } else { "" };
    format!("`{}` is not a number; expected one number a line{hint}", shown.escape_debug())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spaces_line_ends_and_a_blank_last_line_do_not_matter() {
        let text = b"\xef\xbb\xbf  1.5\r\n-2e-1\t\r\n3\n\n";
        assert_eq!(parse(text).unwrap(), [1.5, -0.2, 3.0]);
        assert_eq!(parse(b"1\n2").unwrap(), [1.0, 2.0]);
    }

    #[test]
    fn what_is_no_number_is_named_with_its_line() {
        for (text, begin, part) in [
            ("1\n0,5\n", "line 2: `0,5` is not a number", "point"),
            ("1\n2\nNaN\n", "line 3: NaN", "finite"),
            ("1\n2\ninf\n", "line 3: inf", "finite"),
            ("1\n2\n-Infinity\n", "line 3: -Infinity", "finite"),
            ("1\n2\n1e99\n", "line 3: 1e99", "finite"),
            ("1\n\n2\n", "line 2: blank, but numbers follow", "one number a line"),
            ("1 2\n", "line 1: `1 2` is not", "one number a line"),
            ("\n\n", "it holds no numbers", "record again"),
        ] {
            let said = parse(text.as_bytes()).unwrap_err();
            assert!(said.starts_with(begin) && said.contains(part), "{said}");
        }
    }
}
