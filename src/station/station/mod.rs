//! The station: it recognises the scans of a session, reports every event to its listeners, and
//! obeys commands.
//!
//! A [`Listener`] (the terminal, JSON lines, the page) gets every [`StationEvent`]; a key, a signal
//! or the HTTP API sends a [`Command`]. Listeners and senders know nothing of each other, and
//! neither can delay a device.

mod account;
mod answer;
mod assemble;
mod certainty;
pub mod config;
mod continuous;
mod event;
mod orders;
mod recogniser;
mod run;
mod store;
mod trial_need;
mod worker;

#[doc(hidden)]
pub use account::{damage, told};
pub use answer::{Answer, AnswerState, ChannelLevel};
pub use assemble::{Assembled, assemble};
pub use continuous::Continuous;
#[doc(hidden)] // For the project's own tools.
pub use continuous::{ContinuousNaming, Heard};
pub use event::{
    AnsweredScan, Change, Command, End, Enrolled, EnrolledOutcome, Enrolling, FoundSurface, Guess,
    Listener, RefusedScan, StationEvent, SurfaceProbability,
};
pub use orders::Keep;
pub use recogniser::{LibraryState, Load, Recogniser, SourceSays, Why};
pub use run::Station;
pub use store::ScanStore;
