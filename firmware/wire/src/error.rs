//! Errors of decoding frames and of encoding messages.

use core::fmt;

/// The reason why bytes between two delimiters are no message. The decoder then goes on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum DecodeError {
    /// More bytes came without a delimiter than a frame may have.
    TooLong {
        /// Number of bytes since the last delimiter.
        bytes: usize,
    },
    /// The frame has fewer bytes than version, kind and checksum take.
    TooShort {
        /// Length of the frame in bytes, after COBS decoding.
        bytes: usize,
    },
    /// The COBS encoding is wrong: no bytes, or a length that points beyond the frame's end.
    Stuffing,
    /// The checksum in the frame differs from the checksum of the frame's bytes.
    Checksum {
        /// Checksum computed from the received bytes.
        computed: u32,
        /// Checksum that the frame carries.
        carried: u32,
    },
    /// The frame is undamaged, but this crate does not know its version of the format.
    Version(u8),
    /// The frame is undamaged, but this crate does not know its kind of message.
    Kind(u8),
    /// The frame is undamaged and its kind is known, but its body breaks the named rule.
    Body(&'static str),
}

impl DecodeError {
    /// Whether the line damaged the bytes. If not, the sender uses another format.
    #[must_use]
    pub fn is_damage(&self) -> bool {
        !matches!(self, Self::Version(_) | Self::Kind(_) | Self::Body(_))
    }
}

impl fmt::Display for DecodeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::TooLong { bytes } => {
                write!(f, "{bytes} bytes without a delimiter, more than any frame has")
            }
            Self::TooShort { bytes } => write!(f, "a frame of only {bytes} bytes"),
            Self::Stuffing => write!(f, "the byte stuffing points beyond the frame"),
            Self::Checksum { computed, carried } => {
                write!(f, "checksum {carried:08x} in the frame, {computed:08x} of its bytes")
            }
            Self::Version(v) => {
                write!(f, "format version {v}, expected {}", crate::VERSION)
            }
            Self::Kind(k) => write!(f, "unknown kind of message {k:#04x}"),
            Self::Body(rule) => write!(f, "malformed message: {rule}"),
        }
    }
}

impl core::error::Error for DecodeError {}

/// The reason why a message cannot be encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum EncodeError {
    /// The message is longer than [`MAX_FRAME`](crate::MAX_FRAME) allows.
    TooLong,
    /// The output slice is too short; [`MAX_ENCODED`](crate::MAX_ENCODED) bytes are always enough.
    NoRoom,
    /// The message breaks the named rule.
    Body(&'static str),
}

impl fmt::Display for EncodeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::TooLong => write!(f, "a message longer than {} bytes", crate::MAX_FRAME),
            Self::NoRoom => write!(f, "no room for the frame"),
            Self::Body(rule) => write!(f, "malformed message: {rule}"),
        }
    }
}

impl core::error::Error for EncodeError {}
