//! Reports to systemd: the station is ready, its loop still runs, it ends.
//!
//! The watchdog is fed by the station's own loop: a thread pings it, and only its answer is passed
//! on. Without systemd, none of this happens.

use std::time::Duration;

use crossbeam_channel::Sender;
use sd_notify::NotifyState;

use crate::station::{Command, Listener, StationEvent};

/// Reports to systemd, where it is there.
pub struct Supervisor(());

impl Supervisor {
    /// Pings the station that takes `commands` as often as the watchdog of the unit demands.
    ///
    /// # Errors
    /// If there is no thread to be had.
    pub fn new(commands: Sender<Command>) -> std::io::Result<Self> {
        if let Some(limit) = sd_notify::watchdog_enabled() {
            // Three times as often as necessary: two may come late.
            let every = (limit / 3).max(Duration::from_millis(10));
            let ping = move || {
                while commands.send(Command::Ping).is_ok() {
                    std::thread::sleep(every);
                }
            };
            std::thread::Builder::new().name("watchdog".into()).spawn(ping)?;
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
        // Fails only without systemd.
        let _ = sd_notify::notify(&[state]);
    }
}
