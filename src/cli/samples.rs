//! CSV files of samples: rows are samples, columns are channels, no header.

use std::path::Path;

use ndarray::Array2;

use super::Failure;

/// Reads samples, shape (rows, columns).
///
/// # Errors
/// With file and line, if the file cannot be read, holds nothing, has rows of different lengths,
/// or a field is not a finite number.
pub fn read(path: &Path) -> Result<Array2<f64>, Failure> {
    let failed = |problem: String| Failure::Failed(format!("{}: {problem}", path.display()));
    let text = std::fs::read_to_string(path).map_err(|error| failed(error.to_string()))?;
    let (mut values, mut columns, mut rows) = (Vec::new(), 0, 0);
    for (at, line) in text.lines().enumerate() {
        let line = line.trim_start_matches('\u{feff}').trim();
        if line.is_empty() {
            continue;
        }
        let at = at + 1;
        let before = values.len();
        for field in line.split([',', ';', '\t']) {
            match field.trim().parse::<f64>() {
                Ok(x) if x.is_finite() => values.push(x),
                _ => {
                    return Err(failed(format!(
                        "line {at}: `{}` is no finite number; expected one sample a line, a \
                         column a channel, a point for decimals, no header",
                        field.trim()
                    )));
                }
            }
        }
        let found = values.len() - before;
        if rows == 0 {
            columns = found;
        } else if found != columns {
            return Err(failed(format!(
                "line {at}: {found} column(s), but {columns} in the lines before"
            )));
        }
        rows += 1;
    }
    if rows == 0 {
        return Err(failed("no samples; expected one a line".into()));
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
        "{} has {} column(s), but {} has {}; samples of one source have the same channels",
        a_path.display(),
        a.ncols(),
        b_path.display(),
        b.ncols()
    )))
}
