//! Subscribers to the stream of events. Each has its own bounded queue, so none waits for another.
//!
//! An event is encoded once, and all subscribers share it. If a queue is full, events that the next
//! event of the same type replaces (such as traces) are skipped. If other events were missed, the
//! subscriber learns how many, and receives the whole state again.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};

use axum::body::Bytes;
use clap::ValueEnum;
use futures_core::Stream;
use serde::Serialize;
use serde_json::json;
use tokio::sync::mpsc::{Receiver, Sender, channel, error::TrySendError};

use crate::printable::json_text;

/// How many events may wait for one subscriber.
const QUEUE: usize = 256;
/// Replaceable events such as traces leave this many places of a queue free for others.
const KEPT_FREE: usize = 128;

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum EventKind {
    State,
    Advice,
    Device,
    Phase,
    Guess,
    Change,
    Answer,
    Unnamed,
    Camera,
    Outputs,
    Correction,
    Check,
    Drift,
    Enrolled,
    Enrolling,
    Reading,
    Library,
    Warning,
    Streams,
    Trace,
    Spectrum,
    Missed,
    Finished,
}

impl EventKind {
    fn name(self) -> String {
        // Only a variant that is skipped has no value.
        self.to_possible_value().map_or_else(String::new, |value| value.get_name().into())
    }

    /// Whether an event of this type may be missed, since the next event of the type replaces it.
    fn passes(self) -> bool {
        matches!(self, Self::Trace | Self::Spectrum | Self::Streams | Self::Guess | Self::Advice)
    }
}

/// The types of events that one subscriber wants. Each type has one bit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct EventFilter(u32);

impl EventFilter {
    pub(crate) const ALL: Self = Self(u32::MAX);

    /// Parses names separated by commas. Events of type `missed` are always included.
    pub(crate) fn parse(names: &str) -> Result<Self, String> {
        let mut filter = 1 << EventKind::Missed as u32;
        for name in names.split(',').map(str::trim) {
            let kind = EventKind::from_str(name, false).map_err(|_| {
                let known: Vec<String> =
                    EventKind::value_variants().iter().map(|kind| kind.name()).collect();
                let known = known.join(", ");
                format!("there is no type of event {name:?}; there are {known}")
            })?;
            filter |= 1 << kind as u32;
        }
        Ok(Self(filter))
    }

    fn holds(self, kind: EventKind) -> bool {
        self.0 & (1 << kind as u32) != 0
    }
}

pub(super) fn encode(kind: EventKind, data: &impl Serialize) -> Bytes {
    Bytes::from(format!("event: {}\ndata: {}\n\n", kind.name(), json_text(data)))
}

/// A comment that keeps a silent connection open, and reveals a broken one.
const KEEP_ALIVE: &[u8] = b":\n\n";

#[derive(Debug)]
struct Subscriber {
    queue: Sender<io::Result<Bytes>>,
    filter: EventFilter,
    missed: u64,
}

#[derive(Debug, Default)]
pub(super) struct Subscribers {
    subscribers: Vec<Subscriber>,
    /// Number of events for which a subscriber's queue had no room, including skipped traces.
    pub dropped: u64,
}

impl Subscribers {
    pub(super) fn subscribe(&mut self, filter: EventFilter, first: Bytes) -> EventStream {
        let (queue, events) = channel(QUEUE);
        let mut subscriber = Subscriber { queue, filter, missed: 0 };
        subscriber.send(EventKind::State, &first);
        self.subscribers.push(subscriber);
        EventStream(events)
    }

    pub(super) fn count(&self) -> usize {
        self.subscribers.iter().filter(|subscriber| !subscriber.queue.is_closed()).count()
    }

    pub(super) fn wanted(&self, kind: EventKind) -> bool {
        self.subscribers.iter().any(|subscriber| subscriber.filter.holds(kind))
    }

    /// Sends an event to all that want it, and `state` to those that have room again after a gap.
    pub(super) fn publish(&mut self, kind: EventKind, event: &Bytes, state: &dyn Fn() -> Bytes) {
        let dropped = &mut self.dropped;
        self.subscribers.retain_mut(|subscriber| {
            subscriber.catch_up(state);
            *dropped += u64::from(subscriber.filter.holds(kind) && !subscriber.send(kind, event));
            !subscriber.queue.is_closed()
        });
    }

    pub(super) fn keep_alive(&mut self) {
        // A full queue is no reason to drop a subscriber, only a closed queue is.
        self.subscribers.retain(|subscriber| {
            let sent = subscriber.queue.try_send(Ok(Bytes::from_static(KEEP_ALIVE)));
            !matches!(sent, Err(TrySendError::Closed(_)))
        });
    }

    /// Ends all streams after the events in their queues.
    pub(super) fn close(&mut self) {
        self.subscribers.clear();
    }
}

impl Subscriber {
    /// Sends an event if it is wanted; false if the queue had no room.
    fn send(&mut self, kind: EventKind, event: &Bytes) -> bool {
        if !self.filter.holds(kind) {
            return true;
        }
        let behind = kind.passes() && (self.missed > 0 || self.queue.capacity() <= KEPT_FREE);
        let sent = !behind && self.queue.try_send(Ok(event.clone())).is_ok();
        self.missed += u64::from(!sent && !kind.passes());
        sent
    }

    /// If there is room again, sends the number of missed events, and the whole state.
    fn catch_up(&mut self, state: &dyn Fn() -> Bytes) {
        if self.missed == 0 || self.queue.capacity() <= KEPT_FREE {
            return;
        }
        let events = std::mem::take(&mut self.missed);
        let missed = encode(EventKind::Missed, &json!({ "events": events }));
        // There is room for both events, since only this thread fills the queue.
        self.send(EventKind::Missed, &missed);
        self.send(EventKind::State, &state());
    }
}

/// The receiving end of a queue, as the body of an HTTP answer.
#[derive(Debug)]
pub(crate) struct EventStream(pub Receiver<io::Result<Bytes>>);

impl Stream for EventStream {
    type Item = io::Result<Bytes>;

    fn poll_next(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.0.poll_recv(cx)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(reading: &mut EventStream) -> Vec<String> {
        let mut all = Vec::new();
        while let Ok(event) = reading.0.try_recv() {
            all.push(String::from_utf8(event.unwrap().to_vec()).unwrap());
        }
        all
    }

    fn state() -> Bytes {
        encode(EventKind::State, &"whole")
    }

    #[test]
    fn a_stalled_subscriber_is_bounded_and_holds_up_no_other() {
        let mut subscribers = Subscribers::default();
        let mut stalled = subscribers.subscribe(EventFilter::ALL, state());
        let mut quick = subscribers.subscribe(EventFilter::ALL, state());
        let mut read = 0;
        for n in 0..10_000 {
            let kind = if n % 2 == 0 { EventKind::Trace } else { EventKind::Answer };
            subscribers.publish(kind, &encode(kind, &n), &state);
            read += text(&mut quick).len();
        }
        assert_eq!(read, 10_001, "the quick one got all, and the state before");
        assert_eq!(stalled.0.len(), QUEUE);
        assert_eq!(subscribers.dropped, 10_001 - QUEUE as u64);
        let late = text(&mut stalled);
        assert!(late[0].starts_with("event: state\n"));
        let traces = late.iter().filter(|event| event.starts_with("event: trace")).count();
        assert!(traces < QUEUE - KEPT_FREE, "traces leave room");

        subscribers.publish(EventKind::Answer, &encode(EventKind::Answer, &"next"), &state);
        let caught_up = text(&mut stalled);
        let answers = late.iter().filter(|event| event.starts_with("event: answer")).count();
        let missed = format!("event: missed\ndata: {{\"events\":{}}}\n\n", 5000 - answers);
        assert_eq!(caught_up[0], missed);
        assert!(caught_up[1].contains("whole") && caught_up[2].contains("next"));
    }

    #[test]
    fn a_subscriber_gets_what_it_wants_and_one_that_is_gone_is_forgotten() {
        let mut subscribers = Subscribers::default();
        let filter = EventFilter::parse("answer, phase").unwrap();
        let mut reading = subscribers.subscribe(filter, state());
        assert!(subscribers.wanted(EventKind::Answer) && !subscribers.wanted(EventKind::Trace));
        subscribers.publish(EventKind::Trace, &encode(EventKind::Trace, &0), &state);
        subscribers.publish(EventKind::Answer, &encode(EventKind::Answer, &1), &state);
        assert_eq!(text(&mut reading), ["event: answer\ndata: 1\n\n"]);
        drop(reading);
        assert_eq!(subscribers.count(), 0);
        subscribers.keep_alive();
        assert!(subscribers.subscribers.is_empty());
        assert!(EventFilter::parse("answer,everything").unwrap_err().contains("\"everything\""));
    }
}
