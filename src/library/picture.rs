//! Reads PNG and JPEG pictures.

use std::io::Cursor;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use image::{DynamicImage, ImageDecoder, ImageError, ImageReader, Limits};

use super::{LibraryError, files};
use crate::jpeg;
use crate::trial::{Image, SignalError};

/// Limits of side (in pixels) and memory (in bytes): a hostile header may promise anything.
const MAX_SIDE: u32 = 1 << 14;
const MAX_BYTES: u64 = 1 << 28;
/// Largest picture file, in bytes.
const MOST_FILE: u64 = 1 << 26;

/// Reads a picture of 320 × 480 pixels, or one that lies on its side.
///
/// # Errors
/// If the file cannot be read, is empty, cannot be decoded, or has another size.
pub(crate) fn read(path: &Path) -> Result<Image, LibraryError> {
    let bytes = files::read_bytes(path, MOST_FILE)?;
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
    if jpeg::is_cut_short(&bytes) {
        return Err(damaged("it is truncated".into()));
    }
    // Large decoders may panic on hostile input; nothing that the closure changes outlives it.
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

/// The decoded picture; the inner error is a wrong size, found before anything is decoded.
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
