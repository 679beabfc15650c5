//! Reads small CSV tables of numbers as they are: samples to compare, and tables of features. Recordings
//! in tables are read by [`super::tables`].

use std::path::Path;

use ndarray::Array2;

use crate::library::{LibraryError, files};
use crate::printable::counted;

/// A row of a table: its line number in the file, and its cells.
pub(crate) type NumberedRow = (u64, Vec<String>);

pub struct CsvTable {
    /// Names of the columns; `1`, `2`, … if the file does not name them.
    pub header: Vec<String>,
    pub rows: Vec<NumberedRow>,
    /// Whether a comma may be the decimal mark: true unless commas separate the columns.
    comma: bool,
}

impl CsvTable {
    /// Reads a table, whose columns commas, semicolons, tabs or spaces separate.
    pub fn read(path: &Path) -> Result<Self, LibraryError> {
        let bytes = files::read_bytes(path, files::MOST_TEXT)?;
        Self::parse(&bytes, false).map_err(LibraryError::at(path))
    }

    /// The first line names the columns if `named` is true, or if none of its cells is a number.
    pub(crate) fn parse(bytes: &[u8], named: bool) -> Result<Self, String> {
        let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
        let first = bytes.split(|&byte| byte == b'\n').find(|line| !line.trim_ascii().is_empty());
        let first = first.unwrap_or_default();
        let delimiter = [b';', b'\t', b',', b' '].into_iter().find(|mark| first.contains(mark));
        let delimiter = delimiter.unwrap_or(b',');
        let mut reader = csv::ReaderBuilder::new()
            .flexible(true)
            .has_headers(false)
            .delimiter(delimiter)
            .trim(csv::Trim::All)
            .from_reader(bytes);
        let mut table = Self { header: Vec::new(), rows: Vec::new(), comma: delimiter != b',' };
        for record in reader.records() {
            let record = record.map_err(|error| error.to_string())?;
            let line = line_of(bytes, &record);
            let cells: Vec<String> = record.iter().map(String::from).collect();
            if cells.iter().all(String::is_empty) {
                continue;
            }
            if table.header.is_empty() {
                if named || cells.iter().all(|cell| table.number(cell).is_none()) {
                    table.header = cells;
                    continue;
                }
                table.header = (1..=cells.len()).map(|column| column.to_string()).collect();
            }
            let (found, expected) = (cells.len(), table.header.len());
            if found != expected {
                let found = counted(found, "column");
                return Err(format!("line {line} has {found}; the first has {expected}"));
            }
            table.rows.push((line, cells));
        }
        match table.rows.is_empty() {
            true => Err("it holds no rows of numbers; expected a line for each sample".into()),
            false => Ok(table),
        }
    }

    fn number(&self, cell: &str) -> Option<f64> {
        let plain = cell.parse::<f64>().ok();
        plain.or_else(|| self.comma.then(|| cell.replace(',', ".").parse().ok()).flatten())
    }

    pub(crate) fn value(&self, (line, cells): &NumberedRow, column: usize) -> Result<f64, String> {
        let name = &self.header[column];
        self.number(&cells[column]).filter(|value| value.is_finite()).ok_or_else(|| {
            format!("line {line}, column `{name}`: `{}` is not a finite number", cells[column])
        })
    }

    /// All cells as finite numbers, shape (rows, columns).
    pub fn values(&self) -> Result<Array2<f64>, String> {
        let (rows, columns) = (self.rows.len(), self.header.len());
        let cells =
            self.rows.iter().flat_map(|row| (0..columns).map(move |at| self.value(row, at)));
        let values = cells.collect::<Result<Vec<f64>, String>>()?;
        // This cannot fail: `parse` checked that all rows have the same number of columns.
        Ok(Array2::from_shape_vec((rows, columns), values).expect("rows of equal length"))
    }
}

/// The line number, from 1 on, of a row of a CSV text. If blank lines precede the row, the crate
/// `csv` gives the number of the first blank line instead.
fn line_of(text: &[u8], row: &csv::StringRecord) -> u64 {
    let Some(start) = row.position() else { return 0 };
    let after = text.get(start.byte() as usize..).unwrap_or_default();
    let blank = after.iter().take_while(|byte| matches!(byte, b'\r' | b'\n'));
    start.line() + blank.filter(|byte| **byte == b'\n').count() as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_may_be_separated_in_any_way_and_blank_lines_do_not_count() {
        for text in ["1,2\n3,4\n", "1; 2\n\n3;4", "\u{feff}1\t2\r\n3\t4\r\n  \n"] {
            let samples = CsvTable::parse(text.as_bytes(), false).unwrap().values().unwrap();
            assert_eq!(samples, ndarray::array![[1.0, 2.0], [3.0, 4.0]], "{text:?}");
        }
        for (text, part) in [
            ("1,2\n\n3,x\n", "line 3, column `2`: `x` is not a finite number"),
            ("1,2\n3\n", "line 2 has 1 column; the first has 2"),
            ("1,2\n3,\n", "line 2, column `2`: `` is not"),
            ("\n\n", "no rows"),
        ] {
            let said = CsvTable::parse(text.as_bytes(), false).and_then(|table| table.values());
            assert!(said.as_ref().unwrap_err().contains(part), "{text:?}: {said:?}");
        }
    }
}
