//! Recordings that cannot be used. A command skips them and ends with code 3; with `--strict`, it
//! stops.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use super::{Done, Failure, show};
use crate::dataset;
use crate::library::{Entry, Library, LibraryError, Unreadable, unreadable};
use crate::scene::Scene;

/// Whether a command stops if a recording cannot be used.
static STRICT: AtomicBool = AtomicBool::new(false);
/// The reasons why recordings were skipped, a line each.
static SKIPPED: Mutex<Vec<String>> = Mutex::new(Vec::new());

/// Sets whether a command stops if a recording cannot be used.
pub(super) fn be_strict(strict: bool) {
    STRICT.store(strict, Ordering::Release);
}

/// Opens the usable recordings at a path, in any supported form.
///
/// # Errors
/// If no recording is usable; with `--strict`, if any recording is unusable.
pub(super) fn open(path: &Path, defaults: &Scene) -> Result<Library, Failure> {
    let opened = dataset::open_usable(path, defaults)?;
    skip(path, opened.bad)?;
    Ok(opened.library)
}

/// Runs `work` on the library at `path`. If it fails because recordings cannot be read, runs it
/// again without these recordings.
///
/// # Errors
/// Those of the work; with `--strict`, the recordings that cannot be read.
pub(super) fn work<T>(
    path: &Path,
    library: Library,
    work: impl Fn(&Library) -> Result<T, Failure>,
) -> Result<T, Failure> {
    match work(&library) {
        Ok(done) => Ok(done),
        Err(error) => {
            let (readable, all) = readable(path, library)?;
            if all { Err(error) } else { work(&readable) }
        }
    }
}

/// Reads all recordings of a library, and leaves out those that cannot be read. Returns the rest, and
/// whether all can be read.
///
/// # Errors
/// With `--strict`, if any recording cannot be read.
pub(super) fn readable(path: &Path, mut library: Library) -> Result<(Library, bool), Failure> {
    let all = leave_out(path, &mut library.entries)?;
    library.entries.retain(|entry| !entry.sources.is_empty());
    Ok((library, all))
}

/// Drops sources that cannot be read from the entries of the library at `path`. Returns whether all can
/// be read, so that nothing changed.
///
/// # Errors
/// With `--strict`, if any recording cannot be read.
pub(super) fn leave_out(path: &Path, entries: &mut [Entry]) -> Result<bool, Failure> {
    let unreadable = unreadable(entries);
    for Unreadable { entry, source, .. } in &unreadable {
        entries[*entry].sources.retain(|id| id != source);
    }
    let all = unreadable.is_empty();
    skip(path, unreadable.into_iter().map(|one| one.error).collect())?;
    Ok(all)
}

/// Warns, in one line, that recordings are not used.
///
/// # Errors
/// With `--strict`, if `bad` is not empty; the error names every recording.
pub(super) fn skip(path: &Path, bad: Vec<LibraryError>) -> Done {
    let lines: Vec<String> = bad.iter().map(ToString::to_string).collect();
    if STRICT.load(Ordering::Acquire)
        && let Some(all) = LibraryError::of_all(bad)
    {
        return Err(Failure::Failed(format!(
            "{all}\nrepair or remove them, or go on without them: leave --strict out"
        )));
    }
    let mut skipped = SKIPPED.lock().unwrap_or_else(PoisonError::into_inner);
    // A library may be opened more than once, so only reasons that are not known yet are added.
    let fresh: Vec<String> = lines.into_iter().filter(|why| !skipped.contains(why)).collect();
    if let Some(first) = fresh.first() {
        let all = match fresh.len() {
            1 => format!("not used: {first}"),
            n => {
                let check = show::quoted(path);
                format!("{n} files are not used; `surfaced check {check}` names all: {first}")
            }
        };
        say!("warning: {all}");
    }
    skipped.extend(fresh);
    Ok(())
}

/// The reasons why recordings were skipped, a line each.
pub(super) fn skipped() -> Vec<String> {
    let skipped = SKIPPED.lock().unwrap_or_else(PoisonError::into_inner);
    skipped.iter().map(|why| format!("not used: {why}")).collect()
}

/// The result of a finished command. It is a failure (damaged) if recordings were skipped.
pub(super) fn verdict() -> Done {
    match skipped().len() {
        0 => Ok(()),
        n => Err(Failure::Damaged(format!("done without {}", show::counted(n, "unusable file")))),
    }
}
