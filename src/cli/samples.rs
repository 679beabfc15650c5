//! CSV files of samples: rows are samples, columns are channels, no header.

use std::path::Path;

use ndarray::Array2;

use super::Failure;
use crate::dataset::table::line_of;

/// Reads samples, shape (rows, columns), separated by commas, semicolons or tabs; blank lines are
/// skipped.
///
/// # Errors
/// With file and line, if the file cannot be read, holds nothing, has rows of different lengths,
/// or a field is not a finite number.
pub fn read(path: &Path) -> Result<Array2<f64>, Failure> {
    let failed = |problem: String| Failure::Failed(format!("{}: {problem}", path.display()));
    let text = std::fs::read(path).map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => failed("there is no such file; check the path".into()),
        _ => failed(error.to_string()),
    })?;
    parse(&text).map_err(failed)
}

fn parse(text: &[u8]) -> Result<Array2<f64>, String> {
    let separator = text.iter().copied().find(|byte| b",;\t\n".contains(byte));
    let separator = separator.filter(|byte| *byte != b'\n').unwrap_or(b',');
    let mut reader = csv::ReaderBuilder::new()
        .delimiter(separator)
        .has_headers(false)
        .flexible(true)
        .trim(csv::Trim::All)
        .from_reader(text);
    let (mut values, mut columns, mut rows) = (Vec::new(), 0, 0);
    for row in reader.records() {
        let row = row.map_err(|error| error.to_string())?;
        if row.iter().all(str::is_empty) && row.len() <= 1 {
            continue;
        }
        let line = line_of(text, &row);
        for field in &row {
            match field.parse::<f64>() {
                Ok(x) if x.is_finite() => values.push(x),
                _ => {
                    return Err(format!(
                        "line {line}: `{field}` is not a finite number; expected one sample a \
                         line, a column a channel, a point for decimals, no header"
                    ));
                }
            }
        }
        if rows == 0 {
            columns = row.len();
        } else if row.len() != columns {
            let found = counted(row.len());
            return Err(format!("line {line}: {found}, but {columns} in the lines before"));
        }
        rows += 1;
    }
    if rows == 0 {
        return Err("no samples; expected one a line".into());
    }
    // Each row was checked to have the same number of columns.
    Ok(Array2::from_shape_vec((rows, columns), values).expect("rows of equal length"))
}

/// Checks that two sets of samples can be compared.
///
/// # Errors
/// If they differ in their number of columns.
pub fn same_columns(
    (a_path, a): (&Path, &Array2<f64>),
    (b_path, b): (&Path, &Array2<f64>),
) -> Result<(), Failure> {
    if a.ncols() == b.ncols() {
        return Ok(());
    }
    Err(Failure::Failed(format!(
        "{} has {}, but {} has {}; samples of one source have the same channels",
        a_path.display(),
        counted(a.ncols()),
        b_path.display(),
        b.ncols()
    )))
}

fn counted(columns: usize) -> String {
    if columns == 1 { "1 column".into() } else { format!("{columns} columns") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commas_semicolons_and_tabs_separate_and_blank_lines_do_not_count() {
        for text in ["1,2\n3,4\n", "1; 2\n\n3;4", "\u{feff}1\t2\r\n3\t4\r\n  \n"] {
            let samples = parse(text.as_bytes()).unwrap();
            assert_eq!(samples, ndarray::array![[1.0, 2.0], [3.0, 4.0]], "{text:?}");
        }
        assert_eq!(parse(b"1\n2\n").unwrap().shape(), [2, 1]);
    }

    #[test]
    fn what_is_wrong_is_named_with_its_line() {
        for (text, part) in [
            ("1,2\n\n3,x\n", "line 3: `x` is not a finite number"),
            ("1,2\n3\n", "line 2: 1 column, but 2"),
            ("1,2\n3,\n", "line 2: `` is not"),
            ("\n\n", "no samples"),
        ] {
            let said = parse(text.as_bytes()).unwrap_err();
            assert!(said.contains(part), "{text:?}: {said}");
        }
    }
}
