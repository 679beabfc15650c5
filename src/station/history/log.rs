//! The log of answers, with one line of JSON for each answer and for each change to one. Lines are only
//! ever added; a file that has grown too long is replaced as a whole.
//!
//! ```text
//! {"answer": {…}}                                        an answer, as clients get it
//! {"signals": {"id": "…", "bytes": 1500000}}             bytes of the scan's signals; null if removed
//! {"correction": {"id": "…", "correction": {"was": "surface", "surface": "oak", "person": "anna"}}}
//! {"trial": {"id": "…", "trial": "oak/anna-03", "person": "anna"}}    the scan became this trial of the library
//! ```

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead, BufReader, ErrorKind, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::{AnswerState, Correction, HistoryError};
use crate::library::files;
use crate::station::Answer;
use crate::system::{Locked, read_exact_at};

/// Longest line that is read, in bytes. An answer of this length ranks some ten thousand surfaces.
const LONGEST: usize = 1 << 20;

/// The part of an answer that is kept in memory.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Head {
    pub id: String,
    pub scan: u32,
    /// When the answer was given, in milliseconds since 1970; 0 if that is not known.
    #[serde(default)]
    pub unix_ms: u64,
    pub surface: Option<String>,
    pub state: AnswerState,
    /// Who made the scan, if that is known.
    pub user: Option<String>,
}

impl Head {
    pub(crate) fn of(answer: &Answer) -> Self {
        let Answer { id, scan, unix_ms, surface, state, user, .. } = answer.clone();
        Self { id, scan, unix_ms, surface, state, user }
    }
}

/// An answer, its correction, and what became of its scan. Only the fields that the program reads have
/// types; `others` holds the rest as it was written.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct HistoryRow {
    #[serde(flatten)]
    pub head: Head,
    pub scan_s: f64,
    pub reasons: Vec<String>,
    pub spoiled: Vec<String>,
    #[serde(flatten)]
    pub others: Map<String, Value>,
    pub correction: Option<Correction>,
    /// The trial of the library that the scan became, as `SURFACE/TRIAL`.
    pub became: Option<String>,
    /// Who made that trial, or moved or removed it last; `None` if nobody gave a name.
    pub became_by: Option<String>,
    pub kept: bool,
}

#[derive(Debug)]
pub(super) struct HistoryEntry {
    pub head: Head,
    pub text: Text,
    pub correction: Option<Correction>,
    pub became: Option<String>,
    pub became_by: Option<String>,
    /// Bytes of the scan's signals on disk; `None` if they are not kept.
    pub signals: Option<u64>,
}

impl HistoryEntry {
    pub(super) fn new(head: Head, text: Text) -> Self {
        Self { head, text, correction: None, became: None, became_by: None, signals: None }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum LogLine {
    Answer(Head),
    Signals {
        id: String,
        bytes: Option<u64>,
    },
    Correction {
        id: String,
        correction: Option<Correction>,
    },
    Trial {
        id: String,
        trial: Option<String>,
        /// Who made, moved or removed the trial; `None` if nobody gave a name.
        #[serde(default)]
        person: Option<String>,
    },
}

impl LogLine {
    /// The id of the scan that the line is about, which is also the name of the scan's folder.
    pub(super) fn id(&self) -> &str {
        match self {
            Self::Answer(Head { id, .. })
            | Self::Signals { id, .. }
            | Self::Correction { id, .. }
            | Self::Trial { id, .. } => id,
        }
    }
}

/// The JSON text of an answer. It is in the log, or here if it could not be written to disk.
#[derive(Debug)]
pub enum Text {
    InLog(Span),
    Here(String),
}

impl Text {
    pub fn bytes(&self) -> u64 {
        match self {
            Self::InLog(span) => u64::from(span.length),
            Self::Here(text) => text.len() as u64,
        }
    }

    /// Returns the text, which is read from `log` if it is there.
    pub fn read(&self, log: Option<&Log>) -> Result<String, HistoryError> {
        match (self, log) {
            (Self::InLog(span), Some(log)) => log.answer_text(*span),
            (Self::InLog(_), None) => Ok(String::new()),
            (Self::Here(text), _) => Ok(text.clone()),
        }
    }
}

/// The place of a line in its file, in bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Span {
    pub offset: u64,
    pub length: u32,
}

/// A file of JSON lines that only grows, with the answers of a history, a fleet or an output.
#[derive(Debug)]
pub struct Log {
    path: PathBuf,
    file: File,
    pub bytes: u64,
    _lock: Option<Locked>,
}

impl Log {
    /// Opens a log in a folder, both created if absent, and locks a file against other programs.
    pub fn hold(folder: &Path, name: &str, lock: &str) -> Result<Self, HistoryError> {
        fs::create_dir_all(folder).map_err(HistoryError::io(folder))?;
        let path = folder.join(lock);
        let lock = File::create(&path).map_err(HistoryError::io(&path))?;
        let lock = Locked::now(lock).ok_or_else(|| HistoryError::InUse(folder.to_path_buf()))?;
        Ok(Self { _lock: Some(lock), ..Self::open(&folder.join(name), false)? })
    }

    pub fn open(path: &Path, read_only: bool) -> Result<Self, HistoryError> {
        let fail = HistoryError::io(path);
        let mut options = OpenOptions::new();
        options.read(true).append(!read_only).create(!read_only);
        // Only a regular file is opened, since opening a named pipe would wait for a writer.
        let is_regular = match files::open(path) {
            Err(error) if read_only || error.kind() != ErrorKind::NotFound => Err(error),
            _ => Ok(()),
        };
        let open = || options.open(path).and_then(|file| Ok((file.metadata()?.len(), file)));
        let (bytes, file) = is_regular.and_then(|()| open()).map_err(fail)?;
        Ok(Self { path: path.to_path_buf(), file, bytes, _lock: None })
    }

    /// The lines in the last `most` bytes. Skips lines that are cut short, or are no `T` in JSON.
    pub fn read<T: DeserializeOwned>(&self, most: u64) -> Result<Vec<(T, Span)>, HistoryError> {
        let mut lines = Vec::new();
        self.each(self.bytes.saturating_sub(most)..self.bytes, |line, span| {
            lines.extend(serde_json::from_slice::<T>(line).ok().map(|said| (said, span)));
            Ok(())
        })?;
        Ok(lines)
    }

    /// Calls `act` with each line that lies in a range of bytes, and with the place of the line. Skips
    /// the rest of a line that begins before the range.
    pub(crate) fn each(
        &self,
        range: Range<u64>,
        mut act: impl FnMut(&[u8], Span) -> io::Result<()>,
    ) -> Result<(), HistoryError> {
        let mut read = || {
            let mut reader = BufReader::new(File::open(&self.path)?);
            let mut offset = reader.seek(SeekFrom::Start(range.start))?;
            let (mut text, mut is_begin) = (Vec::new(), offset == 0);
            loop {
                text.clear();
                let most = range.end.saturating_sub(offset).min(LONGEST as u64);
                let read = reader.by_ref().take(most).read_until(b'\n', &mut text)?;
                if read == 0 {
                    return Ok(());
                }
                let line = text.trim_ascii_end();
                if is_begin {
                    act(line, Span { offset, length: line.len() as u32 })?;
                }
                is_begin = text.ends_with(b"\n");
                offset += read as u64;
            }
        };
        read().map_err(HistoryError::io(&self.path))
    }

    pub fn append(&mut self, line: &str) -> Result<Span, HistoryError> {
        let (mut text, mut last) = (Vec::with_capacity(line.len() + 2), [0]);
        let mut ends_well =
            || read_exact_at(&self.file, &mut last, self.bytes - 1).is_ok_and(|()| last == *b"\n");
        // After a crash, the last line may lack its line break, so one is written before this line.
        if self.bytes > 0 && !ends_well() {
            text.push(b'\n');
        }
        let span = Span { offset: self.bytes + text.len() as u64, length: line.len() as u32 };
        text.extend_from_slice(line.as_bytes());
        text.push(b'\n');
        let written = self.file.write_all(&text);
        // A failed write may have left a part of the line in the file, so the length is read anew.
        self.bytes = match (&written, self.file.metadata()) {
            (Err(_), Ok(about)) => about.len(),
            _ => self.bytes + text.len() as u64,
        };
        written.map_err(HistoryError::io(&self.path))?;
        Ok(span)
    }

    /// Adds an answer. Returns where its text is now, and whether it was written.
    pub fn append_answer(&mut self, text: String) -> (Text, Result<(), HistoryError>) {
        match self.append(&format!("{{\"answer\":{text}}}")) {
            Ok(span) => (Text::InLog(span), Ok(())),
            Err(error) => (Text::Here(text), Err(error)),
        }
    }

    pub fn line(&self, span: Span) -> Result<String, HistoryError> {
        let mut text = vec![0; span.length as usize];
        read_exact_at(&self.file, &mut text, span.offset).map_err(HistoryError::io(&self.path))?;
        Ok(String::from_utf8_lossy(&text).into_owned())
    }

    pub fn answer_text(&self, span: Span) -> Result<String, HistoryError> {
        let line = self.line(span)?;
        let text = line.strip_prefix("{\"answer\":").and_then(|rest| rest.strip_suffix('}'));
        Ok(text.unwrap_or("{}").into())
    }

    /// Another handle to the same file, which reads it even after a new file has taken its place.
    pub fn share(&self) -> Result<Self, HistoryError> {
        let file = self.file.try_clone().map_err(HistoryError::io(&self.path))?;
        Ok(Self { path: self.path.clone(), file, bytes: self.bytes, _lock: None })
    }

    /// Opens an empty log, in a file of its own, that can replace this log.
    pub fn begin_anew(&self) -> Result<Self, HistoryError> {
        let path = self.path.with_extension("jsonl.unfinished");
        match fs::remove_file(&path) {
            Err(error) if error.kind() != ErrorKind::NotFound => {
                Err(HistoryError::Io { path, error })
            }
            _ => Self::open(&path, false),
        }
    }

    pub fn replace(&mut self, other: Self) -> Result<(), HistoryError> {
        let moved = other.file.sync_all().and_then(|()| fs::rename(&other.path, &self.path));
        moved.map_err(HistoryError::io(&self.path))?;
        (self.file, self.bytes) = (other.file, other.bytes);
        Ok(())
    }
}
