//! Counts what was passed over while a library was opened, so that each kind is said once.

use std::collections::BTreeMap;

/// How often something was passed over, and where first.
pub(crate) struct Seen {
    count: usize,
    first: String,
}

impl Seen {
    /// Counts one more.
    pub fn count(all: &mut BTreeMap<String, Self>, what: String, place: String) {
        all.entry(what).or_insert(Self { count: 0, first: place }).count += 1;
    }

    /// The remark: what, how often, where first.
    pub fn say(&self, what: &str) -> String {
        match self.count {
            1 => format!("{}: {what}", self.first),
            count => format!("{} and {} more: {what}", self.first, count - 1),
        }
    }
}
