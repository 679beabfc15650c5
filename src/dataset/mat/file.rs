//! One trial in one MATLAB file: which variables it has, and their data as signals.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use super::level5::{self, Array, ArrayValues, ByteOrder, Class, ElementKind, MatError, Variable};
use crate::library::{LibraryError, LoadTrial, Outline, Outlines, files};
use crate::scene::SourceId;
use crate::trial::{Image, Series, Signal, Trial, TrialKey};

/// How a source lies in a file.
#[derive(Debug)]
pub(super) enum MatSource {
    /// [frames × channels].
    Series { variable: String, channels: usize, rate_hz: f64 },
    /// [rows × columns × 3], uint8.
    Image { variable: String },
}

impl MatSource {
    fn variable(&self) -> &str {
        match self {
            Self::Series { variable, .. } | Self::Image { variable } => variable,
        }
    }
}

/// Reads one trial from its file.
#[derive(Debug)]
pub(super) struct MatTrial {
    pub key: TrialKey,
    pub path: PathBuf,
    pub sources: BTreeMap<SourceId, MatSource>,
}

impl LoadTrial for MatTrial {
    fn load(&self, wanted: &[SourceId]) -> Result<Trial, LibraryError> {
        let mut walk = Walk::open(&self.path)?;
        let mut signals = BTreeMap::new();
        while let Some(element) = walk.next()? {
            let name = &element.variable.name;
            let found = self.sources.iter().find(|(id, stored)| {
                stored.variable() == name && wanted.contains(id) && !signals.contains_key(*id)
            });
            if let Some((id, stored)) = found {
                let array = walk.array(&element)?;
                signals.insert(id.clone(), signal(&self.path, stored, array)?);
            }
        }
        let missing =
            self.sources.keys().find(|id| wanted.contains(id) && !signals.contains_key(*id));
        if missing.is_some() {
            let problem = "it changed since the library was opened; open it again";
            return Err(LibraryError::file(&self.path, problem));
        }
        Ok(Trial { key: self.key.clone(), signals })
    }

    fn outlines(&self, wanted: &[SourceId]) -> Result<Option<Outlines>, LibraryError> {
        let mut walk = Walk::open(&self.path)?;
        let mut outlines = Outlines::new();
        while let Some(Element { variable, .. }) = walk.next()? {
            for (id, stored) in self.sources.iter().filter(|(id, _)| wanted.contains(id)) {
                if let MatSource::Series { variable: name, channels, rate_hz } = stored
                    && *name == variable.name
                    && let Some((frames, _)) = frames_of(&variable.dims, *channels)
                {
                    let outline = Outline { rate_hz: *rate_hz, channels: *channels, frames };
                    outlines.insert(id.clone(), outline);
                }
            }
        }
        Ok(Some(outlines))
    }

    fn stamp(&self, wanted: &[SourceId]) -> Option<u64> {
        let path = std::slice::from_ref(&self.path);
        let known = self.sources.keys().filter(|id| wanted.contains(id));
        files::stamp(known.map(|id| (id, path)))
    }
}

/// Frames of a matrix with a given number of channels, and whether they are its columns: a row where a
/// column was expected is no harm.
fn frames_of(dims: &[usize], channels: usize) -> Option<(usize, bool)> {
    match *dims {
        [frames, found] if found == channels => Some((frames, false)),
        [found, frames] if found == channels => Some((frames, true)),
        _ => None,
    }
}

/// Names of the variables of a file; their data are passed over.
///
/// # Errors
/// If the file cannot be read or is not of level 5.
pub(super) fn variables(path: &Path) -> Result<Vec<String>, LibraryError> {
    let mut walk = Walk::open(path)?;
    let mut names = Vec::new();
    while let Some(element) = walk.next()? {
        names.push(element.variable.name);
    }
    Ok(names)
}

/// All texts of a file, in order: the first variable that has any.
///
/// # Errors
/// If the file cannot be read, is not of level 5, or holds no text.
pub(super) fn texts(path: &Path) -> Result<Vec<String>, LibraryError> {
    let mut walk = Walk::open(path)?;
    while let Some(element) = walk.next()? {
        if matches!(element.variable.class, Class::Cell | Class::Char) {
            let array = walk.array(&element)?;
            let texts: Vec<String> = array.texts().into_iter().map(String::from).collect();
            if !texts.is_empty() {
                return Ok(texts);
            }
        }
    }
    Err(LibraryError::file(path, "it holds neither a cell array of names nor a matrix of char"))
}

/// A variable, and where its element lies.
struct Element {
    variable: Variable,
    kind: ElementKind,
    start: u64,
    length: usize,
}

/// A file, from variable to variable.
struct Walk<'a> {
    path: &'a Path,
    file: File,
    size: u64,
    at: u64,
    order: ByteOrder,
}

impl<'a> Walk<'a> {
    fn open(path: &'a Path) -> Result<Self, LibraryError> {
        let fail = |error| LibraryError::io(path, error);
        let (mut file, size) = files::open(path).map_err(fail)?;
        let mut head = Vec::new();
        (&mut file).take(level5::HEADER as u64).read_to_end(&mut head).map_err(fail)?;
        let order = level5::header(&head).map_err(|error| damaged(path, &error))?;
        Ok(Self { path, file, size, at: level5::HEADER as u64, order })
    }

    /// Up to `length` bytes from `start` on.
    fn bytes(&mut self, start: u64, length: usize) -> Result<Vec<u8>, LibraryError> {
        let mut bytes = Vec::new();
        self.file
            .seek(SeekFrom::Start(start))
            .and_then(|_| (&mut self.file).take(length as u64).read_to_end(&mut bytes))
            .map_err(|error| LibraryError::io(self.path, error))?;
        Ok(bytes)
    }

    fn next(&mut self) -> Result<Option<Element>, LibraryError> {
        if self.at >= self.size {
            return Ok(None);
        }
        let head = self.bytes(self.at, level5::TAG + level5::PREFIX)?;
        let (tag, after) = head
            .split_first_chunk::<{ level5::TAG }>()
            .ok_or_else(|| damaged(self.path, &MatError::CutShort))?;
        let (kind, length) =
            level5::tag(self.order, *tag).map_err(|error| damaged(self.path, &error))?;
        let start = self.at + level5::TAG as u64;
        self.at = start + length as u64;
        if self.at > self.size {
            return Err(damaged(self.path, &MatError::CutShort));
        }
        let fail = |error| damaged(self.path, &error);
        let prefix = &after[..after.len().min(length)];
        let variable = level5::peek(self.order, kind, prefix).map_err(fail)?;
        Ok(Some(Element { variable, kind, start, length }))
    }

    fn array(&mut self, element: &Element) -> Result<Array, LibraryError> {
        let body = self.bytes(element.start, element.length)?;
        level5::array(self.order, element.kind, &body).map_err(|error| {
            let name = &element.variable.name;
            LibraryError::file(self.path, format!("variable `{name}`: {error}"))
        })
    }
}

fn damaged(path: &Path, error: &MatError) -> LibraryError {
    LibraryError::file(path, error.to_string())
}

fn signal(path: &Path, stored: &MatSource, array: Array) -> Result<Signal, LibraryError> {
    let Array { variable: Variable { name, class, dims }, values } = array;
    let shape = dims.iter().map(usize::to_string).collect::<Vec<_>>().join("×");
    let wrong = |expected: &str| {
        let what = match class {
            Class::Numbers { byte: true } => "uint8",
            Class::Numbers { byte: false } => "numbers",
            Class::Char => "text",
            Class::Cell => "a cell array",
            Class::Other(what) => what,
        };
        let problem = format!("variable `{name}` is {what}, {shape}; expected {expected}");
        LibraryError::file(path, problem)
    };
    let in_file = |error| LibraryError::file(path, format!("variable `{name}`: {error}"));
    match (stored, values) {
        (MatSource::Series { channels, rate_hz, .. }, ArrayValues::Numbers(values)) => {
            let (frames, turned) = frames_of(&dims, *channels)
                .ok_or_else(|| wrong(&format!("numbers, N×{channels}")))?;
            let at = |frame: usize, channel: usize| {
                if turned { frame * channels + channel } else { channel * frames + frame }
            };
            // The decoder saw to it that there are as many values as the dimensions say.
            let samples = (0..frames)
                .flat_map(|frame| (0..*channels).map(move |channel| (frame, channel)))
                .map(|(frame, channel)| values[at(frame, channel)] as f32);
            let series = Series::new(*rate_hz, *channels, samples.collect()).map_err(in_file)?;
            Ok(Signal::Series(series))
        }
        (MatSource::Image { .. }, ArrayValues::Numbers(values)) => {
            let ([rows, columns, 3], Class::Numbers { byte: true }) = (&dims[..], class) else {
                return Err(wrong("uint8, 480×320×3"));
            };
            let (rows, columns) = (*rows, *columns);
            let pixels = (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column)));
            let rgb = pixels.flat_map(|(row, column)| {
                // uint8, as checked above.
                [0, 1, 2].map(|c| values[(c * columns + column) * rows + row] as u8)
            });
            Image::new(columns, rows, rgb.collect()).map(Signal::Image).map_err(in_file)
        }
        (MatSource::Series { channels, .. }, _) => Err(wrong(&format!("numbers, N×{channels}"))),
        (MatSource::Image { .. }, _) => Err(wrong("uint8, 480×320×3")),
    }
}
