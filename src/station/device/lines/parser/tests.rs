use super::*;
use proptest::prelude::*;

/// Parses bytes, and returns the debug text of each completed line.
fn lines(parser: &mut LineParser, bytes: &[u8]) -> Vec<String> {
    let mut out = Vec::new();
    parser.feed(bytes, |_, line| out.push(format!("{line:?}")));
    out
}

fn rows(text: &str) -> Vec<Vec<f64>> {
    let mut out = Vec::new();
    LineParser::default().feed(text.as_bytes(), |_, line| match line {
        Line::Row(row) => out.push(row.to_vec()),
        Line::Header(_) => {}
        other => panic!("{text:?}: {other:?}"),
    });
    out
}

#[test]
fn every_usual_separator_is_understood() {
    for text in ["1;-2.5;3E-2\r\n", "1\t-2.5\t.03\r", " 1  -2.5 +0.03 \n", "1 ; -2.5 ;\t3e-2\n"] {
        assert_eq!(rows(text), [[1.0, -2.5, 0.03]], "{text:?}");
    }
    assert_eq!(rows("9:30:00.250,1\n\0\n\09:30:00.500,2\n"), [[34_200.25, 1.0], [34_200.5, 2.0]]);
    assert_eq!(rows(&"\u{2}-12.5 g\u{3}\r\n".repeat(4)), [[-12.5]; 4]);
    let apart = rows("500 - 511 - 920\n").concat();
    assert_eq!(
        apart.into_iter().filter(|x| !x.is_nan()).collect::<Vec<_>>(),
        [500.0, 511.0, 920.0]
    );
    assert_eq!(rows("+ 1 - 2 + 3\n"), [[1.0, -2.0, 3.0]]);
    // Lines with words must come often enough to be no log.
    assert!(rows(&"ax:1 ay:2\n".repeat(3)).is_empty());
    assert_eq!(rows(&"ax:1 ay:2\n\n\r\n".repeat(4)), [[1.0, 2.0]; 4]);
}

#[test]
fn numbers_out_of_range_and_missing_values_are_no_header() {
    // No exponent is too large to be read.
    let row = &rows("1.5e-99999999999,-1e99999999999,0e99999999999\n")[0];
    assert!(row[0] == 0.0 && row[1].is_nan() && row[2] == 0.0, "{row:?}");
    // Missing values in all fields are a row of a failing sensor, not a header.
    assert!(rows("nan,nan\n")[0].iter().all(|x| x.is_nan()));
}

#[test]
fn a_header_is_words_alone() {
    let mut parser = LineParser::default();
    assert_eq!(lines(&mut parser, b"\"t\",ax, ay\n"), ["Header([\"t\", \"ax\", \"ay\"])"]);
    assert_eq!(lines(&mut parser, b"# ax ay\n"), ["Header([\"ax\", \"ay\"])"]);
    assert_eq!(lines(&mut parser, b"Ready in a moment ...\n"), ["Words"]);
    assert_eq!(lines(&mut parser, b"\x00\xff\x13\n\xfe,??\n"), ["Garbage", "Garbage"]);
}

#[test]
fn a_list_of_names_names_a_list_of_numbers() {
    let mut parser = LineParser::default();
    let text = "Yaw, Pitch, Roll: 181.5, -4.5, 20\n".repeat(5);
    let found = lines(&mut parser, text.as_bytes());
    assert_eq!(found[found.len() - 6..][0], "Header([\"Yaw\", \"Pitch\", \"Roll\"])", "{found:?}");
    assert_eq!(found[found.len() - 1], "Row([181.5, -4.5, 20.0])");
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
        let out: Vec<_> = flood.chunks(bytes).flat_map(|part| lines(&mut parser, part)).collect();
        assert_eq!(out, ["TooLong", "Row([1.0, 2.0])"]);
    }
    assert!(parser.line.capacity() <= 2 * LONGEST_LINE);
}

proptest! {
    #[test]
    fn numbers_come_out_as_they_were_written_however_the_bytes_are_cut(
        (width, numbers) in (1usize..6, prop::collection::vec(-1e9..1e9f64, 0..100)),
        mark in prop::sample::select(vec![",", ";", "\t", " ", ", "]),
        cut in 1usize..40,
    ) {
        let line = |row: &Vec<f64>| {
            row.iter().map(f64::to_string).collect::<Vec<_>>().join(mark) + "\n"
        };
        let table: Vec<_> = numbers.chunks_exact(width).map(<[f64]>::to_vec).collect();
        let text: String = table.iter().map(line).collect();
        let (mut parser, mut got) = (LineParser::default(), Vec::new());
        for part in text.as_bytes().chunks(cut) {
            parser.feed(part, |_, line| match line {
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
