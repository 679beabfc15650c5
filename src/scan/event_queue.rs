//! The queue of events between the collector and its reader: a slow reader never holds up live
//! devices.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use crossbeam_channel::{SendTimeoutError, Sender, TrySendError};

use super::{Event, Totals};
use crate::ring::Stop;

/// Events kept for a reader that is late, besides those in the channel.
const BACKLOG: usize = 256;
/// The time that a stop waits for the reader.
const PATIENCE: Duration = Duration::from_secs(1);

pub(super) struct EventQueue {
    events: Sender<Event>,
    stop: Stop,
    backlog: VecDeque<Event>,
    /// After a stop: until when to wait for the reader.
    patience: Option<Instant>,
    /// Whether sending waits for the reader: true if no device would lose data by it.
    pub waits: bool,
    pub totals: Totals,
}

impl EventQueue {
    pub fn new(events: Sender<Event>, stop: Stop, waits: bool) -> Self {
        Self {
            events,
            stop,
            backlog: VecDeque::new(),
            patience: None,
            waits,
            totals: Totals::default(),
        }
    }

    /// Sends an event that must not be missed.
    pub fn push(&mut self, event: Event) {
        match &event {
            Event::Scan(_) => self.totals.scans += 1,
            Event::Warning(_) => self.totals.warnings += 1,
            _ => {}
        }
        self.backlog.push_back(event);
        self.flush();
        while self.backlog.len() > BACKLOG {
            // Drops scans last: a flood of warnings must not displace them.
            let other = self.backlog.iter().position(|event| !matches!(event, Event::Scan(_)));
            self.backlog.remove(other.unwrap_or(0));
            self.totals.dropped_events += 1;
        }
    }

    pub fn warn(&mut self, text: String) {
        self.push(Event::Warning(text));
    }

    /// Sends a snapshot; false if the reader was busy: then the next one will include its data.
    pub fn offer(&mut self, event: Event) -> bool {
        self.flush();
        let sent = self.backlog.is_empty() && self.send(event).is_ok();
        self.totals.late_snapshots += u64::from(!sent);
        sent
    }

    /// Sends the backlog, as far as the reader takes it.
    pub fn flush(&mut self) {
        while let Some(event) = self.backlog.pop_front() {
            if let Err(back) = self.send(event) {
                return self.backlog.push_front(back);
            }
        }
    }

    /// Sends all that is left, as far as the reader takes it, and then the totals.
    pub fn finish(mut self) -> Totals {
        self.waits = true;
        self.flush();
        // The reader takes no more: the totals, which the session returns too, count this.
        self.totals.dropped_events += self.backlog.len() as u64;
        self.backlog.clear();
        let _ = self.send(Event::Finished(self.totals.clone()));
        self.totals
    }

    /// Whether to wait for the reader now.
    fn patient(&mut self) -> bool {
        let stopping = self.stop.requested();
        if !stopping {
            return self.waits;
        }
        let now = Instant::now();
        self.waits && now < *self.patience.get_or_insert(now + PATIENCE)
    }

    fn send(&mut self, event: Event) -> Result<(), Event> {
        let mut event = event;
        while self.patient() {
            match self.events.send_timeout(event, Duration::from_millis(20)) {
                Ok(()) => return Ok(()),
                Err(SendTimeoutError::Timeout(back)) => event = back,
                Err(SendTimeoutError::Disconnected(back)) => {
                    self.stop.request();
                    return Err(back);
                }
            }
        }
        self.events.try_send(event).map_err(|error| match error {
            TrySendError::Full(back) => back,
            TrySendError::Disconnected(back) => {
                self.stop.request();
                back
            }
        })
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
        let (sender, events) = crossbeam_channel::bounded(1);
        let mut event_queue = EventQueue::new(sender, Stop::default(), false);
        for number in 1..=10 {
            event_queue.push(scan(number));
            (0..1000).for_each(|_| event_queue.warn("noise".into()));
        }
        let reader = std::thread::spawn(move || {
            events.iter().filter(|event| matches!(event, Event::Scan(_))).count()
        });
        let totals = event_queue.finish();
        assert_eq!(reader.join().unwrap(), 10);
        assert_eq!(totals.dropped_events as usize, 10 + 10_000 - 1 - BACKLOG);
    }

    #[test]
    fn a_reader_that_is_gone_stops_the_session() {
        let (sender, events) = crossbeam_channel::bounded(1);
        drop(events);
        let stop = Stop::default();
        let mut event_queue = EventQueue::new(sender, stop.clone(), true);
        event_queue.warn("nobody reads this".into());
        assert!(stop.requested());
        assert_eq!(event_queue.finish().dropped_events, 1);
    }
}
