//! Trials as MCAP (<https://mcap.dev/spec>), which the field's tools open, and back.
//!
//! A file holds everything twice: as messages, one a frame and one a picture, for tools to draw,
//! and as attachments, the recording's own files byte for byte, from which it comes back exactly.
//! The files are about a thirtieth of the messages, so this costs little.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::BufWriter;
use std::path::{Component, Path, PathBuf};

use base64::Engine;
use mcap::records::MessageHeader;
use mcap::{Attachment, Summary, WriteOptions, Writer};
use serde_json::json;

use crate::library::files::{self, Listed};
use crate::library::recording::DESCRIPTION;
use crate::library::{Library, LibraryError};
use crate::scene::Scene;
use crate::trial::{Image, Series, Signal, Trial};

/// Between two trials, in seconds, so that they stand apart on a time line.
const PAUSE_S: f64 = 1.0;
/// The schema of a frame: its samples, one a channel.
const FRAME_SCHEMA: &str = r#"{"title": "surfaced.Frame", "type": "object", "properties": {"values": {"type": "array", "items": {"type": "number"}}}, "required": ["values"]}"#;
/// The schema that viewers know for pictures, <https://docs.foxglove.dev/docs/sdk/schemas/compressed-image>.
const PICTURE_SCHEMA: &str = r#"{"title": "foxglove.CompressedImage", "type": "object", "properties": {"timestamp": {"type": "object", "title": "time", "properties": {"sec": {"type": "integer", "minimum": 0}, "nsec": {"type": "integer", "minimum": 0, "maximum": 999999999}}}, "frame_id": {"type": "string"}, "data": {"type": "string", "contentEncoding": "base64"}, "format": {"type": "string"}}}"#;

/// Writes a recording, a library or one of its trials (`SURFACE/TRIAL`), as `out`; gives the
/// number of trials.
///
/// # Errors
/// If the recording cannot be read, or `out` exists or cannot be written.
pub fn export(recording: &Path, library: &Library, out: &Path) -> Result<usize, LibraryError> {
    let failed = |error: mcap::McapError| LibraryError::file(out, error.to_string());
    let file = File::create_new(out).map_err(|error| super::failed(out, error))?;
    let options = WriteOptions::new().library(concat!("surfaced ", env!("CARGO_PKG_VERSION")));
    let mut writer = options.create(BufWriter::new(file)).map_err(failed)?;
    for (name, path) in attached(recording)? {
        let data = fs::read(&path).map_err(|error| LibraryError::io(&path, error))?;
        let media_type = media_type(&name).to_string();
        let data = Cow::Owned(data);
        let file = Attachment { log_time: 0, create_time: 0, name, media_type, data };
        writer.attach(&file).map_err(failed)?;
    }
    let mut begin_s = 0.0;
    for entry in &library.entries {
        begin_s += write(&mut writer, &entry.load()?, begin_s).map_err(failed)? + PAUSE_S;
    }
    writer.finish().map_err(failed)?;
    Ok(library.entries.len())
}

/// Writes back the files of a recording that was exported, below `dir`, which must not exist
/// yet; gives the number of trials.
///
/// # Errors
/// If `mcap` is no such file, holds none of a recording's files, or names one that would lie
/// elsewhere; if `dir` exists, or cannot be written.
pub fn import(mcap: &Path, dir: &Path) -> Result<usize, LibraryError> {
    let bytes = fs::read(mcap).map_err(|error| LibraryError::io(mcap, error))?;
    let failed = |problem: String| LibraryError::file(mcap, problem);
    let damaged = |error: mcap::McapError| failed(format!("no whole MCAP file: {error}"));
    let summary = Summary::read(&bytes).map_err(damaged)?.unwrap_or_default();
    let mut files = Vec::new();
    for index in &summary.attachment_indexes {
        let end = index.offset.checked_add(index.length);
        if end.is_none_or(|end| end > bytes.len() as u64) {
            return Err(failed(format!("the index of {:?} points outside the file", index.name)));
        }
        let file = mcap::read::attachment(&bytes, index).map_err(damaged)?;
        let path = within(&file.name).ok_or_else(|| {
            failed(format!("holds a file {:?}; expected SURFACE/TRIAL/FILE", file.name))
        })?;
        files.push((path, file.data));
    }
    if files.is_empty() {
        return Err(failed("holds no recording of surfaced's".into()));
    }
    fs::create_dir(dir).map_err(|error| super::failed(dir, error))?;
    for (path, data) in &files {
        let path = dir.join(path);
        if let Some(parent) = path.parent() {
            fs::create_dir_all(parent).map_err(|error| super::failed(parent, error))?;
        }
        super::write_file(&path, data, true)?;
    }
    let trials: std::collections::BTreeSet<_> = files
        .iter()
        .filter_map(|(path, _)| path.parent())
        .filter(|p| p.iter().count() == 2)
        .collect();
    Ok(trials.len())
}

/// A path that leads to a file of a recording and nowhere else.
fn within(name: &str) -> Option<PathBuf> {
    let path = Path::new(name);
    let plain = |part: Component<'_>| match part {
        Component::Normal(part) => part.to_str().is_some_and(|part| !part.starts_with('.')),
        _ => false,
    };
    let parts = path.components().count();
    let fits = parts == 3 || name == DESCRIPTION;
    let odd = name.contains(['\\', '\0']) || name.contains("//") || name.ends_with('/');
    (fits && !odd && path.components().all(plain)).then(|| path.to_path_buf())
}

/// The files of a recording: their names within its library, and where they are.
fn attached(recording: &Path) -> Result<Vec<(String, PathBuf)>, LibraryError> {
    let trials = trials(recording)?;
    let mut all = Vec::new();
    let library = trials.first().and_then(|trial| trial.ancestors().nth(2));
    if let Some(description) =
        library.map(|dir| dir.join(DESCRIPTION)).filter(|path| path.is_file())
    {
        all.push((DESCRIPTION.to_string(), description));
    }
    for trial in trials {
        let names: Vec<_> = trial.iter().rev().take(2).map(|part| part.to_string_lossy()).collect();
        let [number, surface] = &names[..] else { continue };
        for file in visible(&trial)?.into_iter().filter(|item| !item.is_dir) {
            all.push((format!("{surface}/{number}/{}", file.name), file.path));
        }
    }
    Ok(all)
}

/// The folders of the trials of a recording, whole paths.
fn trials(recording: &Path) -> Result<Vec<PathBuf>, LibraryError> {
    let root = recording.canonicalize().map_err(|error| LibraryError::io(recording, error))?;
    let inner = visible(&root)?;
    // A trial is files alone; a library is folders, with any files beside them.
    if !inner.iter().any(|item| item.is_dir) {
        return Ok(vec![root]);
    }
    let mut all = Vec::new();
    for surface in inner.into_iter().filter(|item| item.is_dir) {
        let folders = visible(&surface.path)?.into_iter().filter(|item| item.is_dir);
        all.extend(folders.map(|trial| trial.path));
    }
    Ok(all)
}

fn visible(dir: &Path) -> Result<Vec<Listed>, LibraryError> {
    Ok(files::list(dir)?.into_iter().filter(|item| !item.is_hidden()).collect())
}

fn media_type(name: &str) -> &'static str {
    match name.rsplit('.').next() {
        Some("wav") => "audio/wav",
        Some("png") => "image/png",
        Some("jpg" | "jpeg") => "image/jpeg",
        Some("toml") => "application/toml",
        _ => "application/octet-stream",
    }
}

/// Writes the messages of a trial, and gives its duration in seconds.
fn write(
    writer: &mut Writer<BufWriter<File>>,
    trial: &Trial,
    begin_s: f64,
) -> mcap::McapResult<f64> {
    let mut longest_s = 0.0f64;
    for (source, signal) in &trial.signals {
        let topic = format!("/{source}");
        let key = &trial.key;
        let mut about = BTreeMap::from([
            ("surface".to_string(), key.surface.clone()),
            ("user".to_string(), key.user.clone()),
            ("trial".to_string(), key.number.to_string()),
        ]);
        match signal {
            Signal::Series(series) => {
                about.insert("rate_hz".into(), series.rate_hz().to_string());
                let schema =
                    writer.add_schema("surfaced.Frame", "jsonschema", FRAME_SCHEMA.as_bytes())?;
                let channel = writer.add_channel(schema, &topic, "json", &about)?;
                frames(writer, channel, series, begin_s)?;
                longest_s = longest_s.max(series.duration_s());
            }
            Signal::Image(image) => {
                let name = "foxglove.CompressedImage";
                let schema = writer.add_schema(name, "jsonschema", PICTURE_SCHEMA.as_bytes())?;
                let channel = writer.add_channel(schema, &topic, "json", &about)?;
                picture(writer, channel, image, begin_s)?;
            }
        }
    }
    Ok(longest_s)
}

fn header(channel_id: u16, sequence: u32, at_s: f64) -> MessageHeader {
    let time = (at_s * 1e9).round() as u64;
    MessageHeader { channel_id, sequence, log_time: time, publish_time: time }
}

fn frames(
    writer: &mut Writer<BufWriter<File>>,
    channel: u16,
    series: &Series,
    begin_s: f64,
) -> mcap::McapResult<()> {
    for (index, frame) in series.samples().chunks_exact(series.channels()).enumerate() {
        let values: Vec<String> = frame.iter().map(|sample| format!("{sample:?}")).collect();
        let text = format!(r#"{{"values":[{}]}}"#, values.join(","));
        let at_s = begin_s + index as f64 / series.rate_hz();
        writer.write_to_known_channel(&header(channel, index as u32, at_s), text.as_bytes())?;
    }
    Ok(())
}

fn picture(
    writer: &mut Writer<BufWriter<File>>,
    channel: u16,
    image: &Image,
    begin_s: f64,
) -> mcap::McapResult<()> {
    let png = super::png(image).map_err(std::io::Error::other)?;
    let data = base64::engine::general_purpose::STANDARD.encode(png);
    let time = json!({ "sec": begin_s as u64, "nsec": (begin_s.fract() * 1e9) as u32 });
    let message = json!({ "timestamp": time, "frame_id": "", "data": data, "format": "png" });
    writer.write_to_known_channel(&header(channel, 0, begin_s), message.to_string().as_bytes())
}

/// Opens what is to be exported: a library, or a single trial of one.
///
/// # Errors
/// If it is neither.
pub fn open(recording: &Path, scene: &Scene) -> Result<Library, LibraryError> {
    use crate::library::recording::{open, open_trial};
    match trials(recording)?.first() {
        Some(trial) if recording.canonicalize().is_ok_and(|root| root == *trial) => {
            open_trial(recording, scene)
        }
        _ => open(recording, scene),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_recordings_own_files_come_back() {
        for name in ["library.toml", "oak/trial1/mi2.wav", "a b/é-01/trial.toml"] {
            assert_eq!(within(name), Some(name.into()));
        }
        for name in [
            "",
            "mi2.wav",
            "/etc/cron.d/x",
            "../a/b",
            "a/../b",
            "a/b/../../../c",
            "a/./b",
            "a//b",
            ".ssh/a/b",
            "a/.b/c",
            "a/b/.bashrc",
            "a\\b/c/d",
            "a/b/c\0",
            "a/b/c/",
            "a/b/c/d",
        ] {
            assert_eq!(within(name), None, "{name:?}");
        }
    }
}
