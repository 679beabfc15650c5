//! How fast a recording is played.

use std::ops::RangeInclusive;
use std::str::FromStr;

/// Bounds of a speed: slower, nothing would ever come; faster, no clock could keep up.
pub(super) const SPEEDS: RangeInclusive<f64> = 1e-3..=1e4;

/// How fast a recording is played.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Speed {
    /// This many times as fast as it was recorded, from 0.001 to 10 000; what the session does not take is lost.
    RealTime(f64),
    /// As fast as the session takes it; nothing is lost.
    Max,
}

impl FromStr for Speed {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.parse::<f64>() {
            _ if text == "max" => Ok(Self::Max),
            Ok(factor) if SPEEDS.contains(&factor) => Ok(Self::RealTime(factor)),
            _ => Err(format!(
                "`{text}` is no speed; expected a number from {} to {}, or `max`",
                SPEEDS.start(),
                SPEEDS.end()
            )),
        }
    }
}
