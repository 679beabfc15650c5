//! Who reads the stream of events: a bounded queue each, and nobody waits for anybody.
//!
//! An event is encoded once and shared. Where a queue is full, traces and figures are skipped,
//! since the next ones make up for them; of other events, the reader is told how many it missed,
//! and gets the whole state again.

use std::pin::Pin;
use std::task::{Context, Poll};

use axum::body::Bytes;
use futures_core::Stream;
use serde::Serialize;
use tokio::sync::mpsc::{Receiver, Sender, channel, error::TrySendError};

/// Events that wait for one reader.
const QUEUE: usize = 256;
/// Figures and traces leave this much room for what matters more.
const KEPT_FREE: usize = 128;

/// The types of event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    State,
    Advice,
    Device,
    Phase,
    Guess,
    Answer,
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

impl Kind {
    const ALL: [Self; 16] = [
        Self::State,
        Self::Advice,
        Self::Device,
        Self::Phase,
        Self::Guess,
        Self::Answer,
        Self::Enrolled,
        Self::Enrolling,
        Self::Reading,
        Self::Library,
        Self::Warning,
        Self::Streams,
        Self::Trace,
        Self::Spectrum,
        Self::Missed,
        Self::Finished,
    ];

    fn name(self) -> &'static str {
        match self {
            Self::State => "state",
            Self::Advice => "advice",
            Self::Device => "device",
            Self::Phase => "phase",
            Self::Guess => "guess",
            Self::Answer => "answer",
            Self::Enrolled => "enrolled",
            Self::Enrolling => "enrolling",
            Self::Reading => "reading",
            Self::Library => "library",
            Self::Warning => "warning",
            Self::Streams => "streams",
            Self::Trace => "trace",
            Self::Spectrum => "spectrum",
            Self::Missed => "missed",
            Self::Finished => "finished",
        }
    }

    /// Whether the next one makes up for it.
    fn passes(self) -> bool {
        matches!(self, Self::Trace | Self::Spectrum | Self::Streams | Self::Guess | Self::Advice)
    }
}

/// The types that one reader asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Wants(u32);

impl Wants {
    /// All types.
    pub const ALL: Self = Self(u32::MAX);

    /// From names with commas between them. How many were missed is always told.
    ///
    /// # Errors
    /// For people: a name that is none.
    pub fn parse(names: &str) -> Result<Self, String> {
        let mut wants = 1 << Kind::Missed as u32;
        for name in names.split(',').map(str::trim) {
            let kind = Kind::ALL.into_iter().find(|kind| kind.name() == name).ok_or_else(|| {
                let known = Kind::ALL.map(Kind::name).join(", ");
                format!("there is no type of event {name:?}; there are {known}")
            })?;
            wants |= 1 << kind as u32;
        }
        Ok(Self(wants))
    }

    fn holds(self, kind: Kind) -> bool {
        self.0 & (1 << kind as u32) != 0
    }
}

/// One event as it goes over the line.
pub fn encode(kind: Kind, data: &impl Serialize) -> Bytes {
    // Plain structs, finite numbers and text: nothing here that JSON cannot express.
    let json = serde_json::to_string(data).unwrap_or_default();
    Bytes::from(format!("event: {}\ndata: {json}\n\n", kind.name()))
}

/// What keeps a silent line open, and finds those that are dead.
const KEEP_ALIVE: &[u8] = b":\n\n";

#[derive(Debug, Serialize)]
struct Missed {
    events: u64,
}

#[derive(Debug)]
struct Seat {
    queue: Sender<Bytes>,
    wants: Wants,
    missed: u64,
}

/// All readers.
#[derive(Debug, Default)]
pub struct Readers {
    seats: Vec<Seat>,
    /// Events that some reader had no room for, skipped traces included.
    pub dropped: u64,
}

impl Readers {
    /// One reader more; it begins with `first`.
    pub fn join(&mut self, wants: Wants, first: Bytes) -> Reading {
        let (queue, events) = channel(QUEUE);
        let mut seat = Seat { queue, wants, missed: 0 };
        seat.send(Kind::State, &first);
        self.seats.push(seat);
        Reading(events)
    }

    /// How many there are.
    pub fn count(&self) -> usize {
        self.seats.iter().filter(|seat| !seat.queue.is_closed()).count()
    }

    /// Whether anybody wants events of this type.
    pub fn want(&self, kind: Kind) -> bool {
        self.seats.iter().any(|seat| seat.wants.holds(kind))
    }

    /// Tells all who want it. `state` is asked for the whole state where somebody has caught up.
    pub fn tell(&mut self, kind: Kind, event: &Bytes, state: &mut dyn FnMut() -> Bytes) {
        let dropped = &mut self.dropped;
        self.seats.retain_mut(|seat| {
            seat.catch_up(state);
            *dropped += u64::from(seat.wants.holds(kind) && !seat.send(kind, event));
            !seat.queue.is_closed()
        });
    }

    /// Keeps lines open.
    pub fn keep_alive(&mut self) {
        // A reader whose queue is full has enough to read.
        self.seats.retain(|seat| {
            let sent = seat.queue.try_send(Bytes::from_static(KEEP_ALIVE));
            !matches!(sent, Err(TrySendError::Closed(_)))
        });
    }

    /// Lets all readers go, after what is in their queues.
    pub fn close(&mut self) {
        self.seats.clear();
    }
}

impl Seat {
    /// Whether it was sent.
    fn send(&mut self, kind: Kind, event: &Bytes) -> bool {
        if !self.wants.holds(kind) {
            return true;
        }
        let behind = kind.passes() && (self.missed > 0 || self.queue.capacity() <= KEPT_FREE);
        let sent = !behind && self.queue.try_send(event.clone()).is_ok();
        self.missed += u64::from(!sent && !kind.passes());
        sent
    }

    /// Once there is room again: how much was missed, and how things are.
    fn catch_up(&mut self, state: &mut dyn FnMut() -> Bytes) {
        if self.missed == 0 || self.queue.capacity() <= KEPT_FREE {
            return;
        }
        let missed = encode(Kind::Missed, &Missed { events: std::mem::take(&mut self.missed) });
        // There is room for both, and this thread alone fills the queue.
        self.send(Kind::Missed, &missed);
        self.send(Kind::State, &state());
    }
}

/// A reader's end: the body of its answer.
#[derive(Debug)]
pub struct Reading(Receiver<Bytes>);

impl Stream for Reading {
    type Item = Result<Bytes, std::convert::Infallible>;

    fn poll_next(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.0.poll_recv(cx).map(|event| event.map(Ok))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(reading: &mut Reading) -> Vec<String> {
        let mut all = Vec::new();
        while let Ok(event) = reading.0.try_recv() {
            all.push(String::from_utf8(event.to_vec()).unwrap());
        }
        all
    }

    fn state() -> Bytes {
        encode(Kind::State, &"whole")
    }

    #[test]
    fn a_stalled_reader_is_bounded_and_holds_up_no_other() {
        let mut readers = Readers::default();
        let (mut stalled, mut quick) =
            (readers.join(Wants::ALL, state()), readers.join(Wants::ALL, state()));
        let mut read = 0;
        for n in 0..10_000 {
            let kind = if n % 2 == 0 { Kind::Trace } else { Kind::Answer };
            readers.tell(kind, &encode(kind, &n), &mut state);
            read += text(&mut quick).len();
        }
        assert_eq!(read, 10_001, "the quick one got all, and the state before");
        assert_eq!(stalled.0.len(), QUEUE);
        assert_eq!(readers.dropped, 10_001 - QUEUE as u64);
        let late = text(&mut stalled);
        assert!(late[0].starts_with("event: state\n"));
        let traces = late.iter().filter(|event| event.starts_with("event: trace")).count();
        assert!(traces < QUEUE - KEPT_FREE, "traces leave room");

        readers.tell(Kind::Answer, &encode(Kind::Answer, &"next"), &mut state);
        let caught_up = text(&mut stalled);
        let answers = late.iter().filter(|event| event.starts_with("event: answer")).count();
        let missed = format!("event: missed\ndata: {{\"events\":{}}}\n\n", 5000 - answers);
        assert_eq!(caught_up[0], missed);
        assert!(caught_up[1].contains("whole") && caught_up[2].contains("next"));
    }

    #[test]
    fn a_reader_gets_what_it_asked_for_and_one_that_is_gone_is_forgotten() {
        let mut readers = Readers::default();
        let wants = Wants::parse("answer, phase").unwrap();
        let mut reading = readers.join(wants, state());
        assert!(readers.want(Kind::Answer) && !readers.want(Kind::Trace));
        readers.tell(Kind::Trace, &encode(Kind::Trace, &0), &mut state);
        readers.tell(Kind::Answer, &encode(Kind::Answer, &1), &mut state);
        assert_eq!(text(&mut reading), ["event: answer\ndata: 1\n\n"]);
        drop(reading);
        assert_eq!(readers.count(), 0);
        readers.keep_alive();
        assert!(readers.seats.is_empty());
        assert!(Wants::parse("answer,everything").unwrap_err().contains("\"everything\""));
    }
}
