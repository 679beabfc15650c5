//! Decisions about a scan: when its answer is settled, how long the scan must last, whether its
//! surface is unknown, which sources are left out because their sensor is dead, and what a sequence of
//! answers says together.

pub(super) mod conformal;
pub(super) mod dead_sensor;
pub(super) mod interval;
pub(super) mod scan_time;
pub(super) mod settle;
pub(super) mod sticky;

use serde::ser::{Serialize, SerializeStruct, Serializer};

/// The trials that were left out together when left-out trials were named, so for whom a figure holds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum LeftOutBy {
    /// All trials of a person; the figure holds for other people too.
    People,
    /// All trials of a session of a person; the figure holds for this person's other sessions too.
    Sessions,
    /// Single trials, so the figure holds within the sessions of the library.
    #[default]
    Trials,
}

impl LeftOutBy {
    pub(crate) fn across_people(self) -> bool {
        self == Self::People
    }

    fn name(self) -> &'static str {
        match self {
            Self::People => "people",
            Self::Sessions => "sessions",
            Self::Trials => "trials",
        }
    }

    /// For whom the figure holds; `people` is the number of people in the library.
    pub(crate) fn of_whom(self, people: usize) -> &'static str {
        match (self, people) {
            (Self::People, _) => "for other people, too: each was left out in turn",
            (Self::Sessions, 0 | 1) => {
                "for this person, in other sessions, too: each was left out in turn"
            }
            (Self::Sessions, _) => "for the people in the library, in other sessions, too",
            (Self::Trials, 0 | 1) => "for this person, within one session",
            (Self::Trials, _) => "for the people in the library, within one session",
        }
    }
}

impl Serialize for LeftOutBy {
    /// Writes the fields `across_people` and `left_out`.
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        let mut fields = to.serialize_struct("LeftOutBy", 2)?;
        fields.serialize_field("across_people", &self.across_people())?;
        fields.serialize_field("left_out", self.name())?;
        fields.end()
    }
}
