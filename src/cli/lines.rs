//! What a station tells as lines of JSON on stdout.

use super::show;
use crate::station::{Listener, Notice};

/// Prints a line for each scan that was named, and for each that was kept.
pub struct JsonLines;

impl Listener for JsonLines {
    fn notice(&mut self, notice: &Notice) {
        match notice {
            Notice::Answer(answer) => show::json(&**answer),
            Notice::Enrolled(enrolled) => show::json(enrolled),
            _ => {}
        }
    }
}
