//! Arrays of NumPy.

use std::io::Write;
use std::path::Path;

use crate::common::{says, write_file};
use crate::table_forms::{files, import};
use surfaced::trial::Signal;

fn npy(descr: &str, shape: &str, data: &[u8]) -> Vec<u8> {
    let header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n");
    [b"\x93NUMPY\x01\x00", &(header.len() as u16).to_le_bytes()[..], header.as_bytes(), data]
        .concat()
}

/// A ZIP file of stored or deflated members, as NumPy writes it.
fn npz(members: &[(&str, Vec<u8>)], deflate: bool) -> Vec<u8> {
    let (mut all, mut directory) = (Vec::new(), Vec::new());
    for (name, content) in members {
        let mut packer =
            flate2::write::DeflateEncoder::new(Vec::new(), flate2::Compression::fast());
        packer.write_all(content).unwrap();
        let packed = if deflate { packer.finish().unwrap() } else { content.clone() };
        let fields = [
            [20, 0, if deflate { 8 } else { 0 }, 0, 0].map(u16::to_le_bytes).concat(),
            [0, packed.len() as u32, content.len() as u32].map(u32::to_le_bytes).concat(),
            [name.len() as u16, 0].map(u16::to_le_bytes).concat(),
        ]
        .concat();
        let offset = all.len() as u32;
        directory.extend(
            [b"PK\x01\x02\x14\x00", &fields[..], &[0; 10], &offset.to_le_bytes(), name.as_bytes()]
                .concat(),
        );
        all.extend([b"PK\x03\x04", &fields[..], name.as_bytes(), &packed].concat());
    }
    let (start, size, count) = (all.len() as u32, directory.len() as u32, members.len() as u16);
    all.extend(directory);
    all.extend(
        [b"PK\x05\x06\0\0\0\0", &[count, count].map(u16::to_le_bytes).concat()[..]].concat(),
    );
    all.extend([size, start].map(u32::to_le_bytes).concat());
    all.extend([0, 0]);
    all
}

/// The sample in a row of a channel of a trial.
pub(crate) fn at(trial: usize, channel: usize, row: usize) -> i16 {
    (trial * 1000 + channel * 100 + row) as i16
}

/// Imports three trials of two channels of 40 samples at 100 Hz, which must have these surfaces and numbers.
pub(crate) fn assert_trials((name, bytes, args): (&str, &[u8], &[&str]), keys: [&str; 3]) {
    let imported = import(name, bytes, &[&["--rate", "100"], args].concat());
    let entries = imported.library().entries;
    let found: Vec<String> =
        entries.iter().map(|e| format!("{} {}", e.key.surface, e.key.number)).collect();
    assert_eq!(found, keys, "{}", imported.said());
    let trial = entries[2].load().unwrap();
    let Signal::Series(series) = &trial.signals["sensor"] else { panic!("no series") };
    let right = (0..40).flat_map(|row| [0, 1].map(|channel| f32::from(at(2, channel, row))));
    assert_eq!(series.samples(), right.collect::<Vec<_>>(), "{name}");
}

#[test]
fn arrays_of_numpy_are_trials() {
    // Three trials of two channels of 40 samples.
    let numbers: Vec<i16> =
        (0..3).flat_map(|t| (0..2).flat_map(move |c| (0..40).map(move |r| at(t, c, r)))).collect();
    let small = numbers.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
    let mut large: Vec<f64> = numbers.iter().map(|x| f64::from(*x)).collect();
    // A missing value, which a straight line fills rightly here.
    large[220] = f64::INFINITY;
    let large = large.into_iter().flat_map(f64::to_be_bytes).collect::<Vec<u8>>();
    let words = ["oak", "ash", "oak"].map(|word| {
        (0..4)
            .flat_map(|at| word.chars().nth(at).map_or(0, u32::from).to_le_bytes())
            .collect::<Vec<u8>>()
    });
    let labels = npy("<U4", "(3,)", &words.concat());
    let array = npy("<i2", "(3, 2, 40)", &small);
    let turned: Vec<i16> =
        (0..3).flat_map(|t| (0..40).flat_map(move |r| (0..2).map(move |c| at(t, c, r)))).collect();
    let turned = turned.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
    let turned =
        npz(&[("X.npy", npy("<i2", "(3, 40, 2)", &turned)), ("y.npy", labels.clone())], true);
    let file = |deflate| npz(&[("X.npy", array.clone()), ("y.npy", labels.clone())], deflate);
    for (name, bytes, args, keys) in [
        ("oak/1.npy", array.clone(), &[][..], ["oak 1", "oak 2", "oak 3"]),
        ("oak/1.npy", npy(">f8", "(3, 2, 40)", &large), &[], ["oak 1", "oak 2", "oak 3"]),
        ("all.npz", file(false), &["--labels", "y"], ["ash 1", "oak 1", "oak 2"]),
        ("all.npz", file(true), &["--labels", "y", "--variable", "X"], ["ash 1", "oak 1", "oak 2"]),
        ("all.npz", turned, &["--labels", "y", "--variable", "X"], ["ash 1", "oak 1", "oak 2"]),
    ] {
        assert_trials((name, &bytes, args), keys);
    }
    for (bytes, args, part) in [
        (array.clone(), &[][..], "--rate HZ"),
        (
            npy("<i2", "(3, 40, 2)", &small),
            &["--rate", "9"],
            "expected trials × channels × samples",
        ),
        (npy("<i2", "(9000, 2, 40)", &small), &["--rate", "9"], "truncated"),
        (npy("|O", "(3,)", &small), &["--rate", "9"], "its elements are"),
        (array.clone(), &["--rate", "9", "--labels", "nosuch"], "there is no file `nosuch`"),
        (array.clone(), &["--rate", "9", "--trial", "n"], "leave --trial out"),
        (array[..20].to_vec(), &["--rate", "9"], "cut short"),
    ] {
        says(&import("oak/1.npy", &bytes, args).said(), &[part]);
    }
    let few = import("oak/1.npz", &file(true), &["--rate", "9", "--labels", "X"]);
    says(&few.said(), &["labels have the shape"]);
}

#[test]
fn arrays_name_the_surface_person_and_session_of_each_trial() {
    // As many labels as rows: each row is a trial.
    let rows = npy("<i2", "(3, 40)", &[1; 240]);
    let groups = npy("|S3", "(3,)", b"bency\0ben");
    let objects = npy("|O", "(3,)", b"a pickle");
    let members = [("X.npy", rows), ("g.npy", groups), ("y.npy", objects)];
    let (dir, file) = (crate::common::temp(), npz(&members, false));
    let labels = dir.1.join("labels.txt");
    let imported = |lines: &str, args: &[&str]| {
        write_file(&labels, lines);
        let labels = ["--rate", "100", "--labels", labels.to_str().unwrap()];
        import("all.npz", &file, &[&labels, args].concat())
    };
    let people = ["--user", "g", "--session", "g"];
    let read = imported("oak\nash\n\"oak, oiled\"", &people);
    says(&read.said(), &["each row is a trial of one channel"]);
    let entries = read.library().entries;
    let keys = entries.iter().map(|e| (&*e.key.surface, &*e.key.user, e.key.session.as_deref()));
    let right = [("ash", "cy"), ("oak", "ben"), ("oak, oiled", "ben")];
    let right = right.map(|(surface, user)| (surface, user, Some(user)));
    assert_eq!(keys.collect::<Vec<_>>(), right);
    assert_eq!(entries[0].outlines().unwrap().values().next().unwrap().frames, 40);
    for (lines, args, part) in [
        ("0,oak\n1,ash\n2,oak", &[][..], "line 1, `0,oak`, has several columns"),
        ("name\noak\nash\noak", &[], "4 labels; the first, `name`, may be a header"),
        ("oak\nash\noak", &["--user", "nosuch"], "no array `nosuch`; it has X.npy, g.npy"),
        ("oak\nash\noak", &["--user", "y"], "`y.npy`: its elements are `|O`; save numbers as"),
    ] {
        says(&imported(lines, args).said(), &[part]);
    }
}

proptest::proptest! {
    #[test]
    fn no_damaged_file_breaks_the_readers(
        kind in 0..files::KINDS.len() as u8,
        at in proptest::prelude::any::<proptest::sample::Index>(),
        with in proptest::collection::vec(proptest::prelude::any::<u8>(), 0..6),
        end in proptest::prelude::any::<proptest::sample::Index>(),
    ) {
        let mut bytes = match files::KINDS[kind as usize] {
            "npy" => npy("<f4", "(2, 2, 10)", &[1; 160]),
            "mat" => crate::mat_forms::sample(),
            "npz" => npz(&[("X.npy", npy("<f4", "(2, 2, 10)", &[1; 160]))], true),
            "wav" => {
                let spec = hound::WavSpec {
                    channels: 2,
                    sample_rate: 1000,
                    bits_per_sample: 16,
                    sample_format: hound::SampleFormat::Int,
                };
                let mut bytes = std::io::Cursor::new(Vec::new());
                let mut writer = hound::WavWriter::new(&mut bytes, spec).unwrap();
                (0..20).for_each(|x| writer.write_sample(x).unwrap());
                writer.finalize().unwrap();
                bytes.into_inner()
            }
            sound @ ("mp3" | "m4a" | "ogg") => {
                let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/lossy");
                std::fs::read(folder.join(format!("tone.{sound}"))).unwrap()
            }
            _ => "# a\n\"t (s)\";x\n0,1;2\n0,2;4\n0,3;nan\n0,4;5\n".into(),
        };
        let start = at.index(bytes.len());
        bytes.splice(start..(start + with.len()).min(bytes.len()), with);
        bytes.truncate(1 + end.index(bytes.len()));
        files::read(&[&[kind], &bytes[..]].concat());
    }
}
