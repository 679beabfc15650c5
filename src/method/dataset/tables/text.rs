//! The lines of a text file, in bounded memory: unpacked (gzip), decoded (UTF-8, UTF-16), and ended by
//! LF, CR LF or CR. Text that is not UTF-8 is read as Latin-1 where it is shown.

use std::io::{self, Cursor, Read};

use flate2::read::MultiGzDecoder;

use super::layout::Layout;

/// Longest line that is read, in bytes.
const MOST_LINE: usize = 1 << 20;
const BLOCK: u64 = 1 << 17;
/// Names of columns stand in these first lines.
const HEADING: u64 = 100;
/// Most ends of lines in the quoted names of one row; spreadsheets write them.
const MOST_ENDS: usize = 8;
/// As many first bytes as decide on the form of a file.
const HEAD: u64 = 4096;

/// Forms of files that are no text, by their first bytes, with what to do instead.
const OTHERS: [(&[u8], &str); 12] = [
    (b"PK\x03\x04", "a ZIP file or an Excel workbook; unpack it, or save the table as CSV"),
    (b"\xd0\xcf\x11\xe0", "an Excel workbook of the old form; save the table as CSV"),
    #[cfg(not(feature = "parquet"))]
    (b"PAR1", "a Parquet file; build with --features parquet to read it, or write it as CSV"),
    #[cfg(feature = "parquet")]
    (b"PAR1", "a packed Parquet file; unpack it first (`gunzip FILE`)"),
    (b"\x89HDF", "an HDF5 file, which is not read; write it as CSV or .npy"),
    (b"MATLAB 7.3", OF_HDF5),
    (b"MATLAB 5.0", "a MATLAB file; let its name end with .mat"),
    (b"TDSm", "a TDMS file, which is not read; export it as CSV"),
    (b"\x28\xb5\x2f\xfd", "packed by zstd; unpack it first (`unzstd FILE`)"),
    (b"\xfd7zXZ", "packed by xz; unpack it first (`unxz FILE`)"),
    (b"BZh", "packed by bzip2; unpack it first (`bunzip2 FILE`)"),
    (b"RIFF", "a sound; put it into a library as it is, as SURFACE/TRIAL.wav"),
    (b"{\\rtf", "a text of a word processor; save the table as CSV"),
];

pub(super) const OF_HDF5: &str =
    "a MATLAB file of v7.3 (HDF5), which is not read; save it by `save -v7`";

/// Lines of a text, each with its number from 1 on.
pub(crate) struct Lines {
    from: Box<dyn Read>,
    buffer: Vec<u8>,
    /// Place of the next line in the buffer.
    start: usize,
    is_over: bool,
    /// Whether the end of the line that was given last is missing.
    is_cut: bool,
    line_end: u8,
    number: u64,
    /// How the lines are laid out, where the file says it.
    pub layout: Option<Layout>,
}

impl Lines {
    /// Ends the lines that are made of rows; no cell holds it.
    #[cfg(feature = "parquet")]
    pub(super) const RECORD_END: u8 = 0x1e;

    /// Lines that are made of rows, of a known layout.
    #[cfg(feature = "parquet")]
    pub(super) fn records(from: Box<dyn Read>, layout: Layout) -> Self {
        Self { layout: Some(layout), ..Self::ended_by(Self::RECORD_END, from) }
    }

    fn ended_by(line_end: u8, from: Box<dyn Read>) -> Self {
        let (buffer, layout) = (Vec::new(), None);
        let (is_over, is_cut) = (false, false);
        Self { from, buffer, start: 0, is_over, is_cut, line_end, number: 0, layout }
    }

    pub(crate) fn new(from: Box<dyn Read>, most: u64) -> Result<Self, String> {
        let said = |error: io::Error| error.to_string();
        let (mut head, mut from) = peeked(from).map_err(said)?;
        if head.starts_with(b"\x1f\x8b") {
            let unpacked = Limited { from: MultiGzDecoder::new(from), left: most };
            (head, from) = peeked(Box::new(unpacked)).map_err(said)?;
        }
        if let Some((_, what)) = OTHERS.iter().find(|(magic, _)| head.starts_with(magic)) {
            return Err((*what).to_string());
        }
        // A mark counts more than zeros.
        let [little, big] = [b"\xff\xfe", b"\xfe\xff"].map(|mark| head.starts_with(mark));
        let is_big = big || !little && mostly_zero(&head, 0);
        if is_big || little || mostly_zero(&head, 1) {
            let decode = if is_big { u16::from_be_bytes } else { u16::from_le_bytes };
            let text = Utf16 { from, decode, bytes: Vec::new(), text: Cursor::default() };
            (head, from) = peeked(Box::new(text)).map_err(said)?;
        }
        let only_returns = head.contains(&b'\r') && !head.contains(&b'\n');
        let mut lines = Self::ended_by(if only_returns { b'\r' } else { b'\n' }, from);
        lines.fill()?;
        if lines.buffer.starts_with(b"\xef\xbb\xbf") {
            lines.start = 3;
        }
        Ok(lines)
    }

    /// The next line without its end, and its number; `None` after the last. Ends of lines in quotes count
    /// as spaces in the heading.
    pub(crate) fn next(&mut self) -> Result<Option<(u64, &[u8])>, String> {
        let end = self.line_end_after(0)?;
        let mut length = end.unwrap_or(self.buffer.len() - self.start);
        if end.is_none() && length == 0 {
            return Ok(None);
        }
        self.is_cut = end.is_none();
        self.number += 1;
        let number = self.number;
        let line = &self.buffer[self.start..][..length];
        let may_go_on = number <= HEADING && end.is_some();
        if may_go_on && has_open_quote(line) && last_quote_begins(line) {
            length = self.closed_after(length)?;
        }
        let from = self.start;
        self.start = (from + length + 1).min(self.buffer.len());
        let line = &self.buffer[from..from + length];
        Ok(Some((number, line.strip_suffix(b"\r").unwrap_or(line))))
    }

    /// Joins a line of a cell that is open in quotes with those after it, up to the one that closes it.
    /// Gives the length of the whole; that of the line alone if the quotes stay open.
    fn closed_after(&mut self, length: usize) -> Result<usize, String> {
        let mut to = length;
        for joined in 1..=MOST_ENDS {
            let Some(end) = self.line_end_after(to + 1)? else { break };
            to = end;
            let whole = &mut self.buffer[self.start..][..to];
            if !has_open_quote(whole) {
                // The last byte may belong to the end of the whole.
                let ends = whole[..to - 1].iter_mut().filter(|byte| b"\r\n".contains(byte));
                ends.for_each(|byte| *byte = b' ');
                self.number += joined as u64;
                return Ok(to);
            }
        }
        Ok(length)
    }

    /// The place of the first end of a line that is `after` or more bytes behind the start of this one.
    fn line_end_after(&mut self, mut after: usize) -> Result<Option<usize>, String> {
        loop {
            if let Some(at) = memchr::memchr(self.line_end, &self.buffer[self.start + after..]) {
                return Ok(Some(after + at));
            }
            if self.is_over {
                return Ok(None);
            }
            // `fill` moves what is left, which has no further end of a line, to the start of the buffer.
            after = self.buffer.len() - self.start;
            self.fill()?;
        }
    }

    /// Whether the end of the line that was given last is missing, as where writing was cut off.
    pub(super) fn is_cut(&self) -> bool {
        self.is_cut
    }

    /// Moves the rest of the buffer to its start, and reads more behind it.
    fn fill(&mut self) -> Result<(), String> {
        self.buffer.drain(..self.start);
        self.start = 0;
        if self.buffer.len() > MOST_LINE {
            let line = self.number + 1;
            return Err(format!("line {line} is longer than a MiB; expected a line a sample"));
        }
        let read = self.from.by_ref().take(BLOCK).read_to_end(&mut self.buffer);
        let read = read.map_err(|error| match self.number {
            0 => error.to_string(),
            line => format!("after line {line}: {error}"),
        })?;
        self.is_over = read == 0;
        Ok(())
    }
}

fn has_open_quote(line: &[u8]) -> bool {
    memchr::memchr_iter(b'"', line).count() % 2 == 1
}

/// Whether the last quote of a text begins a cell; others are inches.
fn last_quote_begins(line: &[u8]) -> bool {
    memchr::memrchr(b'"', line)
        .is_some_and(|at| at.checked_sub(1).is_none_or(|before| b",;\t".contains(&line[before])))
}

/// The first bytes, and a reader that still gives them.
fn peeked(mut from: Box<dyn Read>) -> io::Result<(Vec<u8>, Box<dyn Read>)> {
    let mut head = Vec::new();
    from.by_ref().take(HEAD).read_to_end(&mut head)?;
    Ok((head.clone(), Box::new(Cursor::new(head).chain(from))))
}

/// Whether every second byte, from `first` on, is 0 in most of a text: it is UTF-16 without a mark.
fn mostly_zero(head: &[u8], first: usize) -> bool {
    let zeros = head.iter().skip(first).step_by(2).filter(|&&byte| byte == 0).count();
    let others = head.iter().skip(1 - first).step_by(2).filter(|&&byte| byte == 0).count();
    zeros * 5 > head.len() * 2 && others * 10 < head.len()
}

pub(super) const TOO_LARGE: &str =
    "it unpacks to more than --max-gb allows; check the file, or allow more";

/// A reader that fails after `left` bytes, so that a packed file cannot fill the disk.
pub(crate) struct Limited<R> {
    pub from: R,
    pub left: u64,
}

impl<R: Read> Read for Limited<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.from.read(buffer)?;
        let left = self.left.checked_sub(read as u64);
        self.left = left.ok_or_else(|| io::Error::other(TOO_LARGE))?;
        Ok(read)
    }
}

/// UTF-16 as UTF-8.
struct Utf16 {
    from: Box<dyn Read>,
    decode: fn([u8; 2]) -> u16,
    /// Bytes that are not decoded yet.
    bytes: Vec<u8>,
    text: Cursor<Vec<u8>>,
}

impl Read for Utf16 {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if is_read(&self.text) {
            let read = self.from.by_ref().take(BLOCK).read_to_end(&mut self.bytes)?;
            let mut units: Vec<u16> =
                self.bytes.chunks_exact(2).map(|two| (self.decode)([two[0], two[1]])).collect();
            // The first half of a pair waits for its second half.
            if read > 0 && units.last().is_some_and(|unit| (0xd800..0xdc00).contains(unit)) {
                units.pop();
            }
            self.bytes.drain(..2 * units.len());
            self.text = Cursor::new(String::from_utf16_lossy(&units).into_bytes());
        }
        self.text.read(buffer)
    }
}

pub(super) fn is_read(text: &Cursor<Vec<u8>>) -> bool {
    text.position() == text.get_ref().len() as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::tables::cell::shown;

    fn lines(bytes: &[u8]) -> Result<Vec<String>, String> {
        let mut lines = Lines::new(Box::new(Cursor::new(bytes.to_vec())), 1 << 20)?;
        let mut all = Vec::new();
        while let Some((_, line)) = lines.next()? {
            all.push(shown(line).into_owned());
        }
        Ok(all)
    }

    #[test]
    fn every_coding_and_line_end_gives_the_same_lines() {
        let text = "Zeit µs\n1;2\n\n3;4";
        let wide = |of: fn(u16) -> [u8; 2]| text.encode_utf16().flat_map(of).collect::<Vec<u8>>();
        let marked = |mark: &[u8], rest: &[u8]| [mark, rest].concat();
        for bytes in [
            text.as_bytes().to_vec(),
            marked(b"\xef\xbb\xbf", text.as_bytes()),
            text.replace('\n', "\r\n").into_bytes(),
            text.replace('\n', "\r").into_bytes(),
            wide(u16::to_le_bytes),
            wide(u16::to_be_bytes),
            marked(b"\xff\xfe", &wide(u16::to_le_bytes)),
            marked(b"\xfe\xff", &wide(u16::to_be_bytes)),
            text.chars().map(|c| c as u8).collect(),
        ] {
            assert_eq!(lines(&bytes).unwrap(), ["Zeit µs", "1;2", "", "3;4"], "{bytes:?}");
        }
    }

    #[test]
    fn ends_of_lines_in_a_quoted_name_are_spaces_and_a_lone_quote_joins_nothing() {
        let text = "\"Time\r\n[s]\",\"Force\n[N]\"\r\n1,2\r\n";
        assert_eq!(lines(text.as_bytes()).unwrap(), ["\"Time  [s]\",\"Force [N]\"", "1,2"]);
        for kept in
            ["width,5\"\n1,6\"\n", "\"open\n1,2\n1,2\n1,2\n1,2\n1,2\n1,2\n1,2\n1,2\n1,2\n\"\n"]
        {
            let kept_lines: Vec<&str> = kept.lines().collect();
            assert_eq!(lines(kept.as_bytes()).unwrap(), kept_lines);
        }
    }

    #[test]
    fn long_texts_are_read_in_blocks_and_endless_lines_are_refused() {
        let text: String = (0..200_000).map(|i| format!("{i}\n")).collect();
        assert_eq!(lines(text.as_bytes()).unwrap().len(), 200_000);
        let wide: Vec<u8> = text.encode_utf16().flat_map(u16::to_le_bytes).collect();
        assert_eq!(lines(&wide).unwrap()[199_999], "199999");
        assert!(lines(&vec![b'1'; 2 << 20]).unwrap_err().contains("line 1 is longer"));
    }

    #[test]
    fn what_unpacks_to_too_much_and_what_is_no_text_is_refused() {
        let packed = |bytes: &[u8]| {
            let mut packer = flate2::write::GzEncoder::new(Vec::new(), Default::default());
            io::Write::write_all(&mut packer, bytes).unwrap();
            packer.finish().unwrap()
        };
        assert_eq!(lines(&packed(b"1,2\n3,4\n")).unwrap(), ["1,2", "3,4"]);
        let bomb = packed(&b"1,2\n".repeat(1 << 20));
        assert!(lines(&bomb).unwrap_err().contains("--max-gb"));
        assert!(lines(b"PK\x03\x04").unwrap_err().contains("Excel"));
    }
}
