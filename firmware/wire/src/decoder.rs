//! Decodes the bytes of the serial line into messages, even if some bytes are damaged.

use crate::{DecodeError, MAX_FRAME, Message, cobs, crc};

/// Longest frame on the line in bytes, after COBS encoding and without its delimiter.
const MAX_STUFFED: usize = cobs::max_encoded_len(MAX_FRAME);

/// Collects bytes up to a delimiter, and decodes them as a message or an error.
///
/// Does no I/O and keeps at most one frame. A [`DecodeError`] costs only one frame: each undamaged
/// frame between two delimiters is returned.
///
/// ```
/// use surfaced_wire::{Command, Decoder, MAX_ENCODED, Message, encode};
///
/// let mut line = [0; MAX_ENCODED];
/// let n = encode(&Message::Command(Command::Start), &mut line)?;
///
/// let mut decoder = Decoder::new();
/// let mut bytes = &line[..n];
/// while let Some(result) = decoder.next(&mut bytes) {
///     assert_eq!(result, Ok(Message::Command(Command::Start)));
/// }
/// assert!(bytes.is_empty());
/// # Ok::<(), surfaced_wire::EncodeError>(())
/// ```
#[derive(Debug, Clone)]
pub struct Decoder {
    buffer: [u8; MAX_STUFFED],
    /// Number of bytes since the last delimiter, including those that did not fit into `buffer`.
    seen: usize,
}

impl Default for Decoder {
    fn default() -> Self {
        Self::new()
    }
}

impl Decoder {
    /// A decoder that has seen no bytes yet.
    #[must_use]
    pub const fn new() -> Self {
        Self { buffer: [0; MAX_STUFFED], seen: 0 }
    }

    /// Takes bytes from the front of `input` until a frame is complete, and returns its message.
    ///
    /// Returns `None` once `input` is used up; an unfinished frame is kept for the next call.
    pub fn next<'d>(&'d mut self, input: &mut &[u8]) -> Option<Result<Message<'d>, DecodeError>> {
        loop {
            let Some(end) = cobs::find_zero(input) else {
                self.keep(input);
                *input = &[];
                return None;
            };
            self.keep(&input[..end]);
            *input = &input[end + 1..];
            let seen = core::mem::take(&mut self.seen);
            if seen > 0 {
                return Some(match self.buffer.get_mut(..seen) {
                    Some(stuffed) => decode(stuffed),
                    None => Err(DecodeError::TooLong { bytes: seen }),
                });
            }
        }
    }

    /// Drops the incomplete frame, for example after the line was reopened.
    pub fn reset(&mut self) {
        self.seen = 0;
    }

    fn keep(&mut self, bytes: &[u8]) {
        if let Some(room) = self.buffer.get_mut(self.seen..self.seen.saturating_add(bytes.len())) {
            room.copy_from_slice(bytes);
        }
        // A frame that is too long is dropped as a whole, so the missing bytes do not matter. The
        // count saturates, because noise may come for ever without a delimiter.
        self.seen = self.seen.saturating_add(bytes.len());
    }
}

/// Decodes one COBS-encoded frame, without its delimiter, in place.
fn decode(stuffed: &mut [u8]) -> Result<Message<'_>, DecodeError> {
    let frame = cobs::decode_in_place(stuffed).ok_or(DecodeError::Stuffing)?;
    let too_short = DecodeError::TooShort { bytes: frame.len() };
    let (content, carried) = frame.split_last_chunk::<{ crc::LEN }>().ok_or(too_short)?;
    let carried = u32::from_le_bytes(*carried);
    let computed = crc::checksum(content);
    if computed != carried {
        return Err(DecodeError::Checksum { computed, carried });
    }
    Message::parse(content)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Command, MAX_ENCODED, encode};

    #[test]
    fn every_single_byte_of_damage_is_noticed() {
        let mut good = [0; MAX_ENCODED];
        let n = encode(&Message::Command(Command::Stop), &mut good).unwrap();
        for at in 0..n - 1 {
            for wrong in 0..=255 {
                let mut line = good;
                if wrong == line[at] {
                    continue;
                }
                line[at] = wrong;
                let mut input = &line[..n];
                let mut decoder = Decoder::new();
                let first = decoder.next(&mut input);
                assert!(!matches!(first, Some(Ok(_))), "byte {at} as {wrong}: {first:?}");
            }
        }
    }

    #[test]
    fn endless_noise_is_one_error_and_no_growth() {
        let mut decoder = Decoder::new();
        for _ in 0..1000 {
            assert_eq!(decoder.next(&mut &[0x55; 500][..]), None);
        }
        let mut line = [0; MAX_ENCODED];
        let n = encode(&Message::Command(Command::Start), &mut line).unwrap();
        assert_eq!(decoder.next(&mut &[0][..]), Some(Err(DecodeError::TooLong { bytes: 500_000 })));
        let again = decoder.next(&mut &line[..n]);
        assert_eq!(again, Some(Ok(Message::Command(Command::Start))));
    }

    #[test]
    fn a_frame_begun_is_forgotten_by_reset() {
        let mut decoder = Decoder::new();
        assert_eq!(decoder.next(&mut &[7, 7, 7][..]), None);
        decoder.reset();
        assert_eq!(decoder.next(&mut &[0, 0][..]), None);
    }
}
