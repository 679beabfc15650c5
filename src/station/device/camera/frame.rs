//! Frames in the formats of cameras, and their conversion to RGB.

use std::borrow::Cow;
use std::panic::{AssertUnwindSafe, catch_unwind};

use image::{DynamicImage, RgbImage};

use crate::jpeg;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameFormat {
    /// A JPEG file per frame, perhaps without its Huffman tables.
    Mjpeg,
    /// Four bytes Y0 U Y1 V for each two pixels (BT.601, Y from 16 to 235).
    Yuyv,
    Rgb,
    Bgr,
}

/// A frame as the camera delivered it. `bytes` may hold further bytes after the picture.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    pub format: FrameFormat,
    pub width: u32,
    pub height: u32,
    pub bytes: Vec<u8>,
}

impl Frame {
    pub fn to_rgb(&self) -> Result<RgbImage, String> {
        let (width, height) = (self.width, self.height);
        let bytes = match self.format {
            FrameFormat::Mjpeg => {
                let damaged = |why| format!("a damaged MJPEG frame: {why}");
                return decode_jpeg(&self.bytes).map_err(damaged);
            }
            FrameFormat::Rgb => self.whole(3)?.to_vec(),
            FrameFormat::Bgr => {
                let mut bytes = self.whole(3)?.to_vec();
                bytes.chunks_exact_mut(3).for_each(<[u8]>::reverse);
                bytes
            }
            FrameFormat::Yuyv if !width.is_multiple_of(2) => {
                return Err(format!("a YUYV frame {width} pixels wide; expected an even width"));
            }
            FrameFormat::Yuyv => yuyv_to_rgb(self.whole(2)?),
        };
        RgbImage::from_raw(width, height, bytes).ok_or_else(|| "too few bytes".into())
    }

    fn whole(&self, bytes_a_pixel: usize) -> Result<&[u8], String> {
        let expected = self.width as usize * self.height as usize * bytes_a_pixel;
        let short = || format!("a frame of {} bytes; expected {expected}", self.bytes.len());
        self.bytes.get(..expected).ok_or_else(short)
    }
}

fn yuyv_to_rgb(pairs: &[u8]) -> Vec<u8> {
    let mut rgb = Vec::with_capacity(pairs.len() / 2 * 3);
    for pair in pairs.chunks_exact(4) {
        let (u, v) = (i32::from(pair[1]) - 128, i32::from(pair[3]) - 128);
        for y in [pair[0], pair[2]] {
            // Factors (255/219 for Y, 2(1−0.299)·255/224 for V, …), multiplied by 2^16.
            let y = 76_309 * (i32::from(y) - 16) + (1 << 15);
            let parts = [y + 104_597 * v, y - 25_675 * u - 53_279 * v, y + 132_201 * u];
            // The cast is safe: after the clamp, the value fits into a byte.
            rgb.extend(parts.map(|part| (part >> 16).clamp(0, 255) as u8));
        }
    }
    rgb
}

fn decode_jpeg(bytes: &[u8]) -> Result<RgbImage, String> {
    if !bytes.starts_with(&[0xFF, 0xD8]) {
        return Err("it does not begin as a JPEG does".into());
    }
    if jpeg::is_cut_short(bytes) {
        return Err("its end is missing".into());
    }
    let whole = with_tables(bytes);
    // Catches panics, which decoders may have on hostile input. No damaged state remains.
    let decode = || jpeg::reader(&whole)?.decode();
    let decoded = catch_unwind(AssertUnwindSafe(decode));
    let decoded = decoded.map_err(|_| "the decoder failed")?;
    decoded.map(DynamicImage::into_rgb8).map_err(|error| error.to_string())
}

/// Makes a JPEG without Huffman tables decodable, which MJPEG allows. Decoders use the standard
/// tables if a frame has MJPEG's mark (segment APP0 `AVI1`), so this adds a missing mark.
fn with_tables(jpeg: &[u8]) -> Cow<'_, [u8]> {
    const AVI1: [u8; 18] = *b"\xFF\xE0\x00\x10AVI1\0\0\0\0\0\0\0\0\0\0";
    let (mut has_tables, mut marked, mut at) = (false, false, 2);
    // Goes from marker to marker, until the pixels begin.
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

    fn frame(format: FrameFormat, width: u32, height: u32, bytes: Vec<u8>) -> Frame {
        Frame { format, width, height, bytes }
    }

    #[test]
    fn colours_of_yuyv_are_those_of_bt601() {
        // Black, white and the primary colours, with their codes from ITU-R BT.601.
        let known = [
            ([16, 128, 128], [0, 0, 0]),
            ([235, 128, 128], [255, 255, 255]),
            ([81, 90, 240], [255, 0, 0]),
            ([145, 54, 34], [0, 255, 0]),
            ([41, 240, 110], [0, 0, 255]),
        ];
        for ([y, u, v], rgb) in known {
            let picture = frame(FrameFormat::Yuyv, 2, 1, vec![y, u, y, v]).to_rgb().unwrap();
            for (got, expected) in picture.iter().zip([rgb, rgb].concat()) {
                assert!(got.abs_diff(expected) <= 2, "{:?} is not {rgb:?}", picture.as_raw());
            }
        }
        // Two pixels share their colour, but not their light.
        let picture = frame(FrameFormat::Yuyv, 2, 1, vec![16, 128, 235, 128]).to_rgb().unwrap();
        assert_eq!(*picture, [0, 0, 0, 255, 255, 255]);
    }

    #[test]
    fn rgb_and_bgr_differ_in_their_order_only() {
        let bytes = vec![1, 2, 3, 4, 5, 6, 99];
        let rgb = frame(FrameFormat::Rgb, 2, 1, bytes.clone()).to_rgb().unwrap();
        let bgr = frame(FrameFormat::Bgr, 2, 1, bytes).to_rgb().unwrap();
        assert_eq!((&*rgb, &*bgr), (&[1, 2, 3, 4, 5, 6][..], &[3, 2, 1, 6, 5, 4][..]));
    }

    #[test]
    fn a_short_frame_is_refused() {
        for (format, expected) in
            [(FrameFormat::Yuyv, 16), (FrameFormat::Rgb, 24), (FrameFormat::Bgr, 24)]
        {
            let error = frame(format, 4, 2, vec![0; 15]).to_rgb().unwrap_err();
            assert_eq!(error, format!("a frame of 15 bytes; expected {expected}"));
        }
        let odd = frame(FrameFormat::Yuyv, 3, 2, vec![0; 12]).to_rgb().unwrap_err();
        assert!(odd.contains("3 pixels wide"), "{odd}");
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

    /// Removes the Huffman tables from a JPEG, like many cameras. They must be the standard tables.
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
            assert_eq!(picture.dimensions(), (32, 16));
            let near = |at: usize, rgb: [u8; 3]| {
                picture.as_raw()[at..at + 3].iter().zip(rgb).all(|(a, b)| a.abs_diff(b) < 12)
            };
            assert!(near(4 * 3, [200, 30, 40]) && near(28 * 3, [20, 60, 220]));
        }
    }

    #[test]
    fn a_damaged_mjpeg_frame_is_refused_and_never_panics() {
        let whole = jpeg();
        for bytes in [vec![], vec![0; 100], whole[..whole.len() / 2].to_vec()] {
            let error = frame(FrameFormat::Mjpeg, 32, 16, bytes).to_rgb().unwrap_err();
            assert!(error.starts_with("a damaged MJPEG frame"), "{error}");
        }
        for at in 2..whole.len() {
            let mut bytes = whole.clone();
            bytes[at] ^= 0x55;
            let _ = frame(FrameFormat::Mjpeg, 32, 16, bytes).to_rgb();
        }
    }
}
