//! The queue of events between the collector and its reader, so that a slow reader never holds up
//! live devices.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use crossbeam_channel::{SendTimeoutError, Sender};

use super::{Event, Totals};
use crate::device::{Warning, WarningKind};
use crate::ring::Stop;

/// Most events kept for a slow reader, in addition to those in the channel.
const BACKLOG: usize = 256;
/// How long a stop waits for the reader.
const PATIENCE: Duration = Duration::from_secs(1);

pub(super) struct EventQueue {
    events: Sender<Event>,
    stop: Stop,
    backlog: VecDeque<Event>,
    /// The time when the wait for the reader ends; `None` until a stop is requested.
    patience: Option<Instant>,
    /// Whether sending waits for the reader. True only if no device loses data during the wait.
    pub waits: bool,
    pub totals: Totals,
}

impl EventQueue {
    pub(super) fn new(events: Sender<Event>, stop: Stop, waits: bool) -> Self {
        Self {
            events,
            stop,
            backlog: VecDeque::new(),
            patience: None,
            waits,
            totals: Totals::default(),
        }
    }

    /// Sends an event, or keeps it for later. Drops an event if more than [`BACKLOG`] are kept.
    pub(super) fn push(&mut self, event: Event) {
        match &event {
            Event::Scan(_) => self.totals.scans += 1,
            Event::Warning(_) => self.totals.warnings += 1,
            _ => {}
        }
        self.backlog.push_back(event);
        self.flush();
        while self.backlog.len() > BACKLOG {
            // Drops scans last, since a flood of warnings must not displace scans.
            let other = self.backlog.iter().position(|event| !matches!(event, Event::Scan(_)));
            self.backlog.remove(other.unwrap_or(0));
            self.totals.dropped_events += 1;
        }
    }

    pub(super) fn warn(&mut self, kind: WarningKind, text: impl Into<String>) {
        self.push(Event::Warning(Warning::new(kind, text)));
    }

    /// Sends a snapshot; returns false if the reader is busy. The next snapshot then includes this one.
    pub(super) fn offer(&mut self, event: Event) -> bool {
        self.flush();
        self.backlog.is_empty() && self.send(event).is_ok()
    }

    /// Sends as much of the backlog as the reader takes.
    pub(super) fn flush(&mut self) {
        while let Some(event) = self.backlog.pop_front() {
            if let Err(back) = self.send(event) {
                return self.backlog.push_front(back);
            }
        }
    }

    /// Sends as much of the backlog as the reader takes, and then the totals.
    pub(super) fn finish(&mut self) -> Totals {
        self.waits = true;
        self.flush();
        // The reader takes no more, so the events left are dropped, and the totals count them.
        self.totals.dropped_events += self.backlog.len() as u64;
        self.backlog.clear();
        let _ = self.send(Event::Finished(self.totals.clone()));
        self.totals.clone()
    }

    fn patient(&mut self) -> bool {
        let now = Instant::now();
        let mut has_time = || now < *self.patience.get_or_insert(now + PATIENCE);
        self.waits && (!self.stop.requested() || has_time())
    }

    fn send(&mut self, mut event: Event) -> Result<(), Event> {
        loop {
            let wait = if self.patient() { Duration::from_millis(20) } else { Duration::ZERO };
            match self.events.send_timeout(event, wait) {
                Ok(()) => return Ok(()),
                Err(SendTimeoutError::Timeout(back)) if wait.is_zero() => return Err(back),
                Err(SendTimeoutError::Timeout(back)) => event = back,
                Err(SendTimeoutError::Disconnected(back)) => {
                    self.stop.request();
                    return Err(back);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::scan::Scan;

    fn scan(number: u32) -> Event {
        Event::Scan(Box::new(Scan::of_signals(number, BTreeMap::new())))
    }

    #[test]
    fn a_flood_of_warnings_displaces_no_scan() {
        // With room for one event, each would wait for its turn of a busy processor.
        const ROOM: usize = 64;
        let (sender, events) = crossbeam_channel::bounded(ROOM);
        let mut event_queue = EventQueue::new(sender, Stop::default(), false);
        for number in 1..=10 {
            event_queue.push(scan(number));
            (0..1000).for_each(|_| event_queue.warn(WarningKind::Damaged, "noise"));
        }
        let reader = std::thread::spawn(move || {
            events.iter().filter(|event| matches!(event, Event::Scan(_))).count()
        });
        let totals = event_queue.finish();
        drop(event_queue);
        assert_eq!(reader.join().unwrap(), 10);
        assert_eq!(totals.dropped_events as usize, 10 + 10_000 - ROOM - BACKLOG);
    }

    #[test]
    fn a_reader_that_is_gone_stops_the_session() {
        let (sender, events) = crossbeam_channel::bounded(1);
        drop(events);
        let stop = Stop::default();
        let mut event_queue = EventQueue::new(sender, stop.clone(), true);
        event_queue.warn(WarningKind::Damaged, "nobody reads this");
        assert!(stop.requested());
        assert_eq!(event_queue.finish().dropped_events, 1);
    }
}
