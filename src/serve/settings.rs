//! Settings of the server: address, token, and the limits of clients.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use subtle::ConstantTimeEq;

use crate::device::camera::Viewfinder;
use crate::evaluate::CheckReport;
use crate::history::History;
use crate::outputs::OutputHealth;
use crate::scene::Scene;

/// The default port.
pub const PORT: u16 = 8080;

/// Settings of the server.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Address and port; port 0 picks a free one.
    pub address: SocketAddr,
    /// The token that a client must know, where one is set.
    pub token: Option<Token>,
    /// Proxies in front of the server: what they tell of a client (`X-Forwarded-For`,
    /// `X-Forwarded-Proto`) is believed, and they may have all connections.
    pub proxies: Vec<IpAddr>,
    /// The limits of clients.
    pub limits: Limits,
    /// Whether the station keeps scans for a library.
    pub enrolls: bool,
    /// That library, if it may be edited: scans become its trials.
    pub library: Option<LibraryFolder>,
    /// The audit of that library, if it may be edited.
    pub check: Option<Audit>,
    /// Past scans.
    pub history: Arc<History>,
    /// The view of the camera, if there is one.
    pub viewfinder: Option<Viewfinder>,
    /// The outputs that answers go to, and whether they arrive.
    pub outputs: Vec<OutputHealth>,
}

/// Audits a library each time it is called; gives a message if that fails.
#[derive(Clone)]
pub struct Audit(
    /// The audit.
    pub Arc<dyn Fn() -> Result<CheckReport, String> + Send + Sync>,
);

impl fmt::Debug for Audit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Audit")
    }
}

/// A library on disk.
#[derive(Clone, Debug)]
pub struct LibraryFolder {
    /// Its folder.
    pub folder: PathBuf,
    /// The sources of the library.
    pub scene: Scene,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            address: SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), PORT),
            token: None,
            proxies: Vec::new(),
            limits: Limits::default(),
            enrolls: true,
            library: None,
            check: None,
            history: Arc::default(),
            viewfinder: None,
            outputs: Vec::new(),
        }
    }
}

/// The largest body of a request, in bytes.
pub const LARGEST_BODY: usize = 64 << 10;

/// Limits of clients.
#[derive(Clone, Debug)]
pub struct Limits {
    /// Connections at once; others are closed unread.
    pub connections: usize,
    /// Connections of one address, so that no address can take all.
    pub connections_an_address: usize,
    /// Subscribers to the stream of events at once.
    pub readers: usize,
    /// The time for a request to arrive, and for its answer to be made.
    pub request: Duration,
    /// The time after which a client that reads nothing is disconnected.
    pub unread: Duration,
    /// Requests a second that one address may make in the long run.
    pub requests_a_second: f64,
    /// Requests that one address may make at once.
    pub burst: f64,
    /// Wrong tokens a second that one address may try in the long run.
    pub guesses_a_second: f64,
    /// Wrong tokens that one address may try at once.
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

/// The secret that a client must know. It is compared in constant time, and never printed.
#[derive(Clone)]
pub struct Token(String);

impl Token {
    /// A token from its text.
    ///
    /// # Errors
    /// If it is shorter than 16 characters or longer than 256, or would need quoting in a header,
    /// a cookie or an address.
    pub fn new(text: &str) -> Result<Self, ServeError> {
        let plain = |c: char| c.is_ascii_alphanumeric() || "-._~".contains(c);
        if !(16..=256).contains(&text.len()) || !text.chars().all(plain) {
            return Err(ServeError::Token);
        }
        Ok(Self(text.into()))
    }

    /// Whether a client gave this token. The time that this takes depends on the length alone.
    pub fn matches(&self, given: &str) -> bool {
        self.0.as_bytes().ct_eq(given.as_bytes()).into()
    }

    /// The text, for the cookie.
    pub(super) fn reveal(&self) -> &str {
        &self.0
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(…)")
    }
}

/// Errors of the start of a server.
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
    /// not a valid token
    #[error("the token must be 16 to 256 letters, digits, `-`, `.`, `_` or `~`")]
    Token,
    /// the system cannot start a thread, or cannot wait on sockets
    #[error("cannot serve: {0}")]
    System(std::io::Error),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_whole_token_matches() {
        let token = Token::new("0123456789abcdef").unwrap();
        assert!(token.matches("0123456789abcdef"));
        for wrong in ["", "0123456789abcde", "0123456789abcdef0", "0123456789abcdeF"] {
            assert!(!token.matches(wrong), "{wrong}");
        }
        assert_eq!(format!("{token:?}"), "Token(…)");
    }

    #[test]
    fn a_token_that_is_short_or_would_need_quoting_is_refused() {
        for text in ["", "short", "0123456789abcde;", "0123456789 abcdef", &"x".repeat(257)] {
            assert!(Token::new(text).is_err(), "{text}");
        }
    }
}
