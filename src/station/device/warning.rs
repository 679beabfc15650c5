//! Warnings: something was lost, damaged or not understood, and work continues.

use std::fmt;

/// The kind of a warning, which stays the same between versions; `src/serve/remedies.md` has a row for
/// each.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum WarningKind {
    /// A device did not stop in time.
    Abandoned,
    /// The crystal of a stylus has failed.
    Crystal,
    /// Data of a device were damaged, late or not understood.
    Damaged,
    /// Reference scans say that the station drifts.
    Drift,
    /// An order cannot be followed here.
    Ignored,
    /// A part of the recordings, or a device, is left out.
    LeftOut,
    /// The level of a sound is too low or too high.
    Level,
    /// The library cannot be read.
    LibraryUnread,
    /// The light of a camera cannot be switched.
    Light,
    /// A scan reached the longest time.
    LongestScan,
    /// A trial was not written.
    TrialUnwritten,
    /// The rate of a sensor is not the expected one.
    OffPace,
    /// A scan was cut off, and is not named.
    ScanCut,
    /// The begin or end of a scan does not fit the data.
    ScanMark,
    /// Two columns seem to have changed places.
    Swapped,
    /// A device cannot be opened, for another reason than before.
    Unopened,
    /// A scan was not named.
    Unnamed,
}

#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Warning {
    pub kind: WarningKind,
    /// The warning in words.
    pub text: String,
}

impl Warning {
    pub fn new(kind: WarningKind, text: impl Into<String>) -> Self {
        Self { kind, text: text.into() }
    }
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}
