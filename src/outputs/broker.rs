//! Connections to MQTT brokers.

use std::path::{Path, PathBuf};
use std::time::Duration;

use rumqttc::{AsyncClient, ConnectionError, Event, MqttOptions, Transport};
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

use super::message::LARGEST;
use crate::history::HistoryError;
use crate::station::config::{MqttAddress, TlsFiles};

/// How often something is sent on a silent line.
const KEEP_ALIVE: Duration = Duration::from_secs(15);
/// Packets that wait for a line.
const QUEUE: usize = 64;

/// The files of authorities that systems trust.
const SYSTEM: [&str; 3] =
    ["/etc/ssl/certs/ca-certificates.crt", "/etc/pki/tls/certs/ca-bundle.crt", "/etc/ssl/cert.pem"];

/// The options of a client of a broker.
///
/// # Errors
/// If a certificate cannot be read.
pub(crate) fn options(address: &MqttAddress, client: String) -> Result<MqttOptions, HistoryError> {
    let MqttAddress { host, credentials, tls, .. } = address;
    let mut options = MqttOptions::new(client, host.0.clone(), host.1);
    options.set_keep_alive(KEEP_ALIVE);
    // The topic and the head of the packet come beside the answer.
    options.set_max_packet_size(2 * LARGEST, 2 * LARGEST);
    if let Some((user, password)) = credentials {
        options.set_credentials(user, password);
    }
    if let Some(TlsFiles { ca, client }) = tls {
        let read = |path: &Path| std::fs::read(path).map_err(HistoryError::io(path));
        let system = || SYSTEM.map(PathBuf::from).into_iter().find(|path| path.exists());
        let ca = ca.clone().or_else(system).unwrap_or_else(|| SYSTEM[0].into());
        let client = match client {
            Some((certificate, key)) => Some((read(certificate)?, read(key)?)),
            None => None,
        };
        options.set_transport(Transport::tls(read(&ca)?, client, None));
    }
    Ok(options)
}

/// One connection to a broker, from before it is there until it breaks.
#[derive(Debug)]
pub(crate) struct Line {
    pub client: AsyncClient,
    /// Its events; an error is the last.
    /// What comes in is as much as a broker sends without an acknowledgement.
    pub events: mpsc::UnboundedReceiver<Result<Event, ConnectionError>>,
    task: JoinHandle<()>,
}

impl Line {
    /// Connects; within a runtime.
    pub fn open(options: MqttOptions) -> Self {
        let (client, mut connection) = AsyncClient::new(options, QUEUE);
        let (send, events) = mpsc::unbounded_channel();
        let work = async move {
            loop {
                // Never given up half way: that could lose a packet.
                let event = connection.poll().await;
                let is_last = event.is_err();
                if send.send(event).is_err() || is_last {
                    return;
                }
            }
        };
        Self { client, events, task: tokio::spawn(work) }
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        self.task.abort();
    }
}
