//! A frame's checksum: CRC-32/ISO-HDLC, computed sixteen bytes at a time.

use ::crc::{CRC_32_ISO_HDLC, Crc, Table};

/// The tables take 16 KiB of flash, but are several times faster than one small table. The
/// checksum's speed limits how many bytes the daemon decodes per second on one core.
static CRC: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&CRC_32_ISO_HDLC);

/// Number of bytes of the checksum at the end of a frame.
pub const LEN: usize = 4;

/// CRC-32 of `bytes`. Check value: the nine digits `123456789` give `0xCBF43926`.
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
