//! Past scans as CSV, with a header line and then one line per scan.

use std::io::Write;

use serde::Serialize;
use serde_json::Value;

/// The columns. They are fields of an answer, its correction and its trial; lists have semicolons.
const COLUMNS: &str = "id unix_ms scan state surface nearest reasons confidence fit margin scan_s \
                       settled_s latency_ms lost_samples truth sources spoiled correction became";

/// Writes scans as CSV (RFC 4180).
pub struct CsvWriter<W: Write> {
    out: ::csv::Writer<W>,
    columns: Vec<&'static str>,
}

impl<W: Write> CsvWriter<W> {
    /// Writes the header line.
    pub fn new(out: W) -> std::io::Result<Self> {
        Self::with(out, COLUMNS.split(' ').collect())
    }

    /// Like [`CsvWriter::new`], for scans of many stations, with the station and without corrections.
    pub fn of_stations(out: W) -> std::io::Result<Self> {
        let said = |column: &&str| *column != "correction" && *column != "became";
        Self::with(
            out,
            "station sequence".split(' ').chain(COLUMNS.split(' ')).filter(said).collect(),
        )
    }

    fn with(out: W, columns: Vec<&'static str>) -> std::io::Result<Self> {
        let mut out = ::csv::Writer::from_writer(out);
        out.write_record(&columns)?;
        Ok(Self { out, columns })
    }

    /// Adds a scan, given as a [`super::HistoryRow`] or as its JSON with the fields of a fleet.
    pub fn scan(&mut self, scan: &impl Serialize) -> std::io::Result<()> {
        let scan = serde_json::to_value(scan)?;
        self.out.write_record(self.columns.iter().map(|column| cell(&scan, column)))?;
        Ok(())
    }

    /// Flushes, and returns the inner writer.
    pub fn finish(self) -> std::io::Result<W> {
        self.out.into_inner().map_err(::csv::IntoInnerError::into_error)
    }
}

fn cell(scan: &Value, column: &str) -> String {
    let (value, text) = match column {
        "nearest" => (&scan["ranked"][0]["surface"], None),
        "correction" => match text(&scan["correction"]["was"]).as_str() {
            "surface" | "" => (&scan["correction"]["surface"], None),
            other => (&Value::Null, Some(format!("({other})"))),
        },
        column => (&scan[column], None),
    };
    let text = text.unwrap_or_else(|| self::text(value));
    // A quote is put before a text that a spreadsheet would run as a formula.
    match !value.is_number() && text.starts_with(['+', '-', '=', '@', '\t', '\r']) {
        true => format!("'{text}"),
        false => text,
    }
}

fn text(value: &Value) -> String {
    match value {
        Value::Null => String::new(),
        Value::String(text) => text.clone(),
        Value::Array(list) => list.iter().map(text).collect::<Vec<_>>().join("; "),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scan_is_a_line_whatever_its_texts_hold() {
        let scan = serde_json::json!({
            "id": "x", "surface": "oak, \"sanded\"", "reasons": ["a", "b"], "scan_s": 1.5,
            "ranked": [{"surface": "oak"}], "correction": {"was": "unknown"},
        });
        let mut writer = CsvWriter::new(Vec::new()).unwrap();
        writer.scan(&scan).unwrap();
        let text = String::from_utf8(writer.finish().unwrap()).unwrap();
        let line = text.lines().nth(1).unwrap();
        let cells = serde_json::json!({
            "surface": "=1+1", "margin": -1.5, "truth": "@x", "sources": ["+a"], "became": "-b",
        });
        assert_eq!(cell(&cells, "surface"), "'=1+1");
        let others = ["margin", "truth", "sources", "became"].map(|column| cell(&cells, column));
        assert_eq!(others, ["-1.5", "'@x", "'+a", "'-b"]);
        assert_eq!(line, "x,,,,\"oak, \"\"sanded\"\"\",oak,a; b,,,,1.5,,,,,,,(unknown),");
    }
}
