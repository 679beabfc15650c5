//! The decisions of the stylus's firmware, free of any hardware, so that they are tested on any computer.
//!
//! The sampling interrupt calls [`Sampling::tick`], the main loop [`Stylus::poll`], the UART's
//! interrupt takes and gives bytes through [`ByteRing`]s. Each ring has one producer and one
//! consumer; nothing blocks and nothing is `unsafe`.

#![cfg_attr(not(test), no_std)]
#![forbid(unsafe_code)]
#![warn(missing_docs)]

mod ring;
mod sampling;
mod stylus;

pub use ring::ByteRing;
pub use sampling::{Sample, SampleRing, Sampling};
pub use stylus::{Identity, Stylus};
