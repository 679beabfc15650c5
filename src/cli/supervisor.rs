//! What systemd is told: that the station is ready, that its loop still turns, that it ends.
//!
//! The watchdog is fed by the station's own loop: a thread asks for a sign of life, and only the
//! answer is passed on. Without systemd, nothing of this happens.

use std::time::Duration;

use crossbeam_channel::Sender;
use sd_notify::NotifyState;

use crate::station::{Command, Listener, StationEvent};

/// Tells systemd, where it listens.
pub struct Supervisor(());

impl Supervisor {
    /// Asks the station that takes `orders` for signs of life, as often as the unit wants them.
    ///
    /// # Errors
    /// If there is no thread to be had.
    pub fn new(orders: Sender<Command>) -> std::io::Result<Self> {
        if let Some(limit) = sd_notify::watchdog_enabled() {
            // Thrice as often as need be: two may come late.
            let every = (limit / 3).max(Duration::from_millis(10));
            let ask = move || {
                while orders.send(Command::Ping).is_ok() {
                    std::thread::sleep(every);
                }
            };
            std::thread::Builder::new().name("watchdog".into()).spawn(ask)?;
        }
        Ok(Self(()))
    }
}

impl Listener for Supervisor {
    fn on_event(&mut self, event: &StationEvent) {
        let state = match event {
            StationEvent::Streams(_) => NotifyState::Ready,
            StationEvent::Alive => NotifyState::Watchdog,
            StationEvent::Finished(_) => NotifyState::Stopping,
            _ => return,
        };
        // Where nobody listens, nobody misses it.
        let _ = sd_notify::notify(&[state]);
    }
}
