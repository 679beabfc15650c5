//! Recordings that cannot be used: a command goes on without them, and ends with code 3; with
//! `--strict` it stops.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use super::{Done, Failure, show};
use crate::dataset;
use crate::library::audit::{self, Unreadable};
use crate::library::{Library, LibraryError};
use crate::scene::Scene;

/// Whether the first recording that cannot be used ends the command.
static STRICT: AtomicBool = AtomicBool::new(false);
/// Why recordings were skipped, a line each.
static SKIPPED: Mutex<Vec<String>> = Mutex::new(Vec::new());

/// Sets whether a recording that cannot be used ends the command.
pub(super) fn be_strict(strict: bool) {
    STRICT.store(strict, Ordering::Release);
}

/// Opens recordings of any form, as far as they can be used.
///
/// # Errors
/// If nothing can be used; with `--strict`, if anything cannot be.
pub(super) fn open(path: &Path, defaults: &Scene) -> Result<Library, Failure> {
    let opened = dataset::open_usable(path, defaults)?;
    skip(path, opened.bad)?;
    Ok(opened.library)
}

/// Does some work with the library at `path`; if that fails because recordings cannot be read, does
/// it again without these.
///
/// # Errors
/// Those of the work; with `--strict`, all recordings that cannot be read.
pub(super) fn work<T>(
    path: &Path,
    library: Library,
    work: impl Fn(&Library) -> Result<T, Failure>,
) -> Result<T, Failure> {
    match work(&library) {
        Ok(done) => Ok(done),
        Err(error) => {
            let (readable, unreadable) = readable(path, library)?;
            if unreadable == 0 { Err(error) } else { work(&readable) }
        }
    }
}

/// The library at `path` without the recordings that cannot be read, found by reading all, and the
/// number of those.
///
/// # Errors
/// With `--strict`, if there are any.
pub(super) fn readable(path: &Path, library: Library) -> Result<(Library, usize), Failure> {
    let unreadable = audit::unreadable(&library.entries);
    let entries = audit::without(library.entries, &unreadable);
    let count = unreadable.len();
    skip(path, unreadable.into_iter().map(|Unreadable { error, .. }| error).collect())?;
    Ok((Library { entries, ..library }, count))
}

/// Warns in one line of recordings that are not used.
///
/// # Errors
/// With `--strict`, if there are any; the error names all.
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
    // A library may be opened more than once.
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

/// The reasons of all recordings that were skipped, a line each.
pub(super) fn skipped() -> Vec<String> {
    let skipped = SKIPPED.lock().unwrap_or_else(PoisonError::into_inner);
    skipped.iter().map(|why| format!("not used: {why}")).collect()
}

/// The result of a command that has done its work: damaged if recordings were skipped.
pub(super) fn verdict() -> Done {
    match skipped().len() {
        0 => Ok(()),
        n => Err(Failure::Damaged(format!("done without {}", show::counted(n, "unusable file")))),
    }
}
