//! What a station reports as lines of JSON on stdout.

use crossbeam_channel::Sender;

use super::show;
use crate::station::{Command, Listener, StationEvent};

/// Prints a line for each scan that was named, and for each that was to be kept.
pub struct JsonLines {
    /// Ends the station once nobody reads the lines.
    pub commands: Sender<Command>,
}

impl Listener for JsonLines {
    fn on_event(&mut self, event: &StationEvent) {
        let printed = match event {
            StationEvent::Answer(answer) => show::try_json(&**answer),
            StationEvent::Enrolled(enrolled) => show::try_json(enrolled),
            _ => Ok(()),
        };
        if printed.is_err() {
            // Fails only when the station has ended already.
            let _ = self.commands.send(Command::Quit);
        }
    }
}
