//! Reads FLAC files, and checks that they hold as many samples as their headers say.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use symphonia_bundle_flac::{FlacDecoder, FlacReader};
use symphonia_core::codecs::CodecParameters;
use symphonia_core::codecs::audio::{AudioCodecParameters, AudioDecoder, AudioDecoderOptions};
use symphonia_core::errors::Error;
use symphonia_core::formats::{FormatOptions, FormatReader};
use symphonia_core::io::MediaSourceStream;

use super::LibraryError;
use super::files::{self, EMPTY_FILE};
use super::series_header::{Header, too_long};
use crate::trial::Series;

/// Reads a header.
///
/// # Errors
/// If the file cannot be read, is empty, is no FLAC file, does not say how long it is, or is longer
/// than [`Series::MOST_SAMPLES`].
pub(super) fn probe(path: &Path) -> Result<Header, LibraryError> {
    guarded(path, || open(path).map(|(_, _, header)| header))
}

/// Reads a whole file; samples are scaled to ±1, that is value / 2^(bits − 1).
///
/// # Errors
/// As [`probe`], and if the file is cut short or its checksum is not that of its samples.
pub(super) fn read(path: &Path) -> Result<Series, LibraryError> {
    let (header, samples) = guarded(path, || decode(path))?;
    Series::new(header.rate_hz, header.channels, samples)
        .map_err(|error| LibraryError::Signal { path: path.to_path_buf(), error })
}

/// Large decoders may panic on hostile input; nothing that `work` changes outlives it.
fn guarded<T>(
    path: &Path,
    work: impl FnOnce() -> Result<T, LibraryError>,
) -> Result<T, LibraryError> {
    catch_unwind(AssertUnwindSafe(work))
        .unwrap_or_else(|_| Err(damaged(path, "the decoder failed")))
}

fn open(path: &Path) -> Result<(FlacReader<'static>, AudioCodecParameters, Header), LibraryError> {
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
    let header =
        Header { rate_hz: f64::from(rate_hz), channels: channels.count(), frames: frames as usize };
    if frames == 0 {
        return Err(LibraryError::file(
            path,
            "its header does not say how long it is; encode it again from a file, for example \
             with `sox IN.flac OUT.flac`",
        ));
    }
    match too_long(header) {
        Some(problem) => Err(LibraryError::file(path, problem)),
        None => Ok((reader, codec, header)),
    }
}

fn decode(path: &Path) -> Result<(Header, Vec<f32>), LibraryError> {
    let (mut reader, codec, header) = open(path)?;
    let failed = |error: Error| damaged(path, &error.to_string());
    let verifying = AudioDecoderOptions::default().verify(true);
    let mut decoder = FlacDecoder::try_new(&codec, &verifying).map_err(failed)?;
    let promised = header.frames * header.channels;
    let (mut samples, mut block) = (Vec::with_capacity(promised), Vec::<i32>::new());
    while let Some(packet) = reader.next_packet().map_err(failed)? {
        let decoded = decoder.decode(&packet).map_err(failed)?;
        decoded.copy_to_vec_interleaved(&mut block);
        // The decoder left-aligns samples in 32 bits, however few bits they have.
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
