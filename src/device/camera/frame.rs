//! Frames as cameras deliver them, made into RGB.

use std::borrow::Cow;
use std::io::Cursor;
use std::panic::{AssertUnwindSafe, catch_unwind};

use image::{ImageFormat, ImageReader, Limits};

use crate::jpeg;

/// Longest side of a frame that is accepted, in pixels.
const MAX_SIDE: u32 = 1 << 13;
const MAX_BYTES: u64 = 1 << 28;

/// The coding of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameFormat {
    /// Each frame is a JPEG file, with or without its Huffman tables.
    Mjpeg,
    /// Two bytes a pixel: Y0 U Y1 V for two of them (BT.601, 16 to 235).
    Yuyv,
    /// Three bytes a pixel.
    Rgb,
    /// Three bytes a pixel, blue first.
    Bgr,
}

/// A frame as it came from the camera. `bytes` may continue after the picture.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    pub format: FrameFormat,
    /// Width in pixels, as the camera promised.
    pub width: usize,
    pub height: usize,
    pub bytes: Vec<u8>,
}

/// A picture of any size: three bytes a pixel, row by row, no gaps.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rgb {
    pub width: usize,
    pub height: usize,
    /// width × height × 3 bytes.
    pub bytes: Vec<u8>,
}

/// Errors of decoding a frame.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    #[error("a frame of {got} bytes; expected {expected}")]
    Short { got: usize, expected: usize },
    #[error("a YUYV frame {0} pixels wide; expected an even width")]
    OddWidth(usize),
    #[error("a damaged MJPEG frame: {0}")]
    Jpeg(String),
}

impl Frame {
    /// The picture in it.
    ///
    /// # Errors
    /// If the frame is too short for its size, or damaged.
    pub fn to_rgb(&self) -> Result<Rgb, FrameError> {
        let (width, height) = (self.width, self.height);
        let bytes = match self.format {
            FrameFormat::Mjpeg => return decode_jpeg(&self.bytes),
            FrameFormat::Rgb => self.whole(3)?.to_vec(),
            FrameFormat::Bgr => {
                let mut bytes = self.whole(3)?.to_vec();
                bytes.chunks_exact_mut(3).for_each(<[u8]>::reverse);
                bytes
            }
            FrameFormat::Yuyv if !width.is_multiple_of(2) => {
                return Err(FrameError::OddWidth(width));
            }
            FrameFormat::Yuyv => yuyv_to_rgb(self.whole(2)?),
        };
        Ok(Rgb { width, height, bytes })
    }

    fn whole(&self, bytes_a_pixel: usize) -> Result<&[u8], FrameError> {
        let expected = self.width * self.height * bytes_a_pixel;
        let short = FrameError::Short { got: self.bytes.len(), expected };
        self.bytes.get(..expected).ok_or(short)
    }
}

/// RGB from pairs of pixels Y0 U Y1 V, by BT.601 with Y from 16 to 235, in 16-bit fixed point.
fn yuyv_to_rgb(pairs: &[u8]) -> Vec<u8> {
    let mut rgb = Vec::with_capacity(pairs.len() / 2 * 3);
    for pair in pairs.chunks_exact(4) {
        let (u, v) = (i32::from(pair[1]) - 128, i32::from(pair[3]) - 128);
        for y in [pair[0], pair[2]] {
            // 255/219; 2(1−Kr)·255/224, and so on, times 2^16; Kr = 0.299, Kb = 0.114.
            let y = 76_309 * (i32::from(y) - 16) + (1 << 15);
            let parts = [y + 104_597 * v, y - 25_675 * u - 53_279 * v, y + 132_201 * u];
            // The clamp makes it fit.
            rgb.extend(parts.map(|part| (part >> 16).clamp(0, 255) as u8));
        }
    }
    rgb
}

fn decode_jpeg(bytes: &[u8]) -> Result<Rgb, FrameError> {
    let damaged = |why: &str| FrameError::Jpeg(why.to_string());
    if !bytes.starts_with(&[0xFF, 0xD8]) {
        return Err(damaged("it does not begin as a JPEG does"));
    }
    if jpeg::is_cut_short(bytes) {
        return Err(damaged("its end is missing"));
    }
    let whole = with_tables(bytes);
    // A decoder may panic on hostile input; nothing outlives the closure.
    let decoded = catch_unwind(AssertUnwindSafe(|| {
        let mut reader = ImageReader::with_format(Cursor::new(&whole), ImageFormat::Jpeg);
        let mut limits = Limits::default();
        limits.max_image_width = Some(MAX_SIDE);
        limits.max_image_height = Some(MAX_SIDE);
        limits.max_alloc = Some(MAX_BYTES);
        reader.limits(limits);
        reader.decode()
    }));
    let picture = match decoded {
        Ok(Ok(picture)) => picture,
        Ok(Err(error)) => return Err(FrameError::Jpeg(error.to_string())),
        Err(_) => return Err(damaged("the decoder failed")),
    };
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    Ok(Rgb { width, height, bytes: picture.into_rgb8().into_raw() })
}

/// Many cameras leave the Huffman tables out, as MJPEG allows. A decoder uses the standard ones if
/// the frame is marked as MJPEG (an APP0 segment `AVI1`), which many cameras leave out too.
fn with_tables(jpeg: &[u8]) -> Cow<'_, [u8]> {
    const AVI1: [u8; 18] = *b"\xFF\xE0\x00\x10AVI1\0\0\0\0\0\0\0\0\0\0";
    let (mut has_tables, mut marked, mut at) = (false, false, 2);
    // From marker to marker, up to the pixels.
    while let Some(&[0xFF, marker, high, low]) = jpeg.get(at..at + 4) {
        match marker {
            0xC4 => has_tables = true,
            0xE0 => marked |= jpeg.get(at + 4..at + 8) == Some(b"AVI1"),
            0xDA => break,
            _ => {}
        }
        at += 2 + usize::from(u16::from_be_bytes([high, low])).max(2);
    }
    match has_tables || marked {
        true => Cow::Borrowed(jpeg),
        false => Cow::Owned([&jpeg[..2], &AVI1, &jpeg[2..]].concat()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(format: FrameFormat, width: usize, height: usize, bytes: Vec<u8>) -> Frame {
        Frame { format, width, height, bytes }
    }

    #[test]
    fn colours_of_yuyv_are_those_of_bt601() {
        // Black, white, and the primaries, as ITU-R BT.601 codes them.
        let known = [
            ([16, 128, 128], [0, 0, 0]),
            ([235, 128, 128], [255, 255, 255]),
            ([81, 90, 240], [255, 0, 0]),
            ([145, 54, 34], [0, 255, 0]),
            ([41, 240, 110], [0, 0, 255]),
        ];
        for ([y, u, v], rgb) in known {
            let picture = frame(FrameFormat::Yuyv, 2, 1, vec![y, u, y, v]).to_rgb().unwrap();
            for (got, expected) in picture.bytes.iter().zip([rgb, rgb].concat()) {
                assert!(got.abs_diff(expected) <= 2, "{:?} is not {rgb:?}", picture.bytes);
            }
        }
    }

    #[test]
    fn two_pixels_of_yuyv_share_their_colour_but_not_their_light() {
        let picture = frame(FrameFormat::Yuyv, 2, 1, vec![16, 128, 235, 128]).to_rgb().unwrap();
        assert_eq!(picture.bytes, [0, 0, 0, 255, 255, 255]);
    }

    #[test]
    fn rgb_and_bgr_differ_in_their_order_only() {
        let bytes = vec![1, 2, 3, 4, 5, 6, 99];
        let rgb = frame(FrameFormat::Rgb, 2, 1, bytes.clone()).to_rgb().unwrap();
        let bgr = frame(FrameFormat::Bgr, 2, 1, bytes).to_rgb().unwrap();
        assert_eq!((rgb.bytes, bgr.bytes), (vec![1, 2, 3, 4, 5, 6], vec![3, 2, 1, 6, 5, 4]));
    }

    #[test]
    fn a_short_frame_is_refused() {
        for (format, expected) in
            [(FrameFormat::Yuyv, 16), (FrameFormat::Rgb, 24), (FrameFormat::Bgr, 24)]
        {
            let error = frame(format, 4, 2, vec![0; 15]).to_rgb().unwrap_err();
            assert_eq!(error, FrameError::Short { got: 15, expected });
        }
        let odd = frame(FrameFormat::Yuyv, 3, 2, vec![0; 12]).to_rgb();
        assert_eq!(odd, Err(FrameError::OddWidth(3)));
    }

    fn jpeg() -> Vec<u8> {
        let picture = image::RgbImage::from_fn(32, 16, |x, _| match x < 16 {
            true => image::Rgb([200, 30, 40]),
            false => image::Rgb([20, 60, 220]),
        });
        let mut bytes = Vec::new();
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 95)
            .encode_image(&picture)
            .unwrap();
        bytes
    }

    /// A JPEG without its Huffman tables, which are the standard ones here, as many cameras send
    /// it.
    fn without_tables(jpeg: &[u8]) -> Vec<u8> {
        let (mut out, mut at) = (jpeg[..2].to_vec(), 2);
        loop {
            let length = 2 + usize::from(u16::from_be_bytes([jpeg[at + 2], jpeg[at + 3]]));
            match jpeg[at + 1] {
                0xDA => return [&out, &jpeg[at..]].concat(),
                0xC4 => {}
                _ => out.extend_from_slice(&jpeg[at..at + length]),
            }
            at += length;
        }
    }

    #[test]
    fn mjpeg_is_decoded_with_and_without_its_tables_and_what_follows_it() {
        let whole = jpeg();
        let bare = without_tables(&whole);
        assert!(bare.len() < whole.len());
        let stale = [whole.clone(), vec![7; 500]].concat();
        for bytes in [whole, bare, stale] {
            let picture = frame(FrameFormat::Mjpeg, 32, 16, bytes).to_rgb().unwrap();
            assert_eq!((picture.width, picture.height), (32, 16));
            let near = |at: usize, rgb: [u8; 3]| {
                picture.bytes[at..at + 3].iter().zip(rgb).all(|(a, b)| a.abs_diff(b) < 12)
            };
            assert!(near(4 * 3, [200, 30, 40]) && near(28 * 3, [20, 60, 220]));
        }
    }

    #[test]
    fn a_damaged_mjpeg_frame_is_refused_and_never_panics() {
        let whole = jpeg();
        for bytes in [vec![], vec![0; 100], whole[..whole.len() / 2].to_vec()] {
            let error = frame(FrameFormat::Mjpeg, 32, 16, bytes).to_rgb().unwrap_err();
            assert!(matches!(error, FrameError::Jpeg(_)));
        }
        for at in 2..whole.len() {
            let mut bytes = whole.clone();
            bytes[at] ^= 0x55;
            let _ = frame(FrameFormat::Mjpeg, 32, 16, bytes).to_rgb();
        }
    }
}
