//! Recordings that cannot be used. A command skips them and ends with code 3; with `--strict`, it
//! stops.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

use super::{Done, Failure, show};
use crate::dataset;
use crate::library::{Entry, Library, LibraryError, Unreadable, unreadable};
use crate::outputs::lock;
use crate::scene::Scene;

/// Whether a command stops if a recording cannot be used.
static STRICT: AtomicBool = AtomicBool::new(false);
/// The libraries that were opened, each with why recordings were skipped when it was last opened.
static SKIPPED: Mutex<BTreeMap<PathBuf, Skipped>> = Mutex::new(BTreeMap::new());

/// Recordings of one library that were skipped, a line each.
#[derive(Default)]
struct Skipped {
    now: Vec<String>,
    /// Lines that were said already, since a library may be opened more than once.
    said: BTreeSet<String>,
}

pub(super) fn be_strict(strict: bool) {
    STRICT.store(strict, Ordering::Release);
}

/// Opens the usable recordings at a path, in any supported form. Fails if none is usable; with `--strict`,
/// if any is unusable.
pub(super) fn open(path: &Path, defaults: &Scene) -> Done<Library> {
    let opened = dataset::open_usable(path, defaults)?;
    // Files may have been repaired since the library was last opened.
    lock(&SKIPPED).entry(path.into()).or_default().now.clear();
    skip(path, opened.bad)?;
    Ok(opened.library)
}

/// Runs `work` on the library at `path`. If it fails because recordings cannot be read, runs it again
/// without them, or with `--strict` fails for that reason.
pub(super) fn work<T>(
    path: &Path,
    library: Library,
    work: impl Fn(&Library) -> Done<T>,
) -> Done<T> {
    work(&library).or_else(|error| {
        let (readable, all) = readable(path, library)?;
        if all { Err(error) } else { work(&readable) }
    })
}

/// Reads all recordings of a library, and leaves out those that cannot be read, or with `--strict` fails.
/// Returns the rest, and whether all can be read.
pub(super) fn readable(path: &Path, mut library: Library) -> Done<(Library, bool)> {
    let all = leave_out(path, &mut library.entries)?;
    library.entries.retain(|entry| !entry.sources.is_empty());
    Ok((library, all))
}

/// Drops sources that cannot be read from the entries of the library at `path`, or with `--strict` fails.
/// Returns whether all can be read, so that nothing changed.
pub(super) fn leave_out(path: &Path, entries: &mut [Entry]) -> Done<bool> {
    let unreadable = unreadable(entries);
    for Unreadable { entry, source, .. } in &unreadable {
        entries[*entry].sources.retain(|id| id != source);
    }
    let all = unreadable.is_empty();
    skip(path, unreadable.into_iter().map(|one| one.error).collect())?;
    Ok(all)
}

/// Warns, in one line, that recordings at `path` are not used; `surfaced check` names all of them. With
/// `--strict`, fails if there are any, and names all.
pub(super) fn skip(path: &Path, bad: Vec<LibraryError>) -> Done {
    warn(path, bad, &format!("`surfaced check {}`", show::quoted(path)))
}

/// Like [`skip`], for files that `named_by` names, and not a check of the library at `path`.
pub(super) fn warn(path: &Path, bad: Vec<LibraryError>, named_by: &str) -> Done {
    let lines: Vec<String> = bad.iter().map(ToString::to_string).collect();
    if STRICT.load(Ordering::Acquire)
        && let Some(all) = LibraryError::of_all(bad)
    {
        return Err(Failure::Failed(format!(
            "{all}\nrepair or remove them, or go on without them: leave --strict out"
        )));
    }
    let mut all = lock(&SKIPPED);
    let Skipped { now, said } = all.entry(path.into()).or_default();
    let unknown: Vec<String> = lines.iter().filter(|why| !now.contains(why)).cloned().collect();
    now.extend(unknown);
    let fresh: Vec<String> = lines.into_iter().filter(|why| said.insert(why.clone())).collect();
    if let Some(first) = fresh.first() {
        let all = match fresh.len() {
            1 => format!("not used: {first}"),
            n => format!("{n} files are not used; {named_by} names all: {first}"),
        };
        say!("warning: {all}");
    }
    Ok(())
}

/// Why recordings were skipped when their libraries were last opened, a line each.
pub(super) fn skipped() -> Vec<String> {
    let all = lock(&SKIPPED);
    let lines = all.values().flat_map(|skipped| &skipped.now);
    lines.map(|why| format!("not used: {why}")).collect()
}

/// The result of a finished command. It is a failure (damaged) if recordings were skipped.
pub(super) fn verdict() -> Done {
    match skipped().len() {
        0 => Ok(()),
        n => Err(Failure::Damaged(format!("done without {}", show::counted(n, "unusable file")))),
    }
}
