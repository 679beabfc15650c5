//! Reads WAV and its kin RF64 and BW64: integers of 8 to 32 bits, floats of 32 and 64 bits, A-law and
//! µ-law. A file must hold as many samples as its header says; one whose header was written before its
//! length was known, like a stream's, is read to its end.
//!
//! This module reads the chunks itself: the crate `hound` does not skip the padding after odd-sized
//! chunks, and misplaces WAVE_FORMAT_EXTENSIBLE samples that are smaller than their containers.
//! Decoding sample by sample took a third of a library's loading time, so this decodes blocks.

use std::fs::File;
use std::io::{self, BufReader, Read, Seek};
use std::path::Path;

use super::files::{self, check_length};
use super::{LibraryError, Outline};
use crate::trial::SignalError;

/// Reads the header of a file, and checks that the file is as long as it says.
pub(super) fn probe(path: &Path) -> Result<Outline, LibraryError> {
    open_wav(path).map(|(_, data)| data.outline())
}

/// Number of bytes decoded at a time: a multiple of each possible size of a sample (1 to 8 bytes).
const BLOCK: usize = 48 * 1024;

/// Reads a whole file; the samples are interleaved.
pub(crate) fn read(path: &Path) -> Result<(Outline, Vec<f32>), LibraryError> {
    let (mut file, data) = open_wav(path)?;
    // This fails if the file has become shorter since its header was read.
    let samples = decode_wav(&mut file, data).map_err(|error| failure(path, error))?;
    Ok((data.outline(), samples))
}

fn decode_wav(file: &mut impl Read, data: WavData) -> io::Result<Vec<f32>> {
    let WavData { format, container, length, .. } = data;
    let bytes = usize::from(container);
    let logarithmic: Vec<f32> = (0..=255).map(|code| expanded(format, code)).collect();
    let scale = 1.0 / 2f64.powi(i32::from(container) * 8 - 1);
    let integer = |x: i32| (f64::from(x) * scale) as f32;
    let mut samples = Vec::with_capacity(length as usize / bytes);
    let mut block = [0; BLOCK];
    let mut left = length;
    while left > 0 {
        let block = &mut block[..left.min(BLOCK as u64) as usize];
        file.read_exact(block)?;
        left -= block.len() as u64;
        let to = &mut samples;
        match (format, bytes) {
            (FLOAT, 4) => extend(to, block, f32::from_le_bytes),
            (FLOAT, 8) => extend(to, block, |x| f64::from_le_bytes(x) as f32),
            (A_LAW | MU_LAW, 1) => extend(to, block, |[code]| logarithmic[usize::from(code)]),
            // Unsigned: 128 stands for 0.
            (_, 1) => extend(to, block, |[x]| integer(i32::from(x) - 128)),
            (_, 2) => extend(to, block, |x| integer(i16::from_le_bytes(x).into())),
            (_, 3) => extend(to, block, |[a, b, c]| integer(i32::from_le_bytes([0, a, b, c]) >> 8)),
            (_, 4) => extend(to, block, |x| integer(i32::from_le_bytes(x))),
            _ => unreachable!("`parse_format` lets 1 to 4 bytes pass"),
        }
    }
    Ok(samples)
}

fn extend<const N: usize>(samples: &mut Vec<f32>, bytes: &[u8], sample: impl Fn([u8; N]) -> f32) {
    samples.extend(bytes.as_chunks().0.iter().map(|bytes| sample(*bytes)));
}

/// The sample of an A-law or µ-law code (ITU-T G.711), as a fraction of full scale; 0 for other formats.
fn expanded(format: u16, code: u8) -> f32 {
    let (code, sign) = match format {
        A_LAW => (code ^ 0x55, 0x80),
        MU_LAW => (!code, 0),
        _ => return 0.0,
    };
    let (exponent, mantissa) = (code >> 4 & 7, i32::from(code & 15));
    let size = match (format, exponent) {
        (MU_LAW, _) => (((mantissa << 3) + 0x84) << exponent) - 0x84,
        (_, 0) => (mantissa << 4) + 8,
        (_, _) => ((mantissa << 4) + 0x108) << (exponent - 1),
    };
    let is_negative = code & 0x80 != sign;
    (if is_negative { -size } else { size }) as f32 / 32768.0
}

/// Name of a chunk that holds the rate in Hz as f64, if it is no whole number. The header then holds
/// the nearest whole number, and programs that do not know the chunk skip it.
pub(crate) const EXACT_RATE: [u8; 4] = *b"rate";

/// Codes of sample formats, from the `fmt ` chunk of a WAV file.
const PCM: u16 = 1;
const FLOAT: u16 = 3;
const A_LAW: u16 = 6;
const MU_LAW: u16 = 7;
const EXTENSIBLE: u16 = 0xFFFE;

#[derive(Clone, Copy, Debug)]
struct WavData {
    /// [`PCM`], [`FLOAT`], [`A_LAW`] or [`MU_LAW`].
    format: u16,
    channels: u16,
    rate_hz: f64,
    /// Bytes per sample: 1 to 4, or 8. A sample with fewer bits fills the upper bits of its bytes, by the
    /// rules of WAVE_FORMAT_EXTENSIBLE, and is read as if it used all bits.
    container: u16,
    length: u64,
}

impl WavData {
    fn outline(self) -> Outline {
        let channels = usize::from(self.channels);
        let frames = self.length as usize / (channels * usize::from(self.container));
        Outline { rate_hz: self.rate_hz, channels, frames }
    }
}

/// Opens a WAV file, checks that it is as long as its header says, and goes to its first sample.
fn open_wav(path: &Path) -> Result<(BufReader<File>, WavData), LibraryError> {
    let (file, size) = files::open_filled(path)?;
    let mut file = BufReader::new(file);
    let data = walk_wav(&mut file, size).map_err(|error| failure(path, error))?;
    let at = file.stream_position().map_err(|error| failure(path, error))?;
    let rest = size.saturating_sub(at);
    if data.length == 0 {
        return Err(LibraryError::file(path, SignalError::Empty));
    }
    check_length(data.outline()).map_err(LibraryError::at(path))?;
    if rest < data.length {
        return Err(truncated(path, &format!(" ({rest} of {} bytes of samples)", data.length)));
    }
    let goes_on = rest > data.length + (data.length / 10).max(64)
        && !ends_after(&mut file, data.length, rest).map_err(|error| failure(path, error))?;
    if goes_on {
        let problem = format!(
            "its header tells of {} bytes of samples, but {rest} follow, as where a recorder was interrupted; open it \
             in a sound editor as raw samples, and save it anew",
            data.length
        );
        return Err(LibraryError::file(path, problem));
    }
    Ok((file, data))
}

fn failure(path: &Path, error: io::Error) -> LibraryError {
    match error.kind() {
        io::ErrorKind::UnexpectedEof => truncated(path, ""),
        io::ErrorKind::InvalidData => LibraryError::file(
            path,
            format!(
                "not a WAV file that can be read ({error}); expected 16-bit, 24-bit or f32 PCM"
            ),
        ),
        _ => LibraryError::io(path, error),
    }
}

fn no(problem: impl Into<String>) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, problem.into())
}

/// Reads the chunks before the samples of a file of `size` bytes, and leaves it at its first sample.
fn walk_wav(file: &mut BufReader<File>, size: u64) -> io::Result<WavData> {
    let [id @ .., a, b, c, d] = take::<8>(file)?;
    let form: [u8; 4] = take(file)?;
    if ![b"RIFF", b"RF64", b"BW64"].contains(&&id) || &form != b"WAVE" {
        return Err(no("it does not begin with RIFF and WAVE"));
    }
    let is_whole = u64::from(u32::from_le_bytes([a, b, c, d])) + 8 == size;
    let (mut format, mut long, mut exact_hz) = (None, None, None);
    loop {
        let [id @ .., a, b, c, d] = take::<8>(file)?;
        let length = u32::from_le_bytes([a, b, c, d]);
        match &id {
            b"data" => {
                let data: WavData =
                    format.ok_or_else(|| no("its format comes after its samples"))?;
                // A program that has resampled a file may have kept the rate before.
                let exact_hz = exact_hz.filter(|hz: &f64| (hz - data.rate_hz).abs() <= 0.5);
                let data = WavData { rate_hz: exact_hz.unwrap_or(data.rate_hz), ..data };
                let frame = u64::from(data.container * data.channels);
                let rest = size.saturating_sub(file.stream_position()?);
                let claimed = long.filter(|_| length == u32::MAX).unwrap_or(u64::from(length));
                if claimed > rest && is_placeholder(claimed)
                    || claimed == 0 && !is_whole && !holds_chunks(file, rest)?
                {
                    // The last frame may be cut, since the writing program was stopped.
                    return Ok(WavData { length: rest - rest % frame, ..data });
                }
                if claimed % frame != 0 {
                    return Err(no("its samples do not fill whole frames"));
                }
                return Ok(WavData { length: claimed, ..data });
            }
            b"ds64" if length >= 16 => {
                let _whole_file: [u8; 8] = take(file)?;
                long = Some(u64::from_le_bytes(take(file)?));
                file.seek_relative(i64::from(length) - 16 + i64::from(length % 2))?;
            }
            id if *id == EXACT_RATE && length == 8 => {
                exact_hz = Some(f64::from_le_bytes(take(file)?)).filter(|hz| *hz > 0.0);
            }
            b"fmt " if length >= 16 => {
                let mut body = [0; 40];
                let kept = (length as usize).min(body.len());
                file.read_exact(&mut body[..kept])?;
                format = Some(parse_format(&body[..kept])?);
                file.seek_relative(i64::from(length) - kept as i64 + i64::from(length % 2))?;
            }
            // An odd-sized chunk is followed by a byte of padding.
            _ => file.seek_relative(i64::from(length) + i64::from(length % 2))?,
        }
    }
}

/// Whether a program writes this length where it does not know the length yet: about 2^31 or 2^32.
fn is_placeholder(length: u64) -> bool {
    [1 << 31, 1 << 32].iter().any(|&most: &u64| length.abs_diff(most) < 1 << 16)
        || length >= u64::MAX >> 1
}

/// Whether chunks, zeros or nothing follow the samples of the `claimed` length. Does not move.
fn ends_after(file: &mut BufReader<File>, claimed: u64, rest: u64) -> io::Result<bool> {
    let start = file.stream_position()?;
    file.seek(io::SeekFrom::Start(start + claimed + claimed % 2))?;
    let rest = rest.saturating_sub(claimed + claimed % 2);
    let is_whole = holds_chunks(file, rest)?;
    let mut first = Vec::new();
    file.by_ref().take(64).read_to_end(&mut first)?;
    file.seek(io::SeekFrom::Start(start))?;
    Ok(is_whole || first.iter().all(|byte| *byte == 0))
}

/// Whether the `rest` bytes that follow are whole chunks, rather than samples. Does not move.
fn holds_chunks(file: &mut BufReader<File>, rest: u64) -> io::Result<bool> {
    let start = file.stream_position()?;
    let mut left = rest;
    while left >= 8 {
        let [id @ .., a, b, c, d] = take::<8>(file)?;
        let length = u64::from(u32::from_le_bytes([a, b, c, d]));
        let padded = length + length % 2;
        if !id.iter().all(|byte| (b' '..=b'~').contains(byte)) || padded > left - 8 {
            break;
        }
        left -= 8 + padded;
        file.seek_relative(padded as i64)?;
    }
    file.seek(io::SeekFrom::Start(start))?;
    Ok(left == 0)
}

fn take<const N: usize>(file: &mut BufReader<File>) -> io::Result<[u8; N]> {
    let mut bytes = [0; N];
    file.read_exact(&mut bytes).map(|()| bytes)
}

/// Parses the content of a `fmt ` chunk, which has 16 bytes or more.
fn parse_format(body: &[u8]) -> io::Result<WavData> {
    let word = |at: usize| u16::from_le_bytes([body[at], body[at + 1]]);
    let (mut format, channels, frame, bits) = (word(0), word(2), word(12), word(14));
    let extensible = format == EXTENSIBLE;
    if extensible {
        if body.len() < 40 {
            return Err(no("its format is cut short"));
        }
        format = word(24);
    }
    if channels == 0 || !frame.is_multiple_of(channels) {
        return Err(no("its frames do not divide into channels"));
    }
    let container = frame / channels;
    let fits = match format {
        PCM => (1..=4).contains(&container) && (1..=container * 8).contains(&bits),
        FLOAT => matches!((container, bits), (4, 32) | (8, 64)),
        A_LAW | MU_LAW => (container, bits) == (1, 8),
        _ => return Err(no(format!("its samples are {}, which is not read", coding(format)))),
    };
    if !fits {
        return Err(no(format!("{bits} bits in {container} bytes")));
    }
    // Refuses samples that fill only part of their bytes: programs use the lower bits or the upper.
    if !extensible && bits != container * 8 {
        return Err(no(format!(
            "{bits} bits in {container} bytes, and its header does not say which bits hold the sample; convert it, for \
             example with `sox IN.wav -b 24 OUT.wav`"
        )));
    }
    let rate_hz = f64::from(u32::from_le_bytes([body[4], body[5], body[6], body[7]]));
    Ok(WavData { format, channels, rate_hz, container, length: 0 })
}

/// Name of a format of samples which is not read.
fn coding(format: u16) -> String {
    match format {
        0x02 => "Microsoft ADPCM".into(),
        0x11 => "IMA ADPCM".into(),
        0x31 => "GSM".into(),
        0x50 => "MPEG".into(),
        0x55 => "mp3".into(),
        0x161 => "Windows Media Audio".into(),
        _ => format!("in format {format}"),
    }
}

fn truncated(path: &Path, sizes: &str) -> LibraryError {
    let problem = format!(
        "truncated: the file ends before what its header promises{sizes}; copy it again from where \
         it came, record again, or remove it"
    );
    LibraryError::file(path, problem)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trial::Series;

    #[test]
    fn an_hour_of_sound_is_refused_before_it_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.wav");
        let length = 2 * (Series::MOST_SAMPLES as u32 + 1);
        // One channel of 16 bits at 1000 Hz.
        let format = [16, 0, 0, 0, 1, 0, 1, 0, 0xE8, 3, 0, 0, 0xD0, 7, 0, 0, 2, 0, 16, 0];
        let parts = [&b"RIFF\0\0\0\0WAVEfmt "[..], &format, b"data", &length.to_le_bytes()];
        let bytes = parts.concat();
        std::fs::write(&path, &bytes).unwrap();
        // The file is sparse, so it takes no room on the disk.
        let file = File::options().write(true).open(&path).unwrap();
        file.set_len(bytes.len() as u64 + u64::from(length)).unwrap();
        let error = open_wav(&path).unwrap_err().to_string();
        assert!(error.contains("minutes are too long for a trial"), "{error}");
    }
}
