//! Exports trials to MCAP (<https://mcap.dev/spec>), for viewers like Foxglove, and imports them.
//!
//! An MCAP file holds each recording twice. Messages are what viewers draw; compressed, they take
//! about as much room as the recording. Attachments are copies of the recording's files, byte for
//! byte, and an import writes them back.
//!
//! A message holds a tenth of a second of one source, so that message headers take little room.
//! 16-bit samples are written as whole numbers with one scale, which take half as much space as
//! decimals. Pictures are written as JPEG.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::BufWriter;
use std::path::{Component, Path, PathBuf};

use base64::Engine;
use mcap::records::MessageHeader;
use mcap::{Attachment, Compression, Summary, WriteOptions, Writer};
use serde_json::json;

use super::importing::Importing;
use super::{failed, write_file};
use crate::library::files::{self, Listed};
use crate::library::recording::{self, DESCRIPTION};
use crate::library::{Library, LibraryError};
use crate::scene::Scene;
use crate::trial::{Image, Series, Signal, Trial};
use crate::{dataset, jpeg};

/// Opens a recording for an export: a library of any layout, or a single trial of a library in the
/// recording format.
///
/// # Errors
/// If the path is neither a library nor a trial, or cannot be read.
pub fn open(recording: &Path, scene: &Scene) -> Result<Library, LibraryError> {
    match is_trial(recording)? {
        true => recording::open_trial(recording, scene),
        false => dataset::open(recording, scene),
    }
}

/// Most parts of a file's path below its library's folder; the LMT108 dataset needs this many.
const DEEPEST: usize = 6;

/// Whether a folder is a single trial: it holds only files, while a library also holds folders.
fn is_trial(recording: &Path) -> Result<bool, LibraryError> {
    Ok(!visible(recording)?.iter().any(|item| item.is_dir))
}

/// Name, relative to the library, and path of each file; refuses a link that leads out of the recording.
fn attached(recording: &Path) -> Result<Vec<(String, PathBuf)>, LibraryError> {
    let root = recording.canonicalize().map_err(|error| LibraryError::io(recording, error))?;
    let mut all = Vec::new();
    if !is_trial(&root)? {
        below(&root, &root, &mut all)?;
        return Ok(all);
    }
    // For a single trial, too, file names begin with `SURFACE/TRIAL`.
    let library = root.ancestors().nth(2).unwrap_or(&root);
    let description = library.join(DESCRIPTION);
    if description.is_file() {
        inside(&description, library)?;
        all.push((DESCRIPTION.into(), description));
    }
    below(&root, library, &mut all)?;
    Ok(all)
}

fn below(folder: &Path, root: &Path, all: &mut Vec<(String, PathBuf)>) -> Result<(), LibraryError> {
    for item in visible(folder)? {
        let name = files::name_within(root, &item.path);
        if item.is_dir && name.split('/').count() < DEEPEST {
            inside(&item.path, root)?;
            below(&item.path, root, all)?;
        } else if !item.is_dir && item.unusable.is_none() {
            inside(&item.path, root)?;
            all.extend(within(&name).map(|_| (name, item.path)));
        }
    }
    Ok(())
}

/// Refuses a link that leads out of `root`, to files that nobody meant to share.
fn inside(path: &Path, root: &Path) -> Result<(), LibraryError> {
    let real = path.canonicalize().map_err(|error| LibraryError::io(path, error))?;
    match real.starts_with(root) {
        true => Ok(()),
        false => Err(LibraryError::file(
            path,
            format!("a link that leads out of the recording, to {}; copy it in", real.display()),
        )),
    }
}

fn visible(dir: &Path) -> Result<Vec<Listed>, LibraryError> {
    Ok(files::list(dir)?.into_iter().filter(|item| !item.is_hidden()).collect())
}

/// The path for the name of an attached file; `None` for a name that no recording has. Allowed are
/// `library.toml` and `.mat` lists beside the folders, and files within the folders.
fn within(name: &str) -> Option<PathBuf> {
    let path = Path::new(name);
    let plain = |part: Component<'_>| match part {
        Component::Normal(part) => part.to_str().is_some_and(|part| !part.starts_with('.')),
        _ => false,
    };
    let fits = match path.components().count() {
        1 => name == DESCRIPTION || name.ends_with(".mat"),
        parts => (2..=DEEPEST).contains(&parts),
    };
    let odd = name.contains(['\\', '\0']) || name.split('/').any(|part| matches!(part, "" | "."));
    (fits && !odd && path.components().all(plain)).then(|| path.to_path_buf())
}

/// Pause between two trials on the time line, in seconds, so that a viewer shows them apart.
const PAUSE_S: f64 = 1.0;
/// Largest file of a recording, and largest MCAP file, in bytes: each is read into memory.
const MOST_FILE: u64 = 1 << 30;
const MOST_MCAP: u64 = 1 << 32;

/// Writes a recording (a library, or one of its trials, `SURFACE/TRIAL`) to `out`, and returns the
/// number of trials. An export that fails leaves no file.
///
/// # Errors
/// If the recording cannot be read or has a link that leads out of it, or if `out` exists or cannot
/// be written.
pub fn export(recording: &Path, library: &Library, out: &Path) -> Result<usize, LibraryError> {
    let file = File::create_new(out).map_err(|error| failed(out, error))?;
    let written = write(recording, library, out, file);
    if written.is_err() {
        // An error of the clean-up is ignored, since the export's own error is returned.
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
    for (name, path) in attached(recording)? {
        let data = match files::read_bytes(&path, MOST_FILE) {
            // An empty file belongs to the recording, too, although `read_bytes` refuses it.
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
        let trial_s = messages(&mut writer, &entry.load()?, begin_s).map_err(failed)?;
        begin_s += trial_s + PAUSE_S;
    }
    writer.finish().map(drop).map_err(failed)
}

fn media_type(name: &str) -> &'static str {
    match name.rsplit('.').next() {
        Some("wav") => "audio/wav",
        Some("flac") => "audio/flac",
        Some("mp3") => "audio/mpeg",
        Some("m4a") => "audio/mp4",
        Some("ogg" | "oga") => "audio/ogg",
        Some("png") => "image/png",
        Some("jpg" | "jpeg") => "image/jpeg",
        Some("toml") => "application/toml",
        Some("txt") => "text/plain",
        _ => "application/octet-stream",
    }
}

const MESSAGES_A_SECOND: f64 = 10.0;
/// The step between two samples of 16 bits, if full scale is ±1.
const STEP: f32 = 1.0 / 32768.0;
/// The JSON schema of samples: one list for each channel; a sample is value times scale.
const SAMPLES_SCHEMA: &str = r#"{"title": "surfaced.Samples", "type": "object", "properties": {"rate_hz": {"type": "number"}, "scale": {"type": "number"}, "values": {"type": "array", "items": {"type": "array", "items": {"type": "number"}}}}, "required": ["rate_hz", "scale", "values"]}"#;
/// JSON schema of pictures: <https://docs.foxglove.dev/docs/sdk/schemas/compressed-image>.
const PICTURE_SCHEMA: &str = r#"{"title": "foxglove.CompressedImage", "type": "object", "properties": {"timestamp": {"type": "object", "title": "time", "properties": {"sec": {"type": "integer", "minimum": 0}, "nsec": {"type": "integer", "minimum": 0, "maximum": 999999999}}}, "frame_id": {"type": "string"}, "data": {"type": "string", "contentEncoding": "base64"}, "format": {"type": "string"}}}"#;

type McapFile = BufWriter<File>;

/// Writes the messages of a trial, and returns the trial's duration in seconds.
fn messages(writer: &mut Writer<McapFile>, trial: &Trial, begin_s: f64) -> mcap::McapResult<f64> {
    let mut longest_s = 0.0f64;
    for (source, signal) in &trial.signals {
        let key = &trial.key;
        let mut about = BTreeMap::from([
            ("surface".to_string(), key.surface.clone()),
            ("user".to_string(), key.user.clone()),
            ("trial".to_string(), key.number.to_string()),
        ]);
        about.extend(key.session.clone().map(|session| ("session".to_string(), session)));
        let (name, schema) = match signal {
            Signal::Series(_) => ("surfaced.Samples", SAMPLES_SCHEMA),
            Signal::Image(_) => ("foxglove.CompressedImage", PICTURE_SCHEMA),
        };
        if let Signal::Series(series) = signal {
            about.insert("rate_hz".into(), series.rate_hz().to_string());
            longest_s = longest_s.max(series.duration_s());
        }
        let schema = writer.add_schema(name, "jsonschema", schema.as_bytes())?;
        let channel = writer.add_channel(schema, &format!("/{source}"), "json", &about)?;
        match signal {
            Signal::Series(series) => samples(writer, channel, series, begin_s)?,
            Signal::Image(image) => picture(writer, channel, image, begin_s)?,
        }
    }
    Ok(longest_s)
}

fn header(channel_id: u16, sequence: u32, at_s: f64) -> MessageHeader {
    let time = (at_s * 1e9).round() as u64;
    MessageHeader { channel_id, sequence, log_time: time, publish_time: time }
}

fn samples(
    writer: &mut Writer<McapFile>,
    channel: u16,
    series: &Series,
    begin_s: f64,
) -> mcap::McapResult<()> {
    let (channels, rate_hz) = (series.channels(), series.rate_hz());
    let frames = ((rate_hz / MESSAGES_A_SECOND).ceil() as usize).max(1);
    // Dividing by 2^-15 is exact. Whole numbers mean that the samples were recorded with 16 bits.
    let whole = series.samples().iter().all(|x| (x / STEP).fract() == 0.0 && x.abs() <= 1.0);
    let scale = if whole { STEP } else { 1.0 };
    for (index, block) in series.samples().chunks(frames * channels).enumerate() {
        let number = |sample: &f32| match whole {
            true => ((sample / STEP) as i32).to_string(),
            false => format!("{sample:?}"),
        };
        let of_channel = |channel: usize| {
            let numbers: Vec<_> = block[channel..].iter().step_by(channels).map(number).collect();
            format!("[{}]", numbers.join(","))
        };
        let values = (0..channels).map(of_channel).collect::<Vec<_>>().join(",");
        let text = format!(r#"{{"rate_hz":{rate_hz},"scale":{scale},"values":[{values}]}}"#);
        let at_s = begin_s + (index * frames) as f64 / rate_hz;
        writer.write_to_known_channel(&header(channel, index as u32, at_s), text.as_bytes())?;
    }
    Ok(())
}

fn picture(
    writer: &mut Writer<McapFile>,
    channel: u16,
    image: &Image,
    begin_s: f64,
) -> mcap::McapResult<()> {
    let jpeg = jpeg::encode(image).map_err(std::io::Error::other)?;
    let data = base64::engine::general_purpose::STANDARD.encode(jpeg);
    let time = json!({ "sec": begin_s as u64, "nsec": (begin_s.fract() * 1e9) as u32 });
    let message = json!({ "timestamp": time, "frame_id": "", "data": data, "format": "jpeg" });
    writer.write_to_known_channel(&header(channel, 0, begin_s), message.to_string().as_bytes())
}

/// Restores the files of an exported recording into `dir`, a new folder. Returns the number of
/// trials (folders SURFACE/TRIAL; 0 for the dataset LMT108). The folder appears only when it is
/// complete: an import that fails leaves nothing.
///
/// # Errors
/// If `mcap` is not an MCAP file, holds no files of a recording, or names a file that would lie
/// outside `dir`; also if `dir` exists, or cannot be written.
pub fn import(mcap: &Path, dir: &Path) -> Result<usize, LibraryError> {
    let bytes = files::read_bytes(mcap, MOST_MCAP)?;
    let attached = attachments(&bytes).map_err(LibraryError::at(mcap))?;
    if dir.symlink_metadata().is_ok() {
        return Err(failed(dir, std::io::ErrorKind::AlreadyExists.into()));
    }
    let importing = Importing::begin(dir)?;
    for (path, data) in &attached {
        let path = importing.folder.join(path);
        let folder = path.parent().unwrap_or(dir);
        fs::create_dir_all(folder).map_err(|error| failed(folder, error))?;
        write_file(&path, data, true)?;
    }
    importing.finish(dir)?;
    let folders = attached.iter().filter_map(|(path, _)| path.parent());
    let trials: BTreeSet<_> = folders.filter(|folder| folder.iter().count() == 2).collect();
    Ok(trials.len())
}

/// The attachments of an MCAP file: for each, its relative path and its bytes. Refuses attachments
/// that overlap, since they could expand to many times the size of the file.
fn attachments(bytes: &[u8]) -> Result<Vec<(PathBuf, Vec<u8>)>, String> {
    let damaged = |error: mcap::McapError| format!("no whole MCAP file: {error}");
    let mut indexes = Summary::read(bytes).map_err(damaged)?.unwrap_or_default().attachment_indexes;
    indexes.sort_by_key(|index| index.offset);
    let (mut end, mut names) = (0, BTreeSet::new());
    let mut attached = Vec::new();
    for index in &indexes {
        let name = &index.name;
        let start = index.offset;
        if start < end {
            return Err(format!("the file {name:?} lies within another one"));
        }
        let inside = start.checked_add(index.length).filter(|end| *end <= bytes.len() as u64);
        end = inside.ok_or_else(|| format!("the index of {name:?} points outside the file"))?;
        let file = mcap::read::attachment(bytes, index).map_err(damaged)?;
        let path = within(&file.name)
            .ok_or_else(|| format!("holds a file {:?}; expected SURFACE/TRIAL/FILE", file.name))?;
        if !names.insert(path.clone()) {
            return Err(format!("holds two files {:?}", file.name));
        }
        attached.push((path, file.data.into_owned()));
    }
    match attached.is_empty() {
        true => Err("holds no recording that surfaced exported".into()),
        false => Ok(attached),
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::*;

    #[test]
    fn only_a_recordings_own_files_come_back() {
        for name in [
            "library.toml",
            "oak/trial1/mi2.wav",
            "a b/é-01/trial.toml",
            "SoundScans/Movement/Training/a.wav",
            "surfaceList_LMT108train.mat",
        ] {
            assert_eq!(within(name), Some(name.into()));
        }
        // The first of these names is empty.
        let others = " mi2.wav /etc/cron.d/x ../a/b a/../b a/b/../../../c a/./b a//b .ssh/a/b a/.b/c \
                      a/b/.bashrc a\\b/c/d a/b/c\0 a/b/c/ a/b/c/d/e/f/g";
        for name in others.split(' ') {
            assert_eq!(within(name), None, "{name:?}");
        }
    }

    fn with(names: &[&str]) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        let mut writer = Writer::new(&mut bytes).unwrap();
        for name in names {
            let (name, data) = ((*name).to_string(), Cow::Owned(vec![7; 1000]));
            let media_type = String::new();
            let file = Attachment { log_time: 0, create_time: 0, name, media_type, data };
            writer.attach(&file).unwrap();
        }
        writer.finish().unwrap();
        drop(writer);
        bytes.into_inner()
    }

    #[test]
    fn files_within_files_and_two_of_one_name_are_refused() {
        assert_eq!(attachments(&with(&["a/b/c", "a/b/d"])).unwrap().len(), 2);
        assert!(attachments(&with(&["a/b/c", "a/b/c"])).unwrap_err().contains("two files"));
        // Makes the index of the second file point into the first file.
        let mut bytes = with(&["a/b/c", "a/b/d"]);
        let indexes = Summary::read(&bytes).unwrap().unwrap().attachment_indexes;
        let second = indexes[1].offset.to_le_bytes();
        let at = bytes.windows(8).rposition(|eight| eight == second).unwrap();
        bytes[at..at + 8].copy_from_slice(&(indexes[0].offset + 8).to_le_bytes());
        let error = attachments(&bytes).unwrap_err();
        assert!(error.contains("within another") || error.contains("no whole"), "{error}");
    }
}
