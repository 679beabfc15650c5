//! The logic of the stylus's firmware. It touches no hardware, so any computer can test it.
//!
//! The sampling interrupt calls [`Sampling::tick`], and the main loop calls [`Stylus::poll`]. The
//! UART's interrupt passes bytes through two [`ByteRing`]s. Each ring has one producer and one
//! consumer; nothing blocks, and nothing is `unsafe`.

#![cfg_attr(not(test), no_std)]
#![forbid(unsafe_code)]
#![warn(missing_docs)]

mod ring;
mod sampling;
mod stylus;

pub use ring::ByteRing;
pub use sampling::{Sample, SampleRing, Sampling};
pub use stylus::{Identity, Stylus};
