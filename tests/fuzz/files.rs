//! Files from outside: recordings and tables, which may be damaged in any way.

/// The kinds of files; the first byte of an input says which it is. Parquet is read where its feature is
/// on, as in the tests.
pub const KINDS: [&str; 10] =
    ["csv", "npy", "npz", "wav", "flac", "mp3", "m4a", "ogg", "mat", "parquet"];

/// Reads a file of a kind and a content; nothing may panic.
pub fn read(input: &[u8]) {
    let Some((kind, content)) = input.split_first() else { return };
    let kind = KINDS[usize::from(*kind) % KINDS.len()];
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join(format!("oak-1.{kind}"));
    std::fs::write(&path, content).expect("a file");
    match kind {
        "wav" | "flac" | "mp3" | "m4a" | "ogg" => {
            let scene = surfaced::scene::Scene::lmt108();
            let library = surfaced::dataset::open(&path, &scene);
            let _ = library.and_then(|library| library.entries[0].load());
        }
        _ => drop(surfaced::dataset::try_table(&path)),
    }
}
