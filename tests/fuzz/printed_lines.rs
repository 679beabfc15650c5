//! Prints numbers in a form that arbitrary bytes choose, and checks what comes back: the numbers as
//! they were printed, or none. For the fuzz target and the property tests.

use surfaced::device::lines::{Column, LinesEvent, LinesIntake, LinesStream, Survey};
use surfaced::scene::SourceId;

const AROUND: [(&str, &str); 9] = [
    ("", ""),
    ("(", ")"),
    ("[", "]"),
    ("{", "}"),
    ("/* ", " */"),
    ("$", ";"),
    ("\"", "\""),
    ("", ","),
    ("\u{1b}[32m", "\u{1b}[0m\r"),
];
const BETWEEN: [&str; 8] = [",", ";", "\t", " ", ", ", "; ", "  ", " \t"];
const NAMES: [[&str; 3]; 6] = [
    ["", "", ""],
    ["x:", "y:", "z:"],
    ["x=", "y=", "z="],
    ["a b: ", "c: ", "d: "],
    ["\"x\":", "\"y\":", "\"z\":"],
    [">x:", ">y:", ">z:"],
];
const UNITS: [&str; 5] = ["", "g", "%", " m/s^2", "°C"];
/// Lines that are no rows.
const OTHERS: [&str; 4] = ["x,y,z", "boot: done", "E (30) wifi: error 5", "\u{1}\u{2}"];

/// Most columns that a line may have.
const MOST_COLUMNS: usize = 512;

/// Feeds bytes as they are, then the numbers that they hold in the form that they choose.
pub fn check(bytes: &[u8]) {
    feed(bytes);
    if let Some((form, numbers)) = bytes.split_first_chunk::<6>() {
        print(form, numbers);
    }
}

fn feed(bytes: &[u8]) {
    let columns = vec![Column::Place(1), Column::Place(2)];
    let id = SourceId::new("x").expect("letters name a source");
    let stream = LinesStream { id, columns, scale: Some(1.0) };
    let mut intake = LinesIntake::new(vec![stream], None, 100.0);
    intake.feed(bytes, 0.0, |event| match event {
        LinesEvent::Frames { samples, .. } => {
            assert!(samples.len().is_multiple_of(2) && samples.iter().all(|x| x.is_finite()));
        }
        LinesEvent::Missing(_) => {}
    });
    let mut survey = Survey::new(true, None);
    for (at, part) in bytes.chunks(50).enumerate() {
        survey.feed(part, at as f64 * 0.1);
    }
    assert!(survey.columns().len() <= MOST_COLUMNS + 1);
    let _ = (survey.remarks(), survey.problem(), survey.rate_hz(), survey.measuring());
}

fn print(form: &[u8; 6], bytes: &[u8]) {
    let pick = |at: usize, of: usize| usize::from(form[at]) % of;
    let (open, close) = AROUND[pick(0, AROUND.len())];
    let (between, names) = (BETWEEN[pick(1, BETWEEN.len())], NAMES[pick(2, NAMES.len())]);
    let (unit, style) = (UNITS[pick(3, UNITS.len())], pick(4, 5));
    // Commas that separate and are decimal at once have two readings.
    let comma = style == 3 && !between.starts_with(',') && close != ",";
    let number = |x: f64| match style {
        0 => format!("{x:+.2}"),
        1 => format!("{x:.4e}"),
        2 => format!("{:.0}", x * 100.0),
        3 if comma => format!("{x:.2}").replace('.', ","),
        _ => format!("{x:8.2}"),
    };
    let one_a_line = names[0].starts_with('>');
    let (mut text, mut rows) = (String::new(), Vec::new());
    for (i, six) in bytes.chunks_exact(6).enumerate() {
        let scale = if style == 2 { 1.0 } else { 0.01 };
        let row = [0, 2, 4].map(|at| i16::from_le_bytes([six[at], six[at + 1]]));
        let printed = row.map(|x| number(f64::from(x) / 100.0));
        rows.push(row.map(|x| (f64::from(x) * scale) as f32));
        let cells = [0, 1, 2].map(|at| format!("{}{}{unit}", names[at], printed[at]));
        match one_a_line {
            true => cells.iter().for_each(|cell| text += &format!("{cell}\n")),
            false => text += &format!("{open}{}{close}\n", cells.join(between)),
        }
        if form[5] < 128 && i % 3 == 2 {
            text += OTHERS[pick(5, OTHERS.len())];
            text.push('\n');
        }
    }
    let columns = [1, 2, 3].map(Column::Place).to_vec();
    let id = SourceId::new("x").expect("letters name a source");
    let stream = LinesStream { id, columns, scale: Some(1.0) };
    let mut intake = LinesIntake::new(vec![stream], None, 100.0);
    let mut got = Vec::new();
    intake.feed(text.as_bytes(), 0.0, |event| {
        if let LinesEvent::Frames { samples, .. } = event {
            got.extend(samples.chunks(3).map(<[f32]>::to_vec));
        }
    });
    // Each row is one that was printed, in the order in which they were printed.
    let near = |a: f32, b: f32| (a - b).abs() <= 1e-5 * b.abs();
    let mut left = rows.iter();
    for row in &got {
        let printed = left.any(|printed| row.iter().zip(printed).all(|(a, b)| near(*a, *b)));
        assert!(printed, "{row:?} was never printed, in: {text}");
    }
    assert!(
        comma || rows.len() < 8 || got.len() + 1 >= rows.len(),
        "{} of {} rows came, in: {text}",
        got.len(),
        rows.len()
    );
}
