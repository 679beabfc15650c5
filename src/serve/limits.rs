//! What clients may take: connections, requests a second, time.

use std::time::Duration;

/// The largest body of a request, in bytes.
pub const LARGEST_BODY: usize = 64 << 10;

/// What clients may take.
#[derive(Clone, Debug)]
pub struct Limits {
    /// Connections at once; one more is closed unread.
    pub connections: usize,
    /// Those of one address, so that no address can take all.
    pub connections_an_address: usize,
    /// Subscribers to the stream of events at once.
    pub readers: usize,
    /// How long a request may take to arrive, and its answer to be made.
    pub request: Duration,
    /// How long a client may leave unread what was sent to it.
    pub unread: Duration,
    /// Requests a second that one address may make in the long run.
    pub requests_a_second: f64,
    /// How many of them at once.
    pub burst: f64,
    /// Wrong tokens a second that one address may try in the long run.
    pub guesses_a_second: f64,
    /// How many of them at once.
    pub guess_burst: f64,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            connections: 256,
            connections_an_address: 64,
            readers: 128,
            request: Duration::from_secs(10),
            unread: Duration::from_secs(20),
            requests_a_second: 50.0,
            burst: 200.0,
            guesses_a_second: 1.0,
            guess_burst: 10.0,
        }
    }
}
