//! Parquet files as tables: their columns by name, times to the nanosecond, labels of any text, and empty
//! cells. The fixture is the one that `fixtures/make_parquet.py` writes.

use crate::common::says;
use crate::table_forms::import;

const ROWS: &[u8] = include_bytes!("../fixtures/rows.parquet");

#[cfg(feature = "parquet")]
#[test]
fn rows_of_parquet_are_those_of_a_table() {
    use surfaced::trial::Signal;
    // Two of these columns rise evenly, as clocks do.
    let args = ["--surface", "material", "--trial", "run", "--source", "a=ax,ay,az"];
    let imported = import("all.parquet", ROWS, &args);
    let entries = imported.library().entries;
    let found: Vec<String> =
        entries.iter().map(|e| format!("{} {}", e.key.surface, e.key.number)).collect();
    assert_eq!(found, ["# oak 1", "ash, wet 2"], "{}", imported.said());
    says(&imported.said(), &["times are column `when`, in units of ns", "straight lines: 1 value"]);
    for (entry, first) in entries.iter().zip([0, 30]) {
        let trial = entry.load().unwrap();
        let Signal::Series(series) = &trial.signals["a"] else { panic!("no series") };
        assert_eq!((series.rate_hz(), series.frames()), (100.0, 30));
        for (row, frame) in (first..first + 30).zip(series.samples().chunks(3)) {
            let x = f64::from(row);
            let right = [x * 0.1, x / 3.0, f64::from(row * row % 997)].map(|x| x as f32);
            assert_eq!(frame[1..], right[1..], "row {row}");
            assert!((frame[0] - right[0]).abs() < 1e-6, "row {row}: {} {}", frame[0], right[0]);
        }
    }
    let about = surfaced::library::About::read(entries[0].places()[0]).unwrap();
    assert_eq!(about.started_at.as_deref(), Some("2023-11-14T22:13:20Z"));
    let bad = import("all.parquet", ROWS, &["--surface", "wood"]);
    says(&bad.said(), &["no column `wood`; its columns: when, material, run, ax, ay, az"]);
    says(&import("oak/1.parquet", &ROWS[..700], &args).said(), &["the Parquet file is damaged"]);
}

#[cfg(not(feature = "parquet"))]
#[test]
fn a_build_without_parquet_names_the_feature() {
    says(&import("oak/1.parquet", ROWS, &["--rate", "9"]).said(), &["--features parquet"]);
}

#[cfg(feature = "parquet")]
proptest::proptest! {
    #[test]
    fn no_damaged_parquet_file_breaks_the_reader(
        at in proptest::prelude::any::<proptest::sample::Index>(),
        with in proptest::collection::vec(proptest::prelude::any::<u8>(), 0..6),
    ) {
        let mut bytes = ROWS.to_vec();
        let start = at.index(bytes.len());
        bytes.splice(start..(start + with.len()).min(ROWS.len()), with);
        let kind = crate::table_forms::files::KINDS.iter().position(|kind| *kind == "parquet");
        crate::table_forms::files::read(&[&[kind.unwrap() as u8], &bytes[..]].concat());
    }
}
