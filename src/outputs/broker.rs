//! Connections to MQTT brokers.

use std::path::{Path, PathBuf};
use std::time::Duration;

use rumqttc::{AsyncClient, ConnectionError, Event, MqttOptions, Transport};
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

use super::message::LARGEST;
use crate::history::HistoryError;
use crate::station::config::{MqttAddress, TlsFiles};

/// Interval at which a packet is sent on an idle connection.
const KEEP_ALIVE: Duration = Duration::from_secs(15);
/// How many packets may wait to be sent.
const QUEUE: usize = 64;

/// The files in which Linux systems keep the certificates of trusted authorities.
const SYSTEM: [&str; 3] =
    ["/etc/ssl/certs/ca-certificates.crt", "/etc/pki/tls/certs/ca-bundle.crt", "/etc/ssl/cert.pem"];

/// The options of an MQTT client, for the broker at an address.
pub(crate) fn options(address: &MqttAddress, client: String) -> Result<MqttOptions, HistoryError> {
    let MqttAddress { host, credentials, tls, .. } = address;
    let mut options = MqttOptions::new(client, host.0.clone(), host.1);
    options.set_keep_alive(KEEP_ALIVE);
    // A packet holds the answer, its topic and a header, so it is larger than the answer.
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

/// One connection to a broker, from the attempt to connect until the connection breaks.
#[derive(Debug)]
pub(crate) struct Line {
    pub client: AsyncClient,
    /// The events of the connection, of which the last is an error. The queue is unbounded, but holds
    /// no more than a broker sends without acknowledgements.
    pub events: mpsc::UnboundedReceiver<Result<Event, ConnectionError>>,
    task: JoinHandle<()>,
}

impl Line {
    /// Starts to connect. Must be called within a runtime.
    pub fn open(options: MqttOptions) -> Self {
        let (client, mut connection) = AsyncClient::new(options, QUEUE);
        let (send, events) = mpsc::unbounded_channel();
        let work = async move {
            loop {
                // `poll` always runs to its end, since stopping it half-way could lose a packet.
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
