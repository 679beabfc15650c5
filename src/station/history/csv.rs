//! Past scans as CSV, with a header line and then one line per scan.

use std::io::{self, Write};

use serde_json::Value;

/// The columns for one station: fields of an answer, its correction and its trial.
pub const COLUMNS: &str = "id unix_ms scan state surface nearest reasons confidence fit margin scan_s \
                       settled_s latency_ms lost_samples truth sources spoiled correction became \
                       p_value doubts begin_s corrected_by became_by";

/// The columns for many stations, with the station and without corrections.
pub const STATION_COLUMNS: &str = "station sequence id unix_ms scan state surface nearest reasons \
                                   confidence fit margin scan_s settled_s latency_ms lost_samples \
                                   truth sources spoiled p_value doubts begin_s";

/// Writes scans, given as JSON, as CSV (RFC 4180). Items of lists are separated by semicolons.
pub fn write_csv(
    out: impl Write,
    columns: &str,
    scans: impl Iterator<Item = io::Result<Value>>,
) -> io::Result<()> {
    let mut out = ::csv::Writer::from_writer(out);
    out.write_record(columns.split(' '))?;
    for scan in scans {
        let scan = scan?;
        out.write_record(columns.split(' ').map(|column| cell(&scan, column)))?;
    }
    out.flush()
}

fn cell(scan: &Value, column: &str) -> String {
    let text = match column {
        "nearest" => text(&scan["ranked"][0]["surface"]),
        "correction" => match text(&scan["correction"]["was"]).as_str() {
            "surface" | "" => text(&scan["correction"]["surface"]),
            other => format!("({other})"),
        },
        "corrected_by" => text(&scan["correction"]["person"]),
        "doubts" => kinds(&scan["doubts"]),
        column => text(&scan[column]),
    };
    // A quote is put before a text that a spreadsheet would run as a formula.
    match !scan[column].is_number() && text.starts_with(['+', '-', '=', '@', '\t', '\r']) {
        true => format!("'{text}"),
        false => text,
    }
}

/// The kinds of the doubts about a scan; scans of older versions have none.
fn kinds(doubts: &Value) -> String {
    let kinds = doubts.as_array().into_iter().flatten().filter_map(|doubt| doubt["kind"].as_str());
    kinds.collect::<Vec<_>>().join("; ")
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
            "ranked": [{"surface": "oak"}], "correction": {"was": "unknown", "person": "anna"},
            "became_by": "ben",
            "doubts": [{"kind": "clipped", "text": "a"}, {"kind": "too_short"}],
        });
        let mut text = Vec::new();
        write_csv(&mut text, COLUMNS, [Ok(scan)].into_iter()).unwrap();
        let text = String::from_utf8(text).unwrap();
        let line = text.lines().nth(1).unwrap();
        let cells = serde_json::json!({
            "surface": "=1+1", "margin": -1.5, "truth": "@x", "sources": ["+a"], "became": "-b",
        });
        assert_eq!(cell(&cells, "surface"), "'=1+1");
        let others = ["margin", "truth", "sources", "became"].map(|column| cell(&cells, column));
        assert_eq!(others, ["-1.5", "'@x", "'+a", "'-b"]);
        assert_eq!(
            line,
            "x,,,,\"oak, \"\"sanded\"\"\",oak,a; b,,,,1.5,,,,,,,(unknown),,,clipped; too_short,,anna,ben"
        );
    }
}
