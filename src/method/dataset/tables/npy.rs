//! Arrays of NumPy: `.npy` files and the arrays of an `.npz`, by NEP 1 of NumPy.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use flate2::read::DeflateDecoder;

use super::array::{Array, Kind};
use super::text::Limited;
use crate::library::{LibraryError, files};

const MAGIC: &[u8] = b"\x93NUMPY";
/// Longest header that is read, in bytes.
const MOST_HEADER: usize = 1 << 16;

/// Opens the array in a file; in an `.npz`, the one called `name`, or the only one of at least two
/// dimensions.
pub(super) fn open(path: &Path, name: Option<&str>, most: u64) -> Result<Array, LibraryError> {
    let (file, length) = files::open_filled(path)?;
    of(file, length, name, most).map_err(LibraryError::at(path))
}

fn of(mut file: File, length: u64, name: Option<&str>, most: u64) -> Result<Array, String> {
    let said = |error: std::io::Error| format!("it cannot be read: {error}");
    let mut start = [0; 4];
    file.read_exact(&mut start).map_err(|_| "it is cut short".to_string())?;
    file.rewind().map_err(said)?;
    if !start.starts_with(b"PK") {
        return read(Box::new(BufReader::new(file)), Some(length));
    }
    let members = members(&mut file, length)?;
    let names = || members.iter().map(|member| &*member.name).collect::<Vec<_>>().join(", ");
    let open = |member: &Member| {
        let file = file.try_clone().map_err(said)?;
        read(content(file, member, most)?, None)
            .map_err(|problem| format!("`{}`: {problem}", member.name))
    };
    if let Some(name) = name {
        let is = |member: &&Member| member.name.strip_suffix(".npy") == Some(name);
        let member = members.iter().find(is);
        return open(
            member.ok_or_else(|| format!("it has no array `{name}`; it has {}", names()))?,
        );
    }
    // All members share one file, so only one may be read from at a time.
    let of_trials = |member| {
        let array = open(member).ok().filter(|array| array.shape.len() > 1 && array.is_number())?;
        // A list, such as of labels, may be written as a matrix of one column.
        Some((member, array.shape.iter().filter(|n| **n > 1).count() < 2))
    };
    let arrays = members.iter().filter(|member| member.name.ends_with(".npy"));
    let arrays: Vec<(&Member, bool)> = arrays.filter_map(of_trials).collect();
    let are_lists = arrays.iter().all(|(_, is_list)| *is_list);
    let mut wanted = arrays.iter().filter(|(_, is_list)| *is_list == are_lists);
    match (wanted.next(), wanted.next()) {
        (None, _) => Err(format!("it has no array of trials; it has {}", names())),
        (Some((only, _)), None) => open(only),
        _ => Err(format!("it has several arrays ({}); say which by --variable", names())),
    }
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
        _ => {
            return Err(format!(
                "its elements are `{descr}`; save numbers as float32 or integers, and text by \
                 `.astype(str)`"
            ));
        }
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
    let (is_big_endian, samples_first) = (order == ">", false);
    Ok(Array { shape, kind, size, is_big_endian, is_crosswise, samples_first, content: from })
}

/// A member of a ZIP file, as NumPy writes it: stored or deflated, also beyond 4 GB (ZIP64).
struct Member {
    name: String,
    is_deflated: bool,
    packed: u64,
    at: u64,
}

fn damaged_zip() -> String {
    "the ZIP file is damaged or cut short".into()
}

fn number(bytes: &[u8], at: usize, size: usize) -> Option<u64> {
    let mut number = [0; 8];
    number[..size].copy_from_slice(bytes.get(at..at + size)?);
    Some(u64::from_le_bytes(number))
}

/// Reads the directory at the end of a file of `length` bytes.
fn members(file: &mut File, length: u64) -> Result<Vec<Member>, String> {
    let tail = length.min(1 << 16) as usize;
    let mut end = vec![0; tail];
    let read = file.seek(SeekFrom::End(-(tail as i64))).and_then(|_| file.read_exact(&mut end));
    read.map_err(|error| error.to_string())?;
    let find = |magic: &[u8]| end.windows(4).rposition(|four| four == magic);
    let at = find(b"PK\x05\x06").ok_or_else(damaged_zip)?;
    let (size, start) = (number(&end, at + 12, 4), number(&end, at + 16, 4));
    let (mut size, mut start) = (size.ok_or_else(damaged_zip)?, start.ok_or_else(damaged_zip)?);
    if let (Some(long), 0xffff_ffff) = (find(b"PK\x06\x06"), start.max(size)) {
        size = number(&end, long + 40, 8).ok_or_else(damaged_zip)?;
        start = number(&end, long + 48, 8).ok_or_else(damaged_zip)?;
    }
    if size > 1 << 24 || start > length || size > length - start {
        return Err(damaged_zip());
    }
    let mut directory = vec![0; size as usize];
    let read = file.seek(SeekFrom::Start(start)).and_then(|_| file.read_exact(&mut directory));
    read.map_err(|error| error.to_string())?;
    let (mut members, mut at) = (Vec::new(), 0);
    while directory[at..].starts_with(b"PK\x01\x02") {
        let field = |place, size| number(&directory, at + place, size).ok_or_else(damaged_zip);
        let (method, mut packed, size) = (field(10, 2)?, field(20, 4)?, field(24, 4)?);
        let lengths = [field(28, 2)?, field(30, 2)?, field(32, 2)?].map(|x| x as usize);
        let mut offset = field(42, 4)?;
        let name = directory.get(at + 46..at + 46 + lengths[0]).ok_or_else(damaged_zip)?;
        let name = String::from_utf8_lossy(name).into_owned();
        let extra = directory.get(at + 46 + lengths[0]..).and_then(|rest| rest.get(..lengths[1]));
        let mut extra = extra.ok_or_else(damaged_zip)?;
        while let (Some(id), Some(length)) = (number(extra, 0, 2), number(extra, 2, 2)) {
            let body = extra.get(4..4 + length as usize).ok_or_else(damaged_zip)?;
            if id == 1 {
                // The long fields stand in this order, and only where the short one is full.
                let mut place = if size == 0xffff_ffff { 8 } else { 0 };
                for short in [&mut packed, &mut offset] {
                    if *short == 0xffff_ffff {
                        *short = number(body, place, 8).ok_or_else(damaged_zip)?;
                        place += 8;
                    }
                }
            }
            extra = &extra[4 + length as usize..];
        }
        if method != 0 && method != 8 {
            return Err(format!("`{name}` is packed by method {method}; save it by NumPy again"));
        }
        members.push(Member { name, is_deflated: method == 8, packed, at: offset });
        at += 46 + lengths.iter().sum::<usize>();
        if at > directory.len() {
            return Err(damaged_zip());
        }
    }
    Ok(members)
}

/// A reader of a member's content, which fails beyond `most` bytes.
fn content(mut file: File, member: &Member, most: u64) -> Result<Box<dyn Read>, String> {
    let mut head = [0; 30];
    let read = file.seek(SeekFrom::Start(member.at)).and_then(|_| file.read_exact(&mut head));
    read.map_err(|_| damaged_zip())?;
    let lengths = [26, 28].map(|at| u64::from(u16::from_le_bytes([head[at], head[at + 1]])));
    file.seek_relative((lengths[0] + lengths[1]) as i64).map_err(|error| error.to_string())?;
    let packed = BufReader::new(file).take(member.packed);
    Ok(match member.is_deflated {
        true => Box::new(Limited { from: DeflateDecoder::new(packed), left: most }),
        false => Box::new(packed),
    })
}
