//! Variables of MATLAB as trials: in both byte orders, packed or not, and files that are damaged or lie.

use std::io::Write;

use surfaced::trial::Signal;

use crate::array_forms::{assert_trials, at};
use crate::common::says;
use crate::table_forms::import;

/// An element of a file: its tag, its content, and what fills it up.
fn element(kind: u32, content: &[u8], is_big: bool) -> Vec<u8> {
    let tag = [kind, content.len() as u32].map(|x| word(x, is_big)).concat();
    [&tag[..], content, &vec![0; content.len().next_multiple_of(8) - content.len()]].concat()
}

fn word(x: u32, is_big: bool) -> [u8; 4] {
    if is_big { x.to_be_bytes() } else { x.to_le_bytes() }
}

/// A variable of a class, whose content are elements.
fn matrix(flags: u32, shape: &[i32], name: &str, content: &[u8], is_big: bool) -> Vec<u8> {
    let shape: Vec<u8> = shape.iter().flat_map(|x| word(*x as u32, is_big)).collect();
    let flags = [word(flags, is_big), [0; 4]].concat();
    let said = [(6, &flags[..]), (5, &shape), (1, name.as_bytes())];
    let said = said.map(|(kind, bytes)| element(kind, bytes, is_big)).concat();
    element(14, &[&said, content].concat(), is_big)
}

fn packed(variable: &[u8]) -> Vec<u8> {
    let mut packer = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    packer.write_all(variable).unwrap();
    let packed = packer.finish().unwrap();
    [&15_u32.to_le_bytes(), &(packed.len() as u32).to_le_bytes(), &packed[..]].concat()
}

fn file(variables: &[Vec<u8>], is_big: bool) -> Vec<u8> {
    let order: &[u8] = if is_big { b"\x01\x00MI" } else { b"\x00\x01IM" };
    [&format!("{:124}", "MATLAB 5.0 MAT-file").into_bytes(), order, &variables.concat()].concat()
}

/// Three trials of two channels of 40 samples, stored as int16, column by column.
fn trials(class: u32, name: &str, is_big: bool) -> Vec<u8> {
    let numbers = (0..40).flat_map(|r| (0..2).flat_map(move |c| (0..3).map(move |t| at(t, c, r))));
    let bytes = numbers.flat_map(|x| if is_big { x.to_be_bytes() } else { x.to_le_bytes() });
    let numbers = element(3, &bytes.collect::<Vec<u8>>(), is_big);
    matrix(class, &[3, 2, 40], name, &numbers, is_big)
}

/// The file of damaged bytes in `table_forms`.
pub(crate) fn sample() -> Vec<u8> {
    file(&[trials(6, "X", false), packed(&trials(6, "Y", false))], false)
}

#[test]
fn variables_of_matlab_are_trials() {
    let letters = |text: &str| text.bytes().flat_map(|byte| [0, byte]).collect::<Vec<u8>>();
    // Of `["oak"; "ash"; "oak"]`, MATLAB writes the columns.
    let words = matrix(4, &[3, 3], "y", &element(4, &letters("oaoasakhk"), true), true);
    let scans = file(&[trials(6, "X", true), words], true);
    let rate = matrix(6, &[1, 1], "fs", &element(4, &[100, 0], false), false);
    let plain = file(&[rate, packed(&trials(7, "X", false))], false);
    let both = file(&[trials(6, "X", false), trials(6, "Z", false)], false);
    for (name, bytes, args, keys) in [
        ("oak/1.mat", &plain, &[][..], ["oak 1", "oak 2", "oak 3"]),
        ("oak/1.mat", &both, &["--variable", "Z"], ["oak 1", "oak 2", "oak 3"]),
        ("all.MAT", &scans, &["--labels", "y"], ["ash 1", "oak 1", "oak 2"]),
    ] {
        assert_trials((name, bytes, args), keys);
    }
    says(&import("oak/1.mat", &both, &["--rate", "9"]).said(), &["`X` (3×2×40 double), `Z` (3×2×"]);
}

/// Trials of unequal lengths, by scipy 1.17 (`X` is an array of objects; `s` a struct):
/// `savemat("cells.mat", {"X": [x[:, :30 + t].astype("float32") for t, x in enumerate(trials)],
/// "y": ["oak", "ash", "oak"], "s": {"a": 1}}, do_compression=True)`, with the numbers of [`at`].
#[test]
fn cells_of_matlab_are_trials_of_their_own_lengths() {
    let bytes = include_bytes!("../fixtures/cells.mat");
    let imported = import("all.mat", bytes, &["--rate", "100", "--labels", "y"]);
    let entries = imported.library().entries;
    let frames = entries.iter().map(|entry| {
        let trial = entry.load().unwrap();
        let Signal::Series(series) = &trial.signals["sensor"] else { panic!("no series") };
        let last = series.samples()[series.samples().len() - 1];
        (entry.key.surface.clone(), series.frames(), last)
    });
    let right = [("ash", 31, at(1, 1, 30)), ("oak", 30, at(0, 1, 29)), ("oak", 32, at(2, 1, 31))];
    let right = right.map(|(name, frames, last)| (name.to_string(), frames, f32::from(last)));
    assert_eq!(frames.collect::<Vec<_>>(), right, "{}", imported.said());
    let refused = import("oak/1.mat", bytes, &["--rate", "9", "--variable", "s"]);
    says(&refused.said(), &["`s` is a struct", "`X = {s.data}`"]);
}

#[test]
fn files_of_matlab_that_are_damaged_or_lie_are_refused_by_name() {
    let of = |variable: Vec<u8>| file(&[variable], false);
    let numbers = |count: usize| element(9, &vec![0; 8 * count], false);
    let plain = |shape: &[i32], count| of(matrix(6, shape, "x", &numbers(count), false));
    let one = matrix(6, &[2, 40], "", &numbers(80), false);
    let other = matrix(6, &[3, 40], "", &numbers(120), false);
    let cells = |count, content: &[u8]| of(matrix(1, &[1, count], "x", content, false));
    let deep = (0..5000).fold(one.clone(), |within, _| matrix(1, &[1, 1], "", &within, false));
    // A header that claims 4 GB, and another one of 2^60 elements.
    let mut long = plain(&[2, 40], 80);
    long[132..136].fill(0xff);
    for (bytes, part) in [
        (sample()[..400].to_vec(), "truncated"),
        (sample()[..100].to_vec(), "truncated"),
        (long[..700].to_vec(), "truncated"),
        (plain(&[1 << 30, 1 << 30], 80), "elements in 640 bytes"),
        (plain(&[2, -40], 80), "its dimensions"),
        (plain(&[2, 2, 2, 10], 80), "4 dimensions"),
        (plain(&[40, 2], 80), "turn the array"),
        (of(matrix(0x806, &[2, 40], "x", &numbers(80), false)), "it has no array of trials"),
        (cells(2, &[one.clone(), other].concat()), "cell 2: it has 3 channels"),
        (cells(1 << 30, &one), "cell 2: truncated"),
        (cells(1, &deep), "it has no array of trials; it has `x` (1×1 cell); save numbers"),
        (of(packed(&packed(&one))), "a variable was expected"),
        (b"MATLAB 7.3 MAT-file, Platform: GLNXA64".to_vec(), "`save -v7`"),
        (b"\0\0\0\0\x02\0\0\0\x28\0\0\0".to_vec(), "v4"),
    ] {
        let said = import("oak/1.mat", &bytes, &["--rate", "9"]).said();
        says(&said, &[part]);
    }
}

#[test]
fn a_variable_unpacks_to_at_most_max_gb() {
    // Twelve trials of 128 MiB, all zeros.
    let mut packer = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    let claimed = |kind: u32, size: u64| [kind, size as u32].map(u32::to_le_bytes).concat();
    let cell = matrix(6, &[1, 1 << 24], "", &element(9, &vec![0; 1 << 27], false), false);
    packer.write_all(&claimed(14, 12 * cell.len() as u64 + 48)).unwrap();
    let start = matrix(1, &[1, 12], "x", &[], false);
    packer.write_all(&start[8..]).unwrap();
    (0..12).for_each(|_| packer.write_all(&cell).unwrap());
    let packed = packer.finish().unwrap();
    let bytes = file(&[[claimed(15, packed.len() as u64), packed].concat()], false);
    let args = ["--rate", "9", "--max-gb", "1", "--dry-run"];
    says(&import("oak/1.mat", &bytes, &args).said(), &["--max-gb"]);
}
