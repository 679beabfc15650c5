//! The station on the network: a page for the operator, an interface for programs, metrics.
//!
//! [`Server::start`] returns a [`Server`] and a [`Reporter`]. The reporter is a
//! [`Listener`](crate::station::Listener) and does nothing on the station's thread but enter an
//! event into a bounded queue; everything else happens on one thread of the server:
//!
//! ```text
//! station ─► reporter ─► hub (state, history, metrics) ─► subscribers (a bounded queue each) ─► SSE
//! station ◄─ orders ◄── api ◄── guard (rate, host, token, origin) ◄── accept (connections, timeouts)
//! ```
//!
//! A subscriber that is slow or gone misses events, learns how many, and delays nobody else.

mod accept;
pub(crate) mod api;
mod client;
#[cfg(any(test, fuzzing))]
pub mod fuzz;
mod guard;
mod hub;
mod label;
mod library;
mod metrics;
mod order;
pub(crate) mod request;
mod scans;
mod server;
mod settings;
mod state;
pub(crate) mod subscribers;
mod trace;

pub(crate) use guard::Traffic;
pub use server::{Reporter, Server};
pub(crate) use settings::{Audit, PORT};
pub use settings::{LibraryFolder, Limits, ServeError, Settings, Token};
