//! Errors of frames, and of messages that cannot be sent.

use core::fmt;

/// Why the bytes between two delimiters are no message. The decoder is in step again after each.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum DecodeError {
    /// More bytes came without a delimiter than any frame has.
    TooLong {
        /// How many bytes came.
        bytes: usize,
    },
    /// Fewer bytes than version, kind and checksum need.
    TooShort {
        /// How many bytes the frame had once unstuffed.
        bytes: usize,
    },
    /// The byte stuffing points beyond the frame's end.
    Stuffing,
    /// The checksum in the frame is not that of its bytes.
    Checksum {
        /// Checksum of the bytes that came.
        computed: u32,
        /// Checksum that the frame carries.
        carried: u32,
    },
    /// A whole frame, of a version of the format that this crate does not know.
    Version(u8),
    /// A whole frame, of a kind that this crate does not know.
    Kind(u8),
    /// A whole frame of a known kind, whose body breaks the rule named.
    Body(&'static str),
}

impl DecodeError {
    /// Whether the bytes were damaged on the way; if not, the sender speaks another format.
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

/// Why a message cannot be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum EncodeError {
    /// The message is longer than [`MAX_FRAME`](crate::MAX_FRAME) allows.
    TooLong,
    /// The slice to write into is too short; [`MAX_ENCODED`](crate::MAX_ENCODED) always suffices.
    NoRoom,
    /// The message breaks the rule named.
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
