//! Variables of MATLAB: `.mat` files of Level 5, which `save` writes as `-v6` and `-v7`. A variable is an
//! array, or a cell array whose cells are arrays of trials.
//!
//! A file is a row of elements, each with its type and length, and a variable is an element that holds
//! others. No length is believed: elements are read to the end of what is there.

use std::fs::File;
use std::io::{self, BufReader, Cursor, Read, Seek, SeekFrom};
use std::path::Path;

use flate2::read::ZlibDecoder;

use super::array::{Array, Kind, MOST_WHOLE, Trials};
use super::text::{Limited, OF_HDF5};
use crate::library::{LibraryError, files};

const HEADER: u64 = 128;
/// Longest description of a variable, such as its name, in bytes.
const MOST_SAID: u64 = 4096;
const MATRIX: u32 = 14;
const COMPRESSED: u32 = 15;
const CELL: u8 = 1;
const CHAR: u8 = 4;
const OPAQUE: u8 = 17;

/// Names of the classes, from 1 on.
const CLASSES: [&str; 17] = [
    "cell", "struct", "object", "char", "sparse", "double", "single", "int8", "uint8", "int16",
    "uint16", "int32", "uint32", "int64", "uint64", "function", "object",
];

pub(super) struct MatFile {
    file: File,
    length: u64,
    is_big_endian: bool,
    most: u64,
}

/// The header of a variable or of a cell.
struct Matrix {
    class: u8,
    is_complex: bool,
    shape: Vec<usize>,
    name: String,
}

/// Elements that follow each other.
struct Elements {
    from: Box<dyn Read>,
    is_big_endian: bool,
}

struct Tag {
    kind: u32,
    size: u64,
    /// Bytes behind the content, up to the next element.
    padding: u64,
}

fn damaged(what: &str) -> String {
    format!("it is damaged: {what}")
}

fn cut(error: io::Error) -> String {
    match error.kind() {
        io::ErrorKind::UnexpectedEof => "truncated".into(),
        _ => format!("truncated, or damaged: {error}"),
    }
}

impl MatFile {
    /// Opens a file; `most` is the largest number of bytes that a variable may unpack to.
    pub(super) fn open(path: &Path, most: u64) -> Result<Self, LibraryError> {
        let (file, length) = files::open_filled(path)?;
        Self::of(file, length, most).map_err(LibraryError::at(path))
    }

    fn of(mut file: File, length: u64, most: u64) -> Result<Self, String> {
        let mut header = [0; HEADER as usize];
        let read = file.read_exact(&mut header);
        if header.starts_with(b"MATLAB 7.3") || header.starts_with(b"\x89HDF") {
            return Err(OF_HDF5.into());
        }
        // Text stands here since Level 5; before it, numbers below 5000.
        if header[..4].contains(&0) {
            return Err("a MATLAB file of v4, or none; save it by `save -v7`".into());
        }
        read.map_err(cut)?;
        let is_big_endian = match &header[126..] {
            b"IM" => false,
            b"MI" => true,
            _ => return Err("it is no MATLAB file of v5 to v7; save it by `save -v7`".into()),
        };
        Ok(Self { file, length, is_big_endian, most })
    }

    /// The trials in the variable called `name`, or in the only one that may hold trials; see [`Trials::of`]
    /// for the number of `labels`.
    pub(super) fn trials(
        &self,
        name: Option<&str>,
        labels: Option<usize>,
    ) -> Result<Trials, String> {
        let at = name.map_or_else(|| self.holding_trials(), |name| self.called(name))?;
        let (matrix, elements, _) = self.variable(at)?;
        if matrix.class != CELL {
            return Trials::of(elements.array(matrix)?, labels);
        }
        let arrays = Box::new(elements.cells(&matrix));
        let mut trials = Trials { count: 0, channels: 0, note: None, arrays };
        for (cell, array) in trials.arrays.by_ref().enumerate() {
            let within = |problem| format!("cell {}: {problem}", cell + 1);
            let [count, channels, _] = array.and_then(|it| it.dimensions()).map_err(within)?;
            if cell > 0 && channels != trials.channels {
                let expected =
                    format!("{channels} channels; those before have {}", trials.channels);
                return Err(within(format!("it has {expected}")));
            }
            (trials.count, trials.channels) = (trials.count + count, channels);
        }
        let (matrix, elements, _) = self.variable(at)?;
        trials.arrays = Box::new(elements.cells(&matrix));
        match trials.count {
            0 => Err("it holds no samples".into()),
            _ => Ok(trials),
        }
    }

    /// The labels in the variable called `name`, or in the only one.
    pub(super) fn labels(&self, name: Option<&str>) -> Result<Vec<String>, String> {
        let at = match (name, &self.variables()?[..]) {
            (Some(name), _) => self.called(name)?,
            (None, [(_, at)]) => *at,
            (None, all) => {
                return Err(format!("expected one variable of labels; it has {}", list(all)));
            }
        };
        let (matrix, elements, _) = self.variable(at)?;
        if matrix.class != CELL {
            return elements.labels(matrix);
        }
        let in_cell = |(at, cell): (usize, Result<(Matrix, Elements), String>)| {
            let (matrix, elements) = cell?;
            match &elements.labels(matrix)?[..] {
                [] => Ok(String::new()),
                [label] => Ok(label.clone()),
                more => Err(format!("cell {} holds {} labels; expected one", at + 1, more.len())),
            }
        };
        elements.matrices(&matrix).enumerate().map(in_cell).collect()
    }

    /// All variables, each with its place in the file.
    fn variables(&self) -> Result<Vec<(Matrix, u64)>, String> {
        let (mut all, mut at) = (Vec::new(), HEADER);
        while at < self.length {
            let (matrix, _, next) = self.variable(at)?;
            // A variable without a name belongs to an object.
            if !matrix.name.is_empty() {
                all.push((matrix, at));
            }
            at = next;
        }
        Ok(all)
    }

    fn called(&self, name: &str) -> Result<u64, String> {
        let all = self.variables()?;
        let found = all.iter().find(|(matrix, _)| matrix.name == name);
        let (_, at) = found.ok_or_else(|| format!("it has no `{name}`; it has {}", list(&all)))?;
        Ok(*at)
    }

    fn holding_trials(&self) -> Result<u64, String> {
        let all = self.variables()?;
        let ranked = |(matrix, at): &(Matrix, u64)| Ok((self.rank(matrix, *at)?, *at));
        let ranks = all.iter().map(ranked).collect::<Result<Vec<_>, String>>()?;
        // Beside trials stand rates and labels, which are no more than a row of numbers.
        let best = ranks.iter().map(|(rank, _)| (*rank).min(2)).max().unwrap_or(0);
        let mut found = ranks.iter().filter(|(rank, _)| best > 0 && (*rank).min(2) == best);
        match (found.next(), found.next()) {
            (Some((_, at)), None) => Ok(*at),
            (Some(_), Some(_)) => {
                Err(format!("it has several arrays ({}); say which by --variable", list(&all)))
            }
            _ => Err(format!(
                "it has no array of trials; it has {}; save numbers or a cell array of them, of a field \
                 of a struct array by `X = {{s.data}}`",
                list(&all)
            )),
        }
    }

    /// How many dimensions of a variable are longer than 1; 2 for a cell array of numbers, and 0 for what
    /// cannot be trials.
    fn rank(&self, matrix: &Matrix, at: u64) -> Result<usize, String> {
        if matrix.class == CELL {
            let (matrix, elements, _) = self.variable(at)?;
            let first = elements.matrices(&matrix).next().transpose()?;
            return Ok(if first.is_some_and(|(cell, _)| cell.refusal().is_none()) { 2 } else { 0 });
        }
        let long = matrix.shape.iter().filter(|length| **length > 1).count();
        Ok(if matrix.refusal().is_none() { long } else { 0 })
    }

    /// The variable at a place in the file, the elements of its content, and the place of the next one.
    fn variable(&self, at: u64) -> Result<(Matrix, Elements, u64), String> {
        let mut file = self.file.try_clone().map_err(cut)?;
        file.seek(SeekFrom::Start(at)).map_err(cut)?;
        let is_big_endian = self.is_big_endian;
        let mut elements = Elements { from: Box::new(BufReader::new(file)), is_big_endian };
        let mut tag = elements.tag()?;
        let mut next = at + 8 + tag.size;
        if tag.kind == COMPRESSED {
            let unpacked = ZlibDecoder::new(elements.from.take(tag.size));
            elements.from = Box::new(Limited { from: unpacked, left: self.most });
            tag = elements.tag()?;
        } else {
            next += tag.padding;
        }
        let mut elements = elements.within(&tag)?;
        Ok((elements.matrix()?, elements, next))
    }
}

fn list(variables: &[(Matrix, u64)]) -> String {
    let one = |(matrix, _): &(Matrix, u64)| {
        let shape: Vec<String> = matrix.shape.iter().map(usize::to_string).collect();
        format!("`{}` ({} {})", matrix.name.escape_debug(), shape.join("×"), matrix.class_name())
    };
    let shown: Vec<String> = variables.iter().take(50).map(one).collect();
    if shown.is_empty() { "no variable".into() } else { shown.join(", ") }
}

impl Matrix {
    fn class_name(&self) -> &'static str {
        let at = usize::from(self.class).checked_sub(1);
        at.and_then(|at| CLASSES.get(at)).unwrap_or(&"unknown class")
    }

    /// Why this is no array of numbers.
    fn refusal(&self) -> Option<String> {
        let what = match self.class {
            _ if self.is_complex => "complex; save its parts as numbers (`real`, `imag`)".into(),
            5 => "sparse; save it by `full`".into(),
            6..=15 => return None,
            _ => {
                let class = self.class_name();
                let article = if class.starts_with(['o', 'u']) { "an" } else { "a" };
                let cells = if class == "struct" { ", as by `X = {s.data}`" } else { "" };
                format!("{article} {class}; save numbers, or a cell array of numbers{cells}")
            }
        };
        let name = if self.name.is_empty() { "it".into() } else { format!("`{}`", self.name) };
        Some(format!("{name} is {what}"))
    }

    /// The shape as that of an array of NumPy, where a column has one dimension.
    fn plain_shape(&self) -> Vec<usize> {
        match self.shape[..] {
            [count, 1] if count > 1 => vec![count],
            _ => self.shape.clone(),
        }
    }
}

impl Elements {
    fn word(&mut self) -> Result<u32, String> {
        let mut bytes = [0; 4];
        self.from.read_exact(&mut bytes).map_err(cut)?;
        Ok(self.number(&bytes))
    }

    fn number(&self, four: &[u8; 4]) -> u32 {
        if self.is_big_endian { u32::from_be_bytes(*four) } else { u32::from_le_bytes(*four) }
    }

    fn tag(&mut self) -> Result<Tag, String> {
        let first = self.word()?;
        // Up to four bytes stand in the place of their length.
        if let (size @ 1.., kind) = (u64::from(first >> 16), first & 0xffff) {
            let padding = 4_u64.checked_sub(size).ok_or_else(|| damaged("a small element"))?;
            return Ok(Tag { kind, size, padding });
        }
        let size = u64::from(self.word()?);
        Ok(Tag { kind: first, size, padding: size.next_multiple_of(8) - size })
    }

    fn within(self, tag: &Tag) -> Result<Self, String> {
        match tag.kind {
            MATRIX => Ok(Self { from: Box::new(self.from.take(tag.size)), ..self }),
            _ => Err(damaged("a variable was expected")),
        }
    }

    /// The content of the element of a tag, of at most `most` bytes.
    fn content(&mut self, tag: &Tag, most: u64) -> Result<Vec<u8>, String> {
        let (size, length) = (tag.size, tag.size + tag.padding);
        if size > most {
            return Err(damaged(&format!("an element of {size} bytes; at most {most} are read")));
        }
        let mut bytes = Vec::new();
        let read = self.from.by_ref().take(length).read_to_end(&mut bytes).map_err(cut)? as u64;
        // The padding behind the last element may be missing.
        if read < size {
            return Err("truncated".into());
        }
        bytes.truncate(size as usize);
        Ok(bytes)
    }

    fn words(&mut self) -> Result<(u32, Vec<u8>), String> {
        let tag = self.tag()?;
        Ok((tag.kind, self.content(&tag, MOST_SAID)?))
    }

    /// Reads what a matrix says of itself; its content is next.
    fn matrix(&mut self) -> Result<Matrix, String> {
        let (_, flags) = self.words()?;
        let flags = flags.first_chunk().ok_or_else(|| damaged("a variable without class"))?;
        let flags = self.number(flags);
        let (class, is_complex) = (flags as u8, flags & 0x800 != 0);
        let mut shape = Vec::new();
        // Objects have no shape.
        if class != OPAQUE {
            for four in self.words()?.1.as_chunks().0 {
                let length =
                    i32::try_from(self.number(four)).map_err(|_| damaged("its dimensions"))?;
                shape.push(length as usize);
            }
        }
        let name = String::from_utf8_lossy(&self.words()?.1).into_owned();
        Ok(Matrix { class, is_complex, shape, name })
    }

    fn array(mut self, matrix: Matrix) -> Result<Array, String> {
        if let Some(problem) = matrix.refusal() {
            return Err(problem);
        }
        let shape = matrix.plain_shape();
        if shape.contains(&0) {
            return Err("it holds no samples".into());
        }
        let tag = self.tag()?;
        // Whole numbers are stored in as few bytes as they take, whatever their class.
        let (kind, size) = match tag.kind {
            1 => (Kind::Signed, 1),
            2 => (Kind::Unsigned, 1),
            3 => (Kind::Signed, 2),
            4 => (Kind::Unsigned, 2),
            5 => (Kind::Signed, 4),
            6 => (Kind::Unsigned, 4),
            7 => (Kind::Float, 4),
            9 => (Kind::Float, 8),
            12 => (Kind::Signed, 8),
            13 => (Kind::Unsigned, 8),
            other => return Err(damaged(&format!("numbers of type {other}"))),
        };
        let bytes = shape.iter().try_fold(size as u64, |all, part| all.checked_mul(*part as u64));
        if bytes != Some(tag.size) {
            return Err(damaged(&format!("{:?} elements in {} bytes", matrix.shape, tag.size)));
        }
        let (is_big_endian, content) = (self.is_big_endian, self.from);
        Ok(Array {
            shape,
            kind,
            size,
            is_big_endian,
            is_crosswise: true,
            samples_first: false,
            content,
        })
    }

    fn matrices(
        mut self,
        matrix: &Matrix,
    ) -> impl Iterator<Item = Result<(Matrix, Self), String>> + use<> {
        // A missing cell is an error, at which all readers stop.
        let count = matrix.shape.iter().fold(1_usize, |all, part| all.saturating_mul(*part));
        (0..count).map(move |_| self.cell())
    }

    fn cell(&mut self) -> Result<(Matrix, Self), String> {
        let tag = self.tag()?;
        let content = self.content(&tag, MOST_WHOLE)?;
        let is_big_endian = self.is_big_endian;
        let cell = Self { from: Box::new(Cursor::new(content)), is_big_endian };
        let mut cell = cell.within(&tag)?;
        match tag.size {
            // Of an empty cell, nothing is written.
            0 => Ok((
                Matrix { class: 6, is_complex: false, shape: vec![0], name: String::new() },
                cell,
            )),
            _ => Ok((cell.matrix()?, cell)),
        }
    }

    fn cells(self, matrix: &Matrix) -> impl Iterator<Item = Result<Array, String>> + use<> {
        self.matrices(matrix).map(|cell| cell.and_then(|(matrix, elements)| elements.array(matrix)))
    }

    /// The lines of text, or the numbers, in a matrix.
    fn labels(mut self, matrix: Matrix) -> Result<Vec<String>, String> {
        if matrix.class != CHAR {
            return self.array(matrix)?.labels();
        }
        let rows = matrix.shape.first().copied().unwrap_or(0);
        if matrix.shape.contains(&0) {
            return Ok(Vec::new());
        }
        let chars = self.chars()?;
        let row = |row: usize| chars.iter().skip(row).step_by(rows).collect::<String>();
        let rows = (0..rows.min(chars.len())).map(row);
        Ok(rows.map(|row| row.trim_end().to_string()).collect())
    }

    fn chars(&mut self) -> Result<Vec<char>, String> {
        let tag = self.tag()?;
        let bytes = self.content(&tag, MOST_WHOLE)?;
        let unit = |two: &[u8; 2]| match self.is_big_endian {
            true => u16::from_be_bytes(*two),
            false => u16::from_le_bytes(*two),
        };
        match tag.kind {
            1 | 2 | 16 => Ok(String::from_utf8_lossy(&bytes).chars().collect()),
            4 | 17 => {
                let chars = char::decode_utf16(bytes.as_chunks().0.iter().map(unit));
                Ok(chars.map(|char| char.unwrap_or('\u{fffd}')).collect())
            }
            other => Err(damaged(&format!("text of type {other}"))),
        }
    }
}
