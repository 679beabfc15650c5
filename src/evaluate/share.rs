//! Shares of queries with their confidence intervals, and their keys in JSON.

use serde::ser::{Serialize, SerializeMap, Serializer};

use crate::recognise::wilson_interval;

/// A number of queries, and how many of them are right (or called unknown).
///
/// In JSON it is a fraction and its 95 % Wilson interval: `accuracy`, `accuracy_low` and
/// `accuracy_high`, which go into the object around it (`#[serde(flatten)]`).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Share {
    /// Number of right ones.
    pub right: usize,
    /// Number of all.
    pub of: usize,
}

impl Share {
    /// Counts how many values are true.
    pub(crate) fn count(each: impl IntoIterator<Item = bool>) -> Self {
        let mut share = Self::default();
        each.into_iter().for_each(|right| share.add(right));
        share
    }

    pub(crate) fn add(&mut self, right: bool) {
        *self = Self { right: self.right + usize::from(right), of: self.of + 1 };
    }

    pub(crate) fn join(&mut self, other: Self) {
        *self = Self { right: self.right + other.right, of: self.of + other.of };
    }

    /// The fraction, from 0 to 1; 0 if there are no queries.
    pub fn value(self) -> f64 {
        self.right as f64 / self.of.max(1) as f64
    }

    /// The 95 % Wilson interval of the fraction.
    pub fn interval(self) -> (f64, f64) {
        wilson_interval(self.right, self.of)
    }

    /// Writes a share as `key`, `key_low` and `key_high`, and before them the number of queries as
    /// `count`, if given; all are null if there is no share.
    pub(crate) fn write<S: Serializer>(
        share: Option<Self>,
        count: Option<&str>,
        key: &str,
        to: S,
    ) -> Result<S::Ok, S::Error> {
        let interval = share.map(Self::interval);
        let mut map = to.serialize_map(None)?;
        if let Some(count) = count {
            map.serialize_entry(count, &share.map(|share| share.of))?;
        }
        map.serialize_entry(key, &share.map(Self::value))?;
        map.serialize_entry(&format!("{key}_low"), &interval.map(|(low, _)| low))?;
        map.serialize_entry(&format!("{key}_high"), &interval.map(|(_, high)| high))?;
        map.end()
    }
}

impl Serialize for Share {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        Self::write(Some(*self), None, "accuracy", to)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_share_has_its_keys_in_json() {
        let json = serde_json::to_value(Share::count([true, true, false, true])).unwrap();
        let (low, high) = wilson_interval(3, 4);
        let wanted =
            serde_json::json!({"accuracy": 0.75, "accuracy_low": low, "accuracy_high": high});
        assert_eq!(json, wanted);
        assert_eq!(Share::default().value(), 0.0);
    }
}
