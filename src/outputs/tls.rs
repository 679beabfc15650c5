//! The certificates by which outputs know their receivers, and are known by them.

use std::io::{Error, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::{ClientConfig, RootCertStore};

use crate::history::HistoryError;
use crate::station::config::TlsFiles;

/// The files in which Linux systems keep the certificates of trusted authorities.
const SYSTEM: [&str; 3] =
    ["/etc/ssl/certs/ca-certificates.crt", "/etc/pki/tls/certs/ca-bundle.crt", "/etc/ssl/cert.pem"];

/// The file of authorities: the configured one, else that of the system.
pub(super) fn authorities(files: &TlsFiles) -> PathBuf {
    let system = || SYSTEM.map(PathBuf::from).into_iter().find(|path| path.exists());
    files.ca.clone().or_else(system).unwrap_or_else(|| SYSTEM[0].into())
}

/// Fails if a file cannot be read or holds something else.
pub(super) fn connector(files: &TlsFiles) -> Result<TlsConnector, HistoryError> {
    let ca = authorities(files);
    let mut roots = RootCertStore::empty();
    // A system's file may hold certificates in forms that are not understood.
    if roots.add_parsable_certificates(certificates(&ca)?).0 == 0 {
        return Err(unusable(&ca, "holds no certificate of an authority in PEM"));
    }
    let config = ClientConfig::builder().with_root_certificates(roots);
    let config = match &files.client {
        Some((certificate, key)) => {
            let private = PrivateKeyDer::from_pem_slice(&read(key)?)
                .map_err(|error| unusable(key, &error.to_string()))?;
            config
                .with_client_auth_cert(certificates(certificate)?, private)
                .map_err(|error| unusable(certificate, &error.to_string()))?
        }
        None => config.with_no_client_auth(),
    };
    Ok(Arc::new(config).into())
}

fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, HistoryError> {
    let all: Result<_, _> = CertificateDer::pem_slice_iter(&read(path)?).collect();
    all.map_err(|error| unusable(path, &error.to_string()))
}

pub(super) fn read(path: &Path) -> Result<Vec<u8>, HistoryError> {
    std::fs::read(path).map_err(HistoryError::io(path))
}

pub(super) fn unusable(path: &Path, why: &str) -> HistoryError {
    HistoryError::io(path)(Error::new(ErrorKind::InvalidData, why))
}
