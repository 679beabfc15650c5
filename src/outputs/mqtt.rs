//! Answers by MQTT 3.1.1: each published under one topic, at least once.

use std::convert::Infallible;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use crossbeam_channel::bounded;
use rumqttc::{Client, Connection, Event, MqttOptions, Outgoing, QoS};

use super::{BackOff, PATIENCE, QUEUE};
use crate::station::config::MqttAddress;
use crate::station::{End, Listener, StationEvent};

/// How often something is sent on a silent line.
const KEEP_ALIVE: Duration = Duration::from_secs(30);

/// Publishes the answers of a station.
pub struct MqttOutput {
    client: Client,
    topic: String,
    ending: Arc<AtomicBool>,
    end: End,
}

impl MqttOutput {
    /// Publishes under a topic from now on.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn start(address: MqttAddress) -> std::io::Result<Self> {
        let MqttAddress { host, topic, credentials } = address;
        let id = format!("surfaced-{}", std::process::id());
        let mut options = MqttOptions::new(id, host.0, host.1);
        options.set_keep_alive(KEEP_ALIVE);
        if let Some((user, password)) = credentials {
            options.set_credentials(user, password);
        }
        let (client, connection) = Client::new(options, QUEUE);
        let (closing, ended) = bounded::<Infallible>(0);
        let ending = Arc::new(AtomicBool::new(false));
        let stop = ending.clone();
        let run = move || {
            let _closing = closing;
            keep_connected(connection, &stop);
        };
        std::thread::Builder::new().name("mqtt-output".into()).spawn(run)?;
        Ok(Self { client, topic, ending, end: End::of(ended) })
    }
}

/// Sends what is published, and connects anew where the line breaks, until the end.
fn keep_connected(mut connection: Connection, stop: &AtomicBool) {
    let mut back_off = BackOff::new();
    for event in connection.iter() {
        match event {
            Ok(Event::Outgoing(Outgoing::Disconnect)) => return,
            Ok(_) => back_off.reset(),
            Err(_) if stop.load(Ordering::Acquire) => return,
            Err(error) => {
                tracing::debug!("MQTT: {error}");
                let mut left = back_off.next();
                while left > Duration::ZERO && !stop.load(Ordering::Acquire) {
                    let step = left.min(Duration::from_millis(100));
                    std::thread::sleep(step);
                    left -= step;
                }
            }
        }
    }
}

impl Listener for MqttOutput {
    fn on_event(&mut self, event: &StationEvent) {
        if self.end.is_here(event) {
            self.close();
        }
        let StationEvent::Answer(answer) = event else { return };
        // Plain structs, numbers and text: nothing here that JSON cannot express.
        let text = serde_json::to_string(&**answer).unwrap_or_default();
        if self.client.try_publish(&self.topic, QoS::AtLeastOnce, false, text).is_err() {
            tracing::warn!("answer {} is not published: too many wait", answer.id);
        }
    }
}

impl Drop for MqttOutput {
    fn drop(&mut self) {
        self.close();
        self.end.wait(PATIENCE);
    }
}

impl MqttOutput {
    /// What was published before goes first.
    fn close(&self) {
        if !self.ending.swap(true, Ordering::AcqRel) {
            let _ = self.client.try_disconnect();
        }
    }
}
