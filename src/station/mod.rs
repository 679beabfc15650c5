//! A station at work: what happens in a session is recognised, told to all who listen, and steered
//! by orders.
//!
//! Whoever listens (the terminal, JSON lines, the page) is a [`Listener`] and gets every
//! [`StationEvent`]; whoever steers (a key, a signal, the interface for programs) sends an [`Command`].
//! Neither knows of the other, and none of them can hold up a device.

mod assemble;
pub mod config;
mod enroll;
mod event;
mod recogniser;
mod requirements;
mod run;
mod store;
mod worker;

pub use assemble::{Assembled, assemble};
pub use event::{
    Answer, Command, Enrolled, Guess, LibraryState, Listener, StationEvent, SurfaceProbability,
};
pub use recogniser::{Load, MethodRecogniser, Recogniser, Verdict};
pub use requirements::DurationRequirements;
pub use run::Station;
pub use store::ScanStore;
