//! Reads files of one series; the extension selects the format. A file must hold as many samples as
//! its header says.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use symphonia_bundle_flac::{FlacDecoder, FlacReader};
use symphonia_core::codecs::CodecParameters;
use symphonia_core::codecs::audio::{AudioCodecParameters, AudioDecoder, AudioDecoderOptions};
use symphonia_core::errors::Error;
use symphonia_core::formats::{FormatOptions, FormatReader};
use symphonia_core::io::MediaSourceStream;

use super::files::{self, check_length};
#[cfg(feature = "lossy")]
use super::lossy;
use super::{LibraryError, Outline, wav};
use crate::trial::Series;

const FLAC: &str = "FLAC file";

/// Reads the header of a file. For WAV, also checks that the file is as long as its header says.
pub(crate) fn probe(path: &Path) -> Result<Outline, LibraryError> {
    match &*files::extension(path) {
        "flac" => decoded(path, FLAC, || open_flac(path).map(|(_, _, header)| header)),
        #[cfg(feature = "lossy")]
        _ if is_lossy(path) => decoded(path, "sound", || lossy::probe(path)),
        _ => wav::probe(path),
    }
}

/// Reads a whole file. Divides integer samples by 2^(bits − 1), so that they lie within ±1.
pub(crate) fn read(path: &Path) -> Result<Series, LibraryError> {
    let (header, samples) = match &*files::extension(path) {
        "flac" => decoded(path, FLAC, || decode_flac(path))?,
        #[cfg(feature = "lossy")]
        _ if is_lossy(path) => decoded(path, "sound", || lossy::read(path))?,
        _ => wav::read(path)?,
    };
    Series::new(header.rate_hz, header.channels, samples).map_err(LibraryError::at(path))
}

/// Whether a file's coding leaves out what people do not hear.
pub(super) fn is_lossy(path: &Path) -> bool {
    files::LOSSY.contains(&&*files::extension(path))
}

/// Runs the decoder of a `kind` of file.
fn decoded<T>(
    path: &Path,
    kind: &str,
    work: impl FnOnce() -> Result<T, LibraryError>,
) -> Result<T, LibraryError> {
    guarded(work, |why| LibraryError::damaged(path, kind, why))
}

/// Runs a decoder. If it panics, as decoders may on damaged files, returns the error `failed`.
pub(crate) fn guarded<T, E>(
    work: impl FnOnce() -> Result<T, E>,
    failed: impl FnOnce(&str) -> E,
) -> Result<T, E> {
    // This is safe, since nothing that `work` changes is used after a panic.
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|_| Err(failed("the decoder failed")))
}

fn open_flac(
    path: &Path,
) -> Result<(FlacReader<'static>, AudioCodecParameters, Outline), LibraryError> {
    let no = |why: &str| LibraryError::damaged(path, FLAC, why);
    let (file, _) = files::open_filled(path)?;
    let stream = MediaSourceStream::new(Box::new(file), Default::default());
    let reader = FlacReader::try_new(stream, FormatOptions::default())
        .map_err(|error| no(&error.to_string()))?;
    let track = reader.tracks().first();
    let Some(CodecParameters::Audio(codec)) = track.and_then(|track| track.codec_params.as_ref())
    else {
        return Err(no("it holds no sound"));
    };
    let (codec, frames) = (codec.clone(), track.and_then(|track| track.num_frames).unwrap_or(0));
    let (Some(rate_hz), Some(channels)) = (codec.sample_rate, codec.channels.as_ref()) else {
        return Err(no("its header says neither rate nor channels"));
    };
    let (rate_hz, channels) = (f64::from(rate_hz), channels.count());
    let header = Outline { rate_hz, channels, frames: frames as usize };
    if frames == 0 {
        return Err(LibraryError::file(
            path,
            "its header does not say how long it is; encode it again from a file, for example \
             with `sox IN.flac OUT.flac`",
        ));
    }
    check_length(header).map_err(LibraryError::at(path))?;
    Ok((reader, codec, header))
}

fn decode_flac(path: &Path) -> Result<(Outline, Vec<f32>), LibraryError> {
    let (mut reader, codec, header) = open_flac(path)?;
    let no = |why: &str| LibraryError::damaged(path, FLAC, why);
    let failed = |error: Error| no(&error.to_string());
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
            return Err(no("it is longer than its header says"));
        }
    }
    if samples.len() < promised {
        return Err(no("truncated: it ends before what its header promises"));
    }
    match decoder.finalize().verify_ok {
        Some(false) => Err(no("its checksum is not that of its samples")),
        _ => Ok((header, samples)),
    }
}
