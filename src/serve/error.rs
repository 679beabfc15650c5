//! Why nothing can be served.

use std::net::SocketAddr;

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
