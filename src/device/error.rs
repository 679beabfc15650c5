//! Why a device cannot continue.

use crate::ring::Stopped;

/// Why a device cannot continue.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// a stop was requested while it waited; no failure
    #[error(transparent)]
    Stopped(#[from] Stopped),
    /// what is wrong, and what to do
    #[error("{0}")]
    Failed(String),
}
