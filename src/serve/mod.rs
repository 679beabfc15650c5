//! The station on the network: a page for the operator, an interface for programs, metrics.
//!
//! [`Server::start`] gives a [`Server`] and a [`Reporter`]. The reporter is a
//! [`Listener`](crate::station::Listener) and does nothing on the station's thread but enter a
//! notice into a bounded queue; everything else happens on one thread of the server's own:
//!
//! ```text
//! station ─► reporter ─► hub (state, history, metrics) ─► readers (a bounded queue each) ─► SSE
//! station ◄─ orders ◄── api ◄── guard (rate, host, token, origin) ◄── accept (connections, timeouts)
//! ```
//!
//! A reader that is slow or gone misses events, is told how many, and cannot hold up anybody.

mod accept;
mod api;
#[cfg(any(test, fuzzing))]
pub mod asked;
mod guard;
mod hub;
mod label;
mod metrics;
mod order;
mod page;
mod readers;
mod reporter;
mod spectrum;
mod state;
mod token;
mod trace;

use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpListener};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam_channel::Sender;
use tokio::sync::watch;

pub use accept::Limits;
pub use reporter::Reporter;
pub use token::Token;

use crate::station::Command;
use hub::Hub;

/// The port where nothing else is said.
pub const PORT: u16 = 8080;

/// Where and how to serve.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Address and port; port 0 picks a free one.
    pub address: SocketAddr,
    /// What a client must know, where one is set.
    pub token: Option<Token>,
    /// What a client may take.
    pub limits: Limits,
    /// Whether the station keeps scans for a library.
    pub enrolls: bool,
}

impl Default for Settings {
    fn default() -> Self {
        let address = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), PORT);
        Self { address, token: None, limits: Limits::default(), enrolls: true }
    }
}

/// Why nothing can be served.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// an address that others reach, without a token
    #[error(
        "{0} can be reached from other machines; give a token in the environment variable \
         SURFACED_TOKEN, or serve on 127.0.0.1"
    )]
    Open(SocketAddr),
    /// the address is taken, or not this machine's
    #[error("{address}: {error}; name another address or port, such as 127.0.0.1:0 for a free one")]
    Bind {
        /// where
        address: SocketAddr,
        /// what the system said
        error: std::io::Error,
    },
    /// a token that is none
    #[error("the token must be 16 to 256 letters, digits, `-`, `.`, `_` or `~`")]
    Token,
    /// the system gave no thread, or no means to wait on sockets
    #[error("cannot serve: {0}")]
    System(std::io::Error),
}

/// A server at work; dropping it ends it.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

/// How long the end of the server waits for answers under way.
const SHUTDOWN_GRACE: Duration = Duration::from_millis(500);

impl Server {
    /// Serves from now on; `orders` go to the station.
    ///
    /// # Errors
    /// If the address is open to others and there is no token, if it cannot be had, or if the
    /// system gives no thread.
    pub fn start(
        settings: &Settings,
        orders: Sender<Command>,
    ) -> Result<(Self, Reporter), ServeError> {
        if !settings.address.ip().is_loopback() && settings.token.is_none() {
            return Err(ServeError::Open(settings.address));
        }
        let bind = |error| ServeError::Bind { address: settings.address, error };
        let listener = TcpListener::bind(settings.address).map_err(bind)?;
        listener.set_nonblocking(true).map_err(ServeError::System)?;
        let address = listener.local_addr().map_err(ServeError::System)?;
        let (reporter, notices) = reporter::pair();
        let hub = Arc::new(Hub::new(settings, orders, reporter.missed()));
        let (stop, stopped) = watch::channel(false);
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_io()
            .enable_time()
            .build()
            .map_err(ServeError::System)?;
        let settings = settings.clone();
        let work = move || {
            runtime.block_on(async move {
                let told = tokio::spawn(hub::run(hub.clone(), notices, stopped.clone()));
                accept::serve(listener, hub, &settings, stopped).await;
                // Whatever was entered before the end is still told, to those who read at once.
                let _ = tokio::time::timeout(SHUTDOWN_GRACE, told).await;
            });
        };
        let thread = std::thread::Builder::new()
            .name("serve".into())
            .spawn(work)
            .map_err(ServeError::System)?;
        Ok((Self { address, stop, thread: Some(thread) }, reporter))
    }

    /// Where it serves, with the port that was picked.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Ends all connections; answers under way have half a second.
    pub fn stop(mut self) {
        self.end();
    }

    fn end(&mut self) {
        self.stop.send_replace(true);
        if let Some(thread) = self.thread.take() {
            // Had it panicked, its connections would be closed all the same.
            let _ = thread.join();
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.end();
    }
}
