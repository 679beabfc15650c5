//! Writes a recording as an MCAP file.

use std::borrow::Cow;
use std::fs::{self, File};
use std::io::BufWriter;
use std::path::Path;

use mcap::{Attachment, Compression, WriteOptions};

use super::{attached, messages};
use crate::library::{Library, LibraryError, files};
use crate::record::failed;

/// Pause between two trials, in seconds, so that they stand apart on a time line.
const PAUSE_S: f64 = 1.0;
/// Largest file of a recording in bytes.
const MOST_FILE: u64 = 1 << 30;

/// Writes a recording (a library, or one of its trials, `SURFACE/TRIAL`) to `out`, and returns the
/// number of trials. An export that fails leaves no file.
///
/// # Errors
/// If the recording cannot be read, has a link that leads out of it, or `out` exists or cannot be
/// written.
pub fn export(recording: &Path, library: &Library, out: &Path) -> Result<usize, LibraryError> {
    let file = File::create_new(out).map_err(|error| failed(out, error))?;
    let written = write(recording, library, out, file);
    if written.is_err() {
        // The first error matters more than one of the clean-up.
        let _ = fs::remove_file(out);
    }
    written.map(|()| library.entries.len())
}

fn write(recording: &Path, library: &Library, out: &Path, file: File) -> Result<(), LibraryError> {
    let failed = |error: mcap::McapError| LibraryError::file(out, error.to_string());
    let options = WriteOptions::new()
        .library(concat!("surfaced ", env!("CARGO_PKG_VERSION")))
        .compression(Some(Compression::Zstd));
    let mut writer = options.create(BufWriter::new(file)).map_err(failed)?;
    for (name, path) in attached::files(recording)? {
        let data = match files::read_bytes(&path, MOST_FILE) {
            // `read_bytes` refuses an empty file, but it belongs to the recording.
            Err(_) if fs::metadata(&path).is_ok_and(|about| about.len() == 0) => Vec::new(),
            data => data?,
        };
        let media_type = media_type(&name).to_string();
        let data = Cow::Owned(data);
        let file = Attachment { log_time: 0, create_time: 0, name, media_type, data };
        writer.attach(&file).map_err(failed)?;
    }
    let mut begin_s = 0.0;
    for entry in &library.entries {
        let trial_s = messages::write(&mut writer, &entry.load()?, begin_s).map_err(failed)?;
        begin_s += trial_s + PAUSE_S;
    }
    writer.finish().map(drop).map_err(failed)
}

fn media_type(name: &str) -> &'static str {
    match name.rsplit('.').next() {
        Some("wav") => "audio/wav",
        Some("flac") => "audio/flac",
        Some("png") => "image/png",
        Some("jpg" | "jpeg") => "image/jpeg",
        Some("toml") => "application/toml",
        Some("txt") => "text/plain",
        _ => "application/octet-stream",
    }
}
