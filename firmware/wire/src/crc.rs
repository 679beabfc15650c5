//! The frame's checksum: CRC-32/ISO-HDLC, sixteen bytes a step.

use ::crc::{CRC_32_ISO_HDLC, Crc, Table};

/// The wide tables cost 16 KiB of flash and are several times as fast as the narrow one, which
/// decides how much one core of the daemon can take in.
static CRC: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&CRC_32_ISO_HDLC);

/// Bytes that the checksum takes at the end of a frame.
pub const LEN: usize = 4;

/// CRC-32 of `bytes`; that of the nine digits `123456789` is `0xCBF43926`.
#[must_use]
pub fn checksum(bytes: &[u8]) -> u32 {
    CRC.checksum(bytes)
}

#[cfg(test)]
mod tests {
    use super::checksum;

    #[test]
    fn agrees_with_the_published_check_value() {
        assert_eq!(checksum(b"123456789"), 0xCBF4_3926);
        assert_eq!(checksum(b""), 0);
    }

    #[test]
    fn agrees_with_the_bit_by_bit_definition() {
        let bytes: [u8; 77] = core::array::from_fn(|i| (i * 37 + 11) as u8);
        for len in 0..bytes.len() {
            let mut crc = !0u32;
            for &byte in &bytes[..len] {
                crc ^= u32::from(byte);
                for _ in 0..8 {
                    crc = (crc >> 1) ^ if crc & 1 == 1 { 0xEDB8_8320 } else { 0 };
                }
            }
            assert_eq!(checksum(&bytes[..len]), !crc);
        }
    }
}
