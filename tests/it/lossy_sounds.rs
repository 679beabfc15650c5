//! Sounds in lossy forms: what is read of them, and how what is not read is named. Their fixtures are
//! those of tests/fixtures/lossy/make.

use std::path::Path;

use crate::common::{self, open, says, temp, write_file};
use surfaced::trial::{Series, Signal};

fn fixture(name: &str) -> Vec<u8> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/lossy").join(name);
    std::fs::read(path).unwrap()
}

/// The series that a library reads of a file, or the reason why it reads none.
fn read(extension: &str, bytes: &[u8]) -> Result<Series, String> {
    let (_dir, path) = temp();
    write_file(&path.join(format!("Oak/1/mi2.{extension}")), bytes);
    let library = open(&path).map_err(|error| error.to_string())?;
    let trial = library.entries[0].load().map_err(|error| error.to_string())?;
    common::assert_outlines_are_true(&library);
    match &trial.signals["mi2"] {
        Signal::Series(series) => Ok(series.clone()),
        Signal::Image(_) => panic!("a sound is a series"),
    }
}

fn refused(extension: &str, bytes: &[u8]) -> String {
    read(extension, bytes).map(|series| series.frames()).unwrap_err()
}

/// The amplitude and the phase of a frequency in a part of a series, in radians.
fn tone(series: &Series, hz: f64) -> (f64, f64) {
    let (from, to) = (4410, 4410 + 8820);
    let (mut re, mut im) = (0.0, 0.0);
    for (i, sample) in series.samples().iter().enumerate().take(to).skip(from) {
        let angle = std::f64::consts::TAU * hz * i as f64 / series.rate_hz();
        re += f64::from(*sample) * angle.sin();
        im += f64::from(*sample) * angle.cos();
    }
    let scale = 2.0 / (to - from) as f64;
    ((re * scale).hypot(im * scale), im.atan2(re))
}

#[test]
fn a_tone_keeps_its_length_its_frequency_its_level_and_its_place() {
    // Half a second is 22,050 frames; where nothing tells the encoder's delay, it stays.
    for (name, frames) in
        [("tone.mp3", 22_050), ("bare.mp3", 24_192), ("tone.m4a", 22_050), ("tone.ogg", 22_050)]
    {
        let series = read(&name[5..], &fixture(name)).unwrap();
        assert_eq!((series.rate_hz(), series.channels()), (44_100.0, 1), "{name}");
        assert_eq!(series.frames(), frames, "{name}");
        let ((level, phase), (other, _)) = (tone(&series, 1000.0), tone(&series, 1100.0));
        // LAME lowers what it codes by a twentieth, so that nothing is clipped.
        assert!((level - 0.5).abs() < 0.03 && other < 0.01, "{name}: {level}, {other}");
        assert!(phase.abs() < 0.05 || name == "bare.mp3", "{name}: {phase}");
    }
}

#[test]
fn lossy_coding_is_said_once() {
    let (_dir, path) = temp();
    for (number, extension) in (1..).zip(["mp3", "M4A", "ogg"]) {
        let bytes = fixture(&format!("tone.{}", extension.to_lowercase()));
        write_file(&path.join(format!("Oak/{number}/mi2.{extension}")), bytes);
    }
    let remarks = open(&path).unwrap().remarks;
    assert_eq!(remarks.len(), 1, "{remarks:?}");
    says(&remarks[0], &["Oak/1/mi2.mp3 and 2 more: lossy coding", "the bands above its cut"]);
    let one = open(&path.join("Oak/3/mi2.ogg")).unwrap();
    assert_eq!(one.entries.len(), 1);
}

/// A copy with `new` in the place of `old`.
fn with(bytes: &[u8], old: &[u8], new: &[u8]) -> Vec<u8> {
    let at = bytes.windows(old.len()).position(|window| window == old).unwrap();
    [&bytes[..at], new, &bytes[at + old.len()..]].concat()
}

#[test]
fn codings_that_are_not_read_are_named() {
    let m4a = fixture("tone.m4a");
    // The configuration of AAC-LC at 44,100 Hz, whose extension says: no spectral band replication.
    let config = [0x12, 0x08, 0x56, 0xE5, 0x00];
    let later = with(&m4a, &config, &[0x12, 0x08, 0x56, 0xE5, 0x80]);
    let first = with(&m4a, &config, &[0x2B, 0x8A, 0x08, 0x00, 0x00]);
    let main = with(&m4a, &config, &[0x0A, 0x08, 0x56, 0xE5, 0x00]);
    for (extension, bytes, name) in [
        ("m4a", fixture("he.m4a"), "HE-AAC is not read"),
        ("m4a", later, "HE-AAC is not read"),
        ("m4a", first, "HE-AAC is not read"),
        ("m4a", main, "AAC other than AAC-LC is not read"),
        ("m4a", fixture("opus.m4a"), "Opus is not read"),
        ("ogg", fixture("opus.ogg"), "Opus is not read"),
        ("oga", with(&fixture("opus.ogg"), b"OpusHead", b"\x7fFLAC..."), "FLAC in Ogg is not read"),
    ] {
        says(&refused(extension, &bytes), &["convert it to WAV or FLAC", name]);
    }
}

#[test]
fn a_lossy_file_that_is_cut_is_refused() {
    for name in ["tone.mp3", "bare.mp3", "tone.m4a", "tone.ogg"] {
        let whole = fixture(name);
        for end in [1, 3, 30, 100, whole.len() / 2, whole.len() - 200, whole.len() - 1] {
            let error = refused(&name[5..], &whole[..end]);
            says(&error, &[&name[5..], "not a sound that can be read", "copy it again"]);
        }
        says(&refused(&name[5..], &[]), &["the file is empty"]);
    }
    // Where LAME counted the frames, a cut between two of them is seen, too.
    let mp3 = fixture("tone.mp3");
    let last = mp3.windows(3).rposition(|at| at == [0xFF, 0xFB, 0x52]).unwrap();
    says(&refused("mp3", &mp3[..last]), &["truncated: it holds 23040 of 24192 frames"]);
}

#[test]
fn a_lossy_file_that_is_damaged_is_refused() {
    let mp3 = fixture("bare.mp3");
    says(&refused("mp3", &[&mp3[..1000], &mp3[1001..]].concat()), &["no frame where"]);
    says(
        &read("mp3", &[&b"once upon a time "[..], &mp3].concat()).unwrap_err(),
        &["does not begin"],
    );
    let mut ogg = fixture("tone.ogg");
    let at = ogg.len() - 50;
    ogg[at] ^= 1;
    says(&refused("ogg", &ogg), &["damaged at its page 2"]);
    let twice = fixture("tone.ogg").repeat(2);
    says(&refused("ogg", &twice), &["Ogg of several streams is not read"]);
    let m4a = fixture("tone.m4a");
    // A table of sizes that claims 2^32 − 1 packets of one byte each.
    let claim = [&b"stsz\0\0\0\0"[..], &1u32.to_be_bytes(), &[0xFF; 4]].concat();
    let sizes = m4a.windows(4).position(|at| at == b"stsz").unwrap();
    says(&refused("m4a", &with(&m4a, &m4a[sizes..sizes + 16], &claim)), &["not a sound"]);
    for extension in ["mp3", "m4a", "ogg"] {
        says(&refused(extension, &[0x55; 5000]), &["not a sound that can be read"]);
    }
}

#[test]
fn what_players_keep_in_a_file_is_no_sound() {
    let mp3 = fixture("tone.mp3");
    let expected = read("mp3", &mp3).unwrap();
    let id3 = [&b"ID3\x04\0\0\0\0\x01\x02"[..], &[0xFF; 130]].concat();
    let tag = [&b"TAG"[..], &[b' '; 125]].concat();
    for bytes in [
        [&id3[..], &mp3].concat(),
        [&mp3[..], &tag].concat(),
        [&mp3[..], &b"APETAGEX"[..], &[0xFF; 200], &tag].concat(),
        [&mp3[..], &[0; 300]].concat(),
    ] {
        assert_eq!(read("mp3", &bytes).unwrap(), expected);
    }
}
