//! Reading PNG and JPEG pictures.

use std::io::Cursor;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use image::{DynamicImage, ImageDecoder, ImageError, ImageReader, Limits};

use super::{LibraryError, files};
use crate::trial::{Image, SignalError};

/// No picture of a surface needs more; a hostile header may promise anything.
const MAX_SIDE: u32 = 1 << 14;
const MAX_BYTES: u64 = 1 << 28;

/// Reads a picture of 320 × 480 pixels, or one that lies on its side.
///
/// # Errors
/// If the file cannot be read, is empty, cannot be decoded, or has another size.
pub(crate) fn read(path: &Path) -> Result<Image, LibraryError> {
    let bytes = files::read_bytes(path)?;
    let damaged = |why: String| {
        LibraryError::file(
            path,
            format!(
                "the picture cannot be decoded ({why}); expected a whole PNG or JPEG file: copy it \
                 again from where it came, take it again, or remove it"
            ),
        )
    };
    let signal = |error| LibraryError::Signal { path: path.to_path_buf(), error };
    if is_cut_short(&bytes) {
        return Err(damaged("it is truncated".into()));
    }
    // Decoders are large and may panic on hostile input; nothing outlives the closure.
    match catch_unwind(AssertUnwindSafe(|| decode(&bytes))) {
        Ok(Ok(Ok(picture))) => {
            let (width, height) = (picture.width() as usize, picture.height() as usize);
            Image::new(width, height, picture.into_rgb8().into_raw()).map_err(signal)
        }
        Ok(Ok(Err(size))) => Err(signal(size)),
        Ok(Err(error)) => Err(damaged(error.to_string())),
        Err(_) => Err(damaged("the decoder failed".into())),
    }
}

/// The picture, or the size that makes decoding pointless.
fn decode(bytes: &[u8]) -> Result<Result<DynamicImage, SignalError>, ImageError> {
    let mut reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format()?;
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_SIDE);
    limits.max_image_height = Some(MAX_SIDE);
    limits.max_alloc = Some(MAX_BYTES);
    reader.limits(limits);
    let decoder = reader.into_decoder()?;
    let (width, height) = decoder.dimensions();
    let size = (width as usize, height as usize);
    if ![(Image::COLS, Image::ROWS), (Image::ROWS, Image::COLS)].contains(&size) {
        return Ok(Err(SignalError::ImageSize { width: size.0, height: size.1 }));
    }
    DynamicImage::from_decoder(decoder).map(Ok)
}

/// Whether these are the bytes of a JPEG file that lacks its end, whose missing part the decoder
/// would fill with grey. (PNG has checksums instead.)
fn is_cut_short(bytes: &[u8]) -> bool {
    const START: [u8; 2] = [0xFF, 0xD8];
    let Some(mut rest) = bytes.strip_prefix(&START) else { return false };
    // Walk from marker to marker: a thumbnail's end inside a segment is not the picture's.
    loop {
        let next = rest.windows(2).position(|two| {
            // 0xFF before 0 is a pixel, before D0 to D7 a restart, before itself a filler.
            two[0] == 0xFF && !matches!(two[1], 0 | 0xFF | 0xD0..=0xD7)
        });
        let Some(at) = next else { return true };
        if rest[at + 1] == 0xD9 {
            return false;
        }
        let &[_, _, high, low, ..] = &rest[at..] else { return true };
        let length = usize::from(u16::from_be_bytes([high, low]));
        match rest.get(at + 2 + length..) {
            Some(after) => rest = after,
            None => return true,
        }
    }
}
