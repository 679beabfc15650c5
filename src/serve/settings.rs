//! Where and how to serve, and what clients may take.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;

use super::limits::Limits;
use super::token::Token;
use crate::device::camera::Viewfinder;
use crate::evaluate::CheckReport;
use crate::history::History;
use crate::outputs::OutputHealth;
use crate::scene::Scene;

/// The default port.
pub const PORT: u16 = 8080;

/// Where and how to serve.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Address and port; port 0 picks a free one.
    pub address: SocketAddr,
    /// What a client must know, where one is set.
    pub token: Option<Token>,
    /// Proxies in front of the server: what they say of a client (`X-Forwarded-For`,
    /// `X-Forwarded-Proto`) is believed, and their connections are not counted.
    pub proxies: Vec<IpAddr>,
    /// What a client may take.
    pub limits: Limits,
    /// Whether the station keeps scans for a library.
    pub enrolls: bool,
    /// That library, where it may be edited: scans become its trials.
    pub library: Option<Shelf>,
    /// Audits that library, where it may be edited.
    pub check: Option<Audit>,
    /// Past scans.
    pub history: Arc<History>,
    /// What the camera sees, if there is one.
    pub viewfinder: Option<Viewfinder>,
    /// Where answers go, and whether they arrive.
    pub outputs: Vec<OutputHealth>,
}

/// Audits a library, as often as it is called; for people, why not.
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
pub struct Shelf {
    /// Its folder.
    pub folder: PathBuf,
    /// What its sources are.
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
