//! Decoder of MATLAB level 5 files: bytes in, arrays out, no I/O.
//!
//! Follows "MAT-File Format" (The MathWorks): a header of 128 bytes, then data elements, each with
//! a tag of type and length. Read are numeric arrays, text and cell arrays, in either byte order,
//! compressed or not. Structures, objects and sparse arrays are named and left unread. Sizes are
//! bounded, so that a hostile file costs bounded memory and time.

mod data;
mod format;

use std::io::Read;

use flate2::read::ZlibDecoder;

use self::data::{letters, numbers, rows};
pub use self::format::{Array, ArrayValues, ByteOrder, Class, MatError, Variable};
use self::format::{MAX_BYTES, MAX_CELLS, MAX_DEPTH, MAX_DIMS, MAX_NAME, MAX_NUMBERS};

/// Length of the header in bytes.
pub const HEADER: usize = 128;
/// Length of the tag before each top-level element in bytes.
pub const TAG: usize = 8;
/// The first bytes of an element that always hold the name and shape of its variable.
pub const PREFIX: usize = 1024;

/// Checks a header and gives the order of bytes.
///
/// # Errors
/// If it is not that of a level 5 file.
pub fn header(bytes: &[u8]) -> Result<ByteOrder, MatError> {
    if bytes.starts_with(b"\x89HDF") || bytes.starts_with(b"MATLAB 7.3") {
        return Err(MatError::Version73);
    }
    let Some(head) = bytes.get(..HEADER) else {
        let is_text = bytes.starts_with(b"MATLAB");
        return Err(if is_text { MatError::CutShort } else { MatError::NotMatlab });
    };
    let order = match &head[126..] {
        b"IM" => ByteOrder::Little,
        b"MI" => ByteOrder::Big,
        _ => return Err(MatError::NotMatlab),
    };
    match order.u16([head[124], head[125]]) {
        0x0100 => Ok(order),
        0x0200 => Err(MatError::Version73),
        _ => Err(MatError::NotMatlab),
    }
}

/// Type and length of the element that a top-level tag opens.
///
/// # Errors
/// If it opens nothing that may stand there.
pub fn tag(order: ByteOrder, bytes: [u8; TAG]) -> Result<(ElementKind, usize), MatError> {
    let [a, b, c, d, e, f, g, h] = bytes;
    let length = order.u32([e, f, g, h]) as usize;
    if length > MAX_BYTES {
        return Err(MatError::TooLarge);
    }
    match order.u32([a, b, c, d]) {
        MATRIX => Ok((ElementKind::Plain, length)),
        COMPRESSED => Ok((ElementKind::Compressed, length)),
        _ => Err(MatError::Damaged("an element is neither an array nor a compressed one")),
    }
}

/// How a top-level element is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ElementKind {
    /// As it is.
    Plain,
    /// By zlib.
    Compressed,
}

/// Name and shape of the variable whose element begins with `prefix`, the first [`PREFIX`] bytes of
/// its body or all of them.
///
/// # Errors
/// If these are not the first bytes of an array.
pub fn peek(order: ByteOrder, kind: ElementKind, prefix: &[u8]) -> Result<Variable, MatError> {
    let opened;
    let body = match kind {
        ElementKind::Plain => prefix,
        ElementKind::Compressed => {
            opened = inflate(prefix, PREFIX)?;
            inner(order, &opened)?.1
        }
    };
    let mut cursor = Cursor { order, rest: body };
    cursor.variable().map(|(variable, _)| variable)
}

/// The array of an element's whole `body`.
///
/// # Errors
/// If the bytes are not an array.
pub fn array(order: ByteOrder, kind: ElementKind, body: &[u8]) -> Result<Array, MatError> {
    match kind {
        ElementKind::Plain => matrix(order, body, 0, &mut MAX_CELLS.clone()),
        ElementKind::Compressed => {
            let mut opened = inflate(body, TAG)?;
            let (length, _) = inner(order, &opened)?;
            opened = inflate(body, TAG.saturating_add(length))?;
            let body = opened.get(TAG..TAG + length).ok_or(MatError::CutShort)?;
            matrix(order, body, 0, &mut MAX_CELLS.clone())
        }
    }
}

const MATRIX: u32 = 14;
const COMPRESSED: u32 = 15;
const COMPLEX: u32 = 0x0800;

/// Up to `most` bytes of what was compressed; what cannot be opened any more ends it.
fn inflate(bytes: &[u8], most: usize) -> Result<Vec<u8>, MatError> {
    let mut opened = Vec::new();
    let mut decoder = ZlibDecoder::new(bytes).take(most as u64);
    match decoder.read_to_end(&mut opened) {
        Ok(_) => Ok(opened),
        // A prefix of the stream gives a prefix of the data.
        Err(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => Ok(opened),
        Err(_) => Err(MatError::Damaged("its compressed data do not open")),
    }
}

/// Length and first bytes of the array within a compressed element.
fn inner(order: ByteOrder, opened: &[u8]) -> Result<(usize, &[u8]), MatError> {
    let (head, body) = opened.split_first_chunk::<TAG>().ok_or(MatError::CutShort)?;
    match tag(order, *head)? {
        (ElementKind::Plain, length) => Ok((length, body)),
        (ElementKind::Compressed, _) => Err(MatError::Damaged("compressed twice")),
    }
}

/// Bytes that are read from the front.
struct Cursor<'a> {
    order: ByteOrder,
    rest: &'a [u8],
}

impl<'a> Cursor<'a> {
    /// Type and data of the next element, with its padding passed over.
    fn element(&mut self) -> Result<(u32, &'a [u8]), MatError> {
        let (head, after) = self.rest.split_first_chunk::<4>().ok_or(MatError::CutShort)?;
        let first = self.order.u32(*head);
        // A small element has its length and up to four bytes of data within the tag.
        if first >> 16 != 0 {
            let data = after.get(..4).ok_or(MatError::CutShort)?;
            let length = (first >> 16) as usize;
            self.rest = &after[4..];
            let data =
                data.get(..length).ok_or(MatError::Damaged("a small element is too long"))?;
            return Ok((first & 0xFFFF, data));
        }
        let (length, after) = after.split_first_chunk::<4>().ok_or(MatError::CutShort)?;
        let length = self.order.u32(*length) as usize;
        let data = after.get(..length).ok_or(MatError::CutShort)?;
        // The last element of an array may lack its padding.
        let padded = length.next_multiple_of(8).min(after.len());
        self.rest = &after[padded..];
        Ok((first, data))
    }

    /// Flags, dimensions and name, which open every array; and whether it is complex.
    fn variable(&mut self) -> Result<(Variable, bool), MatError> {
        let (kind, flags) = self.element()?;
        let Some((flags, _)) = flags.split_first_chunk::<4>().filter(|_| kind == 6) else {
            return Err(MatError::Damaged("an array without flags"));
        };
        let flags = self.order.u32(*flags);
        let (kind, dims) = self.element()?;
        if dims.len() > MAX_DIMS * 8 {
            return Err(MatError::Damaged("impossible dimensions"));
        }
        let dims = numbers(self.order, kind, dims)?;
        if dims.len() > MAX_DIMS || dims.iter().any(|&d| !(0.0..=MAX_BYTES as f64).contains(&d)) {
            return Err(MatError::Damaged("impossible dimensions"));
        }
        let dims: Vec<usize> = dims.into_iter().map(|d| d as usize).collect();
        let (_, name) = self.element()?;
        if name.len() > MAX_NAME {
            return Err(MatError::Damaged("a name of more than 256 bytes"));
        }
        let name = String::from_utf8_lossy(name).trim_end_matches('\0').to_string();
        let class = class(flags & 0xFF);
        Ok((Variable { name, class, dims }, flags & COMPLEX != 0))
    }
}

fn class(number: u32) -> Class {
    match number {
        1 => Class::Cell,
        4 => Class::Char,
        9 => Class::Numbers { byte: true },
        6..=15 => Class::Numbers { byte: false },
        2 => Class::Other("a structure"),
        3 | 17 => Class::Other("an object (a string or a table; use a cell array of char)"),
        5 => Class::Other("a sparse array"),
        _ => Class::Other("of an unknown class"),
    }
}

/// The array of an element; `cells_left` is how many more may be read.
fn matrix(
    order: ByteOrder,
    body: &[u8],
    depth: usize,
    cells_left: &mut usize,
) -> Result<Array, MatError> {
    if depth > MAX_DEPTH {
        return Err(MatError::Damaged("cells within cells without end"));
    }
    let mut cursor = Cursor { order, rest: body };
    if body.is_empty() {
        // An empty cell may be nothing but a tag.
        let variable = Variable { name: String::new(), class: Class::Cell, dims: vec![0, 0] };
        return Ok(Array { variable, values: ArrayValues::Cells(Vec::new()) });
    }
    let (mut variable, complex) = cursor.variable()?;
    let count = variable.dims.iter().try_fold(1usize, |count, &d| count.checked_mul(d));
    let count = count.filter(|&count| count <= MAX_NUMBERS).ok_or(MatError::TooLarge)?;
    let values = match variable.class {
        Class::Numbers { .. } if complex => {
            variable.class = Class::Other("complex");
            ArrayValues::Unread
        }
        // Lists hold names; numbers in them are of no use, and eight times their size on disk.
        Class::Numbers { .. } if depth > 0 => ArrayValues::Unread,
        Class::Numbers { .. } => {
            let (kind, data) = cursor.element()?;
            let values = numbers(order, kind, data)?;
            if values.len() != count {
                return Err(MatError::Damaged("dimensions and data disagree"));
            }
            ArrayValues::Numbers(values)
        }
        Class::Char => {
            let (kind, data) = cursor.element()?;
            let letters = letters(order, kind, data)?;
            if letters.len() != count {
                return Err(MatError::Damaged("dimensions and text disagree"));
            }
            ArrayValues::Text(rows(&letters, variable.dims.first().copied().unwrap_or(0)))
        }
        Class::Cell => {
            *cells_left = cells_left.checked_sub(count).ok_or(MatError::TooLarge)?;
            let mut cells = Vec::new();
            for _ in 0..count {
                match cursor.element()? {
                    (MATRIX, body) => cells.push(matrix(order, body, depth + 1, cells_left)?),
                    _ => return Err(MatError::Damaged("a cell is no array")),
                }
            }
            ArrayValues::Cells(cells)
        }
        Class::Other(_) => ArrayValues::Unread,
    };
    Ok(Array { variable, values })
}

#[cfg(test)]
#[path = "level5_tests.rs"]
mod tests;
