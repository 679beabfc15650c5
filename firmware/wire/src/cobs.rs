//! Consistent overhead byte stuffing (COBS): encodes bytes so that none of them is zero.
//!
//! The data are cut at their zeros. Each part is written as one byte, its length plus one, and then
//! its bytes without the zero. A part of 254 bytes ends early: its length byte is 255, and no zero
//! follows it. (S. Cheshire and M. Baker, *Consistent Overhead Byte Stuffing*, IEEE/ACM
//! Transactions on Networking 7, 1999.)
//!
//! The crate `cobs` (0.5, no_std) is not used: its in-place decoder accepts frames that no encoder
//! writes, its encoder panics if there is no room at all, and it decodes a quiet signal four times
//! slower (273 against 1122 MB/s in `examples/throughput`).

/// Longest run without a zero that one length byte can describe.
const MAX_RUN: usize = 254;

/// The length byte of a run of [`MAX_RUN`] bytes; no zero follows such a run.
const FULL: u8 = 0xFF;

/// Largest size that `len` bytes can have after encoding.
#[must_use]
pub const fn max_encoded_len(len: usize) -> usize {
    len + len / MAX_RUN + 1
}

/// Encodes `data` into `out`, without a delimiter, and returns the number of bytes written.
///
/// Returns `None` if `out` is too short; [`max_encoded_len`] bytes always suffice.
#[must_use]
pub fn encode(data: &[u8], out: &mut [u8]) -> Option<usize> {
    let mut rest = data;
    let mut at = 0;
    loop {
        let window = &rest[..rest.len().min(MAX_RUN)];
        let run = find_zero(window).unwrap_or(window.len());
        let piece = out.get_mut(at..=at + run)?;
        // The length byte cannot overflow, since run <= 254.
        piece[0] = run as u8 + 1;
        piece[1..].copy_from_slice(&window[..run]);
        at += run + 1;
        if run == rest.len() {
            return Some(at);
        }
        // Skips the zero after the run; a run of `MAX_RUN` bytes has none.
        rest = &rest[if run == MAX_RUN { run } else { run + 1 }..];
    }
}

/// Decodes bytes from [`encode`] in place, and returns the data. Returns `None` if `encode` cannot
/// have written `stuffed`: it is empty, holds a zero, or a length points beyond its end.
///
/// The data are `stuffed` without its first byte, with a zero in place of each further length byte.
/// Bytes move only after a length byte that stands for no zero.
#[must_use]
pub fn decode_in_place(stuffed: &mut [u8]) -> Option<&[u8]> {
    let end = stuffed.len();
    let mut code = *stuffed.first()?;
    let mut at = 0;
    // Number of length bytes after full runs so far. They stand for no zero, so they are removed.
    let mut removed = 0;
    loop {
        if code == 0 {
            return None;
        }
        let next = at + usize::from(code);
        if next > end {
            return None;
        }
        if removed > 0 {
            stuffed.copy_within(at + 1..next, at + 1 - removed);
        }
        if next == end {
            return Some(&stuffed[1..end - removed]);
        }
        let following = stuffed[next];
        if code == FULL {
            removed += 1;
        } else {
            stuffed[next - removed] = 0;
        }
        code = following;
        at = next;
    }
}

/// Position of the first zero in `bytes`; searches one machine word at a time.
#[must_use]
pub fn find_zero(bytes: &[u8]) -> Option<usize> {
    const WORD: usize = size_of::<usize>();
    const LOW: usize = usize::MAX / 0xFF; // 0x01 in every byte
    const HIGH: usize = LOW << 7; // 0x80 in every byte
    let (words, tail) = bytes.as_chunks::<WORD>();
    for (i, word) in words.iter().enumerate() {
        let word = usize::from_le_bytes(*word);
        // The lowest mark always stands for a zero byte; a mark above it may be wrong.
        let marks = word.wrapping_sub(LOW) & !word & HIGH;
        if marks != 0 {
            return Some(i * WORD + marks.trailing_zeros() as usize / 8);
        }
    }
    let offset = bytes.len() - tail.len();
    tail.iter().position(|&b| b == 0).map(|i| offset + i)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn round_trip(data: &[u8], stuffed: &[u8]) {
        let mut out = [0xAA; 1100];
        let n = encode(data, &mut out).unwrap();
        assert_eq!(&out[..n], stuffed);
        assert!(n <= max_encoded_len(data.len()));
        assert_eq!(decode_in_place(&mut out[..n]).unwrap(), data);
    }

    #[test]
    fn follows_the_examples_of_the_paper() {
        round_trip(&[], &[1]);
        round_trip(&[0], &[1, 1]);
        round_trip(&[0, 0], &[1, 1, 1]);
        round_trip(&[0x11, 0x22, 0, 0x33], &[3, 0x11, 0x22, 2, 0x33]);
        round_trip(&[0x11, 0, 0, 0], &[2, 0x11, 1, 1, 1]);
    }

    #[test]
    fn runs_around_254_bytes_survive() {
        let mut data = [7u8; 1030];
        for len in [253, 254, 255, 507, 508, 509, 762, 763, 1016, 1030] {
            let mut out = [0; 1100];
            let n = encode(&data[..len], &mut out).unwrap();
            assert!(!out[..n].contains(&0));
            assert_eq!(decode_in_place(&mut out[..n]).unwrap(), &data[..len]);
        }
        for zero_at in [0, 252, 253, 254, 255, 508, 509, 1029] {
            data[zero_at] = 0;
            let mut out = [0; 1100];
            let n = encode(&data, &mut out).unwrap();
            assert!(!out[..n].contains(&0));
            assert_eq!(decode_in_place(&mut out[..n]).unwrap(), &data);
        }
    }

    #[test]
    fn too_little_room_is_refused_not_overrun() {
        let data = [5u8; 300];
        let need = encode(&data, &mut [0; 400]).unwrap();
        let mut out = [0; 400];
        assert_eq!(encode(&data, &mut out[..need]), Some(need));
        for room in 0..need {
            assert_eq!(encode(&data, &mut out[..room]), None);
        }
    }

    #[test]
    fn what_no_encoder_wrote_is_refused() {
        assert_eq!(decode_in_place(&mut []), None);
        assert_eq!(decode_in_place(&mut [0]), None);
        assert_eq!(decode_in_place(&mut [3, 1]), None);
        assert_eq!(decode_in_place(&mut [2, 1, 0]), None);
    }

    #[test]
    fn find_zero_agrees_with_a_plain_search() {
        for len in 0..40 {
            for zero in 0..=len {
                let mut bytes = [0x80u8; 41];
                bytes[0] = 1;
                bytes[zero] = 0;
                let slow = bytes[..len].iter().position(|&b| b == 0);
                assert_eq!(find_zero(&bytes[..len]), slow);
            }
        }
    }
}
