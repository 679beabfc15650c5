//! The lock of a library: it is read by many at a time, or edited by one. It is the system's own
//! (`flock` of the folder), so that it ends with the process that holds it.

use std::fs::File;
use std::path::Path;
use std::time::{Duration, Instant};

use rustix::fs::{FlockOperation, flock};

use super::LibraryError;

/// How long an edit waits for readers: less than a browser does.
const PATIENCE: Duration = Duration::from_secs(8);
/// Time between two attempts.
const PAUSE: Duration = Duration::from_millis(50);

/// A library that is read or edited, until it is dropped.
#[derive(Debug)]
pub struct LibraryLock(#[expect(dead_code, reason = "held for its lock alone")] Option<File>);

impl LibraryLock {
    /// Keeps edits off while a library is read. Where the file system knows no locks, or nobody may
    /// edit the library anyway, there is nothing to keep off.
    pub fn for_reading(library: &Path) -> Self {
        let file = File::open(library).ok();
        // Waits for an edit under way, which takes a moment.
        Self(file.filter(|file| flock(file, FlockOperation::LockShared).is_ok()))
    }

    /// Waits until nobody reads the library, and keeps readers off.
    ///
    /// # Errors
    /// If it cannot be opened, or is read all the time.
    pub fn for_editing(library: &Path) -> Result<Self, LibraryError> {
        let file = File::open(library).map_err(|error| LibraryError::io(library, error))?;
        let begin = Instant::now();
        while flock(&file, FlockOperation::NonBlockingLockExclusive).is_err() {
            if begin.elapsed() > PATIENCE {
                let problem =
                    "another program reads it all the time; try again when that has ended";
                return Err(LibraryError::file(library, problem));
            }
            std::thread::sleep(PAUSE);
        }
        Ok(Self(Some(file)))
    }
}
