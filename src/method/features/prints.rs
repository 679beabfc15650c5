//! What tells whether two recordings share samples.

use serde::{Deserialize, Serialize};

use crate::trial::{Fingerprints, Signal};

/// Windows that are kept of a series.
const MOST: usize = 64;

/// Hash of a signal, and sorted hashes of windows; none of those that can be equal by chance.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Prints(pub Option<u64>, pub Vec<u64>);

impl Prints {
    pub(super) fn of(signal: &Signal) -> Self {
        let Fingerprints { whole, windows } = Fingerprints::of(signal, MOST);
        let windows = windows.into_iter().filter(|_| whole.is_some());
        Self(whole, windows.map(|(hash, _)| hash).collect())
    }
}
