//! The messages between stylus and daemon over the serial line.
//!
//! The crate is `no_std`, allocates nothing and does no I/O. [`encode`] writes one message into a
//! slice. [`Decoder`] takes bytes in parts of any size, and returns messages or typed errors.
//! Stylus and daemon both use this crate, so this page is the one description of the format.
//!
//! # A frame
//!
//! | bytes | content |
//! |---|---|
//! | 1 | version of the format, [`VERSION`] |
//! | 1 | kind of message |
//! | n | body, see below |
//! | 4 | CRC-32 (ISO-HDLC, the one of Ethernet and zip) of everything before it |
//!
//! The whole frame has at most [`MAX_FRAME`] bytes. COBS (consistent overhead byte stuffing,
//! Cheshire and Baker 1999) removes every zero byte from it. One zero byte follows, the delimiter.
//! A receiver that joins late or meets damage throws away all bytes up to the next delimiter and
//! continues there. Two delimiters in a row are no error, so a sender may put a delimiter before a
//! frame to end any noise on the line.
//!
//! All numbers are little-endian. A *text* is one byte of length and that many bytes of UTF-8.
//!
//! # Messages
//!
//! **Hello** (kind 0x01, stylus to daemon): sent at power-up, when asked to identify, and before
//! the first sample after a start.
//!
//! | bytes | content |
//! |---|---|
//! | 3 | firmware version: major, minor, patch |
//! | 4 | sample rate in Hz, u32, not zero |
//! | 1+… | serial number of the device, text of at most [`MAX_SERIAL`] bytes |
//! | 1 | number of channels, 1 to [`MAX_CHANNELS`] |
//! | … | for each channel: scale (f32, finite), name (text), unit (text), each text at most [`MAX_TEXT`] bytes |
//!
//! A value v of a channel means `v × scale` in the channel's unit. As a fraction of the converter's
//! full scale, it is `v / 32768`, as in 16-bit WAV files.
//!
//! **Samples** (kind 0x02, stylus to daemon): k consecutive samples of all channels.
//!
//! | bytes | content |
//! |---|---|
//! | 8 | index of the first sample since the start, u64 |
//! | 1 | number of channels c, 1 to [`MAX_CHANNELS`] |
//! | 1 | number of samples k, at least 1 |
//! | 2·c·k | values, i16, all channels of the first sample, then of the second, … |
//!
//! The index counts all ticks of the sampling clock, even if no sample could be taken or kept at a
//! tick. So a jump of the index is the length of a gap.
//!
//! **Status** (kind 0x03, stylus to daemon): sent once a second during sampling, and as the answer
//! to every command.
//!
//! | bytes | content |
//! |---|---|
//! | 8 | samples sent since the start, u64 |
//! | 4 | overruns: ticks since the start at which no sample was taken, u32 |
//! | 4 | dropped: samples since the start that were taken but found no room, u32 |
//! | 2 | temperature of the microcontroller in 1/100 °C, i16; −32768 where there is none |
//! | 1 | flags: bit 0 sampling, bit 1 light on, bit 2 crystal failed (rate good to 1 % only); others 0 |
//!
//! **Command** (kind 0x10, daemon to stylus): one byte: 1 start, 2 stop, 3 identify, 4 light off,
//! 5 light on. A start while sampling changes nothing; a start after a stop counts from 0 again.
//!
//! # Test vectors
//!
//! These are the bytes on the line, with the delimiter; `tests/vectors.rs` checks them.
//!
//! | message | bytes (hexadecimal) |
//! |---|---|
//! | command start | `08 01 10 01 e2 91 46 c3 00` |
//! | command identify | `08 01 10 03 ce f0 48 2d 00` |
//! | status: 600000 sent, 1 overrun, 2 dropped, 25.50 °C, sampling | `06 01 03 c0 27 09 01 01 01 01 02 01 01 01 02 02 01 01 08 f6 09 01 7a 43 2d 3a 00` |
//! | samples: index 32, 1 sample of 7: 1, −1, 0, 256, −32768, 32767, 2 | `04 01 02 20 01 01 01 01 01 01 04 07 01 01 03 ff ff 01 01 02 01 05 80 ff 7f 02 05 9e 10 61 77 00` |
//! | hello: 0.1.0, 10000 Hz, serial `S1`, one channel `ir`, scale 0.5, unit `V` | `03 01 01 02 01 03 10 27 01 05 02 53 31 01 01 01 0b 3f 02 69 72 01 56 e9 29 95 22 00` |
//!
//! # Overhead
//!
//! A frame of samples adds 16 bytes, COBS at most one byte in 254 plus one, and the delimiter one
//! byte. By default, a frame has [`SAMPLES_PER_FRAME`] samples of [`STYLUS_CHANNELS`] channels:
//! then at most 19 bytes are added to 448, 4.3 %.
//!
//! # Undetected damage
//!
//! A damaged frame is accepted if it happens to have the right checksum: 1 in 2³² for random
//! damage, never for a burst of up to 32 bits within a frame.

#![no_std]
#![forbid(unsafe_code)]
#![warn(missing_docs)]

pub mod cobs;
pub mod crc;
mod decoder;
mod encoder;
mod error;
mod hello;
mod message;
mod samples;

pub use decoder::Decoder;
pub use encoder::encode;
pub use error::{DecodeError, EncodeError};
pub use hello::{Channel, ChannelTable, Hello};
pub use message::{Command, Message, Status};
pub use samples::Samples;

/// Version of the format, the first byte of every frame.
pub const VERSION: u8 = 1;

/// Longest frame in bytes before COBS encoding, with version, kind, body and checksum.
pub const MAX_FRAME: usize = 1024;

/// Longest frame on the line in bytes, with its delimiter: the most that [`encode`] writes.
pub const MAX_ENCODED: usize = cobs::max_encoded_len(MAX_FRAME) + 1;

/// The byte that ends every frame on the line.
pub const DELIMITER: u8 = 0;

/// Most channels that a hello or a samples message can carry.
pub const MAX_CHANNELS: usize = 16;

/// Longest serial number in a hello, in bytes.
pub const MAX_SERIAL: usize = 32;

/// Longest name or unit of a channel, in bytes.
pub const MAX_TEXT: usize = 16;

/// Default number of samples in a frame: 3.2 ms at 10 kHz, 4.3 % overhead.
pub const SAMPLES_PER_FRAME: usize = 32;

/// Channels of the stylus: acceleration X, Y, Z, FSR 1, FSR 2, infrared, metal.
pub const STYLUS_CHANNELS: usize = 7;
