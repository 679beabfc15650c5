//! Reads WAV and FLAC files; the extension selects the format. A file must hold as many samples as its
//! header says.
//!
//! This module reads the chunks of WAV itself: the crate `hound` does not skip the padding after
//! odd-sized chunks, and misplaces WAVE_FORMAT_EXTENSIBLE samples that are smaller than their
//! containers. Decoding sample by sample took a third of a library's loading time, so this decodes
//! blocks.

use std::fs::File;
use std::io::{self, BufReader, Read, Seek};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use symphonia_bundle_flac::{FlacDecoder, FlacReader};
use symphonia_core::codecs::CodecParameters;
use symphonia_core::codecs::audio::{AudioCodecParameters, AudioDecoder, AudioDecoderOptions};
use symphonia_core::errors::Error;
use symphonia_core::formats::{FormatOptions, FormatReader};
use symphonia_core::io::MediaSourceStream;

use super::files::{self, EMPTY_FILE, check_length};
use super::{LibraryError, Outline};
use crate::trial::Series;

/// Reads the header of a file. For WAV, also checks that the file is as long as its header says.
pub(crate) fn probe(path: &Path) -> Result<Outline, LibraryError> {
    match is_flac(path) {
        true => guarded(|| open_flac(path).map(|(_, _, header)| header), |why| damaged(path, why)),
        false => open_wav(path).map(|(_, data)| data.outline()),
    }
}

/// Reads a whole file. Divides integer samples by 2^(bits − 1), so that they lie within ±1.
pub(crate) fn read(path: &Path) -> Result<Series, LibraryError> {
    let (header, samples) = match is_flac(path) {
        true => guarded(|| decode_flac(path), |why| damaged(path, why))?,
        false => read_wav(path)?,
    };
    let series = Series::new(header.rate_hz, header.channels, samples);
    series.map_err(|error| LibraryError::file(path, error))
}

pub(super) fn is_flac(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("flac"))
}

/// Runs a decoder. If it panics, as decoders may on damaged files, returns the error `failed`.
pub(super) fn guarded<T>(
    work: impl FnOnce() -> Result<T, LibraryError>,
    failed: impl FnOnce(&str) -> LibraryError,
) -> Result<T, LibraryError> {
    // This is safe, since nothing that `work` changes is used after a panic.
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|_| Err(failed("the decoder failed")))
}

fn open_flac(
    path: &Path,
) -> Result<(FlacReader<'static>, AudioCodecParameters, Outline), LibraryError> {
    let (file, size) = files::open(path).map_err(|error| LibraryError::io(path, error))?;
    if size == 0 {
        return Err(LibraryError::file(path, EMPTY_FILE));
    }
    let stream = MediaSourceStream::new(Box::new(file), Default::default());
    let reader = FlacReader::try_new(stream, FormatOptions::default())
        .map_err(|error| damaged(path, &error.to_string()))?;
    let track = reader.tracks().first();
    let Some(CodecParameters::Audio(codec)) = track.and_then(|track| track.codec_params.as_ref())
    else {
        return Err(damaged(path, "it holds no sound"));
    };
    let (codec, frames) = (codec.clone(), track.and_then(|track| track.num_frames).unwrap_or(0));
    let (Some(rate_hz), Some(channels)) = (codec.sample_rate, codec.channels.as_ref()) else {
        return Err(damaged(path, "its header says neither rate nor channels"));
    };
    let header = Outline {
        rate_hz: f64::from(rate_hz),
        channels: channels.count(),
        frames: frames as usize,
    };
    if frames == 0 {
        return Err(LibraryError::file(
            path,
            "its header does not say how long it is; encode it again from a file, for example \
             with `sox IN.flac OUT.flac`",
        ));
    }
    check_length(header).map_err(|problem| LibraryError::file(path, problem))?;
    Ok((reader, codec, header))
}

fn decode_flac(path: &Path) -> Result<(Outline, Vec<f32>), LibraryError> {
    let (mut reader, codec, header) = open_flac(path)?;
    let failed = |error: Error| damaged(path, &error.to_string());
    let verifying = AudioDecoderOptions::default().verify(true);
    let mut decoder = FlacDecoder::try_new(&codec, &verifying).map_err(failed)?;
    let promised = header.frames * header.channels;
    let (mut samples, mut block) = (Vec::with_capacity(promised), Vec::<i32>::new());
    while let Some(packet) = reader.next_packet().map_err(failed)? {
        let decoded = decoder.decode(&packet).map_err(failed)?;
        decoded.copy_to_vec_interleaved(&mut block);
        // The decoder moves samples of any bit depth to the upper bits of 32 bits.
        samples.extend(block.iter().map(|&value| (f64::from(value) / 2f64.powi(31)) as f32));
        if samples.len() > promised {
            return Err(damaged(path, "it is longer than its header says"));
        }
    }
    if samples.len() < promised {
        return Err(damaged(path, "truncated: it ends before what its header promises"));
    }
    match decoder.finalize().verify_ok {
        Some(false) => Err(damaged(path, "its checksum is not that of its samples")),
        _ => Ok((header, samples)),
    }
}

fn damaged(path: &Path, why: &str) -> LibraryError {
    let problem = format!(
        "not a FLAC file that can be read ({why}); copy it again from where it came, record again, \
         or remove it"
    );
    LibraryError::file(path, problem)
}

/// Number of bytes decoded at a time: a multiple of each possible size of a sample (1 to 4 bytes).
const BLOCK: usize = 48 * 1024;

fn read_wav(path: &Path) -> Result<(Outline, Vec<f32>), LibraryError> {
    let (mut file, data) = open_wav(path)?;
    // This fails if the file has become shorter since its header was read.
    let samples = decode_wav(&mut file, data).map_err(|error| failure(path, error))?;
    Ok((data.outline(), samples))
}

fn decode_wav(file: &mut impl Read, data: WavData) -> io::Result<Vec<f32>> {
    let WavData { format, container, length, .. } = data;
    let bytes = usize::from(container);
    let scale = 1.0 / 2f64.powi(i32::from(container) * 8 - 1);
    let mut samples = Vec::with_capacity(length as usize / bytes);
    let mut block = [0; BLOCK];
    let mut left = length;
    while left > 0 {
        let block = &mut block[..left.min(BLOCK as u64) as usize];
        file.read_exact(block)?;
        left -= block.len() as u64;
        samples.extend(block.chunks_exact(bytes).map(|sample| match (format, sample) {
            (FLOAT, &[a, b, c, d]) => f32::from_le_bytes([a, b, c, d]),
            _ => (f64::from(integer(sample)) * scale) as f32,
        }));
    }
    Ok(samples)
}

/// Converts a sample of 1 to 4 little-endian bytes. A single byte is unsigned: 128 stands for 0.
#[inline]
fn integer(sample: &[u8]) -> i32 {
    match *sample {
        [a] => i32::from(a) - 128,
        [a, b] => i16::from_le_bytes([a, b]).into(),
        [a, b, c] => i32::from_le_bytes([0, a, b, c]) >> 8,
        [a, b, c, d] => i32::from_le_bytes([a, b, c, d]),
        _ => unreachable!("`parse_format` lets 1 to 4 bytes pass"),
    }
}

/// Name of a chunk that holds the rate in Hz as f64, if it is no whole number. The header then holds
/// the nearest whole number, and programs that do not know the chunk skip it.
pub(crate) const EXACT_RATE: [u8; 4] = *b"rate";

/// Codes of sample formats, from the `fmt ` chunk of a WAV file.
const PCM: u16 = 1;
const FLOAT: u16 = 3;
const EXTENSIBLE: u16 = 0xFFFE;

#[derive(Clone, Copy, Debug)]
struct WavData {
    /// [`PCM`] or [`FLOAT`].
    format: u16,
    channels: u16,
    rate_hz: f64,
    /// Bytes per sample, 1 to 4. A sample with fewer bits fills the upper bits of its bytes, by the
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
    let (file, size) = files::open(path).map_err(|error| LibraryError::io(path, error))?;
    if size == 0 {
        return Err(LibraryError::file(path, EMPTY_FILE));
    }
    let mut file = BufReader::new(file);
    let at_samples = walk_wav(&mut file).and_then(|data| Ok((data, file.stream_position()?)));
    let (data, start) = at_samples.map_err(|error| failure(path, error))?;
    let rest = size.saturating_sub(start);
    check(data, rest).map_err(|problem| LibraryError::file(path, problem))?;
    if rest < data.length {
        return Err(truncated(path, &format!(" ({rest} of {} bytes of samples)", data.length)));
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

/// Refuses a file with no samples, or too many for a trial. `rest` bytes follow the header.
fn check(data: WavData, rest: u64) -> Result<(), String> {
    let samples = data.length / u64::from(data.container);
    if samples == 0 {
        return Err(match rest {
            0 | 1 => "it holds no samples; record again, or remove the file".to_string(),
            _ => format!(
                "its header promises no samples, but {rest} bytes follow: the recording ended \
                 before its header was written; mend the header (for example with \
                 `sox --ignore-length`), or record again"
            ),
        });
    }
    check_length(data.outline())
}

fn no(problem: impl Into<String>) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, problem.into())
}

/// Reads the chunks before the samples, so that the file is then at its first sample.
fn walk_wav(file: &mut BufReader<File>) -> io::Result<WavData> {
    let riff: [u8; 12] = take(file)?;
    if &riff[..4] != b"RIFF" || &riff[8..] != b"WAVE" {
        return Err(no("it does not begin with RIFF and WAVE"));
    }
    let (mut format, mut exact_hz) = (None, None);
    loop {
        let [id @ .., a, b, c, d] = take::<8>(file)?;
        let length = u32::from_le_bytes([a, b, c, d]);
        match &id {
            b"data" => {
                let data: WavData =
                    format.ok_or_else(|| no("its format comes after its samples"))?;
                if u64::from(length) % u64::from(data.container * data.channels) != 0 {
                    return Err(no("its samples do not fill whole frames"));
                }
                // A program that has resampled a file may have kept the rate before.
                let exact_hz = exact_hz.filter(|hz: &f64| (hz - data.rate_hz).abs() <= 0.5);
                let rate_hz = exact_hz.unwrap_or(data.rate_hz);
                return Ok(WavData { length: u64::from(length), rate_hz, ..data });
            }
            b"fmt " if length >= 16 => {
                let mut body = [0; 40];
                let kept = (length as usize).min(body.len());
                file.read_exact(&mut body[..kept])?;
                format = Some(parse_format(&body[..kept])?);
                file.seek_relative(i64::from(length) - kept as i64 + i64::from(length % 2))?;
            }
            id if *id == EXACT_RATE && length == 8 => {
                exact_hz = Some(f64::from_le_bytes(take(file)?)).filter(|hz| *hz > 0.0);
            }
            // An odd-sized chunk is followed by a byte of padding.
            _ => file.seek_relative(i64::from(length) + i64::from(length % 2))?,
        }
    }
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
        FLOAT => (container, bits) == (4, 32),
        _ => return Err(no(format!("format {format} is not PCM"))),
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

    fn chunk(id: &[u8; 4], body: &[u8]) -> Vec<u8> {
        let padding = vec![0; body.len() % 2];
        [&id[..], &(body.len() as u32).to_le_bytes(), body, &padding].concat()
    }

    /// The bytes of a WAV file with one channel at 1000 Hz.
    fn file([format, container, bits]: [u16; 3], valid: Option<u16>, data: &[Vec<u8>]) -> Vec<u8> {
        let rate = 1000u32.to_le_bytes();
        let mut body = [format, 1].map(u16::to_le_bytes).concat();
        body.extend([rate, rate].concat());
        body.extend([container, bits].map(u16::to_le_bytes).concat());
        if let Some(valid) = valid {
            body.extend([22, valid, 0, 0, PCM].map(u16::to_le_bytes).concat());
            body.extend([0; 14]);
        }
        [b"RIFF\0\0\0\0WAVE", &chunk(b"fmt ", &body)[..], &data.concat()].concat()
    }

    fn read_bytes(bytes: &[u8]) -> Result<Vec<f32>, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.wav");
        std::fs::write(&path, bytes).unwrap();
        read_wav(&path).map(|(_, samples)| samples).map_err(|error| error.to_string())
    }

    #[test]
    fn samples_of_24_bits_in_32_are_the_upper_ones() {
        // The samples 0.25 and −0.5, each in the upper 24 of 32 bits.
        let data = chunk(b"data", &[0, 0, 0, 0x20, 0, 0, 0, 0xC0]);
        assert_eq!(
            read_bytes(&file([EXTENSIBLE, 4, 32], Some(24), std::slice::from_ref(&data))).unwrap(),
            [0.25, -0.5]
        );
        let error = read_bytes(&file([PCM, 4, 24], None, &[data])).unwrap_err();
        assert!(error.contains("24 bits in 4 bytes") && error.contains("sox"), "{error}");
    }

    #[test]
    fn an_odd_sized_chunk_is_followed_by_padding() {
        let chunks = [chunk(b"LIST", b"abc"), chunk(b"data", &[0, 0x40, 0, 0xC0])];
        assert_eq!(read_bytes(&file([PCM, 2, 16], None, &chunks)).unwrap(), [0.5, -0.5]);
        let of_bytes = [chunk(b"junk", b"x"), chunk(b"data", &[0x80, 0xC0, 0x40])];
        assert_eq!(read_bytes(&file([PCM, 1, 8], None, &of_bytes)).unwrap(), [0.0, 0.5, -0.5]);
    }

    #[test]
    fn an_hour_of_sound_is_refused_before_it_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.wav");
        let mut bytes = file([PCM, 2, 16], None, &[]);
        bytes.extend(b"data");
        let length = 2 * (Series::MOST_SAMPLES as u32 + 1);
        bytes.extend(length.to_le_bytes());
        std::fs::write(&path, &bytes).unwrap();
        // The file is sparse, so it takes no room on the disk.
        let file = File::options().write(true).open(&path).unwrap();
        file.set_len(bytes.len() as u64 + u64::from(length)).unwrap();
        let error = open_wav(&path).unwrap_err().to_string();
        assert!(error.contains("minutes are too long for a trial"), "{error}");
    }

    #[test]
    fn chunks_without_end_and_formats_that_cannot_be_are_refused() {
        let huge = [b"LIST".to_vec(), u32::MAX.to_le_bytes().to_vec()].concat();
        assert!(read_bytes(&file([PCM, 2, 16], None, &[huge])).unwrap_err().contains("truncated"));
        for (format, container, bits) in [(PCM, 0, 0), (PCM, 8, 64), (FLOAT, 2, 16), (2, 2, 16)] {
            let data = chunk(b"data", &[0; 8]);
            let error = read_bytes(&file([format, container, bits], None, &[data])).unwrap_err();
            assert!(error.contains("not a WAV file that can be read"), "{error}");
        }
    }
}
