//! The lock of a library: it is read by many at a time, or edited by one. It is the system's own, so
//! that it ends with the process that holds it.

use std::fs::{File, TryLockError};
use std::path::Path;
use std::time::{Duration, Instant};

use super::{Editor, steps};
use crate::library::LibraryError;
use crate::system::{lock_holder, open_lock};

/// How long an edit waits for readers: less than a browser does.
const PATIENCE: Duration = Duration::from_secs(8);
/// How long a program waits for a lock before it logs which program holds it.
const SILENT: Duration = Duration::from_secs(1);
/// Time between two attempts.
const PAUSE: Duration = Duration::from_millis(50);

/// A library that is read or edited, until it is dropped.
#[derive(Debug)]
pub struct LibraryLock(#[expect(dead_code, reason = "held for its lock alone")] Option<File>);

impl LibraryLock {
    /// Keeps edits off while a library is read, after finishing one that was cut short. Where the
    /// file system knows no locks, or nobody may edit the library anyway, there is nothing to keep
    /// off.
    pub fn for_reading(library: &Path) -> Self {
        // A list of steps that cannot be read is reported by those who need it.
        let is_left = || {
            steps::read(library)
                .is_ok_and(|(all, _)| all.last().is_some_and(|last| last.left().is_some()))
        };
        if is_left()
            && let Err(error) = Editor::finish(library)
        {
            tracing::warn!(
                "{}: an edit of it was cut short, and cannot be finished now: {error}. Until then \
                 some trials may stand under a wrong label; `surfaced library list` tries again",
                library.display()
            );
        }
        Self(open_lock(library).ok().filter(|file| wait(file, library, None)))
    }

    /// Waits until nobody reads the library, and keeps readers off.
    ///
    /// # Errors
    /// If it cannot be opened, or is read all the time.
    pub fn for_editing(library: &Path) -> Result<Self, LibraryError> {
        let file = open_lock(library).map_err(|error| LibraryError::io(library, error))?;
        if !wait(&file, library, Some(PATIENCE)) {
            let who = lock_holder(&file).unwrap_or_else(|| "another program".into());
            let problem = format!("{who} reads it all the time; try again when that has ended");
            return Err(LibraryError::file(library, problem));
        }
        Ok(Self(Some(file)))
    }
}

/// Waits for a lock, that of an editor if it has only so much patience; false if it does not come, or
/// there are none here.
fn wait(file: &File, library: &Path, patience: Option<Duration>) -> bool {
    let (begin, mut is_said) = (Instant::now(), false);
    loop {
        let lock = if patience.is_some() { file.try_lock() } else { file.try_lock_shared() };
        match lock {
            Ok(()) => return true,
            Err(TryLockError::WouldBlock) => {}
            // A reader goes on without, where there are no locks.
            Err(_) if patience.is_none() => return false,
            Err(_) => {}
        }
        let waited = begin.elapsed();
        if patience.is_some_and(|patience| waited > patience) {
            return false;
        }
        if waited > SILENT && !is_said {
            is_said = true;
            let who = lock_holder(file).unwrap_or_else(|| "another program".into());
            let does = if patience.is_some() { "reads" } else { "edits" };
            tracing::info!("{}: waiting for {who}, which {does} it", library.display());
        }
        std::thread::sleep(PAUSE);
    }
}
