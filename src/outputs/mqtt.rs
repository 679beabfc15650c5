//! Connections to MQTT brokers. Sends answers by MQTT 3.1.1, each at least once. The next answer is sent
//! after the broker has acknowledged the previous one.

use std::collections::VecDeque;
use std::process;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use rand::TryRng;
use rand::rngs::SysRng;
use rumqttc::{
    AsyncClient, ConnectionError, Event, LastWill, MqttOptions, Outgoing, Packet, QoS, Transport,
};
use serde::Serialize;
use serde_json::json;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep, timeout_at};

use super::message::{self, LARGEST, discovery};
use super::{BackOff, Card, PATIENCE, Pending, Said, every, lock, tls};
use crate::history::{History, HistoryError};
use crate::station::config::{MqttAddress, Password};

/// Interval at which the state of the station is published if it has changed.
const STATE_EVERY: Duration = Duration::from_secs(2);
/// If the broker acknowledges nothing for this long, the connection is made again.
const NO_ACKNOWLEDGEMENT: Duration = Duration::from_secs(20);

pub(super) struct Publisher {
    pending: Pending,
    options: MqttOptions,
    /// The beginning of all topics of the station.
    topics: String,
    card: Card,
    history: Arc<History>,
    page: Arc<OnceLock<String>>,
    back_off: BackOff,
}

/// A connection to the broker, and what was published through it.
struct Connection {
    line: Line,
    is_connected: bool,
    /// The number of each message not sent yet, in order; `None` for a message that is no answer.
    queued: VecDeque<Option<u64>>,
    /// The packet id of each message sent but not acknowledged, and its number as in `queued`.
    flying: Vec<(u16, Option<u64>)>,
    /// The number of the answer that waits for its acknowledgement, and the time when it was published.
    awaited: Option<(u64, Instant)>,
    state: String,
}

impl Connection {
    /// Publishes a message, which the broker may retain. Returns false if there is no room for the
    /// message now.
    fn publish(&mut self, topic: &str, text: String, retain: bool, sequence: Option<u64>) -> bool {
        let is_taken = self.line.client.try_publish(topic, QoS::AtLeastOnce, retain, text).is_ok();
        if is_taken {
            self.queued.push_back(sequence);
        }
        is_taken
    }
}

impl Publisher {
    pub(super) fn new(
        pending: Pending,
        address: &MqttAddress,
        card: Card,
        (history, page): (&Arc<History>, &Arc<OnceLock<String>>),
    ) -> Result<Self, HistoryError> {
        // The name is random, since process ids may be equal in two containers, and a broker disconnects
        // the older of two clients with the same name.
        let client =
            format!("surfaced-{:08x}", SysRng.try_next_u32().unwrap_or_else(|_| process::id()));
        let topics = format!("{}/{}", address.prefix, pending.station);
        let mut options = options(address, client)?;
        // The broker publishes this message if the station disappears without notice.
        let will = json!({ "station": pending.station, "state": "offline" }).to_string();
        let state = format!("{topics}/state");
        options.set_last_will(LastWill::new(state, will, QoS::AtLeastOnce, true));
        let (history, page, back_off) = (history.clone(), page.clone(), BackOff::new());
        Ok(Self { pending, options, topics, card, history, page, back_off })
    }

    pub(super) async fn run(mut self, mut answers: mpsc::Receiver<Said>) {
        while let Some(why) = self.connection(&mut answers).await {
            self.pending.health.failed(&format!("{why}; they are tried again"));
            let until = Instant::now() + self.back_off.next();
            while let Ok(answer) = timeout_at(until, answers.recv()).await {
                // Other answers wait on disk for the next connection.
                match answer {
                    Some(answer @ Said::Answer(_)) => self.pending.add(&answer),
                    Some(_) => {}
                    None => return,
                }
            }
        }
    }

    /// Publishes through one connection. Returns why it broke, or `None` at the end of the station.
    async fn connection(&mut self, answers: &mut mpsc::Receiver<Said>) -> Option<String> {
        let mut on = Connection {
            line: Line::open(self.options.clone()),
            is_connected: false,
            queued: VecDeque::new(),
            flying: Vec::new(),
            awaited: None,
            state: String::new(),
        };
        let mut state_due = every(STATE_EVERY);
        loop {
            tokio::select! {
                event = on.line.events.recv() => match event {
                    Some(Ok(event)) => self.take(event, &mut on),
                    Some(Err(error)) => return Some(error.to_string()),
                    None => return Some("the connection ended".into()),
                },
                said = answers.recv() => match said {
                    Some(said @ Said::Answer(_)) => self.pending.add(&said),
                    // Changes and alerts are of no use later, so they wait for no connection.
                    Some(_) if !on.is_connected => {}
                    Some(Said::Change(change)) => self.publish_event("change", &*change, &mut on),
                    Some(Said::Alert(alert)) => self.publish_event("alert", &*alert, &mut on),
                    None => {
                        self.finish(on).await;
                        return None;
                    }
                },
                _ = state_due.tick() => self.publish_state(true, &mut on),
            }
            self.publish_next(&mut on);
            if on.awaited.is_some_and(|(_, since)| since.elapsed() > NO_ACKNOWLEDGEMENT) {
                return Some("the broker acknowledges nothing".into());
            }
        }
    }

    fn take(&mut self, event: Event, on: &mut Connection) {
        match event {
            Event::Incoming(Packet::ConnAck(_)) => {
                on.is_connected = true;
                let (answer, state) = (self.topic("answer"), self.topic("state"));
                for (topic, about) in discovery(&self.pending.station, &answer, &state) {
                    on.publish(&topic, about, true, None);
                }
                self.publish_state(true, on);
            }
            Event::Outgoing(Outgoing::Publish(packet)) => {
                on.flying.push((packet, on.queued.pop_front().flatten()));
            }
            Event::Incoming(Packet::PubAck(ack)) => {
                let at = on.flying.iter().position(|(packet, _)| *packet == ack.pkid);
                if let Some((_, Some(sequence))) = at.map(|at| on.flying.swap_remove(at)) {
                    self.pending.done(sequence);
                    on.awaited = None;
                    self.pending.health.arrived();
                }
                // The pause is reset only now, since a broker may accept a connection but no answer.
                self.back_off = BackOff::new();
            }
            _ => {}
        }
    }

    fn topic(&self, what: &str) -> String {
        format!("{}/{what}", self.topics)
    }

    fn publish_event(&self, what: &str, event: &impl Serialize, on: &mut Connection) {
        let text = message::event(&self.pending.station, None, event);
        on.publish(&self.topic(what), text, false, None);
    }

    /// Publishes the oldest answer, unless an answer waits for its acknowledgement.
    fn publish_next(&self, on: &mut Connection) {
        if !on.is_connected || on.awaited.is_some() {
            return;
        }
        if let Some((sequence, text)) = self.pending.first()
            && on.publish(&self.topic("answer"), text, true, Some(sequence))
        {
            on.awaited = Some((sequence, Instant::now()));
        }
    }

    fn publish_state(&self, is_online: bool, on: &mut Connection) {
        if !on.is_connected {
            return;
        }
        let Pending { station, outbox, .. } = &self.pending;
        let mut state = lock(&self.card).json();
        state["station"] = station.as_str().into();
        state["state"] = if is_online { "online" } else { "offline" }.into();
        state["page"] = self.page.get().cloned().into();
        // The number of unknown or unsure answers that nobody has reviewed.
        state["review"] = self.history.to_review().into();
        // The drift that scans of the reference surfaces show.
        state["drift"] = json!(self.history.drift().doubts);
        // `sequence` is the newest answer's number; `dropped` answers were lost for lack of room.
        state["sequence"] = outbox.newest().into();
        state["dropped"] = outbox.dropped.into();
        let text = state.to_string();
        if text != on.state && on.publish(&self.topic("state"), text.clone(), true, None) {
            on.state = text;
        }
    }

    /// Publishes the waiting answers and the state `offline`, if the broker can take them in time.
    async fn finish(&mut self, mut on: Connection) {
        let until = Instant::now() + PATIENCE * 3 / 4;
        loop {
            self.publish_next(&mut on);
            if on.awaited.is_none() && on.is_connected {
                self.publish_state(false, &mut on);
                if on.queued.is_empty() && on.flying.is_empty() {
                    break;
                }
            }
            match timeout_at(until, on.line.events.recv()).await {
                Ok(Some(Ok(event))) => self.take(event, &mut on),
                _ => return,
            }
        }
        let _ = on.line.client.try_disconnect();
        // The packet must be sent before the connection is dropped, so this waits for that.
        while let Ok(Some(Ok(event))) = timeout_at(until, on.line.events.recv()).await {
            if event == Event::Outgoing(Outgoing::Disconnect) {
                return sleep(Duration::from_millis(20)).await;
            }
        }
    }
}

const KEEP_ALIVE: Duration = Duration::from_secs(15);
const MOST_QUEUED_PACKETS: usize = 64;
/// The environment variable that holds the password of a broker's user.
const PASSWORD: &str = "SURFACED_MQTT_PASSWORD";

pub(crate) fn options(address: &MqttAddress, client: String) -> Result<MqttOptions, HistoryError> {
    let MqttAddress { host, credentials, tls, .. } = address;
    let mut options = MqttOptions::new(client, host.0.clone(), host.1);
    options.set_keep_alive(KEEP_ALIVE);
    // A packet holds the answer, its topic and a header, so it is larger than the answer.
    options.set_max_packet_size(2 * LARGEST, 2 * LARGEST);
    if let Some((user, password)) = credentials {
        options.set_credentials(user, read(password)?);
    }
    if let Some(files) = tls {
        let client = match &files.client {
            Some((certificate, key)) => Some((tls::read(certificate)?, tls::read(key)?)),
            None => None,
        };
        let ca = tls::read(&tls::authorities(files))?;
        options.set_transport(Transport::tls(ca, client, None));
    }
    Ok(options)
}

fn read(password: &Password) -> Result<String, HistoryError> {
    match password {
        Password::Given(password) => Ok(password.clone()),
        Password::File(path) => {
            let text = std::fs::read_to_string(path).map_err(HistoryError::io(path))?;
            Ok(text.trim_end_matches(['\r', '\n']).into())
        }
        Password::Environment => Ok(std::env::var(PASSWORD).unwrap_or_default()),
    }
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
    pub(crate) fn open(options: MqttOptions) -> Self {
        let (client, mut connection) = AsyncClient::new(options, MOST_QUEUED_PACKETS);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_password_comes_from_a_file_where_the_address_has_none() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("password");
        std::fs::write(&path, " se:cret \r\n").unwrap();
        let set = |address: &str| {
            let mut address: MqttAddress = address.parse().unwrap();
            let is_taken = address.set_password_file(path.clone());
            let login = options(&address, "me".into()).unwrap().credentials();
            (is_taken, login.map(|login| (login.username, login.password)))
        };
        let login = |user: &str, password: &str| Some((user.into(), password.into()));
        assert_eq!(set("mqtt://me@broker"), (true, login("me", " se:cret ")));
        assert_eq!(set("mqtt://m%40e:p%3Ass@broker"), (false, login("m@e", "p:ss")));
        assert_eq!(set("mqtt://broker"), (false, None));
        std::fs::remove_file(&path).unwrap();
        let mut address: MqttAddress = "mqtt://me@broker".parse().unwrap();
        address.set_password_file(path);
        let error = options(&address, "me".into()).unwrap_err().to_string();
        assert!(error.contains("password: "), "{error}");
    }
}
