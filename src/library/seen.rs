//! Counts files by the remark on them while a library is opened, so that each remark is made once.

use std::collections::BTreeMap;

/// How many files one remark is about, and the first of them.
pub(crate) struct Seen {
    count: usize,
    first: String,
}

impl Seen {
    /// Counts one more file, at `place`, with the remark `what`.
    pub fn count(all: &mut BTreeMap<String, Self>, what: String, place: String) {
        all.entry(what).or_insert(Self { count: 0, first: place }).count += 1;
    }

    /// The text of the remark: the first file, how many others, and `what`.
    pub fn say(&self, what: &str) -> String {
        match self.count {
            1 => format!("{}: {what}", self.first),
            count => format!("{} and {} more: {what}", self.first, count - 1),
        }
    }
}
