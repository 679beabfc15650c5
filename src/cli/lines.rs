//! What a station tells as lines of JSON on stdout.

use super::show;
use crate::station::{Listener, StationEvent};

/// Prints a line for each scan that was named, and for each that was kept.
pub struct JsonLines;

impl Listener for JsonLines {
    fn on_event(&mut self, event: &StationEvent) {
        match event {
            StationEvent::Answer(answer) => show::json(&**answer),
            StationEvent::Enrolled(enrolled) => show::json(enrolled),
            _ => {}
        }
    }
}
