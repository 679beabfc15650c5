//! The members of a ZIP file, as NumPy writes it: stored or deflated, also beyond 4 GB (ZIP64).

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};

use flate2::read::DeflateDecoder;

use super::text::Limited;

pub(super) struct Member {
    pub name: String,
    is_deflated: bool,
    packed: u64,
    at: u64,
}

fn damaged() -> String {
    "the ZIP file is damaged or cut short".into()
}

fn number(bytes: &[u8], at: usize, size: usize) -> Option<u64> {
    let mut number = [0; 8];
    number[..size].copy_from_slice(bytes.get(at..at + size)?);
    Some(u64::from_le_bytes(number))
}

/// Reads the directory at the end of a file of `length` bytes.
pub(super) fn members(file: &mut File, length: u64) -> Result<Vec<Member>, String> {
    let tail = length.min(1 << 16) as usize;
    let mut end = vec![0; tail];
    let read = file.seek(SeekFrom::End(-(tail as i64))).and_then(|_| file.read_exact(&mut end));
    read.map_err(|error| error.to_string())?;
    let find = |magic: &[u8]| end.windows(4).rposition(|four| four == magic);
    let at = find(b"PK\x05\x06").ok_or_else(damaged)?;
    let (size, start) = (number(&end, at + 12, 4), number(&end, at + 16, 4));
    let (mut size, mut start) = (size.ok_or_else(damaged)?, start.ok_or_else(damaged)?);
    if let (Some(long), 0xffff_ffff) = (find(b"PK\x06\x06"), start.max(size)) {
        size = number(&end, long + 40, 8).ok_or_else(damaged)?;
        start = number(&end, long + 48, 8).ok_or_else(damaged)?;
    }
    if size > 1 << 24 || start > length || size > length - start {
        return Err(damaged());
    }
    let mut directory = vec![0; size as usize];
    let read = file.seek(SeekFrom::Start(start)).and_then(|_| file.read_exact(&mut directory));
    read.map_err(|error| error.to_string())?;
    let (mut members, mut at) = (Vec::new(), 0);
    while directory[at..].starts_with(b"PK\x01\x02") {
        let field = |place, size| number(&directory, at + place, size).ok_or_else(damaged);
        let (method, mut packed, size) = (field(10, 2)?, field(20, 4)?, field(24, 4)?);
        let lengths = [field(28, 2)?, field(30, 2)?, field(32, 2)?].map(|x| x as usize);
        let mut offset = field(42, 4)?;
        let name = directory.get(at + 46..at + 46 + lengths[0]).ok_or_else(damaged)?;
        let name = String::from_utf8_lossy(name).into_owned();
        let extra = directory.get(at + 46 + lengths[0]..).and_then(|rest| rest.get(..lengths[1]));
        let mut extra = extra.ok_or_else(damaged)?;
        while let (Some(id), Some(length)) = (number(extra, 0, 2), number(extra, 2, 2)) {
            let body = extra.get(4..4 + length as usize).ok_or_else(damaged)?;
            if id == 1 {
                // The long fields stand in this order, and only where the short one is full.
                let mut place = if size == 0xffff_ffff { 8 } else { 0 };
                for short in [&mut packed, &mut offset] {
                    if *short == 0xffff_ffff {
                        *short = number(body, place, 8).ok_or_else(damaged)?;
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
            return Err(damaged());
        }
    }
    Ok(members)
}

/// A reader of a member's content, which fails beyond `most` bytes.
pub(super) fn content(mut file: File, member: &Member, most: u64) -> Result<Box<dyn Read>, String> {
    let mut head = [0; 30];
    let read = file.seek(SeekFrom::Start(member.at)).and_then(|_| file.read_exact(&mut head));
    read.map_err(|_| damaged())?;
    let lengths = [26, 28].map(|at| u64::from(u16::from_le_bytes([head[at], head[at + 1]])));
    let skipped = file.seek_relative((lengths[0] + lengths[1]) as i64);
    skipped.map_err(|error| error.to_string())?;
    let packed = BufReader::new(file).take(member.packed);
    Ok(match member.is_deflated {
        true => Box::new(Limited { from: DeflateDecoder::new(packed), left: most }),
        false => Box::new(packed),
    })
}
