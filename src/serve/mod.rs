//! The station on the network, with a page for the operator, an HTTP API for programs, and metrics.
//!
//! [`Server::start`] returns a [`Server`] and a [`Reporter`]. The reporter is a
//! [`Listener`](crate::station::Listener). On the station's thread, it only puts each event into a
//! bounded queue; everything else happens on one thread of the server:
//!
//! ```text
//! station ─► reporter ─► hub (state, history, metrics) ─► subscribers (a bounded queue each) ─► SSE
//! station ◄─ orders ◄── api ◄── guard (rate, host, token, origin) ◄── server (connections, timeouts)
//! ```
//!
//! A subscriber that is slow misses events and learns how many. It never delays other subscribers.

pub(crate) mod api;
mod guard;
mod hub;
mod library;
mod metrics;
pub(crate) mod request;
mod review;
mod roles;
pub(crate) mod scans;
mod server;
mod settings;
mod state;
mod subscribers;
mod trace;

pub(crate) use guard::Traffic;
pub use server::{Reporter, Server};
pub(crate) use settings::Audit;
pub use settings::{LibraryFolder, Limits, ServeError, Settings, Token};
pub(crate) use state::unix_ms;
