//! Help for tests that need files.

#![allow(dead_code)] // Not every test binary uses all of it.

pub mod edited;
pub mod http;
pub mod oak;
pub mod replayed;
pub mod running;
pub mod scores;
pub mod scripted;
pub mod simulate;
pub mod sound;
pub mod stylus;

use std::path::{Path, PathBuf};

use surfaced::dataset;
use surfaced::evaluate::{self, Fold, Protocol};
use surfaced::library::{Entry, Library, LibraryError};
use surfaced::scene::{Scene, SourceId};
use surfaced::trial::{Image, Series, Signal, Trial, TrialKey};

/// A file or folder of the shared material, such as `data/lmt108_surfaces.txt`, or `None` where it
/// is absent, in which case the test should end; this says so on stderr.
///
/// It lies in the folder that `SURFACED_SHARED` names, or in `../shared`.
///
/// # Panics
/// If it is absent and `SURFACED_REQUIRE_SHARED=1`.
pub fn shared(relative: &str) -> Option<PathBuf> {
    let root = std::env::var_os("SURFACED_SHARED")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"), PathBuf::from);
    let path = root.join(relative);
    if path.exists() {
        return Some(path);
    }
    let required = std::env::var("SURFACED_REQUIRE_SHARED").is_ok_and(|value| value == "1");
    assert!(!required, "{} is absent, but SURFACED_REQUIRE_SHARED=1", path.display());
    // Past the test harness, which shows the output of failing tests alone.
    use std::io::Write;
    let _ = writeln!(
        std::io::stderr(),
        "SKIPPED: a test, since {} is absent; set SURFACED_SHARED to the shared folder",
        path.display()
    );
    None
}

/// The real recordings, see [`shared`].
pub fn shared_lmt108() -> Option<PathBuf> {
    shared("data/LMT_108_SurfaceMaterials_Database")
}

/// Entries of the real sounds, and the first folds of leave-one-trial-out; see [`shared`].
pub fn real_sounds(folds: usize) -> Option<(Scene, Vec<Entry>, Vec<Fold>)> {
    let library = dataset::open(&shared_lmt108()?, &Scene::lmt108()).unwrap();
    let scene = library.scene.clone().only(&[id("mi2")]).unwrap();
    let entries: Vec<Entry> = (library.entries.into_iter())
        .map(|entry| entry.within(&scene))
        .filter(|entry| !entry.sources.is_empty())
        .collect();
    let keys: Vec<_> = entries.iter().map(|entry| entry.key.clone()).collect();
    let mut all = evaluate::folds(Protocol::LeaveOneTrialOut, &keys).unwrap();
    all.truncate(folds);
    Some((scene, entries, all))
}

/// A source's name.
pub fn id(name: &str) -> SourceId {
    SourceId::new(name).unwrap()
}

/// A series of `frames` × `channels` that no 16-bit file can hold, different for every `seed`.
pub fn series(rate_hz: f64, channels: usize, frames: usize, seed: u32) -> Signal {
    let values = (0..frames * channels).map(|at| (at as f32 * 0.37 + seed as f32).sin() * 0.5);
    Signal::Series(Series::new(rate_hz, channels, values.collect()).unwrap())
}

/// A picture, different for every `seed`.
pub fn picture(seed: u32) -> Signal {
    let bytes = Image::ROWS * Image::COLS * 3;
    let rgb = (0..bytes).map(|at| ((at as u32 ^ seed).wrapping_mul(2_654_435_761) >> 24) as u8);
    Signal::Image(Image::new(Image::COLS, Image::ROWS, rgb.collect()).unwrap())
}

/// A short trial with all eight sources of LMT108.
pub fn trial(surface: &str, user: &str, number: u32) -> Trial {
    let seed = number + 7 * surface.len() as u32;
    let signals = [
        ("ac", series(10_000.0, 3, 300, seed)),
        ("ca1", picture(seed)),
        ("ca2", picture(seed + 1)),
        ("fr", series(10_000.0, 2, 300, seed)),
        ("ir", series(10_000.0, 1, 300, seed)),
        ("me", Signal::Series(Series::new(10_000.0, 1, vec![0.0; 300]).unwrap())),
        ("mi1", series(44_100.0, 1, 200, seed)),
        ("mi2", series(44_100.0, 1, 500, seed)),
    ];
    Trial {
        key: TrialKey::new(surface, user, number),
        signals: signals.into_iter().map(|(name, signal)| (id(name), signal)).collect(),
    }
}

/// Writes a 16-bit WAV file, and the folders above it.
pub fn write_wav(path: &Path, rate_hz: u32, channels: u16, samples: &[i16]) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    let spec = hound::WavSpec {
        channels,
        sample_rate: rate_hz,
        bits_per_sample: 16,
        sample_format: hound::SampleFormat::Int,
    };
    let mut writer = hound::WavWriter::create(path, spec).unwrap();
    samples.iter().for_each(|&sample| writer.write_sample(sample).unwrap());
    writer.finalize().unwrap();
}

/// Writes a file, and the folders above it.
pub fn write_file(path: &Path, bytes: impl AsRef<[u8]>) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, bytes).unwrap();
}

/// An empty folder for a library; it is removed with the first of the two.
pub fn temp() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("library");
    std::fs::create_dir(&path).unwrap();
    (dir, path)
}

/// Opens recordings of any form with the default scene.
pub fn open(path: &Path) -> Result<Library, LibraryError> {
    surfaced::dataset::open(path, &Scene::lmt108())
}

/// Asserts that a message holds all `parts`.
///
/// # Panics
/// If it does not.
#[track_caller]
pub fn says(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "`{part}` is not in: {message}");
    }
}

/// Checks that what is known of each trial before it is read is what is then read.
#[track_caller]
pub fn assert_outlines_are_true(library: &Library) {
    for entry in &library.entries {
        let trial = entry.load().unwrap();
        let loaded = Entry::in_memory(trial).outlines().unwrap();
        assert_eq!(entry.outlines().unwrap(), loaded, "{}", entry.key);
    }
}
