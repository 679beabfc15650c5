//! Answers by MQTT 3.1.1: each is published at least once, and the next one once the broker has
//! acknowledged it.

use std::collections::VecDeque;
use std::process;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use rand::TryRng;
use rand::rngs::SysRng;
use rumqttc::{Event, LastWill, MqttOptions, Outgoing, Packet, QoS};
use tokio::sync::mpsc;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep, timeout_at};

use super::broker::{Line, options};
use super::message::{CardRest, discovery, last_will};
use super::{BackOff, Card, PATIENCE, Pending, lock};
use crate::history::{History, HistoryError};
use crate::station::Answer;
use crate::station::config::MqttAddress;

/// How often the state of the station is published, if it has changed.
const STATE_EVERY: Duration = Duration::from_secs(2);
/// The time after which a broker that acknowledges nothing is connected to anew.
const NO_ACKNOWLEDGEMENT: Duration = Duration::from_secs(20);

/// What a station's state shows beside its answers.
pub(super) struct Shown {
    pub card: Card,
    pub history: Arc<History>,
    pub page: Arc<OnceLock<String>>,
}

/// Publishes the answers of a station, and its state.
pub(super) struct Publisher {
    pending: Pending,
    options: MqttOptions,
    answer_topic: String,
    state_topic: String,
    shown: Shown,
    back_off: BackOff,
}

/// What one connection has published.
#[derive(Default)]
struct Published {
    is_connected: bool,
    /// Not yet on the line, in their order: the number of an answer, or none for other texts.
    queued: VecDeque<Option<u64>>,
    /// On the line: by packet.
    flying: Vec<(u16, Option<u64>)>,
    /// The answer that is to be acknowledged, and since when.
    awaited: Option<(u64, Instant)>,
    state: String,
}

impl Publisher {
    pub fn new(
        pending: Pending,
        address: &MqttAddress,
        shown: Shown,
    ) -> Result<Self, HistoryError> {
        // Two containers may have the same process ids, and a broker throws out the older one of two
        // clients of one name.
        let client =
            format!("surfaced-{:08x}", SysRng.try_next_u32().unwrap_or_else(|_| process::id()));
        let topic = |what: &str| format!("{}/{}/{what}", address.prefix, pending.station);
        let (answer_topic, state_topic) = (topic("answer"), topic("state"));
        let mut options = options(address, client)?;
        let will = last_will(&pending.station);
        options.set_last_will(LastWill::new(&state_topic, will, QoS::AtLeastOnce, true));
        let back_off = BackOff::new();
        Ok(Self { pending, options, answer_topic, state_topic, shown, back_off })
    }

    /// Publishes answers until no more come.
    pub async fn run(mut self, mut answers: mpsc::Receiver<Arc<Answer>>) {
        while let Some(why) = self.connection(&mut answers).await {
            self.pending.health.failed(&format!("{why}; they are tried again"));
            let until = Instant::now() + self.back_off.next();
            while let Ok(answer) = timeout_at(until, answers.recv()).await {
                // The others wait on disk.
                let Some(answer) = answer else { return };
                self.pending.add(&answer);
            }
        }
    }

    /// Publishes by one connection; the reason why it ended, or none at the end of the station.
    async fn connection(&mut self, answers: &mut mpsc::Receiver<Arc<Answer>>) -> Option<String> {
        let mut line = Line::open(self.options.clone());
        let mut published = Published::default();
        let mut state_due = interval(STATE_EVERY);
        state_due.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                event = line.events.recv() => match event {
                    Some(Ok(event)) => self.take(event, &mut published, &line),
                    Some(Err(error)) => return Some(error.to_string()),
                    None => return Some("the connection ended".into()),
                },
                answer = answers.recv() => match answer {
                    Some(answer) => self.pending.add(&answer),
                    None => {
                        self.finish(&mut line, published).await;
                        return None;
                    }
                },
                _ = state_due.tick() => self.publish_state(true, &mut published, &line),
            }
            self.publish_next(&mut published, &line);
            if published.awaited.is_some_and(|(_, since)| since.elapsed() > NO_ACKNOWLEDGEMENT) {
                return Some("the broker acknowledges nothing".into());
            }
        }
    }

    fn take(&mut self, event: Event, published: &mut Published, line: &Line) {
        match event {
            Event::Incoming(Packet::ConnAck(_)) => {
                published.is_connected = true;
                let entities =
                    discovery(&self.pending.station, &self.answer_topic, &self.state_topic);
                for (topic, about) in entities {
                    publish(&topic, about, None, published, line);
                }
                self.publish_state(true, published, line);
            }
            Event::Outgoing(Outgoing::Publish(packet)) => {
                let what = published.queued.pop_front().flatten();
                published.flying.push((packet, what));
            }
            Event::Incoming(Packet::PubAck(ack)) => {
                let at = published.flying.iter().position(|(packet, _)| *packet == ack.pkid);
                if let Some((_, Some(sequence))) = at.map(|at| published.flying.swap_remove(at)) {
                    self.pending.done(sequence);
                    published.awaited = None;
                    self.pending.health.arrived();
                }
                // A broker may take the connection, and yet no answer.
                self.back_off.reset();
            }
            _ => {}
        }
    }

    /// Publishes the oldest answer, unless another one is under way.
    fn publish_next(&self, published: &mut Published, line: &Line) {
        if !published.is_connected || published.awaited.is_some() {
            return;
        }
        if let Some((sequence, text)) = self.pending.first()
            && publish(&self.answer_topic, text, Some(sequence), published, line)
        {
            published.awaited = Some((sequence, Instant::now()));
        }
    }

    /// Publishes the state of the station, if it has changed.
    fn publish_state(&self, is_online: bool, published: &mut Published, line: &Line) {
        if !published.is_connected {
            return;
        }
        let Pending { station, outbox, .. } = &self.pending;
        let text = lock(&self.shown.card).text(&CardRest {
            station,
            is_online,
            page: self.shown.page.get().map(String::as_str),
            review: self.shown.history.to_review(),
            sequence: outbox.newest(),
            dropped: outbox.dropped(),
        });
        if text != published.state
            && publish(&self.state_topic, text.clone(), None, published, line)
        {
            published.state = text;
        }
    }

    /// Publishes what waits and that the station is offline, as far as the broker is there and takes
    /// it soon.
    async fn finish(&mut self, line: &mut Line, mut published: Published) {
        let until = Instant::now() + PATIENCE * 3 / 4;
        loop {
            self.publish_next(&mut published, line);
            if published.awaited.is_none() && published.is_connected {
                self.publish_state(false, &mut published, line);
                if published.queued.is_empty() && published.flying.is_empty() {
                    break;
                }
            }
            match timeout_at(until, line.events.recv()).await {
                Ok(Some(Ok(event))) => self.take(event, &mut published, line),
                _ => return,
            }
        }
        let _ = line.client.try_disconnect();
        // Until the packet is on the line.
        while let Ok(Some(Ok(event))) = timeout_at(until, line.events.recv()).await {
            if event == Event::Outgoing(Outgoing::Disconnect) {
                return sleep(Duration::from_millis(20)).await;
            }
        }
    }
}

/// Publishes a text, retained; false if there is no room for it now.
fn publish(
    topic: &str,
    text: String,
    sequence: Option<u64>,
    published: &mut Published,
    line: &Line,
) -> bool {
    let is_taken = line.client.try_publish(topic, QoS::AtLeastOnce, true, text).is_ok();
    if is_taken {
        published.queued.push_back(sequence);
    }
    is_taken
}
