//! The lock of a library: it is read by many at a time, or edited by one. It is the system's own
//! (`flock` of the folder), so that it ends with the process that holds it.

use std::fs::{self, File};
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::time::{Duration, Instant};

use rustix::fs::{FlockOperation, flock, major, minor};

use super::{Editor, steps};
use crate::library::LibraryError;

/// How long an edit waits for readers: less than a browser does.
const PATIENCE: Duration = Duration::from_secs(8);
/// How long a program waits before it logs for whom.
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
        let file = File::open(library).ok();
        Self(file.filter(|file| wait(file, library, FlockOperation::NonBlockingLockShared, None)))
    }

    /// Waits until nobody reads the library, and keeps readers off.
    ///
    /// # Errors
    /// If it cannot be opened, or is read all the time.
    pub fn for_editing(library: &Path) -> Result<Self, LibraryError> {
        let file = File::open(library).map_err(|error| LibraryError::io(library, error))?;
        if !wait(&file, library, FlockOperation::NonBlockingLockExclusive, Some(PATIENCE)) {
            let who = holder(&file).unwrap_or_else(|| "another program".into());
            let problem = format!("{who} reads it all the time; try again when that has ended");
            return Err(LibraryError::file(library, problem));
        }
        Ok(Self(Some(file)))
    }
}

/// Waits for a lock; false if it does not come, or there are none here.
fn wait(file: &File, library: &Path, lock: FlockOperation, patience: Option<Duration>) -> bool {
    let (begin, mut is_said) = (Instant::now(), false);
    loop {
        match flock(file, lock) {
            Ok(()) => return true,
            Err(rustix::io::Errno::WOULDBLOCK) => {}
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
            let who = holder(file).unwrap_or_else(|| "another program".into());
            let does = if patience.is_some() { "reads" } else { "edits" };
            tracing::info!("{}: waiting for {who}, which {does} it", library.display());
        }
        std::thread::sleep(PAUSE);
    }
}

/// The process that holds a lock of a file: its command and its number, where the system tells.
fn holder(file: &File) -> Option<String> {
    let about = file.metadata().ok()?;
    let place = format!("{:02x}:{:02x}:{}", major(about.dev()), minor(about.dev()), about.ino());
    let locks = fs::read_to_string("/proc/locks").ok()?;
    let pid = locks.lines().find_map(|line| {
        let words: Vec<&str> = line.split_whitespace().collect();
        // "1: FLOCK ADVISORY WRITE 4711 08:01:1234 0 EOF"; those who wait are listed with an arrow.
        let [_, "FLOCK", _, _, pid, at, ..] = words[..] else { return None };
        (at == place).then(|| pid.to_string())
    })?;
    let command = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
    let words = command.split(|&byte| byte == 0).take(3).map(String::from_utf8_lossy);
    let words: Vec<_> = words.filter(|word| !word.is_empty()).collect();
    let program = words.first()?.rsplit('/').next()?.to_string();
    let rest =
        words.iter().skip(1).filter(|word| !word.contains('/')).map(|word| format!(" {word}"));
    Some(format!("`{program}{}` (process {pid})", rest.collect::<String>()))
}
