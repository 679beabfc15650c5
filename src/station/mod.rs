//! A station at work: what happens in a session is recognised, told to all who listen, and steered
//! by orders.
//!
//! Whoever listens (the terminal, JSON lines, the page) is a [`Listener`] and gets every
//! [`Notice`]; whoever steers (a key, a signal, the interface for programs) sends an [`Order`].
//! Neither knows of the other, and none of them can hold up a device.

mod assemble;
pub mod config;
mod enroll;
mod keep;
mod need;
mod notice;
mod recogniser;
mod run;
mod worker;

pub use assemble::{Assembled, assemble};
pub use keep::Keep;
pub use need::Needs;
pub use notice::{Answer, Enrolled, Guess, LibraryState, Listener, Named, Notice, Order};
pub use recogniser::{Load, Recogniser, Verdict};
pub use run::Station;
