//! Reads PNG and JPEG pictures.

use std::io::Cursor;
use std::path::Path;

use image::{DynamicImage, ImageDecoder, ImageError, ImageReader, Limits};

use super::series_file::guarded;
use super::{LibraryError, files};
use crate::jpeg;
use crate::trial::{Image, SignalError};

/// Limits on a picture's sides (pixels) and memory (bytes); a hostile header may claim any size.
const MAX_SIDE: u32 = 1 << 14;
const MAX_BYTES: u64 = 1 << 28;
/// Largest picture file, in bytes.
const MOST_FILE: u64 = 1 << 26;

/// Reads a picture of 320 × 480 pixels, or of 480 × 320.
pub(crate) fn read(path: &Path) -> Result<Image, LibraryError> {
    let bytes = files::read_bytes(path, MOST_FILE)?;
    let damaged = |why: &str| {
        LibraryError::file(
            path,
            format!(
                "the picture cannot be decoded ({why}); expected a whole PNG or JPEG file: copy it \
                 again from where it came, take it again, or remove it"
            ),
        )
    };
    if jpeg::is_cut_short(&bytes) {
        return Err(damaged("it is truncated"));
    }
    guarded(
        || {
            let decoder = decoder(&bytes).map_err(|error| damaged(&error.to_string()))?;
            let (width, height) = decoder.dimensions();
            let (width, height) = (width as usize, height as usize);
            // Checks the size first: a picture of a wrong size need not be decoded.
            if ![(Image::COLS, Image::ROWS), (Image::ROWS, Image::COLS)].contains(&(width, height))
            {
                return Err(LibraryError::file(path, SignalError::ImageSize { width, height }));
            }
            let picture = DynamicImage::from_decoder(decoder);
            let picture = picture.map_err(|error| damaged(&error.to_string()))?;
            Image::new(width, height, picture.into_rgb8().into_raw())
                .map_err(|error| LibraryError::file(path, error))
        },
        damaged,
    )
}

fn decoder(bytes: &[u8]) -> Result<impl ImageDecoder, ImageError> {
    let mut reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format()?;
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_SIDE);
    limits.max_image_height = Some(MAX_SIDE);
    limits.max_alloc = Some(MAX_BYTES);
    reader.limits(limits);
    reader.into_decoder()
}
