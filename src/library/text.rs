//! Reads text files: one file for each channel, with one number in each line.

use std::path::{Path, PathBuf};

use super::{LibraryError, files};
use crate::trial::Series;

/// Reads one file for each channel, and crops all to the shortest.
///
/// # Errors
/// If a file cannot be read, is empty, or holds a line that is not one finite number.
pub(crate) fn read(paths: &[PathBuf], rate_hz: f64) -> Result<Series, LibraryError> {
    let columns = paths.iter().map(|path| column(path)).collect::<Result<Vec<_>, _>>()?;
    let frames = columns.iter().map(Vec::len).min().unwrap_or(0);
    let mut samples = Vec::with_capacity(frames * columns.len());
    for frame in 0..frames {
        samples.extend(columns.iter().map(|column| column[frame]));
    }
    let path = paths.first().cloned().unwrap_or_default();
    Series::new(rate_hz, columns.len(), samples)
        .map_err(|error| LibraryError::Signal { path, error })
}

/// The number of frames that [`read`] would give: the non-blank lines of the shortest file.
///
/// # Errors
/// If a file cannot be read or is empty.
pub(crate) fn frames(paths: &[PathBuf]) -> Result<usize, LibraryError> {
    let lines = |path: &PathBuf| -> Result<usize, LibraryError> {
        let bytes = files::read_bytes(path, files::MOST_TEXT)?;
        let lines = bytes.split(|&byte| byte == b'\n');
        Ok(lines.filter(|line| !line.trim_ascii().is_empty()).count())
    };
    let lengths = paths.iter().map(lines).collect::<Result<Vec<_>, _>>()?;
    Ok(lengths.into_iter().min().unwrap_or(0))
}

fn column(path: &Path) -> Result<Vec<f32>, LibraryError> {
    let bytes = files::read_bytes(path, files::MOST_TEXT)?;
    parse(&bytes).map_err(|(line, problem)| {
        LibraryError::file(
            path,
            if line == 0 { problem } else { format!("line {line}: {problem}") },
        )
    })
}

/// The numbers of a text, one a line; blank lines may only stand at the end.
///
/// Errors carry the line, counted from 1, or 0 for the text as a whole.
fn parse(bytes: &[u8]) -> Result<Vec<f32>, (usize, String)> {
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
            return Err((line, "blank, but numbers follow; expected one number a line".into()));
        }
        let number = std::str::from_utf8(text).ok().and_then(|text| text.parse::<f64>().ok());
        match number.map(|number| number as f32) {
            Some(number) if number.is_finite() => numbers.push(number),
            Some(_) => {
                let what = String::from_utf8_lossy(text);
                return Err((
                    line,
                    format!(
                        "{what}; expected a finite number (a broken cable gives such values: check \
                     the connector, then record again or remove the file)"
                    ),
                ));
            }
            None => return Err((line, not_a_number(text))),
        }
    }
    if numbers.is_empty() {
        return Err((0, "it holds no numbers; record again, or remove the file".into()));
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

    fn error(text: &str) -> (usize, String) {
        parse(text.as_bytes()).unwrap_err()
    }

    #[test]
    fn spaces_line_ends_and_a_blank_last_line_do_not_matter() {
        let text = b"\xef\xbb\xbf  1.5\r\n-2e-1\t\r\n3\n\n";
        assert_eq!(parse(text).unwrap(), [1.5, -0.2, 3.0]);
        assert_eq!(parse(b"1\n2").unwrap(), [1.0, 2.0]);
    }

    #[test]
    fn a_comma_is_named_with_its_line() {
        let (line, problem) = error("1\n0,5\n");
        assert_eq!(line, 2);
        assert!(
            problem.contains("`0,5` is not a number") && problem.contains("point"),
            "{problem}"
        );
    }

    #[test]
    fn what_is_not_finite_is_named_with_its_line() {
        for bad in ["NaN", "inf", "-Infinity", "1e99"] {
            let (line, problem) = error(&format!("1\n2\n{bad}\n"));
            assert_eq!(line, 3);
            assert!(problem.starts_with(bad) && problem.contains("finite"), "{problem}");
        }
    }

    #[test]
    fn a_gap_and_a_second_number_are_refused() {
        assert_eq!(
            error("1\n\n2\n"),
            (2, "blank, but numbers follow; expected one number a line".into())
        );
        assert!(error("1 2\n").1.contains("one number a line"));
    }

    #[test]
    fn blank_text_holds_no_numbers() {
        assert_eq!(error("\n\n").0, 0);
    }
}
