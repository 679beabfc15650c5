//! Encodes pictures as JPEG files, detects JPEG files that are cut short, and limits all decoders.

use std::io::Cursor;

use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder, ImageReader, ImageResult, Limits};

use crate::trial::Image;

/// Quality of all JPEG files written, from 1 to 100. The files are for viewing, not for comparing.
const QUALITY: u8 = 80;

pub fn encode(image: &Image) -> ImageResult<Vec<u8>> {
    encode_rgb(image.rgb(), (Image::COLS as u32, Image::ROWS as u32))
}

/// Encodes RGB pixels (three bytes each, row by row) as a JPEG file.
pub fn encode_rgb(rgb: &[u8], (width, height): (u32, u32)) -> ImageResult<Vec<u8>> {
    let mut bytes = Vec::new();
    let encoder = JpegEncoder::new_with_quality(&mut bytes, QUALITY);
    encoder.write_image(rgb, width, height, ExtendedColorType::Rgb8)?;
    Ok(bytes)
}

/// Limits on a picture's sides (pixels) and memory (bytes); a hostile header may claim any size.
const MAX_SIDE: u32 = 1 << 14;
const MAX_BYTES: u64 = 1 << 28;

/// A decoder with limits, for the PNG or JPEG file in `bytes`. It may panic on hostile bytes.
pub fn reader(bytes: &[u8]) -> ImageResult<ImageReader<Cursor<&[u8]>>> {
    let mut reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format()?;
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_SIDE);
    limits.max_image_height = Some(MAX_SIDE);
    limits.max_alloc = Some(MAX_BYTES);
    reader.limits(limits);
    Ok(reader)
}

/// Whether the bytes are a JPEG file without its end, whose missing part a decoder would fill with
/// grey. False for bytes that are not a JPEG file.
pub fn is_cut_short(bytes: &[u8]) -> bool {
    const START: [u8; 2] = [0xFF, 0xD8];
    let Some(mut rest) = bytes.strip_prefix(&START) else { return false };
    // Goes from marker to marker, to skip the end marker of an embedded thumbnail.
    loop {
        let next = rest.windows(2).position(|two| {
            // Only markers count: 0xFF 0 is pixel data, 0xFF D0 to D7 a restart, 0xFF 0xFF padding.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_end_of_the_picture_itself_counts() {
        let start = [0xFF, 0xD8];
        // A segment of application data that holds a thumbnail, and so an end marker.
        let segment = [0xFF, 0xE1, 0, 6, 0xFF, 0xD8, 0xFF, 0xD9];
        let pixels = [0xFF, 0xDA, 0, 2, 1, 2, 0xFF, 0, 3];
        let cut = [&start[..], &segment, &pixels].concat();
        assert!(is_cut_short(&cut) && is_cut_short(&start));
        assert!(!is_cut_short(&[&cut[..], &[0xFF, 0xD9]].concat()));
        assert!(!is_cut_short(b"PNG"));
    }
}
