//! Any model file: it is opened or refused, without a panic. `tools/fuzz` runs it.

#![no_main]

use libfuzzer_sys::fuzz_target;
use surfaced::recognise::ModelFile;

/// Magic, version and length, and the checksum at the end.
const HEADER: usize = 24;
const CHECKSUM: usize = 4;

fuzz_target!(|bytes: &[u8]| {
    let _ = ModelFile::decode(bytes);
    // The same with a length and a checksum that are right, so that the body is read, too.
    let Some((head, rest)) = bytes.split_at_checked(HEADER) else { return };
    let Some(length) = rest.len().checked_sub(CHECKSUM) else { return };
    let body = &rest[..length];
    let mut framed = [&head[..16], &(length as u64).to_le_bytes(), body].concat();
    framed.extend(crc32fast::hash(&framed).to_le_bytes());
    let _ = ModelFile::decode(&framed);
});
