//! Encodes messages into the bytes that are sent on the serial line.

use crate::message::kind;
use crate::{DELIMITER, EncodeError, MAX_FRAME, Message, VERSION, cobs, crc};

/// Encodes `message` as one frame with its delimiter, into the front of `out`. Returns the number
/// of bytes written; [`MAX_ENCODED`](crate::MAX_ENCODED) bytes always suffice.
///
/// # Errors
/// If the message breaks a rule of the format or is too long, or `out` is too short. After an
/// error, the bytes in `out` must not be sent.
pub fn encode(message: &Message<'_>, out: &mut [u8]) -> Result<usize, EncodeError> {
    let mut frame = Frame { bytes: [0; MAX_FRAME], len: 0 };
    match message {
        Message::Samples(samples) => {
            frame.put(&[VERSION, kind::SAMPLES])?;
            frame.put(&samples.first_index().to_le_bytes())?;
            // The casts lose nothing: there are at most 16 channels and 255 samples.
            frame.put(&[samples.channels() as u8, samples.count() as u8])?;
            frame.put(samples.bytes())?;
        }
        Message::Hello(hello) => {
            hello.check().map_err(EncodeError::Body)?;
            frame.put(&[VERSION, kind::HELLO])?;
            frame.put(&hello.firmware)?;
            frame.put(&hello.sample_rate_hz.to_le_bytes())?;
            frame.text(hello.serial)?;
            frame.put(&[hello.channels.len() as u8])?; // at most 16
            for channel in hello.channels.iter() {
                frame.put(&channel.scale.to_le_bytes())?;
                frame.text(channel.name)?;
                frame.text(channel.unit)?;
            }
        }
        Message::Status(status) => {
            if status.temperature_centi_c == Some(i16::MIN) {
                return Err(EncodeError::Body("this temperature is reserved for \"not measured\""));
            }
            frame.put(&[VERSION, kind::STATUS])?;
            frame.put(&status.to_bytes())?;
        }
        Message::Command(command) => frame.put(&[VERSION, kind::COMMAND, *command as u8])?,
    }
    let sum = crc::checksum(frame.written());
    frame.put(&sum.to_le_bytes())?;
    let n = cobs::encode(frame.written(), out).ok_or(EncodeError::NoRoom)?;
    *out.get_mut(n).ok_or(EncodeError::NoRoom)? = DELIMITER;
    Ok(n + 1)
}

/// A frame before COBS encoding; its first `len` bytes are filled.
struct Frame {
    bytes: [u8; MAX_FRAME],
    len: usize,
}

impl Frame {
    fn put(&mut self, bytes: &[u8]) -> Result<(), EncodeError> {
        let room = self.bytes.get_mut(self.len..self.len + bytes.len());
        room.ok_or(EncodeError::TooLong)?.copy_from_slice(bytes);
        self.len += bytes.len();
        Ok(())
    }

    /// Adds one byte with the text's length, which the caller has checked, and the text.
    fn text(&mut self, text: &str) -> Result<(), EncodeError> {
        self.put(&[text.len() as u8])?;
        self.put(text.as_bytes())
    }

    fn written(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}
