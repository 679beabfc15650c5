//! Answers by MQTT 3.1.1: each published under one topic, at least once.

use std::convert::Infallible;
use std::process;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use crossbeam_channel::bounded;
use rand::TryRng;
use rand::rngs::SysRng;
use rumqttc::{Client, Connection, Event, MqttOptions, Outgoing, Packet, QoS};

use super::{BackOff, OutputHealth, PATIENCE, QUEUE};
use crate::station::config::MqttAddress;
use crate::station::{Answer, End, Listener, StationEvent};

/// How often something is sent on a silent line.
const KEEP_ALIVE: Duration = Duration::from_secs(30);

/// Largest answer in bytes, some 2000 surfaces: brokers refuse large ones, often from here on.
const LARGEST: usize = 128 << 10;
/// Surfaces that stay in an answer that is larger.
const BEST: usize = 10;

/// Publishes the answers of a station.
pub struct MqttOutput {
    client: Client,
    topic: String,
    health: OutputHealth,
    /// Answers that the broker has not acknowledged.
    waiting: Arc<AtomicUsize>,
    is_shortened: bool,
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
        let health = OutputHealth::new(format!("mqtt://{}:{}/{topic}", host.0, host.1));
        // Two containers may have the same process ids, and a broker throws out the older one of two
        // clients of one name.
        let id =
            format!("surfaced-{:08x}", SysRng.try_next_u32().unwrap_or_else(|_| process::id()));
        let mut options = MqttOptions::new(id, host.0, host.1);
        options.set_keep_alive(KEEP_ALIVE);
        // The topic and the head of the packet come beside the answer.
        options.set_max_packet_size(2 * LARGEST, 2 * LARGEST);
        if let Some((user, password)) = credentials {
            options.set_credentials(user, password);
        }
        let (client, connection) = Client::new(options, QUEUE);
        let (closing, ended) = bounded::<Infallible>(0);
        let ending = Arc::new(AtomicBool::new(false));
        let waiting = Arc::<AtomicUsize>::default();
        let (stop, of, left) = (ending.clone(), health.clone(), waiting.clone());
        let run = move || {
            let _closing = closing;
            keep_connected(connection, &stop, &of, &left);
        };
        std::thread::Builder::new().name("mqtt-output".into()).spawn(run)?;
        let (is_shortened, end) = (false, End::of(ended));
        Ok(Self { client, topic, health, waiting, is_shortened, ending, end })
    }

    /// How it is, now and later.
    pub fn health(&self) -> OutputHealth {
        self.health.clone()
    }

    /// An answer as text, with the best surfaces alone where it would be too large.
    fn text(&mut self, answer: &Answer) -> String {
        // Plain structs, numbers and text: nothing here that JSON cannot express.
        let text = serde_json::to_string(answer).unwrap_or_default();
        if text.len() <= LARGEST {
            return text;
        }
        if !std::mem::replace(&mut self.is_shortened, true) {
            tracing::warn!(
                "answers are published with their {BEST} best surfaces alone: all {} take {} KiB, \
                 and brokers refuse more than {}",
                answer.ranked.len(),
                text.len() >> 10,
                LARGEST >> 10
            );
        }
        let ranked = answer.ranked.iter().take(BEST).cloned().collect();
        serde_json::to_string(&Answer { ranked, ..answer.clone() }).unwrap_or_default()
    }
}

/// Sends what is published, and connects anew where the line breaks, until the end.
fn keep_connected(
    mut connection: Connection,
    stop: &AtomicBool,
    health: &OutputHealth,
    waiting: &AtomicUsize,
) {
    let mut back_off = BackOff::new();
    for event in connection.iter() {
        match event {
            Ok(Event::Outgoing(Outgoing::Disconnect)) => return,
            Ok(Event::Incoming(Packet::PubAck(_))) => {
                back_off.reset();
                let before = |left: usize| Some(left.saturating_sub(1));
                let _ = waiting.fetch_update(Ordering::AcqRel, Ordering::Acquire, before);
                health.waits(waiting.load(Ordering::Acquire));
                health.arrived();
            }
            // A broker may take the connection, and yet no answer.
            Ok(Event::Incoming(Packet::PingResp)) => back_off.reset(),
            Ok(_) => {}
            Err(_) if stop.load(Ordering::Acquire) => return,
            Err(error) => {
                health.failed(&format!("{error}; they are tried again"));
                back_off.wait(stop);
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
        let text = self.text(answer);
        match self.client.try_publish(&self.topic, QoS::AtLeastOnce, false, text) {
            Ok(()) => self.health.waits(self.waiting.fetch_add(1, Ordering::AcqRel) + 1),
            Err(_) => self
                .health
                .failed(&format!("{QUEUE} wait already, so answer {} is dropped", answer.id)),
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
    /// Disconnects, after all that was published before.
    fn close(&self) {
        if !self.ending.swap(true, Ordering::AcqRel) {
            let _ = self.client.try_disconnect();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recognise::RankedSurface;
    use crate::scan::Scan;

    #[test]
    fn an_answer_that_is_too_large_keeps_its_ten_best_surfaces() {
        let mut output = MqttOutput::start("mqtt://127.0.0.1:1/x".parse().unwrap()).unwrap();
        let answer = Answer::of(&Scan::of_signals(1, Default::default()), 0.0);
        for (surfaces, kept) in [(170, 170), (3000, BEST)] {
            let ranked = |at| RankedSurface { surface: "a".repeat(40), score: at as f64 };
            let answer = Answer { ranked: (0..surfaces).map(ranked).collect(), ..answer.clone() };
            let text = output.text(&answer);
            let said: serde_json::Value = serde_json::from_str(&text).unwrap();
            assert_eq!(said["ranked"].as_array().unwrap().len(), kept);
            assert!(text.len() <= LARGEST);
        }
        assert!(output.is_shortened);
    }
}
