//! The memory that a hostile model file takes.

#[path = "common/counting.rs"]
mod counting;

use std::fs::File;
use std::io::Write;
use std::sync::atomic::Ordering;

use counting::{Counting, HELD, PEAK};
use surfaced::recognise::ModelFile;

#[global_allocator]
static COUNTING: Counting = Counting;

const MOST: i64 = 64 << 20;

/// A model file, said to have a body of `length` bytes.
fn with_length(model: &[u8], length: u64) -> Vec<u8> {
    [&model[..16], &length.to_le_bytes(), &model[24..]].concat()
}

#[test]
fn a_hostile_model_file_is_refused_within_64_mb() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("model.surfaced");
    let model = std::fs::read("tests/fixtures/models/8.surfaced").unwrap();
    let altered: Vec<u8> = model.iter().enumerate().map(|(at, x)| x ^ u8::from(at == 99)).collect();
    for (what, bytes, size) in [
        ("cut short", model[..model.len() / 2].to_vec(), None),
        ("altered", altered, None),
        ("newer", [&model[..14], &[9, 9], &model[16..]].concat(), None),
        ("claims 4 GB", with_length(&model, 4 << 30), None),
        ("claims all", with_length(&model, u64::MAX), None),
        ("has 4 GB", with_length(&model, (4 << 30) - 28), Some(4 << 30)),
        ("has 256 MB", with_length(&model, (256 << 20) - 28), Some(256 << 20)),
    ] {
        let mut file = File::create(&path).unwrap();
        file.write_all(&bytes).unwrap();
        // The rest takes no room on the disk.
        size.into_iter().for_each(|size| file.set_len(size).unwrap());
        PEAK.store(HELD.load(Ordering::Relaxed), Ordering::Relaxed);
        let before = HELD.load(Ordering::Relaxed);
        let Err(error) = ModelFile::read(&path) else { panic!("{what}: opened") };
        let taken = PEAK.load(Ordering::Relaxed) - before;
        println!("{what}: {taken} bytes; {error}");
        assert!(taken < MOST, "{what}: {taken} bytes");
    }
}
