//! Settings of the server: address, token, and the limits of clients.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use http::Uri;
use subtle::ConstantTimeEq;

use crate::device::camera::Viewfinder;
use crate::evaluate::CheckReport;
use crate::history::{History, Role};
use crate::outputs::OutputHealth;
use crate::scene::Scene;

const PORT: u16 = 8080;

#[derive(Clone)]
pub struct Settings {
    /// Address and port; with port 0, the system picks a free port.
    pub address: SocketAddr,
    /// The token of administrators, who may do everything. If it is `None`, no token is needed, and
    /// everyone is an administrator.
    pub token: Option<Token>,
    /// The token of operators, who see everything, begin and end scans, and correct them. Needs
    /// `token`, and is another one.
    pub operator_token: Option<Token>,
    /// Trusted proxies. Their `X-Forwarded-For` and `X-Forwarded-Proto` headers are believed, and
    /// the limit of connections for one address does not apply to them.
    pub proxies: Vec<IpAddr>,
    pub limits: Limits,
    /// Whether scans may be kept as trials of a library.
    pub enrolls: bool,
    /// Whether there is a library that may be read again.
    pub reloads: bool,
    /// The library that may be edited and extended by scans; `None` if no library may be edited.
    pub library: Option<LibraryFolder>,
    /// The function that audits the library, if the library may be edited.
    pub check: Option<Audit>,
    pub history: Arc<History>,
    pub viewfinder: Option<Viewfinder>,
    pub outputs: Vec<OutputHealth>,
    /// Age from which the page no longer shows an answer as the present one, in seconds.
    pub stale_after_s: f64,
    /// The address of the page at a proxy in front, whose own pages may then send requests.
    pub public_address: Option<Uri>,
}

/// Audits a library each time it is called; returns a message if the audit fails.
pub(crate) type Audit = Arc<dyn Fn() -> Result<CheckReport, String> + Send + Sync>;

#[derive(Clone, Debug)]
pub struct LibraryFolder {
    pub folder: PathBuf,
    /// The sources of the library, as its scene.
    pub scene: Scene,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            address: SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), PORT),
            token: None,
            operator_token: None,
            proxies: Vec::new(),
            limits: Limits::default(),
            enrolls: true,
            reloads: true,
            library: None,
            check: None,
            history: Arc::default(),
            viewfinder: None,
            outputs: Vec::new(),
            stale_after_s: 30.0,
            public_address: None,
        }
    }
}

impl Settings {
    /// The role of a client that gave a token; `None` if the token is wrong.
    pub(super) fn role_of(&self, given: &str) -> Option<Role> {
        let is = |token: &Option<Token>| token.as_ref().is_some_and(|token| token.matches(given));
        // Both are compared, so that the time does not tell which of them it is like.
        match (is(&self.token), is(&self.operator_token)) {
            (true, _) => Some(Role::Administrator),
            (false, true) => Some(Role::Operator),
            (false, false) => None,
        }
    }

    /// Checks that the tokens fit the address and each other.
    pub(super) fn check_tokens(&self) -> Result<(), ServeError> {
        match (&self.token, &self.operator_token) {
            (None, Some(_)) => Err(ServeError::OperatorAlone),
            (Some(token), Some(operator)) if token.matches(&operator.0) => {
                Err(ServeError::SameToken)
            }
            (None, None) if !self.address.ip().is_loopback() => Err(ServeError::Open(self.address)),
            _ => Ok(()),
        }
    }
}

/// The largest body of a request, in bytes.
pub(super) const LARGEST_BODY: usize = 64 << 10;

#[derive(Clone, Debug)]
pub struct Limits {
    /// How many connections may be open at once; further ones are closed unread.
    pub connections: usize,
    /// How many connections one address may have, so that no address can take all of them.
    pub connections_an_address: usize,
    /// How many subscribers the stream of events may have at once.
    pub readers: usize,
    /// The longest time for a request to arrive, and for its answer to be made.
    pub request: Duration,
    /// The time after which a client that reads nothing is disconnected.
    pub unread: Duration,
    /// How many requests a second one address may make on average.
    pub requests_a_second: f64,
    /// How many requests one address may make at once.
    pub burst: f64,
    /// How many wrong tokens a second one address may try on average.
    pub guesses_a_second: f64,
    /// How many wrong tokens one address may try at once.
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

/// The secret that clients must give. Clients' guesses are compared with it in constant time.
#[derive(Clone)]
pub struct Token(String);

impl Token {
    /// Checks a text for use as a token.
    ///
    /// # Errors
    /// If the text is shorter than 16 or longer than 256 characters, or would need quoting in a
    /// header, a cookie or an address.
    pub fn new(text: &str) -> Result<Self, ServeError> {
        let plain = |c: char| c.is_ascii_alphanumeric() || "-._~".contains(c);
        if !(16..=256).contains(&text.len()) || !text.chars().all(plain) {
            return Err(ServeError::Token);
        }
        Ok(Self(text.into()))
    }

    /// Whether a client gave this token. The time of the comparison depends only on the length.
    pub fn matches(&self, given: &str) -> bool {
        self.0.as_bytes().ct_eq(given.as_bytes()).into()
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(…)")
    }
}

/// Reasons why a server does not start.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    #[error(
        "{0} can be reached from other machines; give a token in the environment variable \
         SURFACED_TOKEN, or serve on 127.0.0.1"
    )]
    Open(SocketAddr),
    #[error("{address}: {error}; name another address or port, such as 127.0.0.1:0 for a free one")]
    Bind { address: SocketAddr, error: std::io::Error },
    #[error("the token must be 16 to 256 letters, digits, `-`, `.`, `_` or `~`")]
    Token,
    #[error(
        "SURFACED_OPERATOR_TOKEN is set, but SURFACED_TOKEN, the administrator's token, is not; set \
         both, or neither"
    )]
    OperatorAlone,
    #[error(
        "SURFACED_OPERATOR_TOKEN equals SURFACED_TOKEN, so every operator would be an administrator; \
         give operators another token"
    )]
    SameToken,
    #[error("cannot serve: {0}")]
    System(#[from] std::io::Error),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_whole_token_matches_and_one_that_is_short_or_would_need_quoting_is_refused() {
        let token = Token::new("0123456789abcdef").unwrap();
        assert!(token.matches("0123456789abcdef"));
        for wrong in ["", "0123456789abcde", "0123456789abcdef0", "0123456789abcdeF"] {
            assert!(!token.matches(wrong), "{wrong}");
        }
        assert_eq!(format!("{token:?}"), "Token(…)");
        for text in ["", "short", "0123456789abcde;", "0123456789 abcdef", &"x".repeat(257)] {
            assert!(Token::new(text).is_err(), "{text}");
        }
    }
}
