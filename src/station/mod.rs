//! A station at work: what happens in a session is recognised, reported to every listener, and
//! steered by commands.
//!
//! A [`Listener`] (the terminal, JSON lines, the page) gets every [`StationEvent`]; a key, a signal
//! or the interface for programs sends a [`Command`]. They do not know of each other, and cannot
//! hold up a device.

mod answer;
mod assemble;
mod certainty;
pub mod config;
mod event;
mod followed;
mod orders;
mod recogniser;
mod run;
mod start;
mod store;
mod trial_need;
mod why;
mod worker;

pub use answer::{Answer, AnswerState, AnsweredScan, Damage, Unnamed};
pub use assemble::{Assembled, assemble};
pub use event::{
    Command, End, Enrolled, EnrolledOutcome, Enrolling, Guess, Listener, RefusedScan, StationEvent,
    SurfaceProbability,
};
pub use orders::Keep;
pub use recogniser::{LibraryState, Load, Recogniser, Remark, RemarkKind, Verdict};
pub use start::Station;
pub use store::ScanStore;
pub use why::{SourceSays, Why};
