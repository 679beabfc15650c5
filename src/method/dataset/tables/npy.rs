//! Arrays of NumPy: `.npy` files and the arrays of an `.npz`, by NEP 1 of NumPy.

use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::Path;

use super::array::{Array, Kind};
use super::zip;
use crate::library::LibraryError;
use crate::library::files;

const MAGIC: &[u8] = b"\x93NUMPY";
/// Longest header that is read, in bytes.
const MOST_HEADER: usize = 1 << 16;

/// Opens the array in a file; in an `.npz`, the one called `name`, or the only one of at least two
/// dimensions.
///
/// # Errors
/// If the file is damaged, holds another type, or its array is not clear.
pub(super) fn open(path: &Path, name: Option<&str>, most: u64) -> Result<Array, LibraryError> {
    let (file, length) = files::open_filled(path)?;
    of(file, length, name, most).map_err(|problem| LibraryError::file(path, problem))
}

fn of(mut file: File, length: u64, name: Option<&str>, most: u64) -> Result<Array, String> {
    let said = |error: std::io::Error| format!("it cannot be read: {error}");
    let mut start = [0; 4];
    file.read_exact(&mut start).map_err(|_| "it is cut short".to_string())?;
    file.rewind().map_err(said)?;
    if !start.starts_with(b"PK") {
        return read(Box::new(BufReader::new(file)), Some(length));
    }
    let members = zip::members(&mut file, length)?;
    let names = || members.iter().map(|member| &*member.name).collect::<Vec<_>>().join(", ");
    let open = |member: &zip::Member| {
        let file = file.try_clone().map_err(said)?;
        read(zip::content(file, member, most)?, None)
    };
    if let Some(name) = name {
        let is = |member: &&zip::Member| member.name.strip_suffix(".npy") == Some(name);
        let member = members.iter().find(is);
        return open(
            member.ok_or_else(|| format!("it has no array `{name}`; it has {}", names()))?,
        );
    }
    let mut found = None;
    for member in members.iter().filter(|member| member.name.ends_with(".npy")) {
        // All members share one file, so only one may be read from at a time.
        if open(member).is_ok_and(|array| array.shape.len() > 1 && array.is_number())
            && found.replace(member).is_some()
        {
            return Err(format!("it has several arrays ({}); say which by --variable", names()));
        }
    }
    open(found.ok_or_else(|| format!("it has no array of trials; it has {}", names()))?)
}

/// Reads a header. `length` is that of the whole file, if it is known.
fn read(mut from: Box<dyn Read>, length: Option<u64>) -> Result<Array, String> {
    let short = |_| "its header is cut short".to_string();
    let mut start = [0; 8];
    from.read_exact(&mut start).map_err(short)?;
    if !start.starts_with(MAGIC) {
        return Err("it is no array of NumPy (.npy)".into());
    }
    let mut size = [0; 4];
    let digits = if start[6] == 1 { 2 } else { 4 };
    from.read_exact(&mut size[..digits]).map_err(short)?;
    let size = u32::from_le_bytes(size) as usize;
    if size > MOST_HEADER || !(1..=3).contains(&start[6]) {
        return Err("its header is damaged".into());
    }
    let mut header = vec![0; size];
    from.read_exact(&mut header).map_err(short)?;
    let header = String::from_utf8_lossy(&header);
    let value = |key: &str| {
        let at = header.find(&format!("'{key}':"))? + key.len() + 3;
        Some(header[at..].trim_start())
    };
    let damaged = || format!("its header is damaged: {}", header.trim().escape_debug());
    let quoted = value("descr").and_then(|text| text.strip_prefix('\''));
    let Some((descr, _)) = quoted.and_then(|text| text.split_once('\'')) else {
        return Err("its elements are records or objects; save plain numbers".into());
    };
    let (order, kind) = descr.split_at_checked(1).ok_or_else(damaged)?;
    let (kind, size) = kind.split_at_checked(1).ok_or_else(damaged)?;
    // Objects have no size.
    let size: usize = size.parse().unwrap_or(0);
    let (kind, size) = match (kind, size) {
        ("f", 2 | 4 | 8) => (Kind::Float, size),
        ("i", 1 | 2 | 4 | 8) => (Kind::Signed, size),
        ("u", 1 | 2 | 4 | 8) | ("b", 1) => (Kind::Unsigned, size),
        ("U", 1..=1000) => (Kind::Wide, 4 * size),
        ("S", 1..=4000) => (Kind::Bytes, size),
        _ => return Err(format!("its elements are `{descr}`; save float32 or integers")),
    };
    let shape = value("shape").and_then(|text| text.strip_prefix('(')?.split_once(')'));
    let (shape, _) = shape.ok_or_else(damaged)?;
    let shape: Option<Vec<usize>> = shape
        .split(',')
        .map(str::trim)
        .filter(|part| !part.is_empty())
        .map(|part| part.parse().ok())
        .collect();
    let shape = shape.ok_or_else(damaged)?;
    let bytes = shape.iter().try_fold(size as u64, |all, part| all.checked_mul(*part as u64));
    let bytes = bytes.ok_or_else(damaged)?;
    if length.is_some_and(|length| bytes > length) {
        return Err(format!("truncated: {shape:?} elements of {size} bytes are not there"));
    }
    let is_crosswise = value("fortran_order").is_some_and(|text| text.starts_with("True"));
    Ok(Array { shape, kind, size, is_big_endian: order == ">", is_crosswise, content: from })
}
