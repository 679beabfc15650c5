//! Sounds in the forms in which programs and recorders write them, with the samples that they hold.

use crate::common::{open, says, temp, write_file, write_wav};
use crate::plan::{said, surfaced, text};
use surfaced::trial::Signal;

/// A WAV file: the form and size of its head, the chunks before its format, its format, and its data
/// with the size that its header claims.
struct Wav<'a> {
    form: &'a [u8; 4],
    riff: Option<u32>,
    before: Vec<u8>,
    format: u16,
    channels: u16,
    bytes: u16,
    /// what WAVE_FORMAT_EXTENSIBLE says of the bits that are valid
    extensible: Option<u16>,
    data: Vec<u8>,
    claimed: Option<u32>,
    after: Vec<u8>,
}

fn wav(format: u16, bytes: u16, data: &[u8]) -> Wav<'static> {
    Wav {
        form: b"RIFF",
        riff: None,
        before: Vec::new(),
        format,
        channels: 1,
        bytes,
        extensible: None,
        data: data.to_vec(),
        claimed: None,
        after: Vec::new(),
    }
}

impl Wav<'_> {
    fn bytes(&self) -> Vec<u8> {
        let frame = self.bytes * self.channels;
        let format = if self.extensible.is_some() { 0xFFFE } else { self.format };
        let mut body = [format, self.channels].map(u16::to_le_bytes).concat();
        body.extend([44_100, 44_100 * u32::from(frame)].map(u32::to_le_bytes).concat());
        body.extend([frame, self.bytes * 8].map(u16::to_le_bytes).concat());
        if let Some(valid) = self.extensible {
            body.extend([22, valid, 4, 0, self.format].map(u16::to_le_bytes).concat());
            body.extend(*b"\x00\x00\x00\x00\x10\x00\x80\x00\x00\xaa\x00\x38\x9b\x71");
        }
        let chunk = |id: &[u8; 4], length: u32, body: &[u8]| {
            [&id[..], &length.to_le_bytes(), body].concat()
        };
        let claimed = self.claimed.unwrap_or(self.data.len() as u32);
        let rest = [
            b"WAVE".to_vec(),
            self.before.clone(),
            chunk(b"fmt ", body.len() as u32, &body),
            chunk(b"data", claimed, &self.data),
            self.after.clone(),
        ]
        .concat();
        chunk(self.form, self.riff.unwrap_or(rest.len() as u32), &rest)
    }
}

/// The samples that a library reads of such a file, or the reason why it reads none.
fn samples(bytes: &[u8]) -> Result<Vec<f32>, String> {
    let (_dir, path) = temp();
    write_file(&path.join("Oak/1/mi2.wav"), bytes);
    let read = open(&path).and_then(|library| library.entries[0].load());
    match &read.map_err(|error| error.to_string())?.signals["mi2"] {
        Signal::Series(series) => Ok(series.samples().to_vec()),
        Signal::Image(_) => panic!("a sound is a series"),
    }
}

fn le16(samples: &[i16]) -> Vec<u8> {
    samples.iter().flat_map(|x| x.to_le_bytes()).collect()
}

/// A chunk that claims to be of this length.
fn list(claimed: u32, content: &[u8]) -> Vec<u8> {
    [b"LIST", &claimed.to_le_bytes(), content].concat()
}

fn ds64(data: u64) -> Vec<u8> {
    let sizes = [1000, data, 2].map(u64::to_le_bytes).concat();
    [b"ds64".to_vec(), 28u32.to_le_bytes().to_vec(), sizes, vec![0; 4]].concat()
}

#[test]
fn every_kind_of_wav_gives_its_samples() {
    let two = le16(&[8192, -16384]);
    let f64s = [0.25_f64, -0.5].map(f64::to_le_bytes).concat();
    let info = list(4, b"INFO");
    let streamed = |riff, claimed, data: &[u8]| Wav {
        riff: Some(riff),
        claimed: Some(claimed),
        ..wav(1, 2, data)
    };
    let long = |claimed, size| Wav {
        form: b"RF64",
        riff: Some(u32::MAX),
        before: ds64(size),
        claimed: Some(claimed),
        after: info.clone(),
        ..wav(1, 2, &two)
    };
    let is = [0.25, -0.5];
    for (name, file, expected) in [
        ("16 bits", wav(1, 2, &two), &is[..]),
        ("8 bits", wav(1, 1, &[0xA0, 0x40]), &is),
        ("chunks after the samples", Wav { after: info.clone(), ..wav(1, 2, &two) }, &is),
        ("a padded chunk", Wav { before: list(3, b"abc\0"), ..wav(1, 2, &two) }, &is),
        ("a stream with sizes of 0", streamed(0, 0, &two), &is),
        ("a stream of ffmpeg", streamed(u32::MAX, u32::MAX, &two), &is),
        ("a stream of 2^31 − 1", streamed(0x7FFF_FFFF, 0x7FFF_FFFF, &two), &is),
        ("a stream of sox", streamed(0x7FFF_F024, 0x7FFF_F000, &two), &is),
        ("a stream of arecord", streamed(0x8000_0024, 0x8000_0000, &two), &is),
        ("zeros after the samples", Wav { after: vec![0; 50], ..wav(1, 2, &two) }, &is),
        ("a stream that was stopped", streamed(0, 0, &[&two[..], b"\x07"].concat()), &is),
        ("RF64", long(u32::MAX, 4), &is),
        ("BW64", Wav { form: b"BW64", ..long(u32::MAX, 4) }, &is),
        ("RF64 with plain sizes", long(4, 0), &is),
        ("a stream in RF64", Wav { after: vec![], ..long(u32::MAX, u64::MAX) }, &is),
        ("64-bit float", wav(3, 8, &f64s), &is),
        ("32-bit float", wav(3, 4, &[0.25_f32, -0.5].map(f32::to_le_bytes).concat()), &is),
        ("A-law", wav(6, 1, &[0x55, 0xD5, 0x2A, 0xAA]), &[-8.0, 8.0, -32256.0, 32256.0]),
        ("µ-law", wav(7, 1, &[0x00, 0x80, 0xFF, 0x7F]), &[-32124.0, 32124.0, 0.0, 0.0]),
        ("extensible", Wav { extensible: Some(16), ..wav(1, 2, &two) }, &is),
        ("extensible float", Wav { extensible: Some(64), ..wav(3, 8, &f64s) }, &is),
        (
            "24 of 32 bits",
            Wav { extensible: Some(24), ..wav(1, 4, &[0, 0, 0, 32, 0, 0, 0, 192]) },
            &is,
        ),
    ] {
        let scale = if matches!(file.format, 6 | 7) { 32768.0 } else { 1.0 };
        let got = samples(&file.bytes()).unwrap_or_else(|error| panic!("{name}: {error}"));
        let got: Vec<f32> = got.iter().map(|x| x * scale).collect();
        assert_eq!(got, expected, "{name}");
    }
}

#[test]
fn what_wav_does_not_hold_is_named() {
    let nothing = |riff| Wav { riff, after: list(4, b"INFO"), ..wav(1, 2, &[]) };
    for (file, part) in [
        (wav(1, 0, &[0; 8]), "0 bits in 0 bytes"),
        (wav(1, 8, &[0; 8]), "64 bits in 8 bytes"),
        (wav(2, 2, &[0; 8]), "Microsoft ADPCM"),
        (wav(0x11, 1, &[0; 4]), "IMA ADPCM"),
        (wav(0x55, 1, &[0; 4]), "mp3"),
        (wav(3, 2, &[0; 4]), "16 bits in 2 bytes"),
        (nothing(None), "it holds no samples"),
        (nothing(Some(0)), "it holds no samples"),
        (Wav { before: list(u32::MAX, b""), ..wav(1, 2, &[0; 4]) }, "truncated"),
        (Wav { claimed: Some(4000), ..wav(1, 2, &[0; 4]) }, "truncated"),
        (Wav { claimed: Some(u32::MAX), ..wav(1, 2, &[]) }, "it holds no samples"),
        (Wav { claimed: Some(8), ..wav(1, 2, &[7; 400]) }, "of 8 bytes of samples, but 400 follow"),
    ] {
        says(&samples(&file.bytes()).unwrap_err(), &[part]);
    }
    // Without a list of valid bits, 24 bits may be the upper or the lower ones of 32.
    let mut unclear = wav(1, 4, &[0; 4]).bytes();
    unclear[34] = 24;
    says(&samples(&unclear).unwrap_err(), &["24 bits in 4 bytes", "sox"]);
}

#[test]
fn recordings_that_are_not_read_are_named() {
    let (_dir, path) = temp();
    write_wav(&path.join("Oak/1/mi2.wav"), 44_100, 1, &[1]);
    for (file, part) in [
        ("a.aiff", "convert it to WAV or FLAC"),
        ("Oak/b.opus", "convert it to WAV or FLAC"),
        ("Oak/1/ac.wma", "convert it to WAV or FLAC"),
        ("Oak/1/ac.csv", "surfaced import csv"),
        ("Oak/1/ca1.tiff", "save it as PNG or JPEG"),
    ] {
        write_file(&path.join(file), "x");
        let remarks = open(&path).unwrap().remarks.join("\n");
        says(&remarks, &[&format!("{file}: not used, ."), part]);
    }
}

#[test]
fn names_that_may_be_those_of_people_are_said() {
    for (files, parts) in [
        (
            ["anna/oak_1", "anna/ash_1", "ben/oak_1", "ben/ash_1"],
            &["begin with `ash` and `oak`: if"][..],
        ),
        (["oak/Anna 1", "oak/ben-1", "ash/Anna 1", "ash/ben 2"], &["`user = \"Anna\"`"]),
        (["oak/anna1/mi2", "oak/ben2/mi2", "ash/anna1/mi2", "ash/ben2/mi2"], &["`anna` and `ben`"]),
        (["oak/oak_1", "oak/scan 2", "ash/ash_1", "ash/scan 2"], &[]),
    ] {
        let (_dir, path) = temp();
        files.iter().for_each(|file| write_wav(&path.join(format!("{file}.wav")), 44_100, 1, &[1]));
        let remarks = open(&path).unwrap().remarks.join("\n");
        says(&remarks, parts);
        assert_eq!(remarks.contains("people"), !parts.is_empty(), "{remarks}");
    }
}

#[test]
fn trials_of_one_number_and_names_that_capitals_tell_apart_are_found() {
    let (_dir, path) = temp();
    let samples: Vec<i16> = (0..4000).map(|i| (i * i % 977) as i16).collect();
    for (at, trial) in ["oak/anna-1", "oak/ben-1", "plank/anna-2"].into_iter().enumerate() {
        write_wav(&path.join(trial).join("mi2.wav"), 44_100, 1, &samples[at..]);
    }
    write_file(&path.join("plank/anna-2/trial.toml"), "surface = \"Oak\"");
    let library = text(&path);
    let output = surfaced(&["check", library]);
    assert_eq!(output.status.code(), Some(3), "{}", said(&output));
    let found = String::from_utf8(output.stdout).unwrap();
    let one =
        "not used in 1 trial: oak/ben-1 (the same trial (oak · expert · trial 1) as oak/anna-1";
    says(&found, &[one, "`Oak`, `oak` count as different surfaces"]);
    assert!(!found.contains("library remove"), "{found}");
    let import = surfaced(&["import", "csv", library, "--out", "x"]);
    says(&said(&import), &[".parquet. Sounds", "a folder for each surface"]);
}

#[cfg(not(feature = "lossy"))]
#[test]
fn a_build_without_lossy_forms_says_how_to_read_them() {
    let (_dir, path) = temp();
    write_wav(&path.join("Oak/1/mi2.wav"), 44_100, 1, &[1]);
    for extension in ["mp3", "m4a", "ogg", "OGA"] {
        let file = format!("Oak/1/ac.{extension}");
        write_file(&path.join(&file), "x");
        let said = open(&path).unwrap().remarks.join("\n");
        says(&said, &[&format!("{file}: not used, ."), "build with `--features lossy`"]);
        let alone = open(&path.join(&file)).unwrap_err().to_string();
        says(&alone, &[&file, "build with `--features lossy`"]);
    }
}

/// The samples that a mono source reads of a stereo file, and the remarks.
fn mixed(frames: impl Iterator<Item = [i16; 2]>) -> (Vec<f32>, String) {
    let (_dir, path) = temp();
    let samples: Vec<i16> = frames.flatten().collect();
    for number in 1..=2 {
        write_wav(&path.join(format!("Oak/{number}/mi2.wav")), 44_100, 2, &samples);
    }
    let library = open(&path).unwrap();
    assert_eq!(library.remarks.len(), 1, "{:?}", library.remarks);
    let Signal::Series(series) = &library.entries[1].load().unwrap().signals["mi2"] else {
        panic!("a sound is a series")
    };
    (series.samples().iter().map(|x| x * 32768.0).collect(), library.remarks[0].clone())
}

#[test]
fn the_better_side_of_a_stereo_sound_is_taken_where_a_mean_would_lose_it() {
    let wave = |i: i16, step: i16| (i * step) % 101 - 50;
    let (means, said) = mixed((0..1000).map(|i| [wave(i, 7), wave(i, 7) + 20]));
    assert_eq!(means[..2], [-40.0, -33.0]);
    says(&said, &["and 1 more: stereo, mixed down to the one channel of source `mi2`"]);
    let (left, said) = mixed((0..1000).map(|i| [wave(i, 7) * 3, -wave(i, 7)]));
    assert_eq!(left[..2], [-150.0, -129.0]);
    says(&said, &["and 1 more: stereo with sides of opposite phase", "the louder side"]);
    let (right, said) = mixed((0..1000).map(|i| [i % 2 + 500, wave(i, 7) * 10]));
    assert_eq!(right[..2], [-500.0, -430.0]);
    says(&said, &["and 1 more: stereo with a dead side", "only the other side"]);
}
